"""The bench's questions answered from single touches, their average, rows pooled over columns: hand values."""

import itertools

import numpy as np
import pytest

from experiments.core.results import Estimate
from experiments.paper.bench_scores import SingleTouchAnswers, answer_all, average, bench_row, pooled_table
from sensors_io.schema import ATTRIBUTES
from touchr1_jax.bench.averages import touch_average
from touchr1_jax.bench.comparison import ORDERS
from touchr1_jax.bench.items import Ask, Touch
from touchr1_jax.bench.scoring import score
from touchr1_jax.training.evaluation import Evaluation
from touchr1_jax.types import Parsed

SENSORS = ("xense", "tac3d")
TOUCHES = tuple(Touch(object=name, site=0, motion="press", trial=0) for name in "abcdef")
PLACES = {touch: n for n, touch in enumerate(TOUCHES)}


def ask(kind, answer, touches=(0,), attributes=("hardness",), **fields) -> Ask:
    shown = tuple(TOUCHES[t] for t in touches)
    defaults = {"id": f"{kind}-{touches}-{attributes}-{fields}", "sensors": SENSORS}
    return Ask(kind=kind, answer=answer, touches=shown, attributes=attributes, **{**defaults, **fields})


def of_hardness(level, alone=None) -> SingleTouchAnswers:
    """The other attributes are ⊥."""
    n = len(level)
    out, single = np.full((n, 4), -1), np.full((n, 2, 4), -1)
    out[:, 0] = level
    single[:, :, 0] = np.repeat(np.asarray(level)[:, None], 2, 1) if alone is None else alone
    return SingleTouchAnswers(level=out, alone=single)


TIES = of_hardness([1, 1, 1], alone=[[2, 1], [1, 1], [-1, 0]])


@pytest.mark.parametrize(
    ("question", "answers", "expected"),
    [
        (ask("identify", (1,)), of_hardness([2, 0]), (2,)),
        (ask("compose", (1, 1), attributes=("hardness", "roughness")), of_hardness([2, 0]), (2, -1)),
        (ask("conflict", (1,), touches=(1,), attributes=("material",)), of_hardness([2, 0]), (-1,)),
        (ask("one_sensor", (1,), sensors=("xense",)), of_hardness([2], alone=[[0, 1]]), (0,)),
        (ask("one_sensor", (1,), sensors=("tac3d",)), of_hardness([2], alone=[[0, 1]]), (1,)),
        (ask("compare", (0,), touches=(0, 1)), of_hardness([2, 1]), (0,)),
        (ask("compare", (0,), touches=(0, 1)), of_hardness([0, 1]), (1,)),
        (ask("compare", (0,), touches=(0, 1)), of_hardness([2, -1]), (-1,)),
        (ask("compare", (0,), touches=(0, 1)), TIES, (0,)),
        (ask("compare", (0,), touches=(1, 0)), TIES, (1,)),
        (ask("order", (0,), touches=(0, 1, 2)), TIES, (ORDERS.index((2, 1, 0)),)),
        (ask("compare", (0,), touches=(0, 1)), of_hardness([1, 0], alone=[[0, 0], [2, 2]]), (0,)),
    ],
)
def test_answers_follow_from_single_touches(question, answers, expected):
    """Touches compare by level, equal levels by the mean of single sensors, which never outweighs a level."""
    assert answer_all([question], answers, PLACES, SENSORS) == {question.id: expected}


def test_what_is_answered_without_any_touch_is_no_answer_of_a_sensor():
    """The second contact lacks sensor 1: its prompt shows nothing then, and must not break the tie."""
    conclude = np.full((2, 4), -1)
    conclude[:, 0] = 1
    nothing, alone = np.full((2, 2, 4), -1), np.full((2, 2, 4), -1)
    alone[..., 0] = [[1, 1], [1, 2]]
    flag, of = np.ones(2, bool), {"perceive": nothing, "compare": conclude, "conclude": conclude}
    answers = Evaluation(
        contact=np.arange(2),
        attribute=np.zeros(2, int),
        streams=np.array([[True, True], [True, False]]),
        tokens=np.zeros((2, 0), int),
        parsed=Parsed(**of, formatted=flag, truncated=~flag, length=np.zeros(2, int)),
        label=conclude,
        alone=alone,
    )
    single = SingleTouchAnswers.of(answers, 2)
    assert single.alone[:, :, 0].tolist() == [[1, 1], [1, -1]]
    assert single.strength(0, 0) == single.strength(1, 0)


