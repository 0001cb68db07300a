"""A sweep is its units: each runs once, what is finished stays, and one page shows them all."""

from pathlib import Path

import pytest

from experiments.core import runs
from experiments.core.artifacts import read_json
from experiments.core.runner import main
from experiments.core.runs import locate, locked
from experiments.core.sweep import SweepError, plan
from experiments.core.sweep import main as sweep
from experiments.core.sweep_figures import chart, chosen_figures
from tests.experiments.core.test_report import read
from tests.experiments.fakes import coin

FAKES = "tests.experiments.fakes"
SWEEP = ("coin", "--vary", "toss.bias=0.1,0.9", "--vary", "coin=gold,silver", "--steps", "8", "--seeds", "2")


@pytest.fixture
def workplace(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def directories(folder: Path) -> list[Path]:
    return sorted(p for p in (folder / "coin").iterdir() if not p.is_symlink())


@pytest.mark.long
def test_a_stopped_sweep_goes_on_and_runs_nothing_twice(workplace, monkeypatch, capsys):
    arguments = (*SWEEP, "--crash-at", "6")
    monkeypatch.setenv("COIN_CRASHES", "1")
    with pytest.raises(RuntimeError, match="rolled away"):
        sweep(arguments, package=FAKES)
    monkeypatch.delenv("COIN_CRASHES")
    assert sweep(arguments, package=FAKES) == 0
    assert "continuing runs/sweeps/" in capsys.readouterr().out
    (folder,) = Path("runs/sweeps").iterdir()
    made = directories(folder)
    assert len(made) == 4
    with monkeypatch.context() as changed:
        changed.setattr(runs, "code_digest", lambda: "of other files")
        assert sweep(arguments, package=FAKES) == 0
    out = capsys.readouterr().out
    assert out.count("finished before") == out.count("other source files made it (code ") == 4
    assert directories(folder) == made
    assert not Path("runs/coin").exists()
    units = read_json(folder / "sweep.json")["units"]
    assert [u["settings"] for u in units] == [
        {"toss.bias": bias, "coin": metal} for bias in ("0.1", "0.9") for metal in ("gold", "silver")
    ]
    configs = [read_json(directory / "config.json")["config"] for directory in made]
    assert [u["config"] for u in units] == configs
    page = (folder / "report.html").read_text()
    assert "4 of 4 runs are finished." in read(page).text
    assert page.count('/report.html">coin/') == 4
    assert page.count("<img") == 1
    shown = read(page).text
    assert "paid: Acc" in shown
    assert "unpaid: OMAE" in shown


@pytest.mark.long
def test_a_sweep_with_more_values_keeps_what_its_folder_holds(workplace, capsys):
    for values in ("2", "2,3"):
        arguments = ("coin", "--vary", f"seeds={values}", "--steps", "1", "--into", "mine", "--figures", "omae")
        assert sweep(arguments, package=FAKES) == 0
    out = capsys.readouterr().out
    assert "1 of 2, seeds 2: finished before" in out
    assert len(directories(Path("mine"))) == 2
    text = read(Path("mine/report.html").read_text()).text
    assert "paid: OMAE" in text
    assert "paid: Acc" not in text
    assert main(["compare", *(f"coin/{d.name}" for d in directories(Path("mine"))), "--runs-dir", "mine"], FAKES) == 0
    assert locate("coin", Path("mine")) == directories(Path("mine"))[-1].resolve()


@pytest.mark.long
def test_a_folder_of_another_sweep_and_damaged_runs_are_named(workplace, capsys):
    one = ("coin", "--steps", "1", "--seeds", "2", "--into", "mine", "--vary")
    assert sweep((*one, "toss.bias=0.1,0.9"), package=FAKES) == 0
    before = Path("mine/sweep.json").read_bytes()
    for other in ("toss.bias=0.1", "coin=gold,silver"):
        assert sweep((*one, other), package=FAKES) == 1
        assert "runs that this one leaves out" in capsys.readouterr().err
    assert Path("mine/sweep.json").read_bytes() == before
    results = directories(Path("mine"))[0] / "results.json"
    for text in ("{", "[]", '{"verdict": [], "arms": 3}', '{"verdict": [], "arms": {"paid": {"acc": {"mean": 1}}}}'):
        results.write_text(text)
        assert sweep((*one, "toss.bias=0.1,0.9"), package=FAKES) == 1
        assert "DamagedFileError" in capsys.readouterr().err


@pytest.mark.long
def test_a_folder_may_have_a_name_that_is_not_utf_8(workplace):
    arguments = ("coin", "--vary", "toss.bias=0.1", "--steps", "1", "--seeds", "2", "--into", "n\udcff")
    assert sweep(arguments, package=FAKES) == 0
    assert read_json(Path("n\udcff/sweep.json"))["units"][0]["command"][-1] == "n\udcff"


@pytest.mark.parametrize(
    ("vary", "rest", "what"),
    [
        (["steps"], [], "must be OPTION=VALUE"),
        (["steps=3,"], [], "must be OPTION=VALUE"),
        (["steps=3", "steps=4"], [], "twice"),
        ([], [], "no option varies"),
        (["steps=3,03"], [], "are one configuration"),
        (["steps=3"], ["--fresh"], "--fresh belongs to single runs"),
        (["fresh=true"], [], "--fresh belongs to single runs"),
        (["runs-dir=x"], [], "--runs-dir belongs to single runs"),
    ],
)
def test_options_that_make_no_sweep_are_named(vary, rest, what):
    with pytest.raises(SweepError, match=what):
        plan(coin.EXPERIMENT, "about", vary, rest, Path("runs"), None)


@pytest.mark.parametrize("into", ["s3://bucket/sweep", __file__])
def test_a_sweep_goes_into_a_folder_of_this_machine(into):
    with pytest.raises(SweepError, match=r"into is .*: must be a folder of this machine"):
        plan(coin.EXPERIMENT, "about", ["steps=3"], [], Path("runs"), Path(into))


def test_a_mistyped_option_or_value_runs_nothing(workplace, capsys):
    for vary, corrected in (("stepz=1,2", "--steps"), ("steps=1,x", "invalid|could not convert")):
        with pytest.raises(SystemExit) as stop:
            sweep(["coin", "--vary", vary], package=FAKES)
        assert stop.value.code == 2
        assert any(word in capsys.readouterr().err for word in corrected.split("|"))
    assert sweep(["coyn", "--vary", "steps=1"], package=FAKES) == 2
    assert "Did you mean coin?" in capsys.readouterr().err
    assert not list(workplace.iterdir())


def estimate(mean: float) -> dict:
    return {"mean": mean, "ci95": [mean - 1, mean + 1], "per_seed": [mean]}


def test_figures_that_all_runs_have_are_chosen_and_drawn():
    study = {"arms": {"x": {"acc": estimate(1), "omae": estimate(2), "csc": estimate(3)}}}
    assert chosen_figures([study, {"arms": {"x": {"acc": estimate(4)}}}], ()) == ["x acc"]
    assert chosen_figures([study, study], ("csc",)) == ["x csc"]
    measured = {"requirements": [{"name": "speed", "measured": 2.0}], "tables": []}
    assert chosen_figures([measured], ()) == ["requirement: speed"]
    finished = [({"a": v}, {"x acc": estimate(1), "requirement: speed": 2.0}) for v in ("1", "100")]
    assert chart(finished, ["x acc", "requirement: speed"]).startswith(b"<?xml")
    assert chart([({"a": v}, of) for v, (_, of) in zip(("one", "two"), finished, strict=True)], ["x acc"])


def test_two_sweeps_at_once_do_not_write_into_one_folder(workplace, capsys):
    """They would train each run twice, end with errors where they meet, and replace each other's list and page."""
    Path("mine").mkdir()
    arguments = ("coin", "--vary", "seeds=2,3", "--steps", "1", "--into", "mine")
    with locked(Path("mine")):
        assert sweep(arguments, package=FAKES) == 1
    said = "RunInUse: mine is in use by another process: two would overwrite each other; wait for it, stop it, or give"
    assert said in capsys.readouterr().err
    assert [path.name for path in Path("mine").iterdir()] == [".lock"]
    Path("file").touch()
    assert sweep((*arguments[:-1], "file"), package=FAKES) == 2
    assert "into is file: must be a folder of this machine; name another by --into" in capsys.readouterr().err
