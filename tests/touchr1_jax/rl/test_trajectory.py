"""Trajectories: what the sampler writes is legal, costs what the bank says, and is scored alike by the learner."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.touchr1_jax import explored
from tests.touchr1_jax.explored import BANK, BUDGET, ONCE, POLICY, N
from touchr1_jax.models.active_policy import Explored
from touchr1_jax.rl.active import make_explore
from touchr1_jax.rl.config import DrGrpo, GRPOConfig
from touchr1_jax.rl.gradient import log_probs

OBJECTS = (0, 1, 2, 3)
GROUP = 16


def explore(fns, batch, seed: int = 0, **options):
    run = make_explore(fns, BUDGET, group=GROUP, greedy=False, **options)
    return run(explored.params(), jax.tree.map(jnp.asarray, BANK), batch, jax.random.key(seed))


FNS = {"constrained": POLICY.constrained_fns, "free": POLICY.fns, "once": ONCE.constrained_fns}


@pytest.fixture(scope="module", params=FNS)
def found(request):
    """Functions, batch and trajectories."""
    fns, batch = FNS[request.param], explored.batch_of(*OBJECTS)
    return fns, batch, explore(fns, batch)


@pytest.fixture(scope="module")
def legal():
    return explore(POLICY.constrained_fns, explored.batch_of(*OBJECTS))


@pytest.mark.long
def test_sampler_and_learner_agree(found):
    fns, batch, said = found
    config = GRPOConfig(prompts=len(OBJECTS), group=GROUP, length=explored.T, algorithm=DrGrpo())
    seen = Explored(batch.features, said.touch, said.exists, jnp.ones((len(OBJECTS), 1), bool))
    shown = dataclasses.replace(batch, features=seen)
    again = jax.jit(lambda p: log_probs(fns, config, p, shown, said.rollout))(explored.params())
    assert said.rollout.mask.sum() > 4 * GROUP
    np.testing.assert_allclose(np.where(said.rollout.mask, again, 0), said.rollout.log_prob, atol=1e-5)


@pytest.mark.long
def test_a_policy_that_repeats_no_action_takes_each_once():
    two = {
        tuple(a) for a in explore(ONCE.constrained_fns, explored.batch_of(*OBJECTS)).action.reshape(-1, BUDGET).tolist()
    }
    assert two == {(-1, -1), (0, -1), (1, -1), (0, 1), (1, 0)}


@pytest.mark.long
def test_actions_tokens_costs_and_answers_tell_one_story(legal):
    known = {tuple(explored.padded(explored.turn_ids(*t))): t for t in explored.trajectories()}
    counts = set()
    for p, which in enumerate(OBJECTS):
        for g in range(GROUP):
            actions, word = known[tuple(np.asarray(legal.rollout.tokens[p, g]))]
            counts.add(len(actions))
            taken = list(actions) + [-1] * (BUDGET - len(actions))
            assert legal.action[p, g].tolist() == taken
            np.testing.assert_allclose(legal.seconds[p, g], BANK.seconds[which, list(actions)].sum(), rtol=1e-6)
            possible = [BANK.available[which, a] for a in actions]
            assert legal.harm[p, g] == sum(BANK.harm[which, a] for a, f in zip(actions, possible, strict=True) if f)
            assert legal.exists[p, g].tolist() == [[f] * N for f in possible] + [[False] * N] * (BUDGET - len(actions))
            levels = [[words[0] for words in a.levels] for a in POLICY.language.attributes]
            assert legal.parsed.conclude[p, g].tolist() == [x.index(word) if word in x else -1 for x in levels]
            assert legal.rollout.mask[p, g].sum() == sum(map(len, explored.turn_ids(actions, word)))
    assert counts == {0, 1, 2}
    assert legal.parsed.formatted.all()


@pytest.mark.long
def test_observations_are_those_of_the_bank(legal):
    p, g, b = (int(x[0]) for x in np.nonzero(np.asarray(legal.exists.any(-1))))
    np.testing.assert_array_equal(legal.touch[p, g, b], BANK.tokens[OBJECTS[p], int(legal.action[p, g, b])])


@pytest.mark.long
def test_a_malformed_turn_ends_the_trajectory_without_an_answer():
    said = explore(POLICY.fns, explored.batch_of(*OBJECTS), seed=1)
    lost = np.asarray(said.parsed.truncated)
    assert lost.any()
    assert (np.asarray(said.parsed.conclude)[lost] == -1).all()
    width = POLICY.turns.length
    turns = np.asarray(said.rollout.mask).reshape(*lost.shape, BUDGET + 1, width).any(-1).sum(-1)
    np.testing.assert_array_equal(turns, (np.asarray(said.action) >= 0).sum(-1) + 1)


@pytest.mark.long
def test_the_most_likely_trajectory_needs_no_key():
    run = make_explore(POLICY.constrained_fns, BUDGET)
    bank, batch = jax.tree.map(jnp.asarray, BANK), explored.batch_of(*OBJECTS)
    one, other = (run(explored.params(), bank, batch, jax.random.key(seed)) for seed in (0, 1))
    np.testing.assert_array_equal(one.rollout.tokens, other.rollout.tokens)


@pytest.mark.long
def test_a_choice_that_dropped_out_is_not_felt(legal):
    batch = explored.batch_of(*OBJECTS)
    case = batch.case._replace(offered=jnp.zeros_like(batch.case.offered))
    said = explore(POLICY.constrained_fns, dataclasses.replace(batch, case=case))
    assert not said.exists.any()
    assert (said.action >= 0).any()
    assert (said.seconds > 0).any()
    assert legal.exists.any()
