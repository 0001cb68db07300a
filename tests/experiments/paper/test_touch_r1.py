"""The paper's training on released weights: what is refused before anything is made, and the whole run on tiny ones."""

import dataclasses
import json
import os
import signal
from pathlib import Path

import numpy as np
import pytest

from experiments.core.artifacts import read_json
from experiments.core.context import Context
from experiments.core.loops import STEPPING, WAITING
from experiments.core.results import Estimate
from experiments.core.runner import main
from experiments.paper.touch_r1 import ARM, DRAWN, SMALL, SMOKE, TAUGHT, WRITTEN, ZERO, verdict
from experiments.study.study import BLIND, CONTINUED, SFT
from sensors_io.schema import SENSORS
from tests.experiments.shrunk import only_run
from tests.touchr1_jax.training.stand_in import COMPLETE, StandIn
from touchr1_jax.bench.grounding import CONTROLS
from touchr1_jax.models.load import load_checkpoint
from touchr1_jax.models.released_policy import build_released_policy

SERVER = ["--rollouts.url", "http://127.0.0.1:9", "--rollouts.tries", "1"]


@pytest.mark.long
@pytest.mark.parametrize(
    ("options", "message"),
    [
        ([], "weights is None: must be the folder of a released Qwen2.5-VL"),
        (["--weights", "nowhere"], "nowhere/config.json is no file: must be the config.json of a checkpoint"),
        (["--scale", "smoke", *SERVER, "--weights"], "http://127.0.0.1:9/v1/models gave no answer in 1 tries"),
    ],
)
def test_absent_weights_and_servers_are_named_before_data_are_made(tmp_path, weights, capsys, options, message):
    places = ["--runs-dir", str(tmp_path / "runs"), "--cache-dir", str(tmp_path / "data")]
    there = [str(weights)] if options[-1:] == ["--weights"] else []
    assert main(["touch_r1", *options, *there, *places]) == 1
    assert "".join(message.split()) in "".join(capsys.readouterr().err.split())
    assert not list((tmp_path / "data").glob("scenes-*"))


@pytest.mark.slow
def test_a_server_draws_the_rollouts_of_the_smoke_run(tmp_path, weights):
    """With a policy in bfloat16 whose decoder is the same on both sides."""
    model = dataclasses.replace(SMOKE.model, in_order=True)
    with StandIn(build_released_policy(model, load_checkpoint(weights), SENSORS)) as server:
        places = ["--runs-dir", str(tmp_path / "runs"), "--cache-dir", str(tmp_path / "data")]
        options = ["--weights", str(weights), "--rollouts.url", server.url, "--grpo.algorithm.importance-cap", "2"]
        options += ["--grpo.algorithm.mismatch-limit", "0.5", "--grpo.algorithm.score-centering", "16"]
        assert main(["touch_r1", "--scale", "smoke", *places, *options]) == 0
        asked = [body for path, body in server.requests if path == COMPLETE]
    assert len(asked) == SMOKE.grpo_steps * SMOKE.grpo.prompts
    assert {body["logprobs"] for body in asked} == {16}
    directory = only_run(tmp_path / "runs", "touch_r1")
    assert read_json(directory / "results.json")["settings"]["rollouts"] == server.url
    lines = [json.loads(line) for line in (directory / "metrics.jsonl").read_text().splitlines()]
    steps = [line for line in lines if line["stage"] == f"grpo/{ARM}/0"]
    assert len(steps) == SMOKE.grpo_steps
    assert all(0 < line["sampler_gap"] < 0.05 and line["dropped_share"] == 0 for line in steps)
    assert json.loads((directory / "policies" / ARM / "0" / "config.json").read_text())["model"]["in_order"]


