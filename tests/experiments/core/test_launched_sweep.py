"""A sweep whose runs are made by workers ends in the same results as one that runs here."""

import json
from pathlib import Path

import pytest

from experiments.core.artifacts import read_json
from experiments.core.sweep import main as sweep

SWEEP = ("coin", "--vary", "toss.bias=0.1,0.9", "--steps", "8", "--seeds", "2")
FAKES = "tests.experiments.fakes"


def results(folder: str) -> dict[str, str]:
    """Results and log of each run, by configuration."""
    found = {}
    for path in Path(folder).glob("coin/2*/results.json"):
        result, config = read_json(path), read_json(path.parent / "config.json")["config"]
        kept = {name: value for name, value in result.items() if name not in ("timing", "description", "tables")}
        log = (path.parent / "metrics.jsonl").read_text()
        found[json.dumps(config, sort_keys=True)] = json.dumps(kept, sort_keys=True) + log
    return found


@pytest.mark.long
def test_workers_make_the_same_results(tmp_path, monkeypatch, capfd):
    """One unit is there already, so that a single worker is started, which takes seconds."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).resolve().parents[3]))
    assert sweep((*SWEEP, "--into", "here"), package=FAKES) == 0
    assert sweep(("coin", "--vary", "toss.bias=0.1", *SWEEP[3:], "--into", "there"), package=FAKES) == 0
    assert sweep((*SWEEP, "--into", "there", "--launcher.workers", "2"), package=FAKES) == 0
    assert "2 of 2 finished" in capfd.readouterr().out
    assert results("there") == results("here")
    assert len(results("here")) == 2
    assert sweep((*SWEEP, "--into", "there", "--launcher.workers", "2"), package=FAKES) == 0
    assert len(list(Path("there/coin").glob("2*"))) == 2
    assert sweep((*SWEEP, "--into", "there", "--launcher.workers", "0"), package=FAKES) == 2
    assert "launcher.workers is 0: must be" in capfd.readouterr().err
