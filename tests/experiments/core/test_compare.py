"""Runs side by side: figures of hand-made results, and two real runs of the fake experiment."""

import json
from pathlib import Path

import pytest

from experiments.core.artifacts import DamagedFileError, read_json, write_sealed
from experiments.core.compare import compare_results
from experiments.core.runner import main

FAKES = "tests.experiments.fakes"


def estimate(*per_seed: float) -> dict:
    mean = sum(per_seed) / len(per_seed)
    return {"mean": mean, "ci95": [mean - 1, mean + 1], "per_seed": list(per_seed)}


def figures(a: dict, b: dict) -> dict[str, tuple[str, str]]:
    """Change and verdict of every figure."""
    return {f.where: (f.change, f.verdict) for f in compare_results(a, b)}


def test_seeds_are_paired():
    """Differences 1, 1, 1.3 have the t interval 1.1 ± 4.303 · .1; those of −1, 1 surround 0."""
    a = {"arms": {"x": {"acc": estimate(10, 20, 30), "omae": estimate(1, 2), "csc": estimate(5, 6)}}, "baselines": {}}
    b = {"arms": {"x": {"acc": estimate(11, 21, 31.3), "omae": estimate(0, 3), "csc": estimate(5, 6)}}, "baselines": {}}
    assert figures(a, b) == {
        "x acc": ("+1.1 [0.67, 1.53]", "significant"),
        "x omae": ("+0 [−12.7, 12.7]", "not significant"),
        "x csc": ("", "same"),
    }


def test_figures_without_seeds_differ_or_not():
    a = {"baselines": {"blind": {"acc": estimate(40)}}, "arms": {"old": {"acc": estimate(1)}}}
    b = {"baselines": {"blind": {"acc": estimate(42)}}, "arms": {"new": {"acc": estimate(1)}}}
    found = figures(a, b)
    assert found["blind acc"] == ("+2", "differs")
    assert [found[f"{arm} acc"][1] for arm in ("old", "new")] == ["only in A", "only in B"]


def test_requirements_and_cells_of_tables():
    def findings(measured: float, *rows: list) -> dict:
        columns = [{"name": name} for name in ("method", "error", "converged")]
        return {
            "requirements": [{"name": "speed", "measured": measured}],
            "tables": [{"title": "Errors", "columns": columns, "rows": list(rows)}],
        }

    found = figures(
        findings(2.0, ["spg", 1.0, True], ["spg", 3.0, True]), findings(3.0, ["spg", 1.0, False], ["spg", None, True])
    )
    assert found == {
        "requirement: speed": ("+1 (× 1.5)", "differs"),
        "Errors | spg | error": ("", "same"),
        "Errors | spg | converged": ("", "differs"),
        "Errors | spg #2 | error": ("", "differs"),
        "Errors | spg #2 | converged": ("", "same"),
    }


@pytest.mark.parametrize("changed", [{"ci95": ["a"]}, {"ci95": [1, [2]]}, {"mean": ""}, {"per_seed": 7}])
def test_an_estimate_of_other_types_is_damage(changed):
    with pytest.raises(DamagedFileError, match=r"results\.json is not that of a run"):
        figures({}, {"arms": {"x": {"acc": estimate(1, 2) | changed}}})


def test_of_several_runs_shared_figures_are_judged_against_the_first():
    runs = [{"arms": {"x": {"acc": estimate(*seeds)}}} for seeds in ((1, 2), (1, 2), (3, 4.1))]
    runs[1]["arms"]["x"]["csc"] = estimate(1)
    found = {f.where: f for f in compare_results(*runs)}
    assert (found["x acc"].change, found["x acc"].verdict) == ("C", "significant")
    assert len(found["x acc"].shown) == 3
    assert found["x csc"].verdict == "only in B"
    assert found["x csc"].shown[::2] == ("–", "–")


@pytest.fixture(scope="module")
def home(tmp_path_factory) -> Path:
    """Two finished runs of the fake experiment, which differ in one setting."""
    path = tmp_path_factory.mktemp("home")
    for bias in ("0.5", "0.25"):
        arguments = ["coin", "--scale", "smoke", "--runs-dir", str(path), "--toss.bias", bias, "--cache-dir", str(path)]
        assert main(arguments, package=FAKES) == 0
    return path


def stamps(home: Path) -> list[str]:
    return sorted(p.name for p in (home / "coin").iterdir() if not p.is_symlink())


@pytest.mark.long
def test_two_runs_of_one_experiment(home, capsys):
    first, second = stamps(home)
    arguments = ["compare", f"coin/{first}", f"coin/{second}", "--runs-dir", str(home)]
    assert main(arguments, package=FAKES) == 0
    out = capsys.readouterr().out
    path = home / "coin" / second / "config.json"
    whole = path.read_text()
    write_sealed(path, read_json(path) | {"source": "of uncommitted changes"})
    assert main(arguments, package=FAKES) == 0
    path.write_text(whole)
    assert "of uncommitted changes" in capsys.readouterr().out
    path = home / "coin" / second / "results.json"
    whole = path.read_text()
    for data, exit_code in (({"records": "labelled anew"}, 0), (["no", "object"], 1)):
        write_sealed(path, read_json(path) | {"data": data})
        assert main(arguments, package=FAKES) == exit_code
    path.write_text(whole)
    of_data = capsys.readouterr()
    assert "labelled anew" in of_data.out
    assert "results.json is not that of a run" in of_data.err
    assert f"A  coin  {first}  smoke" in out
    assert "toss.bias  0.5  0.25" in out
    assert "Different code or machine: nothing" in out
    assert "same: " in next(line for line in out.splitlines() if " figures; " in line)
    assert "Cost: A " in out


@pytest.mark.long
def test_the_gravest_differences_come_first_and_the_others_are_counted(home, capsys):
    first, second = (home / "coin" / stamp / "results.json" for stamp in stamps(home))
    text = second.read_text()
    assert first.read_text() != text
    try:
        write_sealed(second, json.loads(json.dumps(read_json(second)).replace('"blind"', '"deaf"')))
        arguments = ["compare", f"coin/{stamps(home)[0]}", "coin", "--runs-dir", str(home), "--most", "1"]
        assert main(arguments, package=FAKES) == 0
    finally:
        second.write_text(text)
    out = capsys.readouterr().out
    assert "only in A: 3; only in B: 3" in out
    assert "… and 5 more; --most shows them" in out
    assert main(["compare", "a", "b", "--most", "-1"]) == 2
    assert "most is -1: must be at least 0; raise it" in capsys.readouterr().err


@pytest.mark.long
def test_what_cannot_be_compared_is_said(home, tmp_path, capsys):
    (tmp_path / "config.json").write_text("{")
    unfinished = tmp_path / "coin" / "20260101-000000"
    unfinished.mkdir(parents=True)
    (unfinished / "config.json").write_bytes((home / "coin" / stamps(home)[0] / "config.json").read_bytes())
    for others, said in (
        (["dice"], "'dice' is no run"),
        (["coin"], "is named twice"),
        ([], "must be at least two"),
        ([str(tmp_path)], "DamagedFileError"),
        ([str(unfinished)], "must be finished to be compared; continue it with: python -m experiments coin"),
    ):
        assert main(["compare", "coin", *others, "--runs-dir", str(home)], package=FAKES) == 1
        assert said in capsys.readouterr().err
