"""The data card on the command line, shrunk, and its commands on the same records."""

import dataclasses
from pathlib import Path

import pytest

from experiments.bench import dataset_card
from experiments.bench.__main__ import main
from experiments.core.artifacts import read_json
from sensors_io.records import RecordStore
from tests.experiments.shrunk import run_shrunk
from touchr1_jax.bench.items import KINDS, read_items
from touchr1_jax.bench.json_lines import read_lines, write_lines
from touchr1_jax.bench.questions.draw import Quota

pytestmark = pytest.mark.long  # the experiment runs first

NONE = dict.fromkeys(KINDS, 0)
QUOTA = Quota(**NONE | {"identify": 12, "scale": 6, "compose": 4, "compare": 4, "one_sensor": 16})


@pytest.fixture(scope="module")
def directory(tmp_path_factory, records):
    config = dataclasses.replace(dataset_card.SMOKE, data="records", data_dir=records, quota=QUOTA)
    return run_shrunk(dataset_card, config, tmp_path_factory.mktemp("runs"))


def test_everything_is_reported(directory):
    results = read_json(directory / "results.json")
    assert all(r["met"] for r in results["requirements"])
    assert [len(table["columns"]) for table in results["tables"]] == [7, 5, 3, 5, 2, 3]
    assert {row[0]: row[2] for row in results["tables"][0]["rows"]} == {
        kind: count for kind, count in dataclasses.asdict(QUOTA).items() if count
    }
    assert (directory / "plots" / "answers.svg").exists()


def test_its_items_are_of_test_objects_alone(directory, records):
    objects = RecordStore(records).objects
    items = read_items(directory / "items.jsonl")
    assert len(items) == QUOTA.total
    assert {objects[t.object].split for item in items for t in item.ask.touches} == {"test"}


def quotas() -> list[str]:
    return [
        part
        for kind, count in dataclasses.asdict(QUOTA).items()
        for part in (f"--{kind.replace('_', '-')}", str(count))
    ]


def test_the_command_makes_the_same_bench(directory, records, tmp_path):
    assert main(["generate", str(records), "--out", str(tmp_path / "items.jsonl"), *quotas()]) == 0
    assert (tmp_path / "items.jsonl").read_bytes() == (directory / "items.jsonl").read_bytes()


def test_another_author_by_command(directory, records, tmp_path):
    requests, answers, out = (tmp_path / name for name in ("requests.jsonl", "answers.jsonl", "items.jsonl"))
    assert main(["propose", str(records), "--out", str(requests), *quotas()]) == 0
    words = {tree["id"]: tree["answer"] for _, tree in read_lines(requests)}
    trees = [item.to_json() for item in read_items(directory / "items.jsonl")]
    write_lines(
        answers,
        (
            {"answer": words[t["id"]]} | {name: t[name] for name in ("id", "question", "rationale", "evidence")}
            for t in trees
        ),
    )
    assert main(["accept", str(records), str(answers), "--out", str(out), *quotas()]) == 0
    assert out.read_bytes() == (directory / "items.jsonl").read_bytes()
    assert read_lines(out.with_suffix(".rejected.jsonl")) == []


def test_anybody_is_scored(directory, tmp_path, capsys, monkeypatch):
    items = read_items(directory / "items.jsonl")
    said, silent = tmp_path / "said.jsonl", tmp_path / "silent.jsonl"
    write_lines(said, ({"id": i.ask.id, "text": i.rationale} for i in items[:-1]))
    write_lines(silent, [])
    score = ["score", str(directory / "items.jsonl"), str(said), str(silent), "--cache-dir", str(tmp_path / "cache")]
    assert main(score) == 0
    shown = capsys.readouterr().out
    assert f"parsed {100 * (len(items) - 1) / len(items):.1f} %" in shown
    assert "parsed 0.0 %" in shown
    assert "no average without" in shown
    monkeypatch.setattr("experiments.bench.score_units.metric_rows", None)
    assert main(score) == 0  # what was scored is not scored again
    assert capsys.readouterr().out == shown
    one, other = sorted((tmp_path / "cache" / "scores").glob("*.json"))
    one.write_bytes(other.read_bytes())
    assert main(score) == 1
    assert f"holds the scores of {other.stem}: put its own copy back, or remove it" in capsys.readouterr().err
    for text in ("[]", "{}", '{"rows": {"acc": {}}}', '{"rows": {}}', '{"rows": {"none": {}}, "said": ""}'):
        one.write_text(text)
        assert main(score) == 1
        assert f"{one} is not that of a run" in capsys.readouterr().err
    assert main([*score[:-1], str(said)]) == 1
    assert f"cache-dir is {said}: must be a folder" in capsys.readouterr().err
    write_lines(said, [{"id": "nobody", "text": "?"}])
    assert main(score) == 1
    assert "line 1: id is 'nobody'" in capsys.readouterr().err


@pytest.mark.slow
def test_workers_score_the_same(directory, tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).resolve().parents[3]))
    items, said = read_items(directory / "items.jsonl"), tmp_path / "said.jsonl"
    write_lines(said, ({"id": i.ask.id, "text": i.rationale} for i in items))
    shown = []
    for name, options in {"here": [], "there": ["--launcher.workers", "2"]}.items():
        score = ["score", str(directory / "items.jsonl"), str(said), "--cache-dir", str(tmp_path / name), *options]
        assert main(score) == 0
        shown.append(capsys.readouterr().out)
    assert shown[0] == shown[1]


def test_a_sample_is_drawn_by_command(directory, records, tmp_path):
    sheet = tmp_path / "sheet.csv"
    assert main(["audit-sheet", str(directory / "items.jsonl"), str(records), "--out", str(sheet), "--count", "5"]) == 0
    assert len(sheet.read_text().splitlines()) == 6
    assert len(read_json(sheet.with_suffix(".key.json"))) == 5
