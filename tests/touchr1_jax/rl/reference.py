"""The objective once more, in NumPy and float64, from logits."""

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]


def log_softmax(logits: np.ndarray) -> Float:
    """log softmax of float64 logits."""
    x = np.asarray(logits, np.float64)
    x = x - x.max(-1, keepdims=True)
    return x - np.log(np.exp(x).sum(-1, keepdims=True))


def of_tokens(log_p: Float, tokens: np.ndarray) -> Float:
    """Entry of each token."""
    out = np.empty(tokens.shape)
    for index in np.ndindex(tokens.shape):
        out[index] = log_p[(*index, tokens[index])]
    return out


def terms(logits, reference, masked, tokens, old, mask, advantage, *, clip: float) -> dict[str, Float]:
    """Surrogate, k3 to the reference and G_tg of each prompt [P]: rollouts' mean of the mean over their tokens.

    Logits are [P, G, T, V], `tokens`, `old` and `mask` [P, G, T], `advantage` [P, G].
    """
    log_p, log_ref, log_masked = log_softmax(logits), log_softmax(reference), log_softmax(masked)
    here = of_tokens(log_p, tokens)
    ratio, a = np.exp(here - old), advantage[..., None]
    log_r = of_tokens(log_ref, tokens) - here
    p = np.exp(log_p)
    kl = np.where(p > 0, p * (log_p - log_masked), 0).sum(-1)
    per_token = {
        "surrogate": np.minimum(ratio * a, np.clip(ratio, 1 - clip, 1 + clip) * a),
        "kl": np.exp(log_r) - 1 - log_r,
        "grounding": kl,
    }
    mean = lambda x: np.array([[x[i, g][mask[i, g]].mean() for g in range(x.shape[1])] for i in range(len(x))]).mean(1)
    with np.errstate(over="ignore", invalid="ignore"):
        return {name: mean(x) for name, x in per_token.items()}


def advantages(reward: np.ndarray, epsilon: float) -> Float:
    """(R − R̄)/(σ + ε) row by row, 0 where all are equal."""
    out = np.zeros(reward.shape)
    for i, row in enumerate(np.asarray(reward, np.float64)):
        if np.ptp(row) > 1e-5:
            out[i] = (row - row.mean()) / (row.std() + epsilon)
    return out


def surrogate(kind: str, log_prob, old, mask, advantage, low: float, high: float) -> dict[str, NDArray]:
    """Value [G, T] of a surrogate, where its clip binds, and d mean_i 1/|o_i| Σ_t value / d log_prob, loop by loop."""
    value, gradient = np.zeros(log_prob.shape), np.zeros(log_prob.shape)
    clipped = np.zeros(log_prob.shape, bool)
    for i, a in enumerate(advantage):
        n = int(mask[i].sum())
        for t in range(log_prob.shape[1]):
            ratio = np.exp(log_prob[i, t] - old[i, t])
            if kind == "sequence":
                ratio = np.exp(sum(log_prob[i, u] - old[i, u] for u in range(n)) / n)
            inside = min(max(ratio, 1 - low), 1 + high)
            share = 1 / (n * len(advantage)) if mask[i, t] else 0.0
            if kind == "cispo":
                value[i, t], clipped[i, t] = inside * a * log_prob[i, t], inside != ratio
                gradient[i, t] += share * inside * a
                continue
            clipped[i, t] = ratio * a > inside * a
            value[i, t] = inside * a if clipped[i, t] else ratio * a
            if not clipped[i, t] and kind == "token":
                gradient[i, t] += share * ratio * a
            if not clipped[i, t] and kind == "sequence":
                gradient[i, :n] += share * ratio * a / n
    return {"value": value, "clipped": clipped, "gradient": gradient}


