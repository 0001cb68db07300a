"""R_tu by hand, and how often it pays by chance, enumerated."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.touchr1_jax import tiny
from tests.touchr1_jax.rewards.examples import make_parsed, make_target
from touchr1_jax.rl.advantages import advantages, of_kept_groups
from touchr1_jax.rl.config import Advantage, Paper, Stable, TactileUse
from touchr1_jax.rl.credit_odds import CREDIT, HELPED, HINDERED, credit_odds, false_credit
from touchr1_jax.rl.tactile_use import TERM, bar, bonus_metrics, literal, recommended, right, tactile_bonus
from touchr1_jax.types import Parsed

SIZES = {"group": 8, "rollouts": Stable().controls, "controls": 3}


def test_false_credit_and_power_of_the_stable_preset():
    """Null: answers and controls from one distribution over 0, .4, 1, for every split of what is not right."""
    margin = Stable().tactile_margin
    worst = false_credit(**SIZES, margin=margin)
    power = credit_odds(HELPED, HINDERED, **SIZES, margin=margin)
    assert worst <= 0.12
    assert worst == pytest.approx(0.086, abs=0.002)
    assert power >= 0.5
    assert power == pytest.approx(0.5115, abs=0.002)


@pytest.mark.parametrize(("controls", "worst"), [(2, 0.149), (1, 0.320)])
def test_fewer_controls_let_more_chance_through(controls, worst):
    found = false_credit(group=8, rollouts=Stable().controls, controls=controls, margin=Stable().tactile_margin)
    assert found == pytest.approx(worst, abs=0.002)


def test_an_unknown_label_is_matched_by_no_answer():
    target = make_target(label=(-1, 0, 0))
    assert not right(make_parsed((-1, 0, 0)), target)
    assert right(make_parsed((0, 0, 0)), make_target(label=(0, -1, -1)))


def test_the_literal_margin_is_too_small():
    """At δ = .1 one right answer in eight passes for touch: why the stable preset departs from the paper."""
    rare = np.array([0.9, 0, 0.1])
    assert credit_odds(rare, rare, **SIZES, margin=0.1) > 0.15


def test_odds_by_hand():
    """One rollout against one control of one rollout: it pays where its credit is the larger one."""
    touch, control = np.array([0.5, 0.2, 0.3]), np.array([0.7, 0.2, 0.1])
    odds = credit_odds(touch, control, group=1, rollouts=1, controls=1, margin=0.13)
    assert odds == pytest.approx(0.2 * 0.7 + 0.3 * 0.9)


def test_odds_agree_with_drawing():
    """Groups and controls drawn at random, and paid by the formula itself."""
    rng, n = np.random.default_rng(0), 20_000
    own = rng.choice(CREDIT, (n, 8), p=HELPED)
    control = rng.choice(CREDIT, (n, 3, 4), p=HINDERED).mean(-1).max(-1)
    paid = (own.mean(-1) > control + 0.13) & (own.max(-1) > control)
    assert paid.mean() == pytest.approx(credit_odds(HELPED, HINDERED, **SIZES, margin=0.13), abs=0.015)


def test_recommended_by_hand():
    own, ok = jnp.array([1.0, 0.4, 0.0, 1.0]), jnp.array([True, True, True, False])
    np.testing.assert_allclose(recommended(own, jnp.array(0.3), ok, 0.1), [0.7, 0.1, 0, 0], rtol=1e-6)
    assert not recommended(own, jnp.array(0.55), ok, 0.1).any()  # .6 is no lead of .1


def test_literal_by_hand():
    own, is_right = jnp.array([1.0, 0.4, 0.0, 1.0]), jnp.array([True, False, False, True])
    np.testing.assert_array_equal(literal(own, jnp.array(0.3), is_right, 0.1), [1, 0, 0, 1])


@pytest.mark.parametrize("margin", [0.0, 0.1])
def test_a_lead_of_just_the_margin_is_none_however_means_round(margin):
    """Groups of 8 and controls of 4 in tenths: of these 675 pairs, float32 alone called some of both margins paid."""
    spreads = lambda n: np.array(list(itertools.combinations_with_replacement([0, 4, 10], n)))
    own, control = spreads(8), spreads(4)
    pays = lambda own, control: literal(own, jnp.mean(control), jnp.ones(8, bool), margin).any()
    found = jax.vmap(lambda own: jax.vmap(lambda control: pays(own, control))(control / 10))(own / 10)
    lead = own.sum(-1)[:, None] - 2 * control.sum(-1)  # in eightieths
    np.testing.assert_array_equal(found, lead > 80 * margin)


def test_nothing_right_earns_nothing():
    """Video-R1's bonus for correct frames' order is paid at zero accuracy; this one cannot be."""
    zero = jnp.zeros(4)
    assert not recommended(zero, jnp.array(0.0), jnp.ones(4, bool), 0.1).any()
    assert not literal(zero, jnp.array(0.0), jnp.zeros(4, bool), 0.1).any()


def test_the_bar_is_the_best_control_that_counts():
    control = jnp.array([[0.0, 0.4], [1.0, 1.0], [0.0, 0.0]])
    assert bar(control, jnp.array([True, False, True])) == pytest.approx(0.2)
    assert bar(control, jnp.array([True, True, True])) == 1
    assert bar(control, jnp.zeros(3, bool)) == 1  # nothing passes where no control could be made


@pytest.mark.long
def test_bonuses_and_their_metrics_by_hand():
    """Of three groups one is right, and no control ever is."""
    batch = tiny.question_batch(0, 3)
    says = lambda level: jnp.where(batch.target.asked, level[:, None], -1)[:, None]
    answered = lambda level: Parsed(
        perceive=jnp.full((3, 2, tiny.S, tiny.A), -1),
        compare=jnp.full((3, 2, tiny.A), -1),
        conclude=jnp.broadcast_to(says(level), (3, 2, tiny.A)),
        formatted=jnp.ones((3, 2), bool),
        truncated=jnp.zeros((3, 2), bool),
        length=jnp.zeros((3, 2), jnp.int32),
    )
    none = jnp.full(3, -1)
    noise = jnp.zeros((2, *batch.features.touch.shape[1:]))
    answer = lambda features, key: answered(none)
    rollouts = answered(none.at[0].set(batch.target.label[0].max()))
    bonus, metrics = tactile_bonus(Stable(), rollouts, batch, noise, answer, jax.random.key(0))
    np.testing.assert_allclose(bonus, [[1, 1], [0, 0], [0, 0]])
    third = pytest.approx(1 / 3)
    shares = {"touch_score": third, "tactile_credit_share": third}
    shares |= {"control_missing_share": 0, "credit_unearned_share": 0}
    for name in ("drop", "noise", "order"):
        shares |= {f"control_{name}": 0, f"control_{name}_share": 1, f"lead_{name}": third}
    assert metrics == shares
    # without touch in the last group, its answers are compared with none
    touched = batch.features.replace(stream_mask=batch.features.stream_mask.at[2].set(False))
    _, metrics = tactile_bonus(Stable(), rollouts, batch.replace(features=touched), noise, answer, jax.random.key(0))
    assert (metrics["lead_drop"], metrics["touch_score"]) == (0.5, third)


@pytest.mark.long
@pytest.mark.parametrize(("form", "cancelled"), [(TactileUse.LITERAL, 1 / 3), (TactileUse.RECOMMENDED, 0)])
def test_a_literal_bonus_that_follows_the_reward_is_cancelled(form, cancelled):
    """Where σ takes it away: of the two groups with different bonuses the one whose rewards differ as they do."""
    algorithm = Paper(tactile_use=form)
    base, bonus = jnp.array([[1.0, 0.0], [0.0, 0.0], [1.0, 0.0]]), jnp.array([[1.0, 0.0], [1.0, 0.0], [1.0, 1.0]])
    added = algorithm.tactile_weight * bonus
    reward, terms = (base + added, {"a": base, TERM: added}) if form is TactileUse.LITERAL else (base, {"a": base})
    after = advantages(algorithm, reward, terms)
    if form is TactileUse.RECOMMENDED:
        after += added - added.mean(-1, keepdims=True)
    found = bonus_metrics(algorithm, reward, terms, bonus, after, jnp.ones(3, bool))
    assert found["bonus_telling_share"] == pytest.approx(2 / 3)
    assert found["bonus_cancelled_share"] == pytest.approx(cancelled)


@pytest.mark.parametrize("comparison", [Advantage.GROUP, Advantage.GLOBAL])
def test_a_group_that_is_left_out_says_nothing_of_the_bonus(comparison):
    """Its advantages ignore the bonus, as they ignore all; the σ of the others is not that of all groups either."""
    algorithm, finite = Paper(advantage=comparison, tactile_use=TactileUse.RECOMMENDED), jnp.array([True, False, True])
    reward, bonus = jnp.array([[1.0, 0.0], [0.5, 0.5], [1.0, 0.0]]), jnp.array([[0.0, 0.0], [1.0, 0.0], [1.0, 0.0]])
    after = of_kept_groups(algorithm, advantages(algorithm, reward, {"a": reward}), finite)
    found = bonus_metrics(algorithm, reward, {"a": reward}, bonus, after, finite)
    assert found == dict.fromkeys(("bonus_telling_share", "bonus_cancelled_share"), pytest.approx(1 / 3))
