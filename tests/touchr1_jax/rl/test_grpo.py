"""The whole step: against a float64 reference, without compilation, and as a program that is traced once."""

import contextlib
import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from tests.touchr1_jax import tiny
from tests.touchr1_jax.rl import reference
from touchr1_jax.rl.config import GRPOConfig, Paper
from touchr1_jax.rl.counterfactual import mask_one_stream
from touchr1_jax.rl.grpo import FrozenInputs, GRPOState, make_grpo_step
from touchr1_jax.rl.rollout import SampleConfig, sample_group
from touchr1_jax.types import SAMPLE, Parsed, Target

P, G, T, K = 4, 3, 4, 3
FNS = tiny.SHALLOW
ALGORITHM = Paper(beta=0.1, gamma=0.05, drop_degenerate=True)
CONFIG = GRPOConfig(prompts=P, group=G, length=T, micro_prompts=2, algorithm=ALGORITHM)
DRAW = SampleConfig(group=G, length=T, end_ids=FNS.end_ids, pad_id=FNS.pad_id)
FROZEN = FrozenInputs(
    reference=tiny.shallow_params(1),
    noise=jnp.asarray(
        np.random.default_rng(5).normal(size=(K, tiny.S, tiny.N, tiny.CONFIG.decoder.hidden_size)), jnp.float32
    ),
)
LEARNING_RATE = 0.05
OPTIMIZER = optax.sgd(LEARNING_RATE)


def score(tokens: jax.Array, target: Target) -> tuple[jax.Array, dict[str, jax.Array], Parsed]:
    """Share of tokens that are the label modulo 3; the material question pays everybody the same."""
    label = jnp.max(target.label)
    right = jnp.mean(tokens % 3 == label)
    reward = jnp.where(target.asked[3], 0.4, right)
    level = jnp.where(target.asked, tokens[0] % 3, -1)
    parsed = Parsed(
        perceive=jnp.tile(level, (tiny.S, 1)),
        compare=level,
        conclude=level,
        formatted=tokens[0] > 20,
        truncated=jnp.all(tokens != 1),
        length=jnp.sum(tokens > 1),
    )
    return reward, {"right": right}, parsed


def state(seed: int = 0) -> GRPOState:
    """A fresh state on buffers of its own, since the step takes them over."""
    params = tiny.copy(tiny.shallow_params(0))
    return GRPOState(params=params, opt_state=OPTIMIZER.init(params), step=jnp.int32(0), key=jax.random.key(seed))


class Run:
    """Three steps on different batches, with the parameters before each."""

    def __init__(self) -> None:
        self.traces = 0

        def counted(tokens: jax.Array, target: Target):
            self.traces += 1
            return score(tokens, target)

        self.step = make_grpo_step(FNS, counted, OPTIMIZER, CONFIG)
        self.batches = [tiny.question_batch(seed, P) for seed in (1, 2, 2)]
        self.before, self.metrics = [], []
        now = state()
        for batch in self.batches:
            self.before.append(tiny.copy(now))
            now, metrics = self.step(now, batch, FROZEN)
            self.metrics.append(metrics)
        self.end = now


@pytest.fixture(scope="module")
def run() -> Run:
    """One run, and one program, for all tests."""
    return Run()


@pytest.mark.long
def test_no_nan_under_debug_nans(run):
    """`debug_nans` looks at every array that leaves the program."""
    with jax.debug_nans(True):
        run.step(tiny.copy(run.before[0]), run.batches[0], FROZEN)


draw = jax.jit(lambda p, b, k: sample_group(FNS, p, b, k, DRAW))


def experience_of(before: GRPOState, batch):
    """Rollouts and masked touch of a step, by the documented use of its key: fold in the step, split for each."""
    sample_key, mask_key = jax.random.split(jax.random.fold_in(before.key, before.step))
    return draw(before.params, batch, sample_key), mask_one_stream(batch.features, FROZEN.noise, mask_key)[0]


group_logits = jax.jit(jax.vmap(FNS.group_logits, in_axes=(None, 0, 0, 0, 0)))