def loss(algorithm, *, prompts: int, **x: np.ndarray) -> tuple[float, dict[str, NDArray]]:
    """The loss of a micro-batch and its averages, prompt by prompt, under weighted and clipped surrogates of tokens."""
    total, found = 0.0, {"surrogate": [], "kl": [], "grounding": [], "entropy": []}
    for p, weight in enumerate(x["weight"]):
        mask, a = x["mask"][p], x["advantage"][p][:, None]
        ratio = np.exp(x["log_prob"][p] - x["old"][p])
        objective = np.minimum(ratio * a, np.clip(ratio, 1 - algorithm.clip_low, 1 + algorithm.clip_high) * a)
        objective = objective * np.minimum(np.exp(x["old"][p] - x["sampler"][p]), algorithm.importance_cap)
        average = lambda y, mask=mask: (np.where(mask, y, 0).sum(1) / mask.sum(1)).mean()
        surrogate, kl = average(objective), average(x["reference_kl"][p])
        grounding, entropy = average(x["grounding"][p]), average(x["entropy"][p])
        grounded = min(algorithm.gamma * grounding, algorithm.grounding_budget or np.inf)
        explored = algorithm.entropy_weight * min(entropy, algorithm.entropy_floor_nat or np.inf)
        total += weight * surrogate + (grounded - algorithm.beta * kl + explored) / prompts
        for name, value in zip(found, (surrogate, kl, grounding, entropy), strict=True):
            found[name].append(value)
    return -total, {name: np.array(values) for name, values in found.items()}


def nucleus(p: Float, top_p: float, min_p: float) -> NDArray[np.bool_]:
    """Tokens of one distribution that may be drawn, one after the other from the most likely on."""
    kept, together = np.zeros(len(p), bool), 0.0
    for v in np.argsort(-p, kind="stable"):
        if together < top_p and p[v] >= min_p * p.max():
            kept[v] = True
        together += p[v]
    return kept


def drawn(config, log, still, tokens) -> Float:
    """Log-probability of each token among those that may be drawn by the distribution `still`."""
    value = of_tokens(log, tokens)
    for at in np.ndindex(tokens.shape) if config.top_p < 1 or config.min_p > 0 else ():
        kept = nucleus(np.exp(still[at]), config.top_p, config.min_p)
        kept[tokens[at]] = True
        value[at] -= np.log(np.exp(log[at][kept]).sum())
    return value


def drift(algorithm, log_p, still, fixed) -> Float:
    """What score centering subtracts at advantage 1, token by token, 0 without it; `still` has no gradient."""
    found, cap = np.zeros(fixed["tokens"].shape), algorithm.importance_cap or np.inf
    for at in np.ndindex(found.shape) if algorithm.score_centering else ():
        head, p, q = fixed["head"][at], np.exp(still[at]), np.exp(fixed["head_q"][at])
        tail = (1 - q.sum()) / (1 - p[head].sum())
        w = np.ones(len(head)), 1.0
        if cap < np.inf:
            w = np.minimum(p[head] / q, cap), min(1 / tail, cap)
        found[at] = ((q * w[0] - tail * w[1] * p[head]) * log_p[at][head]).sum()
    return found


def concluded(a, log_p, still, fixed) -> tuple[Float, Float, Float]:
    """E_i / n with gradient, the same without, and A_i of the trace, [P, G], where conclusions are enumerated."""

    def outcomes(log, i, j):
        """Probability of each level, and what it earns."""
        at, ids = fixed["at"][i, j], fixed["ids"][i][fixed["ids"][i] >= 0]
        if at == log.shape[-2]:
            return np.ones(1), fixed["sampled"][i, j : j + 1]
        return np.exp(log[i, j, at, ids]), fixed["earns"][i, j, : len(ids)]

    def spread(i, j):
        q, r = outcomes(still, i, j)
        return q @ (r - mean[i, 0]) ** 2 + (1 - q.sum()) * mean[i, 0] ** 2

    p, g = fixed["at"].shape
    each = lambda of: np.array([[of(i, j) for j in range(g)] for i in range(p)])
    value, now = (each(lambda i, j, log=log: np.dot(*outcomes(log, i, j))) for log in (log_p, still))
    mean = now.mean(1, keepdims=True)
    sigma = np.sqrt(each(spread).mean(1, keepdims=True)) + a.epsilon
    n = {"none": 1.0, "std": sigma, "mean": np.maximum(mean, 0.02)}[a.enumerated.value]
    return value / n, now / n, (now - (now.sum(1, keepdims=True) - now) / (g - 1)) / n


