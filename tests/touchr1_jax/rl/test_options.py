"""Options of a step: minibatches, a lagging sampler, a moving reference, KL in the reward, truncated rollouts."""

import dataclasses
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from tests.touchr1_jax import tiny
from tests.touchr1_jax.rl.test_grpo import FNS, FROZEN, P, score
from touchr1_jax.models.lora import LoraConfig, init_adapters
from touchr1_jax.rl.config import (
    Advantage,
    Average,
    GRPOConfig,
    Gspo,
    Norm,
    Paper,
    ReinforcePlusPlus,
    Rloo,
    TactileUse,
    at_precision,
)
from touchr1_jax.rl.enumerated import LevelRewards
from touchr1_jax.rl.gradient import Experience, log_probs
from touchr1_jax.rl.grpo import make_grpo_step, start_state
from touchr1_jax.rl.losses import over_tokens
from touchr1_jax.rl.rollout import SampleConfig, drawn_log_probs, nucleus, sample_group
from touchr1_jax.rl.update import bucketed_gradient, over_minibatches, update_policy

G, T, RATE = 3, 4, 1e-3
CONFIG = GRPOConfig(prompts=P, group=G, length=T, micro_prompts=2, algorithm=Paper(beta=0.0, gamma=0.0))
OPTIMIZER = optax.sgd(RATE)
START = tiny.shallow_params(0)


def of(score=score, **options):
    """Step and first state under an algorithm with some options."""
    config = dataclasses.replace(CONFIG, algorithm=dataclasses.replace(CONFIG.algorithm, **options))
    step = make_grpo_step(FNS, score, OPTIMIZER, config)
    return step, start_state(START, OPTIMIZER, jax.random.key(1), config)


def close(a, b, **tolerance) -> None:
    for x, y in zip(*map(jax.tree.leaves, (a, b)), strict=True):
        np.testing.assert_allclose(x, y, **tolerance)


BATCH = tiny.question_batch(1, P)


@pytest.fixture(scope="module")
def on_policy():
    """The step without options; a state after its first step, and its metrics."""
    step, state = of()
    after, metrics = step(state, BATCH, FROZEN)
    return step, tiny.copy(after), jax.device_get(metrics)


@pytest.fixture(scope="module")
def lagging():
    """Two steps: the sampler is one step behind, the reference moves a quarter, the KL is in the reward."""
    step, state = of(stale=1, reference_every=1, reference_share=0.25, kl_in_reward=True, beta=0.1)
    state = state.replace(reference=tiny.copy(FROZEN.reference))
    states, found = [tiny.copy(state)], []
    for _ in range(2):
        state, metrics = step(state, BATCH, FROZEN)
        states.append(tiny.copy(state))
        found.append(jax.device_get(metrics))
    return states, found


@pytest.mark.long
def test_a_lagging_sampler_draws_with_the_parameters_before_the_last_update(on_policy, lagging):
    """At step 1 it says what the first parameters say there; the learner by then says something else."""
    step, after, _ = on_policy
    states, metrics = lagging
    close(states[1].behind, (states[0].params,), rtol=0)
    close(states[2].behind, (states[1].params,), rtol=0)
    early = start_state(START, OPTIMIZER, jax.random.key(1), CONFIG).replace(step=jnp.int32(1))
    _, expected = step(early, BATCH, FROZEN)
    assert metrics[1]["reward_right"] == expected["reward_right"]
    assert metrics[0]["sampler_gap_peak"] < 1e-4 < metrics[1]["sampler_gap_peak"]
    assert early.behind == after.behind == ()


@pytest.mark.long
def test_without_an_update_in_between_bfloat16_clips_nothing_though_the_sampler_lags():
    """The old log-probabilities are those of the learner's pass with the parameters that sampled."""
    algorithm = Gspo(stale=1, clip_low=1e-5, clip_high=1e-5)
    config = dataclasses.replace(CONFIG, algorithm=algorithm, bfloat16=True)
    state = start_state(START, OPTIMIZER, jax.random.key(1), config)
    _, metrics = make_grpo_step(FNS, score, OPTIMIZER, config)(state, BATCH, FROZEN)
    assert metrics["clip_share"] == 0
    assert metrics["sampler_gap_peak"] > 1e-4


