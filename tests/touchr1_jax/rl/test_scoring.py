"""Rewards in the graph and on the host: one interface, and faults that are named when the step is traced."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.touchr1_jax import tiny
from touchr1_jax.rewards import GroupReward, HostReward, Reward, RewardError, make_rewards
from touchr1_jax.rewards.base import GROUP
from touchr1_jax.rl.scoring import left_out_groups, make_score
from touchr1_jax.text.parser import compile_parser

PARSER = compile_parser(tiny.LANGUAGE, tiny.TOKENIZER)
REWARDS = make_rewards(np.array([[1 / 3] * 3 + [0] * 6] * 3 + [[1 / 9] * 9]))
WEIGHTS = {"accuracy": 0.6, "consistency": 0.3, "format": 0.1}
TARGET = tiny.target(np.zeros(3, int), np.array([0, 1, 2]))
TOKENS = tiny.completions(0, 3, 4, 8)


def batched(score):
    return jax.jit(jax.vmap(jax.vmap(score, in_axes=(0, None))))(TOKENS, TARGET)


def scored(value, **others):
    """Scores of all rollouts by a reward on the host, alone or with others."""
    rewards = {"mine": HostReward(value), **others}
    return batched(make_score(PARSER, rewards, dict.fromkeys(rewards, 0.5), tiny.TOKENIZER.decode))


@pytest.mark.parametrize(
    ("returned", "message"),
    [
        (np.ones(2), r"reward 'mine' is array\(\[1., 1.\]\): must be one number per rollout"),
        (None, "reward 'mine' is None: must be one number"),
        ("0.5", "reward 'mine' is '0.5': must be one number"),
    ],
)
def test_what_is_no_number_is_named(returned, message):
    with pytest.raises(Exception, match=message):
        jax.block_until_ready(scored(lambda *_: returned))


def test_an_error_of_a_host_reward_names_the_reward():
    with pytest.raises(Exception, match=r"reward 'mine' raised KeyError\('no'\) on the host"):
        jax.block_until_ready(scored(lambda *_: {}["no"]))


@pytest.mark.long
def test_a_host_reward_that_is_nan_costs_its_group_alone():
    wrong = lambda text, parsed, target: np.nan if target.label[0] == 1 else float(parsed.formatted)
    reward, terms, _ = scored(wrong, format=REWARDS["format"])
    _, _, finite, shares = left_out_groups(reward, terms)
    np.testing.assert_array_equal(finite, [True, False, True])
    assert (shares["nonfinite_in_mine"], shares["nonfinite_in_format"]) == (pytest.approx(1 / 3), 0)


@pytest.mark.long
def test_a_reward_that_does_not_count_cannot_harm():
    """At weight 0, and where it does not apply."""
    nan = lambda text, parsed, target: np.nan
    rewards = {**REWARDS, "off": HostReward(nan), "elsewhere": HostReward(nan, lambda target: jnp.array(False))}
    score = make_score(PARSER, rewards, {"format": 0.5, "off": 0.0, "elsewhere": 0.5}, tiny.TOKENIZER.decode)
    reward, terms, parsed = batched(score)
    np.testing.assert_allclose(reward, 1.0 * np.asarray(parsed.formatted))  # format takes the other's weight over
    assert not np.any([terms["off"], terms["elsewhere"]])


def test_a_reward_that_is_not_finite_somewhere_fails_when_traced():
    score = make_score(PARSER, {"mine": Reward(lambda p, t: jnp.log(p.length / 20))}, {"mine": 1.0})
    with pytest.raises(RewardError, match=r"reward 'mine' is -inf for .*: must be finite everywhere"):
        jax.eval_shape(score, TOKENS[0, 0], jax.tree.map(lambda x: x[0], TARGET))


RANK = GroupReward(lambda tokens, parsed, target: jnp.argsort(jnp.argsort(tokens[:, 0])) * 1.0)
"""Place of a rollout among those of its group, by its first token."""
ENDS = HostReward(lambda text, parsed, target: float(text.endswith("</conclude>")) + float(target.label[0]))
"""1 where the text ends well, and the label of the first attribute."""


@pytest.mark.parametrize("size", [8, 9])
def test_a_table_of_levels_holds_those_of_every_attribute(size):
    """The parser tells how many levels there are: of materials nine."""
    worth = {"worth": Reward(lambda p, t: jnp.zeros(size)[p.conclude[jnp.argmax(t.asked)]])}
    of_rollout = lambda: jax.eval_shape(make_score(PARSER, worth, {"worth": 1.0}), TOKENS[0, 0], target)
    target = jax.tree.map(lambda x: x[0], TARGET)
    if size == 9:
        of_rollout()
        return
    with pytest.raises(RewardError, match="'worth': index 8 is out of bounds for axis 0 with size 8"):
        of_rollout()


@pytest.mark.long
def test_a_reward_may_see_the_tokens_of_the_whole_group():
    score = make_score(PARSER, {"rank": RANK}, {"rank": 2.0})
    reward, _, _ = jax.vmap(jax.vmap(score, in_axes=(0, None), axis_name=GROUP))(TOKENS, TARGET)
    np.testing.assert_allclose(reward, 2.0 * np.argsort(np.argsort(TOKENS[..., 0], 1), 1))


def test_a_reward_may_see_the_text_beside_rewards_of_the_program():
    score = make_score(PARSER, {**REWARDS, "ends": ENDS}, {"ends": 0.5, "format": 0.5}, tiny.TOKENIZER.decode)
    _, terms, parsed = batched(score)
    ends = [[tiny.TOKENIZER.decode(np.asarray(row)).endswith("</conclude>") for row in group] for group in TOKENS]
    np.testing.assert_allclose(terms["ends"], 0.5 * (np.array(ends) + np.asarray(TARGET.label)[:, :1]))
    np.testing.assert_allclose(terms["format"], 0.5 * np.asarray(parsed.formatted))


@pytest.mark.parametrize(
    ("reward", "message"),
    [
        (RANK, "reward 'mine' compares the rollouts of a group: must be scored along the axis 'group'"),
        (ENDS, "reward 'mine' sees tokens or text: must be given them"),
    ],
)
def test_a_reward_without_what_it_sees_is_named(reward, message):
    score = make_score(PARSER, {"mine": reward}, {"mine": 1.0})
    with pytest.raises(RewardError, match=message):
        jax.eval_shape(score, TOKENS[0, 0], jax.tree.map(lambda x: x[0], TARGET))


@pytest.mark.long
def test_traced_score_is_the_weighted_sum():
    reward, terms, _ = batched(make_score(PARSER, REWARDS, WEIGHTS))
    np.testing.assert_allclose(reward, sum(terms.values()), rtol=1e-5)
    assert set(terms) == set(WEIGHTS)
