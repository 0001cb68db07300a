"""The study of real videos on a folder of synthetic presses, and answers for a folder that it never saw."""

import dataclasses
import json
import shutil
from pathlib import Path

import cv2
import pytest

from experiments.core.artifacts import read_json
from experiments.core.runner import main, run_experiment
from experiments.recordings import physiclear
from experiments.recordings.learning import identity
from tests.experiments import tiny
from tests.experiments.recordings.presses import press
from tests.experiments.shrunk import only_run
from tests.sensors_io.importers.films import entry, labels

UNKNOWN = dict.fromkeys(("hardness", "roughness", "bumps", "material"))


def source(path):
    """A folder in PhysiCLeAR's layout: six objects, the rougher ones have more texture, and one without labels."""
    (path / "videos").mkdir(parents=True)
    levels = [dict.fromkeys(("hardness", "roughness", "bumps"), i % 3) for i in range(6)]
    entries = [entry(f"thing{i}", **level) for i, level in enumerate([*levels, UNKNOWN | {"split": "unlabelled"}])]
    for i, item in enumerate(entries):
        for k, name in enumerate(item["videos"]):
            frames = press(depth=25.0 + 15 * (i % 3), texture=0.3 * (i % 3), seed=10 * i + k)
            codec = cv2.VideoWriter.fourcc(*"MJPG")
            writer = cv2.VideoWriter(str(path / "videos" / name), codec, 25.0, frames.shape[2:0:-1])
            for frame in frames:
                writer.write(frame[..., ::-1].copy())
            writer.release()
    labels(path, *entries)
    return path


SMOKE = dataclasses.replace(physiclear.SMOKE, scenes=tiny.SCENES)  # which the session has made
SMALL = dataclasses.replace(physiclear.EXPERIMENT, scales={"smoke": SMOKE})


def run_small(*arguments: str) -> int:
    return run_experiment(SMALL, ["--scale", "smoke", *arguments], "")


@pytest.fixture(scope="module")
def run(tmp_path_factory, cache_dir):
    """A finished run, its folder of videos and its cache."""
    home = tmp_path_factory.mktemp("physiclear")
    data = source(home / "in")
    places = ["--runs-dir", str(home / "runs"), "--cache-dir", str(cache_dir)]
    assert run_small("--data-dir", str(data), "--objects", "6", *places) == 0
    return home, data, only_run(home / "runs", "physiclear"), places


@pytest.mark.long
def test_every_video_is_answered_by_a_policy_that_never_met_its_object(run):
    _, _, directory, _ = run
    results = read_json(directory / "results.json")
    assert (results["data"]["objects"], results["data"]["videos"]) == (6, 12)
    scores, partitions, *_ = results["tables"]
    assert [row[0] for row in scores["rows"]][:2] == ["policy, one video", "policy, all videos of the object"]
    assert [row[0] for row in partitions["rows"]] == ["1001", "1002"]
    bounds = {r["name"] for r in results["requirements"]}
    assert {"all right", "all videos: mean", "surest half: mean", "data and training, one partition"} < bounds
    assert (directory / "plots" / "confusions.svg").stat().st_size > 1000


@pytest.mark.long
def test_a_kept_policy_answers_for_a_folder(run, capsys):
    home, data, directory, places = run
    unseen = home / "unseen"
    unseen.mkdir()
    shutil.copy(data / "videos" / "thing6_0.avi", unseen / "new.avi")
    (unseen / "broken.mov").write_bytes(b"no video")
    out, policy = home / "pred.json", str(directory / "policy.npz")
    asked = ["--predict", str(unseen), "--out", str(out), "--policy", policy]
    assert run_small(*asked, *places) == 0
    answers = json.loads(out.read_text())
    assert answers.keys() == {"new.avi"}
    answer = answers["new.avi"]
    assert {answer[name] for name in ("hardness", "roughness", "bumps")} <= {0, 1, 2}
    assert answer["words"].endswith(("%", "touch it again"))
    assert sum(answer["probabilities"]["hardness"]) == pytest.approx(1, abs=1e-4)
    again = [str(unseen / "new.avi"), str(data / "videos" / "thing5_0.avi")]
    assert run_small("--predict", *again, "--out", str(out), "--policy", policy, *places) == 0
    assert json.loads(out.read_text()).keys() == {"new.avi", "thing5_0.avi", "together"}
    other = shutil.copytree(data, home / "other")
    table = json.loads((other / "labels.json").read_text())
    (other / "labels.json").write_text(json.dumps(table | {"objects": table["objects"][:5]}))
    for folder, number in ((data, 6), (other, 5)):  # the cache has the policy of the first
        order = ["--objects", "None", "--data-dir", str(folder), "--fresh"]
        assert run_small("--predict", str(unseen), "--out", str(out), *order, *places) == 0
        results = read_json(home / "runs" / "physiclear" / "latest" / "results.json")
        assert results["settings"]["objects learned from"] == number
    (home / "runs" / "physiclear" / "latest" / "results.json").unlink()  # the same run goes on
    (other / "labels.json").write_text(json.dumps(table | {"objects": table["objects"][:4]}))
    assert run_small("--predict", str(unseen), "--out", str(out), *order[:-1], *places) == 1
    assert "other videos or scenes: another policy is trained" in " ".join(capsys.readouterr().out.split())
    kept = Path(places[-1]) / f"physiclear-policy-{identity(SMOKE.learn)}-1001.npz"
    asked = ["--predict", str(unseen), "--out", str(out), "--fresh", *places]
    assert run_small(*asked) == 0
    assert run_small(*asked, "--seeds", "7", "8") == 1
    assert "no such file; give the --seeds that it was trained with" in capsys.readouterr().err
    shutil.copy(kept, kept.with_name(kept.name.replace("-1001", "-7")))
    assert run_small(*asked, "--seeds", "7", "8") == 1
    assert "-1001: must be of physiclear-policy-" in capsys.readouterr().err


@pytest.mark.long
@pytest.mark.parametrize("name", ["physiclear", "sim_to_real"])
@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("--seeds", "seeds is ()"),
        ("--seeds 7 7", "must be different seeds"),
        ("--folds 1", "folds is 1: must be at least 2"),
        ("--learn.evidence.folds 1", "learn.evidence.folds is 1"),
        ("--learn.evidence.ridge 0", "learn.evidence.ridge is 0.0: must be above 0"),
        ("--learn.evidence.families x", "learn.evidence.families is ('x',)"),
        ("--learn.evidence.families edges", "must hold those of by_attribute"),
    ],
)
def test_what_cannot_be_fitted_is_refused_before_videos_are_read(name, arguments, message, tmp_path, capsys):
    assert main([name, *arguments.split(), "--data-dir", "x", "--runs-dir", str(tmp_path)]) == 2
    assert message in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--predict", "x", "y"], "predict is x y, out None: give both to predict"),
        (["--policy", "x"], "policy is x: is read by --predict alone"),
        ([], "data_dir is None"),
    ],
)
def test_an_incomplete_command_is_refused(arguments, message, tmp_path, capsys):
    assert main(["physiclear", *arguments, "--runs-dir", str(tmp_path), "--cache-dir", str(tmp_path / "c")]) == 1
    error = capsys.readouterr().err
    assert error.startswith("ConfigurationError: ")
    assert message in error