@pytest.mark.long
def test_without_a_lag_the_step_is_on_policy(on_policy):
    """At the first step a lagging sampler has not fallen behind yet."""
    _, after, metrics = on_policy
    step, state = of(stale=2)
    state, found = step(state, BATCH, FROZEN)
    assert len(state.behind) == 2
    assert found["reward"] == metrics["reward"]
    close(state.params, after.params, rtol=1e-4, atol=1e-7)


def test_a_state_without_older_parameters_cannot_lag():
    step, _ = of(stale=1)
    _, state = of()
    with pytest.raises(ValueError, match="stale is 1, but the state holds 0 older parameters; make"):
        step(state, BATCH, FROZEN)


@pytest.mark.long
def test_the_reference_moves_by_its_share(lagging):
    states, _ = lagging
    for before, after in itertools.pairwise(states):
        mix = lambda new, old: 0.25 * np.asarray(new) + 0.75 * np.asarray(old)
        mixed = jax.tree.map(mix, after.params, before.reference)
        close(after.reference, mixed, rtol=1e-6)


def first_kl(state):
    """Rollouts of the first step from a state, and Σ_t log(π/π_ref) of each."""
    draw = SampleConfig(group=G, length=T, end_ids=FNS.end_ids, pad_id=FNS.pad_id)
    sample_key, _ = jax.random.split(jax.random.fold_in(state.key, 0))
    rollout = jax.jit(lambda: sample_group(FNS, START, BATCH, sample_key, draw))()
    log_p, log_ref = (
        jax.jit(lambda p: log_probs(FNS, CONFIG, p, BATCH, rollout))(p) for p in (START, FROZEN.reference)
    )
    kl = np.where(rollout.mask, log_p - log_ref, 0).sum(-1)
    return rollout, kl


@pytest.mark.long
def test_the_kl_in_the_reward_is_a_term_of_it(lagging):
    """−β Σ_t log(π/π_ref) of the rollouts, from log-probabilities of their own; the loss has no KL then."""
    state, metrics = lagging[0][0], lagging[1][0]
    rollout, kl = first_kl(state)
    np.testing.assert_allclose(metrics["reward_kl"], -0.1 * kl.mean(), rtol=1e-4)
    paid = jax.vmap(jax.vmap(lambda o, t: score(o, t)[0], (0, None)))(rollout.tokens, BATCH.target)
    np.testing.assert_allclose(metrics["reward"], metrics["reward_kl"] + np.mean(paid), rtol=1e-4)
    assert not {"kl", "kl_peak", "kl_cost_peak"} & metrics.keys()  # the loss computes none


HALF = jax.tree.map(lambda x: x.astype(jnp.bfloat16), START)
LORA = LoraConfig(rank=2)
ADAPTERS = {"adapters": init_adapters(jax.random.key(0), HALF, LORA)}
ON_HALF = dataclasses.replace(FNS, base=HALF, cache_dtype=jnp.dtype(jnp.bfloat16), lora=LORA)


@pytest.mark.long
@pytest.mark.parametrize(("fns", "start", "bfloat16"), [(FNS, START, True), (ON_HALF, ADAPTERS, False)])
def test_a_sampler_that_rounds_otherwise_is_no_kl_in_the_reward(fns, start, bfloat16):
    """The policy is its reference and all answers earn alike: what bfloat16 rounds would be an advantage of .06.

    Also where only the frozen weights under adapters have 16 bits, as those of released models: from these, the sampler
    of jax 0.12 computes as the learner does.
    """
    config = dataclasses.replace(CONFIG, bfloat16=bfloat16, algorithm=Paper(gamma=0.0, kl_in_reward=True))
    alike = lambda o, t: (jnp.ones(()), {"right": jnp.ones(())}, score(o, t)[2])
    step, state = (
        make_grpo_step(fns, alike, OPTIMIZER, config),
        start_state(start, OPTIMIZER, jax.random.key(1), config),
    )
    _, metrics = step(state, BATCH, FROZEN._replace(reference=at_precision(config, start)))
    assert metrics["sampler_gap"] > 0 or (not bfloat16 and jax.__version_info__ >= (0, 12))
    assert (metrics["reward_kl"], metrics["advantage_peak"]) == (0, 0)


