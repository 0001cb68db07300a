"""Enumerated conclusions: values by hand, the gradient against a float64 one, and whole steps."""

import dataclasses
import itertools
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from tests.touchr1_jax import tiny
from tests.touchr1_jax.rl.test_grpo import FNS, FROZEN, P, score
from touchr1_jax.models.touch_policy import TouchConfig, TouchPolicy
from touchr1_jax.rewards import make_rewards, uniform_prior
from touchr1_jax.rl.config import Average, Cispo, Dapo, GRPOConfig, Gspo, Norm, Paper, Rloo, TactileUse
from touchr1_jax.rl.enumerated import (
    LevelRewards,
    all_equal,
    before_level,
    conclude_exactly,
    conclusion_place,
    exact_terms,
    expected_of_kept,
    level_rewards,
)
from touchr1_jax.rl.grpo import Group, GRPOEngine, make_grpo_step, start_state
from touchr1_jax.rl.losses import TokenTerms, grpo_loss
from touchr1_jax.rl.scoring import make_score
from touchr1_jax.text.constraint import compile_constraint
from touchr1_jax.text.parser import compile_parser
from touchr1_jax.text.template import level_tokens

PARSER = compile_parser(tiny.LANGUAGE, tiny.TOKENIZER)
LEVELS = level_tokens(tiny.LANGUAGE, tiny.TOKENIZER)
PROBABILITY = jnp.array([[0.5, 0.25], [0.0, 0.5]])  # of two levels after two traces; the rest is other words
REWARD = jnp.array([[1.0, 0.0], [1.0, 0.4]])


def terms(norm: Norm, states=(True, True), sampled=(0.0, 0.0)):
    return exact_terms(norm, jnp.log(PROBABILITY), REWARD, jnp.array(states), jnp.array(sampled), epsilon=0.0)


@pytest.mark.parametrize(
    ("norm", "n"),
    [
        (Norm.NONE, 1.0),
        # Ē = .35: (.5 · .65² + .25 · .35² + .25 · .35² + .5 · .05² + .5 · .35²) / 2
        (Norm.STD, np.sqrt((0.5 * 0.65**2 + 0.5 * 0.35**2 + 0.5 * 0.05**2 + 0.5 * 0.35**2) / 2)),
        (Norm.MEAN, 0.35),
    ],
)
def test_expected_rewards_and_advantages_by_hand(norm, n):
    found = terms(norm)
    np.testing.assert_allclose(found.expected, [0.5, 0.2], rtol=1e-6)
    np.testing.assert_allclose(found.advantage, np.array([0.3, -0.3]) / n, rtol=1e-5)
    np.testing.assert_allclose(found.objective, np.array([0.5, 0.2]) / n, rtol=1e-5)


def test_a_trace_without_conclusion_keeps_its_sampled_reward():
    found = terms(Norm.NONE, states=(True, False), sampled=(9.0, 0.1))
    np.testing.assert_allclose(found.expected, [0.5, 0.1], rtol=1e-6)
    np.testing.assert_allclose(found.advantage, [0.4, -0.4], rtol=1e-6)
    spread = np.sqrt(((0.5 * 0.7**2 + 0.5 * 0.3**2) + 0.2**2) / 2)
    np.testing.assert_allclose(
        terms(Norm.STD, states=(True, False), sampled=(9.0, 0.1)).advantage, [0.4 / spread, -0.4 / spread], rtol=1e-5
    )


@pytest.mark.parametrize("reward", [0.0, 0.4])
def test_a_group_that_earns_the_same_has_no_advantage_without_an_epsilon_either(reward):
    """E_i of equal rewards differ by rounding, which σ of them would make advantages of 2."""
    log_p = jax.nn.log_softmax(jnp.asarray(np.random.default_rng(0).normal(0, 2, (50, 8, 3)), jnp.float32))
    states, sampled = jnp.ones((50, 8), bool), jnp.zeros((50, 8))
    found = exact_terms(Norm.STD, log_p, jnp.full((50, 8, 3), reward), states, sampled, epsilon=0.0)
    np.testing.assert_allclose(found.advantage, 0, atol=5e-3)