def objective(config, own, perturbed, fixed, *, first: bool) -> float:
    """The loss from logits [P, G, T, V] in float64, term by term as published.

    `fixed` are the numbers of `test_reference_gradients.problem`; its `own` and `perturbed` take the place of the
    arguments wherever no gradient may flow.
    """
    a, mask, tokens = config.algorithm, fixed["mask"], fixed["tokens"]
    log_p, log_q, log_ref, still, still_q = (
        log_softmax(x / config.temperature)
        for x in (own, perturbed, fixed["reference"], fixed["own"], fixed["perturbed"])
    )

    here, then = (drawn(config, log, still, tokens) for log in (log_p, still))
    old = then if first else fixed["old"]
    log_c, drawn_length = old - fixed["sampler"], mask.sum(-1)
    if a.mismatch_limit is not None:
        far = (np.abs(log_c) * mask).sum(-1) / drawn_length > a.mismatch_limit
        mask = mask & ~far[..., None]
    length, advantage, trace = np.maximum(mask.sum(-1), 1), fixed["advantage"], mask
    advantage = advantage if advantage.ndim == mask.ndim else advantage[..., None]
    if a.enumerated is not None:
        exact, fixed_exact, of_trace = concluded(a, log_p, still, fixed)
        place, at, advantage = np.arange(mask.shape[-1]), fixed["at"][..., None], of_trace[..., None]
        trace = mask & (place < at)
    if a.importance_sequence:
        log_c = np.broadcast_to((log_c * trace).sum(-1, keepdims=True), log_c.shape)
    c = np.ones_like(here) if a.importance_cap is None else np.minimum(np.exp(log_c), a.importance_cap)
    ratio, low, high = np.exp(here - old), 1 - a.clip_low, 1 + a.clip_high
    if a.surrogate.value == "sequence":
        mean = ((here - old) * trace).sum(-1, keepdims=True) / np.maximum(trace.sum(-1, keepdims=True), 1)
        ratio = np.exp(mean) * np.ones_like(here)
    policy = np.minimum(ratio * advantage, np.clip(ratio, low, high) * advantage)
    if a.surrogate.value == "cispo":
        policy = np.clip(np.exp(then - old), low, high) * advantage * here
    policy = c * policy - advantage * drift(a, log_p, still, fixed)
    log_r = of_tokens(log_ref, tokens) - of_tokens(log_p, tokens)
    p = np.exp(log_p)
    kl = {"k1": -log_r, "k2": log_r**2 / 2, "k3": np.exp(log_r) - 1 - log_r, "exact": (p * (log_p - log_ref)).sum(-1)}
    if a.enumerated is not None:
        weight = c[..., :1] if a.importance_sequence else 1.0
        level = weight * exact[..., None] if a.learn_conclusion else fixed_exact[..., None] - kl[a.kl]
        policy = np.where(place < at, policy, np.where(place == at, level, 0.0))
    grounding = (p * (log_p - (still_q if a.grounding_stop_masked else log_q))).sum(-1)
    grounding = np.minimum(grounding, a.grounding_cap_nat or np.inf)
    sums = lambda x: (x * mask).sum(-1)
    per_rollout = lambda x: (sums(x) / length).mean(-1)
    average = {
        "rollout": per_rollout,
        "token": lambda x: sums(x).sum(-1) / np.maximum(mask.sum((-2, -1)), 1),
        "batch": lambda x: sums(x).mean(-1) / drawn_length.mean(),
        "length": lambda x: sums(x).mean(-1) / config.length,
    }[a.average.value]
    gain = (fixed["weight"] * average(policy)).sum()
    beta = 0.0 if a.kl_in_reward else a.beta
    grounded = np.minimum(a.gamma * per_rollout(grounding), a.grounding_budget or np.inf)
    of_kept = per_rollout(-(p * log_p).sum(-1)) / np.maximum(mask.any(-1).mean(-1), 1e-9)
    entropy = np.minimum(of_kept, a.entropy_floor_nat or np.inf)
    likelihood = of_tokens(log_softmax(own[:, 0]), fixed["answer"]).mean(-1)
    further = grounded - beta * average(kl[a.kl]) + a.entropy_weight * entropy + a.anchor * likelihood
    return -(gain + further.sum() / config.prompts)