@pytest.mark.long
def test_a_group_that_is_left_out_has_the_mean_kl_of_the_others():
    """Its reward is no number; a statistic over the batch sees the others alone."""
    left_out = np.asarray(BATCH.target.asked[:, 0])
    assert 0 < left_out.sum() < P

    def broken(tokens, target):
        reward, terms, parsed = score(tokens, target)
        return jnp.where(target.asked[0], jnp.nan, reward), terms, parsed

    step, state = of(broken, beta=0.1, kl_in_reward=True)
    _, kl = first_kl(state)
    _, metrics = step(state, BATCH, FROZEN)
    np.testing.assert_allclose(metrics["reward_kl"], -0.1 * kl[~left_out].mean(), rtol=1e-4)
    assert abs(kl.mean() - kl[~left_out].mean()) > 1e-3
    assert metrics["nonfinite_in_kl"] == 0
    broken_reference = jax.tree.map(lambda x: jnp.nan * x, FROZEN.reference)
    _, metrics = step(of()[1], BATCH, FROZEN._replace(reference=broken_reference))
    assert (metrics["nonfinite_in_kl"], metrics["nonfinite_share"]) == (np.mean(~left_out), 1)


CUT_OFF, EQUAL = 3, 6
"""Added to the label of a question: its rollouts are truncated; all are paid the same."""


@pytest.mark.long
def test_truncated_rollouts_are_out_of_the_loss():
    """Where every rollout is cut off nothing is learned, where only one prompt's are, it alone."""

    def by_the_label(tokens, target):
        case = jnp.max(target.label) // 3 * 3
        reward, terms, parsed = score(tokens, target.replace(label=target.label - jnp.where(target.asked, case, 0)))
        return jnp.where(case == EQUAL, 0.5, reward), terms, parsed.replace(truncated=case == CUT_OFF)

    step, _ = of(by_the_label, mask_truncated=True)

    def learn(first, others=0):
        case = jnp.where(jnp.arange(P) == 0, first, others)[:, None]
        target = BATCH.target.replace(label=jnp.where(BATCH.target.asked, BATCH.target.label + case, -1))
        return step(of()[1], BATCH.replace(target=target), FROZEN)

    part, metrics = learn(CUT_OFF)
    close(part.params, learn(EQUAL)[0].params, rtol=1e-5, atol=1e-8)
    assert metrics["grad_norm"] > 0
    assert metrics["truncated_share"] == 0.25
    assert learn(CUT_OFF, CUT_OFF)[1]["grad_norm"] == 0


@pytest.fixture(scope="module")
def learn() -> Experience:
    """Rollouts with advantages of their own, from a sampler whose log-probabilities are off."""
    rng = np.random.default_rng(0)
    draw = SampleConfig(group=G, length=T, end_ids=FNS.end_ids, pad_id=FNS.pad_id)
    rollout = jax.jit(lambda: sample_group(FNS, START, BATCH, jax.random.key(0), draw))()
    off = rollout.replace(log_prob=rollout.log_prob + jnp.asarray(rng.uniform(-0.5, 0.5, (P, G, T)), jnp.float32))
    advantage = jnp.asarray(rng.normal(size=(P, G)), jnp.float32)
    stream = jnp.zeros(P, jnp.int32)
    return Experience(BATCH, BATCH.features.touch, stream, off, off.log_prob, advantage, jnp.full(P, 1 / P))