def test_the_expected_reward_of_a_step_is_of_the_groups_that_stay():
    parts = {"expected_reward": jnp.array(0.2), "loss": jnp.array(0.2)}
    of = lambda *finite: {name: float(x) for name, x in expected_of_kept(parts, jnp.array(finite)).items()}
    assert of(True, False) == {"expected_reward": pytest.approx(0.4), "loss": pytest.approx(0.2)}
    assert of(True, True) == {"expected_reward": pytest.approx(0.2), "loss": pytest.approx(0.2)}
    assert np.isfinite(of(False, False)["expected_reward"])


def test_a_group_of_one_has_no_advantage_and_a_tiny_mean_is_bounded():
    one = exact_terms(Norm.MEAN, jnp.log(jnp.array([[0.01]])), jnp.array([[1.0]]), jnp.array([True]), jnp.zeros(1))
    np.testing.assert_allclose(one.advantage, [0.0])
    np.testing.assert_allclose(one.objective, [0.5], rtol=1e-6)  # .01 / .02


def test_the_level_takes_the_place_of_its_token_and_what_follows_counts_nothing():
    objective = jnp.arange(1.0, 9.0).reshape(2, 4)
    found = conclude_exactly(objective, jnp.array([[0.5], [0.7]]), jnp.array([2, 4]))
    np.testing.assert_allclose(found, [[1, 2, 0.5, 0], [5, 6, 7, 8]])
    mask = jnp.array([[True, True, True, True], [True, True, False, False]])
    expected = [[True, True, False, False], [True, True, False, False]]
    np.testing.assert_array_equal(before_level(mask, jnp.array([2, 4])), expected)


TRACE = np.array([0.3, -0.5])  # logits of two traces
LEVEL = np.array([[0.2, -0.1, 0.6], [-0.4, 0.9, 0.0]])  # logits of three levels after each
EARNS = np.array([[1.0, 0.4, 0.0], [0.0, 1.0, 0.3]])
REFERENCE = np.array([[0.5, 0.3, 0.2], [0.1, 0.2, 0.7]])  # probabilities of the levels


def softmax(x: np.ndarray) -> np.ndarray:
    return np.exp(x) / np.exp(x).sum(-1, keepdims=True)


def true_gradient() -> tuple[np.ndarray, np.ndarray]:
    """Central differences of Σ_trace π(trace) Σ_k p_k r_k, float64."""
    flat = np.concatenate([TRACE, LEVEL.ravel()])
    value = lambda x: softmax(x[:2]) @ (softmax(x[2:].reshape(2, 3)) * EARNS).sum(-1)
    h = 1e-6 * np.eye(len(flat))
    slope = np.array([(value(flat + e) - value(flat - e)) / 2e-6 for e in h])
    return slope[:2], slope[2:].reshape(2, 3)


def gradient_to_reference() -> np.ndarray:
    """Of −Σ_trace π(trace) KL(p ‖ reference): −π p_k (log p_k/q_k − KL)."""
    p = softmax(LEVEL)
    ratio = np.log(p / REFERENCE)
    return -softmax(TRACE)[:, None] * p * (ratio - (p * ratio).sum(-1, keepdims=True))


ALGORITHMS = (
    Rloo(enumerated=Norm.NONE),
    Dapo(enumerated=Norm.NONE, average=Average.LENGTH),
    Cispo(enumerated=Norm.NONE, average=Average.LENGTH),
    Rloo(enumerated=Norm.NONE, learn_conclusion=False),
)


