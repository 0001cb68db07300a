"""The study of real videos on a folder of synthetic presses, and answers for a folder that it never saw."""

import json
import shutil

import pytest

from experiments.core.artifacts import read_json
from experiments.core.runner import main
from tests.experiments.recordings.presses import source


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A finished run, its folder of videos and its cache."""
    home = tmp_path_factory.mktemp("physiclear")
    data = source(home / "in")
    places = ["--runs-dir", str(home / "runs"), "--cache-dir", str(home / "cache")]
    arguments = ["physiclear", "--scale", "smoke", "--data-dir", str(data), "--objects", "6", *places]
    assert main(arguments) == 0
    (directory,) = (p for p in (home / "runs" / "physiclear").iterdir() if not p.is_symlink())
    return home, data, directory, places


def test_every_video_is_answered_by_a_policy_that_never_met_its_object(run):
    _, _, directory, _ = run
    results = read_json(directory / "results.json")
    assert results["data"]["objects"] == 6
    assert results["data"]["videos"] == 12
    assert [t["title"] for t in results["tables"]][:2] == ["Unseen objects", "Every fold"]
    assert [row[0] for row in results["tables"][0]["rows"]][:2] == ["policy", "probes alone"]
    assert {r["name"] for r in results["requirements"]} == {"all right", "mean", "OMAE", "data and training, all folds"}
    assert (directory / "plots" / "confusions.svg").stat().st_size > 1000


def test_a_kept_policy_answers_for_a_folder(run):
    home, data, directory, places = run
    unseen = home / "unseen"
    unseen.mkdir()
    shutil.copy(data / "videos" / "thing6_0.avi", unseen / "new.avi")
    (unseen / "broken.mov").write_bytes(b"no video")
    out = home / "pred.json"
    policy = ["--policy", str(directory / "policy.npz")]
    arguments = ["physiclear", "--scale", "smoke", "--predict", str(unseen), "--out", str(out), *policy, *places]
    assert main(arguments) == 0
    answers = json.loads(out.read_text())
    assert list(answers) == ["new.avi"]
    assert set(answers["new.avi"]) == {"hardness", "roughness", "bumps"}
    assert all(level in (0, 1, 2) for level in answers["new.avi"].values())


@pytest.mark.parametrize(
    ("arguments", "message"), [(["--predict", "x"], "give both to predict"), ([], "data_dir is None")]
)
def test_half_a_question_is_refused(arguments, message, tmp_path, capsys):
    assert main(["physiclear", *arguments, "--runs-dir", str(tmp_path), "--cache-dir", str(tmp_path / "c")]) == 1
    said = capsys.readouterr().err
    assert said.startswith("ConfigurationError: ")
    assert message in said
