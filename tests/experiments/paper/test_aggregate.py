"""Rows pooled over seeds and columns: hand values, directions, what is left out."""

from experiments.core.results import Estimate
from experiments.paper.aggregate import aggregate_table


def row(**seeds: tuple[float, ...]) -> dict[str, Estimate]:
    return {m: Estimate(mean=sum(x) / len(x), ci95=(0.0, 0.0), per_seed=x) for m, x in seeds.items()}


ROWS = {
    "sft": row(h_acc=(50.0, 60.0), omae=(1.0, 1.0), parse_rate=(100.0, 100.0)),
    "full": row(h_acc=(60.0, 70.0), omae=(0.5, 1.0), parse_rate=(0.0, 0.0)),
    "constant": row(h_acc=(90.0,), omae=(0.0,), parse_rate=(100.0,)),
}


def test_columns_are_shares_and_errors_count_the_other_way():
    (table,) = aggregate_table(ROWS, "sft")
    got = {str(line[0]): line[1:] for line in table.rows}
    assert set(got) == {"sft", "full"}  # a baseline has no seeds
    assert got["sft"][0] == "50.0"  # 50, 60 and 50, 50: the middle two of four
    assert got["full"][0] == "65.0"  # 60, 70 and 75, 50: of 50, 60, 70, 75 the middle two
    assert got["full"][2] == "0.81"  # h: 60 against 50 and 60, 70 against both: 3.5 of 4; omae: 2 and 2 halves, 3 of 4
    assert got["sft"][2:] == ("–", "–")
    assert "OMAE" in table.note
    assert "parse" not in table.note.lower()


def test_an_interval_holds_its_point_and_one_seed_gives_no_table():
    (table,) = aggregate_table(ROWS, "sft")
    for line in table.rows:
        low, high = (float(x) for x in str(line[2]).strip("[]").split(","))
        assert low <= float(str(line[1])) <= high
    assert aggregate_table({"sft": ROWS["constant"]}, "sft") == ()


def test_a_better_row_is_better():
    rows = {"sft": row(h_acc=(50.0, 51.0)), "full": row(h_acc=(70.0, 71.0))}
    (table,) = aggregate_table(rows, "sft")
    assert table.rows[1][3:] == ("1.00", "[1.00, 1.00]")
    (table,) = aggregate_table({"sft": row(omae=(0.5, 0.6)), "full": row(omae=(0.7, 0.8))}, "sft")
    assert table.rows[1][3] == "0.00"