@pytest.mark.long
@pytest.mark.parametrize("algorithm", ALGORITHMS, ids=lambda a: f"{type(a).__name__}, {a.learn_conclusion}")
def test_mean_gradient_over_all_groups_is_that_of_the_expected_reward(algorithm):
    """A policy of two traces, one token each, and three levels; every group of two traces by its probability.

    Where the conclusion is not learned, the levels follow the reference, and the gradient of the traces is the same.
    """
    config = GRPOConfig(prompts=1, micro_prompts=1, group=2, length=2, algorithm=algorithm)

    def loss(trace_logits, level_logits, drawn):
        log_trace, log_level = jax.nn.log_softmax(trace_logits), jax.nn.log_softmax(level_logits)
        log_prob = jnp.stack([log_trace[drawn], log_level[drawn, 0]], -1)[None]
        nothing = jnp.zeros_like(log_prob)
        kl = jnp.sum(jnp.exp(log_level) * (log_level - jnp.log(REFERENCE)), -1)[drawn]
        found = TokenTerms(log_prob, nothing.at[..., 1].set(kl), nothing, nothing, log_level[drawn][None])
        earns, at = jnp.asarray(EARNS)[drawn][None], jnp.ones((1, 2), int)
        levels = LevelRewards(ids=jnp.arange(3)[None], at=at, reward=earns, sampled=nothing[..., 0])
        old = jax.lax.stop_gradient(log_prob)
        mask, a, w = jnp.ones(old.shape, bool), jnp.full((1, 2), jnp.nan), jnp.ones(1)
        return grpo_loss(found, old, old, mask, a, w, config, levels=levels)[0]

    grad = jax.jit(jax.grad(loss, argnums=(0, 1)))
    total = [np.zeros(2), np.zeros((2, 3))]
    for pair in itertools.product(range(2), repeat=2):
        chance = np.prod(softmax(TRACE)[list(pair)])
        for sum_, g in zip(total, grad(TRACE, LEVEL, np.array(pair)), strict=True):
            sum_ -= config.length * chance * np.asarray(g, float)
    of_trace, of_level = true_gradient()
    of_level = of_level if algorithm.learn_conclusion else gradient_to_reference()
    for found, exact in zip(total, (of_trace, of_level), strict=True):
        np.testing.assert_allclose(found, exact, atol=2e-6)


SAMPLER = np.array([-0.4, 0.6])  # logits of the traces under a sampler that differs, as do its levels


@pytest.mark.parametrize("norm_of", [Average.LENGTH, Average.ROLLOUT])
def test_weights_of_rollouts_make_up_for_a_sampler_that_draws_other_traces(norm_of):
    """Groups by the sampler's probability, the level of a rollout at its own: the gradient is still the policy's."""
    algorithm = Rloo(enumerated=Norm.NONE, average=norm_of, importance_cap=1e6, importance_sequence=True)
    config = GRPOConfig(prompts=1, micro_prompts=1, group=2, length=2, algorithm=algorithm)
    log_q = np.log(np.stack([softmax(SAMPLER), [0.1, 0.7]], -1))  # of a trace, and of the level that was drawn after it

    def loss(level_logits, drawn):
        log_trace, log_level = jax.nn.log_softmax(jnp.asarray(TRACE)), jax.nn.log_softmax(level_logits)
        log_prob = jnp.stack([log_trace[drawn], log_level[drawn, 0]], -1)[None]
        nothing = jnp.zeros_like(log_prob)
        found = TokenTerms(log_prob, nothing, nothing, nothing, log_level[drawn][None])
        earns, at = jnp.asarray(EARNS)[drawn][None], jnp.ones((1, 2), int)
        levels = LevelRewards(ids=jnp.arange(3)[None], at=at, reward=earns, sampled=nothing[..., 0])
        arrays = jax.lax.stop_gradient(log_prob), jnp.asarray(log_q, jnp.float32)[drawn][None]
        rest = jnp.ones((1, 2, 2), bool), jnp.full((1, 2), jnp.nan), jnp.ones(1)
        return grpo_loss(found, *arrays, *rest, config, levels=levels)[0]

    grad, total = jax.jit(jax.grad(loss)), np.zeros((2, 3))
    for pair in itertools.product(range(2), repeat=2):
        total -= config.length * np.prod(softmax(SAMPLER)[list(pair)]) * np.asarray(grad(LEVEL, np.array(pair)), float)
    np.testing.assert_allclose(total, true_gradient()[1], atol=2e-6)


@pytest.mark.parametrize("learned", [True, False])
def test_only_tokens_of_the_trace_count_as_clipped(learned):
    """All ratios are e; of the two traces the first is the better one, and its third token is the level."""
    config = GRPOConfig(
        prompts=1,
        micro_prompts=1,
        group=2,
        length=4,
        algorithm=Paper(enumerated=Norm.NONE, learn_conclusion=learned, beta=0.0, gamma=0.0),
    )
    log_p, old, exists = jnp.zeros((1, 2, 4)), jnp.full((1, 2, 4), -1.0), jnp.ones((1, 2, 4), bool)
    at, zero = jnp.full((1, 2), 2), jnp.zeros((1, 2))
    levels = LevelRewards(ids=jnp.arange(2)[None], at=at, reward=REWARD[None], sampled=zero)
    found = TokenTerms(log_p, log_p, log_p, log_p, jnp.log(PROBABILITY)[None])
    run = jax.jit(lambda old: grpo_loss(found, old, old, exists, zero, jnp.ones(1), config, levels=levels)[1])
    np.testing.assert_allclose(run(old)["clip_share"], 0.25)