@pytest.mark.long
def test_a_bucket_holds_the_longest_rollout(learn):
    """Whether the longest rollout has 3 or 4 tokens, a gradient in buckets is that over all tokens."""
    tokens = jnp.arange(T)
    gradient = lambda config: jax.jit(lambda e: bucketed_gradient(FNS, config, START, START, e, first=False))
    whole, cut = gradient(CONFIG), gradient(dataclasses.replace(CONFIG, buckets=(3,)))
    for longest in (3, T):
        mask = jnp.broadcast_to(tokens < jnp.array([1, 2, longest])[:, None], (P, G, T))
        ended = learn._replace(rollout=learn.rollout.replace(mask=mask))
        (grads, parts, old), (expected, values, before) = cut(ended), whole(ended)
        close(grads, expected, rtol=1e-4, atol=1e-6)
        close(parts, values, rtol=1e-4, atol=1e-6)
        close(old[mask], before[mask], rtol=1e-6)


ANCHORED = {"algorithm": Paper(beta=0.0, gamma=0.0, anchor=0.5)}
CONCLUDED = {"algorithm": Rloo(enumerated=Norm.NONE)}


@pytest.mark.long
@pytest.mark.parametrize("change", [ANCHORED, CONCLUDED], ids=["an answer", "the level of a masked rollout"])
def test_a_bucket_holds_all_that_the_loss_reads(learn, change):
    """Rollouts of two tokens fit into the bucket; the answer, or the level of a rollout that is cut off, does not."""
    mask = jnp.broadcast_to(jnp.arange(T) < 2, (P, G, T)).at[0, 0].set(False)
    answer = {"answer": learn.rollout.tokens[:, 0], "answer_mask": jnp.ones((P, T), bool)}
    batch = BATCH.replace(**answer) if change is ANCHORED else BATCH
    at, reward = jnp.ones((P, G), int).at[0, 0].set(T - 1), jnp.tile(jnp.array([1.0, 0.5]), (P, G, 1))
    levels = LevelRewards(ids=jnp.tile(jnp.array([3, 5]), (P, 1)), at=at, reward=reward, sampled=jnp.zeros((P, G)))
    masked = learn._replace(
        batch=batch, rollout=learn.rollout.replace(mask=mask), levels=levels if change is CONCLUDED else None
    )
    whole, cut = (dataclasses.replace(CONFIG, **change, buckets=buckets) for buckets in ((), (2,)))
    gradient = lambda config: jax.jit(lambda e: bucketed_gradient(FNS, config, START, START, e)[0])(masked)
    close(gradient(cut), gradient(whole), rtol=1e-4, atol=1e-6)


@pytest.mark.long
def test_parts_of_several_updates_are_those_of_the_first(learn):
    """But the share of clipped tokens is that of the last, which is off policy at a large rate."""
    optimizer = optax.sgd(30.0)
    state = optimizer.init(START)
    found = []
    for updates in (1, 2):
        config = dataclasses.replace(CONFIG, algorithm=dataclasses.replace(CONFIG.algorithm, updates=updates))
        run = jax.jit(lambda config=config: update_policy(FNS, optimizer, config, START, state, START, learn)[2])
        found.append(run())
    one, two = found
    assert one.pop("clip_share") == 0 < two.pop("clip_share")
    close(two, one, rtol=1e-4, atol=1e-6)