@pytest.mark.long
@pytest.mark.parametrize("i", [0, 1])
def test_loss_equals_a_float64_reference(run, i):
    """Surrogate over the groups that differ − β k3 + γ G_tg over all; the step index is in the key."""
    before, batch = run.before[i], run.batches[i]
    rollout, masked_touch = experience_of(before, batch)
    reward = np.asarray(jax.vmap(jax.vmap(lambda o, t: score(o, t)[0], (0, None)))(rollout.tokens, batch.target))
    logits = [
        np.asarray(group_logits(p, f, batch.ids, batch.mask, rollout.tokens))
        for p, f in [
            (before.params, batch.features),
            (FROZEN.reference, batch.features),
            (before.params, batch.features.replace(touch=masked_touch)),
        ]
    ]
    rollout = jax.tree.map(np.asarray, rollout)
    advantage = reference.advantages(reward, ALGORITHM.epsilon)
    terms = reference.terms(*logits, rollout.tokens, rollout.log_prob, rollout.mask, advantage, clip=0.2)
    lively = np.ptp(reward, axis=1) > 1e-5
    assert lively.sum() >= 2
    assert not lively[3]
    gain = (
        terms["surrogate"][lively].mean() + (ALGORITHM.gamma * terms["grounding"] - ALGORITHM.beta * terms["kl"]).mean()
    )
    np.testing.assert_allclose(run.metrics[i]["loss"], -gain, rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(run.metrics[i]["reward"], reward.mean(), rtol=1e-5)
    np.testing.assert_allclose(run.metrics[i]["degenerate_share"], 1 - lively.mean(), rtol=1e-6)


@pytest.mark.long
def test_update_is_the_gradient_of_the_written_out_objective(run):
    """On policy the surrogate's value says nothing (advantages sum to 0), so the update is held to its gradient."""
    before, batch = run.before[0], run.batches[0]
    rollout, masked_touch = experience_of(before, batch)
    tokens, mask = rollout.tokens, rollout.mask
    reward = np.asarray(jax.vmap(jax.vmap(lambda o, t: score(o, t)[0], (0, None)))(tokens, batch.target))
    lively = np.ptp(reward, axis=1) > 1e-5
    advantage = jnp.asarray(reference.advantages(reward, ALGORITHM.epsilon))[..., None]
    per_prompt = lambda x: jnp.mean(jnp.sum(jnp.where(mask, x, 0), -1) / jnp.sum(mask, -1), -1)

    def objective(params):
        log_p = jax.nn.log_softmax(group_logits(params, batch.features, batch.ids, batch.mask, tokens))
        perturbed = batch.features.replace(touch=masked_touch)
        log_masked = jax.nn.log_softmax(group_logits(params, perturbed, batch.ids, batch.mask, tokens))
        log_ref = jax.nn.log_softmax(group_logits(FROZEN.reference, batch.features, batch.ids, batch.mask, tokens))
        here, there = (jnp.take_along_axis(x, tokens[..., None], -1)[..., 0] for x in (log_p, log_ref))
        log_r = jnp.where(mask, there - here, 0)
        learn = jnp.sum(per_prompt(advantage * here) * lively) / lively.sum()
        grounding = per_prompt(jnp.sum(jnp.exp(log_p) * (log_p - log_masked), -1))
        k3 = per_prompt(jnp.exp(log_r) - 1 - log_r)
        return learn + jnp.mean(ALGORITHM.gamma * grounding - ALGORITHM.beta * k3)

    ascent = jax.jit(jax.grad(objective))(before.params)
    for g, a, b in zip(*map(jax.tree.leaves, (ascent, before.params, run.before[1].params)), strict=True):
        np.testing.assert_allclose(b - a, LEARNING_RATE * g, rtol=1e-3, atol=2e-7)


def test_one_trace_serves_all_batches(run):
    assert run.traces == 1
    assert run.step._cache_size() == 1


def test_nothing_leaves_the_device_inside_a_step(run):
    batch = jax.tree.map(jnp.asarray, tiny.question_batch(4, P))
    with jax.transfer_guard("disallow"):
        now, metrics = run.step(tiny.copy(run.end), batch, FROZEN)
    assert int(now.step) == 4
    assert all(isinstance(value, jax.Array) for value in metrics.values())
    host = jax.tree.map(np.asarray, batch)
    with jax.transfer_guard("disallow"), pytest.raises(Exception, match="Disallowed host-to-device transfer"):
        run.step(jax.tree.map(lambda x: x, now), host, FROZEN)  # the guard has teeth


def test_state_advances_and_its_key_stays(run):
    assert int(run.end.step) == 3
    assert run.end.key == run.before[0].key
    moved = [
        bool((a != b).any()) for a, b in zip(*map(jax.tree.leaves, (run.end.params, run.before[0].params)), strict=True)
    ]
    assert all(moved)


@pytest.mark.long
def test_steps_draw_afresh(run):
    """The same batch at steps 1 and 2."""
    one, two = (experience_of(run.before[i], run.batches[i])[0].tokens for i in (1, 2))
    assert (one != two).any()


def test_state_is_donated_and_nothing_else(run):
    now = tiny.copy(run.before[0])
    run.step(now, run.batches[0], FROZEN)
    assert all(leaf.is_deleted() for leaf in jax.tree.leaves(now))
    assert not any(leaf.is_deleted() for leaf in jax.tree.leaves((run.batches[0], FROZEN)))


def test_metrics_are_finite_scalars(run):
    for metrics in run.metrics:
        for name, value in metrics.items():
            assert value.shape == (), name
            assert np.isfinite(value), name
    expected = {"loss", "surrogate", "kl", "grounding", "entropy", "clip_share", "reward", "reward_right", "grad_norm"}
    assert expected <= set(run.metrics[0])


def test_grounding_of_every_stream_is_logged(run):
    for metrics in run.metrics:
        assert sum(metrics[f"perturbed_stream_{s}"] for s in range(tiny.S)) == P
        present = [s for s in range(tiny.S) if metrics[f"perturbed_stream_{s}"]]
        assert all(metrics[f"grounding_stream_{s}"] > 1e-3 for s in present)


def test_surrogate_is_on_policy(run):
    """Sampler and learner agree: no token is clipped at the first update, and the mean advantage of each group is 0."""
    assert all(metrics["clip_share"] == 0 for metrics in run.metrics)


def assert_first_step(run, end: GRPOState, metrics: dict[str, jax.Array]) -> None:
    """A first step by other means came to the same."""
    for name, value in run.metrics[0].items():
        np.testing.assert_allclose(value, metrics[name], rtol=1e-4, atol=1e-6, err_msg=name)
    for a, b in zip(*map(jax.tree.leaves, (end.params, run.before[1].params)), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-5)


@pytest.mark.slow
def test_uncompiled_step_is_the_compiled_one(run):
    """Operation by operation, loops in Python, and no operation anywhere gives NaN."""
    with jax.disable_jit(), jax.debug_nans(True):
        end, metrics = make_grpo_step(FNS, score, OPTIMIZER, CONFIG)(state(), run.batches[0], FROZEN)
    assert_first_step(run, end, metrics)


@pytest.mark.long
def test_weights_are_gathered_for_the_sampler_and_not_for_the_learner(run):
    """A gather that returns zeros makes the sampler uniform; the learner's weights, and its gradient, stay."""
    gathered = []

    def zeros(params):
        gathered.append(jax.tree.structure(params))
        return jax.tree.map(jnp.zeros_like, params)

    step = make_grpo_step(FNS, score, OPTIMIZER, CONFIG, gather=zeros, sampled=True)
    _, metrics = step(state(), run.batches[0], FROZEN)
    assert gathered == [jax.tree.structure(run.before[0].params)]
    assert metrics["grad_norm"] > 0
    sample, target = metrics[SAMPLE], run.batches[0].target
    np.testing.assert_array_equal(sample.asked, target.asked[0])
    np.testing.assert_array_equal(sample.label, target.label[0])
    expected, _, _ = score(sample.tokens, jax.tree.map(lambda x: x[0], target))
    np.testing.assert_allclose(sample.reward, expected, rtol=1e-6)


def test_lean_compilation_needs_a_jax_that_has_it():
    old = jax.__version_info__ < (0, 11)
    expected = contextlib.nullcontext() if old else pytest.raises(ValueError, match="has one code generator only")
    with expected:
        make_grpo_step(FNS, score, OPTIMIZER, dataclasses.replace(CONFIG, lean_compilation=True))