def test_the_conclusion_begins_after_its_only_tag():
    tokens = jnp.array([[5, 7, 1, 2], [5, 1, 2, 7], [5, 1, 2, 3], [7, 1, 7, 2]])
    np.testing.assert_array_equal(conclusion_place(tokens, 7), [2, 4, 4, 4])


def test_levels_of_several_tokens_are_refused():
    by_letter = dataclasses.replace(tiny.TOKENIZER, encoder=lambda text: [ord(c) for c in text])
    policy = TouchPolicy(
        model=TouchConfig(), language=tiny.LANGUAGE, tokenizer=by_letter, layout=tiny.LAYOUT, fns=FNS, parser=PARSER
    )
    with pytest.raises(ValueError, match="several tokens"):
        assert policy.level_tokens


@pytest.fixture(scope="module")
def rewards():
    """Of an answer that concludes "firm" and one that is cut off, for a question about hardness and one of all."""
    text = "<perceive> xense soft </perceive> <compare> hard </compare> <conclude> firm </conclude>"
    ids = [*tiny.TOKENIZER.encode(text), tiny.TOKENIZER.end_ids[0]]
    tokens = jnp.asarray([ids, [*ids[:6], *[tiny.TOKENIZER.pad_id] * (len(ids) - 6)]])
    target = tiny.target(np.zeros(2, int), np.array([2, 2]))
    target = target.replace(asked=target.asked.at[1].set(True))
    worth = make_score(PARSER, make_rewards(uniform_prior((3, 3, 3, 9))), {"accuracy": 1.0})
    each = jax.vmap(jax.vmap(worth, in_axes=(0, None), axis_name="group"))
    reward_of = lambda tokens, level: each(tokens, target)[0]
    both = jnp.stack([tokens, tokens])
    sampled, counts = jnp.full((2, 2), 0.25), jnp.ones(2, bool)
    return jax.jit(lambda both: level_rewards(reward_of, LEVELS, both, target, sampled, counts))(both)[0]


@pytest.mark.long
def test_rewards_of_every_conclusion_by_hand(rewards):
    """Label "hard": ordinal credit 0, .4, 1; the levels that hardness lacks earn 0, and a cut answer states none."""
    np.testing.assert_allclose(rewards.reward[0, 0], [0, 0.4, 1, *[0] * 6], atol=1e-6)
    assert rewards.at[0, 0] == 8
    length = 11
    assert rewards.at[0, 1] == length
    np.testing.assert_array_equal(rewards.at[1], [length, length])  # a question about everything is not enumerated
    assert list(rewards.ids[0]) == list(LEVELS.level[0])


def test_a_level_that_nobody_said_and_whose_reward_is_nan_costs_its_group():
    """Two questions; every answer says the first level.  For the second question another level earns NaN; rewards are
    of 16 bits, in which the square of 300 is infinite."""
    opens, first = LEVELS.opens, int(LEVELS.level[0][0])
    tokens = jnp.broadcast_to(jnp.array([opens, first]), (2, 2, 2))
    target = tiny.target(np.zeros(2, int), np.array([2, 2]))
    broken = lambda tokens, level: jnp.where(
        (level == 1) & (jnp.arange(2) == 1)[:, None], jnp.nan, jnp.full((2, 2), 300, jnp.float16)
    )
    sampled, counts = jnp.ones((2, 2)), jnp.ones(2, bool)
    found, finite, shares = level_rewards(broken, LEVELS, tokens, target, sampled, counts)
    np.testing.assert_array_equal(finite, [True, False])
    assert shares == {"nonfinite_in_levels": 0.5}
    np.testing.assert_array_equal(found.ids, [LEVELS.level[0]] * 2)
    np.testing.assert_allclose(found.reward[0, 0, :3], 300)
    np.testing.assert_allclose(found.reward[1], 0)
    np.testing.assert_allclose(found.sampled, [[1, 1], [0, 0]])