@pytest.mark.long
@pytest.mark.parametrize("minibatches", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_the_trust_region_does_not_count_the_lag_of_the_sampler(learn, minibatches):
    """The learner is far from the parameters that sampled, the update is short."""
    algorithm = dataclasses.replace(CONFIG.algorithm, stale=1, trust_nat=1e-3, minibatches=minibatches)
    optimizer = optax.sgd(1e-6)
    config = dataclasses.replace(CONFIG, algorithm=algorithm)
    parts = jax.jit(lambda: update_policy(FNS, optimizer, config, START, optimizer.init(START), START, learn)[2])()
    assert parts["update_kl"] < 1e-6
    assert parts["update_scale"] == 1


@pytest.mark.long
def test_minibatches_take_a_step_each_and_together_that_of_the_batch(learn):
    """At a small rate two halves move twice as far as the whole; at a large one the second is off policy.

    The mean is that over the tokens of the batch, of which one half has more.
    """
    average = dataclasses.replace(CONFIG.algorithm, average=Average.BATCH)
    batch = dataclasses.replace(CONFIG, algorithm=average)
    halves = dataclasses.replace(CONFIG, algorithm=dataclasses.replace(average, minibatches=2))
    mask = jnp.broadcast_to(jnp.arange(T) < 1 + jnp.arange(P)[:, None, None], (P, G, T))
    learn = learn._replace(rollout=learn.rollout.replace(mask=mask))

    def move(config):
        def run(rate):
            optimizer = optax.sgd(rate)
            params, _, parts = update_policy(FNS, optimizer, config, START, optimizer.init(START), START, learn)
            return jax.tree.map(lambda a, b: (a - b) / rate, params, START), parts

        return jax.jit(run)

    (whole, _), (both, parts), (_, far) = move(batch)(1e-3), move(halves)(1e-3), move(halves)(30.0)
    scale = max(float(np.abs(x).max()) for x in jax.tree.leaves(whole))
    close(jax.tree.map(lambda x: np.asarray(x) / 2, both), whole, atol=0.01 * scale)
    assert parts["clip_share"] == 0
    assert far["clip_share"] > 0
    # how far the sampler is off is no matter of how far the first half's step was
    np.testing.assert_allclose(far["sampler_gap_peak"], parts["sampler_gap_peak"], rtol=1e-3)


def test_a_mean_over_the_tokens_of_the_batch_weighs_prompts_by_them():
    """Of three prompts with 1, 3 and 2 tokens a rollout the last does not count: Σ x / 4 over the other two."""
    mask = jnp.arange(3) < jnp.array([1, 3, 2])[:, None, None]
    weight = over_tokens(jnp.array([0.5, 0.5, 0.0]), mask)
    np.testing.assert_allclose(weight / 2.0, [0.25, 0.25, 0.0])  # of sums over tokens, in units of the mean length, 2
    np.testing.assert_array_equal(over_tokens(jnp.zeros(3), mask), np.zeros(3))


P_BY_HAND = np.array([0.5, 0.3, 0.15, 0.05])


@pytest.mark.parametrize(
    ("top_p", "min_p", "kept"),
    [
        (1.0, 0.0, [True, True, True, True]),
        (0.5, 0.0, [True, False, False, False]),
        (0.6, 0.0, [True, True, False, False]),
        (0.81, 0.0, [True, True, True, False]),
        (1.0, 0.4, [True, True, False, False]),
        (0.81, 0.4, [True, True, False, False]),
    ],
)
def test_nucleus_by_hand(top_p, min_p, kept):
    order = np.array([2, 0, 3, 1])
    log_p = jnp.log(jnp.asarray(P_BY_HAND[order], jnp.float32))
    np.testing.assert_array_equal(nucleus(log_p, top_p, min_p), np.array(kept)[order])
    share = P_BY_HAND[np.array(kept)].sum()
    drawn = drawn_log_probs(log_p, jnp.array(1), top_p, min_p)  # the most likely one
    np.testing.assert_allclose(drawn, np.log(0.5 / share), rtol=1e-5)


@pytest.mark.long
def test_the_learner_scores_what_was_sampled_as_the_sampler_did():
    """At a temperature and from a nucleus; without these settings it would be off by tenths of a nat."""
    config = dataclasses.replace(CONFIG, group=8, temperature=0.7, top_p=0.8, min_p=0.05)
    draw = SampleConfig(
        group=8, length=T, end_ids=FNS.end_ids, pad_id=FNS.pad_id, temperature=0.7, top_p=0.8, min_p=0.05
    )
    rollout = jax.jit(lambda: sample_group(FNS, START, BATCH, jax.random.key(0), draw))()
    gap = lambda config: np.abs(
        np.where(rollout.mask, jax.jit(lambda: log_probs(FNS, config, START, BATCH, rollout))() - rollout.log_prob, 0)
    ).max()
    assert gap(config) < 1e-4
    assert gap(CONFIG) > 0.1


def test_metrics_of_minibatches_count_prompts_and_weigh_streams_by_them():
    """Stream 0 was perturbed in three prompts of the first half, with grounding .2, and in one of the second, .6.

    All rollouts of the second half were cut off and are masked, so that it has neither entropy, KL nor clipped tokens.
    """
    parts = {
        "entropy": [0.5, 0.0],
        "clip_share": [0.1, 0.0],
        "kl": [0.4, 0.0],
        "kept_prompts": [2.0, 0.0],
        "sampler_gap": [0.2, 0.3],
        "drawn_prompts": [1.0, 3.0],
        "grounding_stream_0": [0.2, 0.6],
        "perturbed_stream_0": [3.0, 1.0],
        "loss": [1.0, 2.0],
        "kl_peak": [5.0, 4.0],
    }
    parts |= {"grounding_stream_1": [0.0, 0.0], "perturbed_stream_1": [0.0, 0.0]}
    found = over_minibatches({name: jnp.array(x) for name, x in parts.items()})
    hand = {"grounding_stream_0": 0.3, "perturbed_stream_0": 4, "grounding_stream_1": 0, "perturbed_stream_1": 0}
    hand |= {"entropy": 0.5, "clip_share": 0.1, "kl": 0.4, "kept_prompts": 2, "sampler_gap": 0.275, "drawn_prompts": 4}
    assert found == pytest.approx(hand | {"loss": 1.5, "kl_peak": 5})


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"minibatches": 0}, "minibatches is 0: must be at least 1"),
        ({"stale": -1}, "stale is -1: must be at least 0"),
        ({"reference_share": 0.0, "reference_every": 2}, "reference_share is 0.0: must lie in 0 < share ≤ 1"),
        ({"reference_share": 0.5}, "reference_share is 0.5, but reference_every is None: set it"),
        ({"importance_sequence": True}, "importance_sequence is True, but importance_cap is None: set it"),
        ({"grounding_cap_nat": 1.0, "gamma": 0.0}, "grounding_cap_nat is 1.0, but gamma is 0.0: set it or drop"),
        ({"grounding_budget": 0.05, "gamma": 0.0}, "grounding_budget is 0.05, but gamma is 0.0: set it or drop"),
        ({"entropy_floor_nat": 0.1}, "entropy_floor_nat is 0.1, but entropy_weight is 0.0: set it or drop"),
        ({"tactile_margin": 0.2}, "tactile_margin is 0.2, but tactile_use is TactileUse.OFF: set it or drop"),
        ({"tactile_weight": 0.5}, "tactile_weight is 0.5, but tactile_use is TactileUse.OFF: set it or drop"),
        ({"controls": 8}, "controls is 8, but tactile_use is TactileUse.OFF: set it or drop controls"),
        ({"kl_in_reward": True, "beta": 0.0}, "kl_in_reward is True, but beta is 0.0: set it or drop kl_in_reward"),
        ({"reference_every": 3, "beta": 0.0}, "reference_every is 3, but beta is 0.0: set it or drop reference_every"),
        (
            {"grounding_stop_masked": True, "gamma": 0.0},
            "grounding_stop_masked is True, but gamma is 0.0: set it or drop",
        ),
        ({"kl_in_reward": True, "advantage": Advantage.PER_REWARD}, "kl_in_reward is True: must go .* takes beta away"),
        (
            {"tactile_use": TactileUse.LITERAL, "advantage": Advantage.PER_REWARD},
            "tactile_use is .*LITERAL: must go for PER_REWARD, whose σ takes tactile_weight away",
        ),
    ],
)
def test_bad_options_are_named(change, message):
    with pytest.raises(ValueError, match=message):
        Paper(**change)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"temperature": 0.0}, "temperature is 0.0"),
        ({"temperature": 1e8}, "temperature is 100000000.0: must lie in 1e-06 … 1000000.0"),  # would draw banned tokens
        ({"top_p": 0.0}, "top_p is 0.0"),
        ({"min_p": 1.5}, "min_p is 1.5"),
        ({"group": 1, "algorithm": ReinforcePlusPlus(enumerated=Norm.NONE)}, "group is 1: must be at least 2"),
        ({"algorithm": Paper(minibatches=3)}, "micro_prompts 4 of each of 3 minibatches must divide prompts 8"),
    ],
)
def test_bad_settings_of_a_step_are_named(change, message):
    with pytest.raises(ValueError, match=message):
        GRPOConfig(**change)