def everything() -> tuple[Ask, ...]:
    """Questions of every kind about objects whose hardness is their number modulo three."""
    singles = [ask("identify", (t % 3,), touches=(t,), attributes=(a,)) for a in ATTRIBUTES for t in range(6)]
    pairs = [
        ask("compare", (int(b > a),), touches=(a, b), group=f"{min(a, b)}{max(a, b)}", position=int(a > b))
        for a, b in itertools.permutations(range(3), 2)
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


def constant(level: int) -> SingleTouchAnswers:
    return SingleTouchAnswers(level=np.full((6, 4), level), alone=np.full((6, 2, 4), level))


def test_a_constant_answer_has_exactly_the_chance_accuracy_of_comparisons():
    asks = everything()
    table = {n: s.mean() for n, s in score(asks, answer_all(asks, constant(1), PLACES, SENSORS)).items()}
    assert (table["sfd"], table["sfd_swap"]) == (50, 0)
    assert (table["soi_rho"], table["h_acc"]) == pytest.approx((0, 100 / 3))


def test_right_levels_answer_everything():
    level = np.repeat(np.arange(6)[:, None] % 3, 4, 1)
    answers = SingleTouchAnswers(level=level, alone=np.repeat(level[:, None], 2, 1))
    asks = everything()
    row = bench_row(asks, [answer_all(asks, answers, PLACES, SENSORS)] * 2)
    assert (row["avg"].mean, *row["avg"].ci95) == pytest.approx((100, 100, 100))
    assert row["sfd"].per_seed == (100, 100)


def test_the_interval_of_the_average_resamples_whole_objects():
    asks = everything()
    table = score(asks, answer_all(asks, constant(1), PLACES, SENSORS))
    found = average([table, table], np.array([a.cluster for a in asks]))
    assert found.mean == pytest.approx(touch_average({n: s.mean() for n, s in table.items()}))
    assert found.ci95[0] <= found.mean <= found.ci95[1]
    assert found.ci95[1] - found.ci95[0] > 1


def row(**seeds: tuple[float, ...]) -> dict[str, Estimate]:
    return {m: Estimate(mean=sum(x) / len(x), ci95=(0.0, 0.0), per_seed=x) for m, x in seeds.items()}


def test_pooled_columns_are_shares_and_errors_count_the_other_way():
    rows = {
        "sft": row(h_acc=(50.0, 60.0), omae=(1.0, 1.0), parse_rate=(100.0, 100.0)),
        "full": row(h_acc=(60.0, 70.0), omae=(0.5, 1.0), parse_rate=(0.0, 0.0)),
        "constant": row(h_acc=(90.0,), omae=(0.0,), parse_rate=(100.0,)),
    }
    (table,) = pooled_table(rows, "sft")
    got = {line[0]: line[1:] for line in table.rows}
    assert set(got) == {"sft", "full"}  # a baseline has no seeds
    assert got["sft"][0] == "50.0"  # 50, 60 and 50, 50: the middle two of four
    assert got["full"][0] == "65.0"  # 60, 70 and 75, 50: of 50, 60, 70, 75 the middle two
    assert got["full"][2] == "0.81"  # h: 60 against 50 and 60, 70 against both: 3.5 of 4; omae: 2 and 2 halves, 3 of 4
    assert pooled_table({"sft": rows["constant"]}, "sft") == ()


def test_conflict_needs_the_answers_from_pictures():
    asks = (*everything(), ask("conflict", (2,), touches=(2,), deceptive=True), ask("conflict", (0,), touches=(3,)))
    right, wrong = (answer_all(asks, constant(level), PLACES, SENSORS) for level in (2, 1))
    assert "conflict_acc" not in bench_row(asks, [right])
    assert bench_row(asks, [right], [wrong])["conflict_acc"].mean == 50