@pytest.mark.parametrize(("config", "first"), [(SMOKE, DRAWN), (SMALL, TAUGHT)])
def test_a_verdict_says_what_its_figures_are_of(config, first):
    half = Estimate(mean=50.0, ci95=(40.0, 60.0), per_seed=(50.0,))
    rows = {name: {"acc": half} for name in (ZERO, SFT, CONTINUED, ARM, BLIND, "constant")}
    assert verdict(config, rows, None)[0] == first
    assert DRAWN not in (said := verdict(dataclasses.replace(config, weights=Path("released")), rows, None))
    assert TAUGHT not in said


def run(home: Path, cache: Path) -> int:
    return main(["touch_r1", "--scale", "smoke", "--runs-dir", str(home), "--cache-dir", str(cache)])


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A run that nobody stopped."""
    home = tmp_path_factory.mktemp("whole")
    assert run(home / "runs", home / "data") == 0
    return home


@pytest.mark.slow
def test_the_smoke_run_trains_scores_writes_and_answers(whole, capsys):
    directory = only_run(whole / "runs", "touch_r1")
    results = read_json(directory / "results.json")
    assert list(results["arms"]) == ["sft", "sft_continued", ARM]
    assert list(results["baselines"])[:2] == [ZERO, "tactile_blind"]
    assert {"acc", "omae", "csc", "mat_acc", "parse_rate", "reward"} <= set(results["arms"][ARM])
    assert "csc" not in results["baselines"][ZERO]
    assert results["verdict"][0] == DRAWN
    (same,) = results["requirements"]
    assert same["measured"] == 0
    assert {"Decision rules", "Seconds of training"} <= {table["title"] for table in results["tables"]}
    stages = ("sft/0", "decoder/sft/0", "decoder/sft_continued/0", f"grpo/{ARM}/0", "blind/0")
    assert {f"{what}/{stage}" for what in (STEPPING, WAITING) for stage in stages} <= set(results["timing"])
    assert results["settings"]["weights"] == "tiny, bfloat16"
    folder = directory / "policies" / ARM / "0"
    answer = ["ask", str(folder), "generated:1", "--question", "How hard is it?", "--json"]
    assert main([*answer, "--cache-dir", str(whole / "data")]) == 0
    (said,) = json.loads(capsys.readouterr().out.splitlines()[-1])["touches"]
    assert said["answers"][0]["attribute"] == "hardness"
    assert (directory / "report.html").exists()
    said = [f"{ARM}-under-{control}" for control in CONTROLS]
    names = {path.stem for path in (directory / "answers").glob("*.npz")}
    assert names == {f"{name}-0" for name in ("sft", "sft_continued", ARM, "tactile_blind", ZERO, WRITTEN, *said)}


@pytest.mark.slow
@pytest.mark.parametrize("where", [("sft/0", 5), ("decoder/sft/0", 2), (f"grpo/{ARM}/0", 2)])
def test_a_stopped_run_ends_in_the_same_bits(whole, tmp_path, monkeypatch, where):
    log = Context.log

    def stop(self, stage, step, **scalars):
        log(self, stage, step, **scalars)
        if (stage, step) == where:
            os.kill(os.getpid(), signal.SIGTERM)

    with monkeypatch.context() as patch:
        patch.setattr(Context, "log", stop)
        assert run(tmp_path, whole / "data") == 128 + signal.SIGTERM
    assert run(tmp_path, whole / "data") == 0
    ended, expected = only_run(tmp_path, "touch_r1"), only_run(whole / "runs", "touch_r1")
    assert (ended / "metrics.jsonl").read_bytes() == (expected / "metrics.jsonl").read_bytes()
    for path in (expected / "policies" / ARM / "0").glob("*.safetensors"):
        assert (ended / path.relative_to(expected)).read_bytes() == path.read_bytes(), path.name
    for path in (expected / "answers").iterdir():
        with np.load(path) as a, np.load(ended / path.relative_to(expected)) as b:
            assert a.files == b.files
            assert all(np.array_equal(a[name], b[name]) for name in a.files), path.name
    lines = [json.loads(line) for line in (ended / "metrics.jsonl").read_text().splitlines()]
    assert sum(line["stage"] == where[0] for line in lines) == (8 if where[0] == "sft/0" else 4)
