"""The bench's questions answered from what is said about single touches."""

import numpy as np
import pytest

from experiments.paper.questions import Answerer, answer_all
from experiments.paper.rows import average, bench_row
from sensors_io.schema import ATTRIBUTES
from touchr1_jax.bench.averages import touch_average
from touchr1_jax.bench.comparison import ORDERS
from touchr1_jax.bench.items import Ask, Touch
from touchr1_jax.bench.scoring import score

SENSORS = ("xense", "tac3d")
TOUCHES = tuple(Touch(object=name, site=0, motion="press", trial=0) for name in "abcdef")
ROWS = {touch: n for n, touch in enumerate(TOUCHES)}


def ask(kind, answer, touches=(0,), attributes=("hardness",), **fields) -> Ask:
    shown = tuple(TOUCHES[t] for t in touches)
    defaults = {"id": f"{kind}-{touches}-{attributes}-{fields}", "sensors": SENSORS}
    return Ask(kind=kind, answer=answer, touches=shown, attributes=attributes, **{**defaults, **fields})


def answerer(level, alone=None) -> Answerer:
    """Levels of hardness; the other attributes are ⊥."""
    n = len(level)
    out, single = np.full((n, 4), -1), np.full((n, 2, 4), -1)
    out[:, 0] = level
    single[:, :, 0] = np.repeat(np.asarray(level)[:, None], 2, 1) if alone is None else alone
    return Answerer(level=out, alone=single)


def said(question: Ask, who: Answerer) -> tuple[int, ...]:
    return answer_all([question], who, ROWS, SENSORS)[question.id]


def test_properties_are_read_off_one_by_one():
    who = answerer([2, 0])
    assert said(ask("identify", (1,)), who) == (2,)
    assert said(ask("compose", (1, 1), attributes=("hardness", "roughness")), who) == (2, -1)
    assert said(ask("conflict", (1,), touches=(1,), attributes=("material",)), who) == (-1,)


def test_one_sensor_answers_for_itself():
    who = answerer([2], alone=[[0, 1]])
    assert [said(ask("one_sensor", (1,), sensors=(s,)), who) for s in SENSORS] == [(0,), (1,)]


def test_touches_are_compared_by_level_then_by_single_sensors():
    assert said(ask("compare", (0,), touches=(0, 1)), answerer([2, 1])) == (0,)
    assert said(ask("compare", (0,), touches=(0, 1)), answerer([0, 1])) == (1,)
    ties = answerer([1, 1, 1], alone=[[2, 1], [1, 1], [-1, 0]])
    assert said(ask("compare", (0,), touches=(0, 1)), ties) == (0,)
    assert said(ask("compare", (0,), touches=(1, 0)), ties) == (1,)
    assert said(ask("order", (0,), touches=(0, 1, 2)), ties) == (ORDERS.index((2, 1, 0)),)
    assert said(ask("compare", (0,), touches=(0, 1)), answerer([2, -1])) == (-1,)


def test_single_sensors_never_outdo_a_level():
    who = answerer([1, 0], alone=[[0, 0], [2, 2]])
    assert said(ask("compare", (0,), touches=(0, 1)), who) == (0,)


def everything() -> tuple[Ask, ...]:
    """Questions of every kind about objects whose hardness is their number modulo three."""
    names = zip(ATTRIBUTES, (0, 1, 2, 3), strict=True)
    singles = [ask("identify", (t % 3,), touches=(t,), attributes=(a,)) for a, _ in names for t in range(6)]
    pairs = [
        ask("compare", (int(b % 3 > a % 3),), touches=(a, b), group=f"{min(a, b)}{max(a, b)}", position=int(a > b))
        for a in range(3)
        for b in range(3)
        if a != b
    ]
    orders = [
        ask("order", (k,), touches=tuple(3 * half + order.index(place) for place in range(3)))
        for half in range(2)
        for k, order in enumerate(ORDERS)
    ]
    single = [
        ask("one_sensor", (t % 3,), touches=(t,), sensors=(s,), group=str(t), position=i)
        for t in range(6)
        for i, s in enumerate(SENSORS)
    ]
    compose = [ask("compose", (t % 3, t % 3), touches=(t,), attributes=("hardness", "roughness")) for t in range(6)]
    return (*singles, *compose, *pairs, *orders, *single)


def constant(level: int) -> Answerer:
    return Answerer(level=np.full((6, 4), level), alone=np.full((6, 2, 4), level))


def test_a_constant_gets_exactly_chance_in_comparisons():
    asks = everything()
    table = {n: s.mean() for n, s in score(asks, answer_all(asks, constant(1), ROWS, SENSORS)).items()}
    assert table["sfd"] == 50
    assert table["sfd_swap"] == 0
    assert table["soi_rho"] == pytest.approx(0)
    assert table["h_acc"] == pytest.approx(100 / 3)


def test_who_knows_the_levels_knows_everything():
    level = np.repeat(np.arange(6)[:, None] % 3, 4, 1)
    who = Answerer(level=level, alone=np.repeat(level[:, None], 2, 1))
    asks = everything()
    row = bench_row(asks, [answer_all(asks, who, ROWS, SENSORS)] * 2)
    assert row["avg"].mean == pytest.approx(100)
    assert row["avg"].ci95 == pytest.approx((100, 100))
    assert row["sfd"].per_seed == (100, 100)


def test_the_interval_of_the_average_is_that_of_whole_objects():
    asks = everything()
    table = score(asks, answer_all(asks, constant(1), ROWS, SENSORS))
    objects = np.array([a.cluster for a in asks])
    found = average([table, table], objects)
    assert found.mean == pytest.approx(touch_average({n: s.mean() for n, s in table.items()}))
    assert found.ci95[0] <= found.mean <= found.ci95[1]
    assert found.ci95[1] - found.ci95[0] > 1


def test_conflict_needs_what_sight_says():
    asks = (*everything(), ask("conflict", (2,), touches=(2,), deceptive=True), ask("conflict", (0,), touches=(3,)))
    right, wrong = (answer_all(asks, constant(level), ROWS, SENSORS) for level in (2, 1))
    assert "conflict_acc" not in bench_row(asks, [right])
    assert bench_row(asks, [right], [wrong])["conflict_acc"].mean == 50