@pytest.mark.long
def test_a_group_that_is_left_out_teaches_its_traces_nothing():
    """Some answers conclude and some do not: the first have expected reward 0, the others the mean of other groups."""
    config = GRPOConfig(prompts=P, micro_prompts=P, group=3, length=4, algorithm=Rloo(enumerated=Norm.NONE))
    engine = GRPOEngine(FNS, score, optax.sgd(0.1), config, None, lambda p: p, LEVELS, False)
    batch = tiny.question_batch(1, P)
    finite = jnp.arange(P) > 0
    nothing = jnp.zeros((P, 3))
    at = jnp.ones((P, 3), int)
    levels = LevelRewards(ids=jnp.zeros((P, 1), int), at=at, reward=nothing[..., None], sampled=nothing)
    rollout = SimpleNamespace(mask=jnp.ones((P, 3, 4), bool), log_prob=jnp.zeros((P, 3, 4)))
    parsed = SimpleNamespace(truncated=jnp.zeros((P, 3), bool))
    group = Group(batch, rollout, parsed, nothing, {}, finite, nothing, levels)
    weight = engine.experience(group, (batch.features.touch, jnp.zeros(P, int))).weight
    np.testing.assert_allclose(weight, np.where(finite, 1 / P, 0))


def test_prompts_whose_levels_all_earn_the_same_teach_nothing():
    reward = jnp.array([[[1.0, 0.0]], [[0.5, 0.5]], [[0.5, 9.0]]])
    ids = jnp.array([[1, 2], [1, 2], [1, -1]])
    levels = LevelRewards(ids=ids, at=jnp.zeros((3, 1), int), reward=reward, sampled=jnp.zeros((3, 1)))
    np.testing.assert_array_equal(all_equal(levels, 1e-5), [False, True, True])


@pytest.mark.parametrize(
    "change", [{"best_of": 2}, {"segment_credit": True}, {"kl_in_reward": True}, {"tactile_use": TactileUse.LITERAL}]
)
def test_options_that_need_a_sampled_conclusion_are_refused(change):
    with pytest.raises(ValueError, match=next(iter(change))):
        Paper(enumerated=Norm.STD, **change)


@pytest.mark.long
def test_a_sampled_conclusion_is_always_learned():
    with pytest.raises(ValueError, match="learn_conclusion"):
        Paper(learn_conclusion=False)


@pytest.mark.long
def test_a_step_needs_the_tokens_of_the_levels():
    config = GRPOConfig(prompts=P, micro_prompts=P, algorithm=Rloo(enumerated=Norm.NONE))
    with pytest.raises(ValueError, match="enumerated is set"):
        make_grpo_step(FNS, score, optax.sgd(0.1), config)


@pytest.mark.slow
@pytest.mark.parametrize("preset", [Rloo, Gspo])
def test_a_step_on_the_policy_raises_the_expected_reward(preset):
    """Constrained rollouts conclude, so that no prompt is degenerate although all samples may earn the same."""
    constraint = compile_constraint(tiny.LANGUAGE, tiny.TOKENIZER)
    algorithm = preset(enumerated=Norm.MEAN, constrained=True)
    config = GRPOConfig(prompts=P, group=2, length=14, micro_prompts=P, algorithm=algorithm)
    worth = make_score(PARSER, make_rewards(uniform_prior((3, 3, 3, 9))), {"accuracy": 1.0})
    optimizer = optax.adam(3e-3)
    step = make_grpo_step(FNS, worth, optimizer, config, constraint, levels=LEVELS)
    state = start_state(tiny.shallow_params(0, loud=0.2), optimizer, jax.random.key(0), config)
    found = []
    for _ in range(30):
        state, metrics = step(state, tiny.question_batch(1, P), FROZEN)
        found.append(jax.device_get(metrics))
    assert all(np.isfinite(v) for m in found for v in m.values())
    early, late = (np.mean([m["expected_reward"] for m in part]) for part in (found[:5], found[-5:]))
    assert late > early + 0.02
    assert found[0]["degenerate_share"] == 0
