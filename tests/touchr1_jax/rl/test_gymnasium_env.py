"""The Gymnasium environment passes Gymnasium's own check and pays what training pays."""

import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.touchr1_jax import explored
from tests.touchr1_jax.explored import BANK, BUDGET
from touchr1_jax.rl.gymnasium_env import Episodes, make_gymnasium_env
from touchr1_jax.rl.touch_reward import Prices, priced_answer

PRICES = Prices(jnp.float32(0.05), jnp.float32(0.1))
OBJECTS = (0, 1, 3)


def make(**options):
    bank = jax.tree.map(jnp.asarray, BANK)
    return make_gymnasium_env(bank, explored.batch_of(*OBJECTS), budget=BUDGET, prices=PRICES, **options)


def test_without_gymnasium_the_error_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "gymnasium", None)
    with pytest.raises(ImportError, match=r"touchr1-jax\[gymnasium\]"):
        make()


@pytest.fixture
def env():
    """Each action costs .25 besides its seconds."""
    pytest.importorskip("gymnasium")
    return make(reward=lambda *of: priced_answer(*of) | {"actions": -0.25 * of[2].actions})


def test_gymnasiums_check_passes(env):
    from gymnasium.utils.env_checker import check_env

    check_env(env, skip_render_check=True)


def test_an_episode_by_hand(env):
    seen, _ = env.reset(options={"prompt": 1})
    assert seen["question"].tolist() == [0, 1]
    assert not seen["touch"].any()
    seen, reward, ended, _, totals = env.step(1)
    np.testing.assert_array_equal(seen["touch"][0], BANK.tokens[1, 1])
    assert (reward, ended, totals["actions"]) == (0.0, False, (1,))
    _, reward, ended, _, totals = env.step(2 + int(BANK.label[1, 1]))
    assert ended
    assert reward == pytest.approx(0.75 - 0.05 * BANK.seconds[1, 1] - 0.1 * BANK.harm[1, 1], rel=1e-5)


def test_a_contact_that_is_missing_is_not_seen(env):
    env.reset(options={"prompt": 2})
    seen, *_, totals = env.step(1)
    assert not seen["touch"].any()
    assert (totals["seconds"], totals["harm"]) == (pytest.approx(BANK.seconds[3, 1]), 0.0)


def test_one_action_too_many_ends_without_an_answer(env):
    env.reset(options={"prompt": 0})
    for _ in range(BUDGET):
        assert not env.step(0)[2]
    _, reward, ended, *_ = env.step(0)
    assert ended
    assert reward == pytest.approx(-0.1 - BUDGET * (0.25 + 0.05 * BANK.seconds[0, 0]), rel=1e-5)


def test_beliefs_may_take_the_place_of_tokens():
    pytest.importorskip("gymnasium")
    env = make(encode=lambda touch, exists, actions: np.append(exists.sum(), actions))
    assert env.observation_space["touch"].shape == (1 + BUDGET,)
    assert env.reset()[0]["touch"].tolist() == [0, *[-1] * BUDGET]


@pytest.mark.long
def test_episodes_at_once_are_those_alone():
    """Three episodes that touch, touch twice and conclude, and conclude at once; then the last begins anew."""
    bank, batch = jax.tree.map(jnp.asarray, BANK), explored.batch_of(*OBJECTS)
    make_episodes = lambda count: Episodes(bank, batch, budget=BUDGET, prices=PRICES, count=count)
    together, alone = make_episodes(3), [make_episodes(1) for _ in range(3)]
    actions, again = np.array([[1, 0, 2], [2, 1, 3], [2, 2, 2]]), np.array([False, False, True])
    together.begin(np.arange(3))
    for i, episodes in enumerate(alone):
        episodes.begin(np.array([i]))
    for row in actions:
        stepped = together.step(row)
        for i, (episodes, action) in enumerate(zip(alone, row, strict=True)):
            observation, reward, ended, totals = episodes.step(np.array([action]))
            jax.tree.map(lambda a, b, i=i: np.testing.assert_array_equal(a[i], b[0]), stepped[0], observation)
            assert (stepped[1][i], stepped[2][i], stepped[3][i]) == (reward[0], ended[0], totals[0])
    before, seen = stepped[0], together.begin(np.zeros(3, int), again)
    jax.tree.map(lambda a, b: np.testing.assert_array_equal(a[:2], b[:2]), seen, before)
    jax.tree.map(lambda a, b: np.testing.assert_array_equal(a[2], b[0]), seen, alone[0].begin(np.array([0])))
    np.testing.assert_array_equal(stepped[2], [True, True, True])
    for action in (-1, together.actions):  # −1 would be the last action, and not counted as one
        with pytest.raises(ValueError, match=rf"actions are \[.*{action}\]: must lie in 0 … {together.actions - 1}"):
            together.step(np.array([0, 0, action]))
