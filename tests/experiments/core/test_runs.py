"""Run directories, the revision of the code, and past runs as `list` shows them."""

import fcntl
import json
import os
import re
import subprocess
import sys
import threading
from pathlib import Path
from unittest import mock

import pytest

from experiments.__main__ import main as start
from experiments.ask.command import run_asking
from experiments.core import runs
from experiments.core.artifacts import DamagedFileError, UnwrittenError, write_json
from experiments.core.runner import main
from experiments.core.text import duration

FAKES = "tests.experiments.fakes"
COMMAND = "python -m experiments coin --steps 9"
FINISHED = {"verdict": ["It is a coin.", "Really."], "requirements": [{"met": True}, {"met": False}]}


def git(directory, *arguments):
    identity = ("-c", "user.name=a", "-c", "user.email=a@b")
    subprocess.run(["git", *identity, *arguments], cwd=directory, check=True, capture_output=True)


def test_revision_is_clean_dirty_or_unknown(tmp_path, monkeypatch):
    assert runs.revision(tmp_path).commit == "unknown"
    git(tmp_path, "init")
    (tmp_path / "code.py").write_text("1")
    git(tmp_path, "add", ".")
    git(tmp_path, "commit", "-m", "one")
    clean = runs.revision(tmp_path)
    assert len(clean.commit) == 40
    assert not clean.dirty
    (tmp_path / "code.py").write_text("2")
    assert str(runs.revision(tmp_path)) == f"{clean.commit}-dirty"
    (tmp_path / "inside").mkdir()
    assert runs.revision(tmp_path / "inside").commit == "unknown"  # installed below somebody else's checkout
    monkeypatch.setenv("PATH", "")
    assert runs.revision(tmp_path).commit == "unknown"


FOREIGN = '{"experiment": "coin", "scale": "a", "config": {}, "command": "b", "git": %s}'


def test_runs_of_one_second_get_their_own_directories(tmp_path, monkeypatch):
    description = json.loads(FOREIGN % '{"commit": "a", "dirty": false}')
    made = {runs.create(tmp_path / "coin", description) for _ in range(3)}
    assert len(made) == 3
    assert runs.newest(tmp_path / "coin", {}, finished=False) == max(made)
    write_json(max(made) / "results.json", FINISHED)
    assert runs.newest(tmp_path / "coin", {}, finished=True) == max(made)
    assert runs.newest(tmp_path / "coin", {}, finished=False) == sorted(made)[1]
    assert runs.newest(tmp_path / "coin", {"a": 1}, finished=False) is None
    assert runs.newest(tmp_path / "none", {}, finished=False) is None
    (tmp_path / "coin").rename(tmp_path / "die")  # its configuration may have the same fields
    assert runs.newest(tmp_path / "die", {}, finished=True) is None
    (tmp_path / "die").rename(tmp_path / "coin")
    with pytest.raises(UnwrittenError, match=r"runs-dir is .*results\.json: must be a folder .* name another"):
        runs.create(max(made) / "results.json" / "coin", description)
    monkeypatch.setattr(runs.datetime, "datetime", mock.Mock(**{"now.return_value.strftime.return_value": "a" * 300}))
    with pytest.raises(UnwrittenError, match=r"runs-dir is .*: must be a folder that can be written .* name another"):
        runs.create(tmp_path / "coin", description)


def make_run(home, stamp, *, results=None, total=None):
    """A run directory of the fake experiment."""
    directory = home / "coin" / stamp
    description = {
        "experiment": "coin",
        "scale": "default",
        "config": {"steps": 9},
        "git": {"commit": "0123456789", "dirty": True},
        "versions": {"python": "3.11"},
        "machine": {"cpus": 2},
        "command": f"{COMMAND} --fresh",
    }
    write_json(directory / "config.json", description)
    if total is not None:
        write_json(directory / "timing.json", {"total": total})
    if results is not None:
        write_json(directory / "results.json", results)
    return directory


def test_the_list_of_one_experiment_shows_every_run_and_how_to_continue(tmp_path, capsys):
    oldest = make_run(tmp_path, "20260101-000000")
    make_run(tmp_path, "20260102-000000")
    make_run(tmp_path, "20260103-000000", results=FINISHED, total=2)
    with runs.locked(oldest):
        assert main(["list", "coin", "--runs-dir", str(tmp_path)], package=FAKES) == 0
        lines = capsys.readouterr().out.splitlines()
        assert runs.read_run(oldest).state == "running"
    assert runs.read_run(oldest).state == "unfinished"
    stamps = [line.split()[0] for line in lines if line.strip().startswith("2026")]
    assert stamps == ["20260103-000000", "20260102-000000", "20260101-000000"]
    assert "      Really." in lines
    assert f"      to continue: {COMMAND}" in lines
    assert lines[-1].endswith("running")


def test_who_looks_at_a_run_does_not_keep_it_from_going_on(tmp_path):
    """`list`, `compare` and a sweep's page lock each run for the moment in which they see whether it is in use."""
    with (tmp_path / ".lock").open("w") as looking:
        fcntl.flock(looking, fcntl.LOCK_SH)
        threading.Timer(0.1, looking.close).start()
        with runs.locked(tmp_path):
            assert looking.closed
            with pytest.raises(runs.RunInUse, match="is in use by another process"), runs.locked(tmp_path):
                pass


UNREADABLE = "a" * 300
"""As the target of a link: a name that raises an error whoever asks, as a folder without permission does to some."""


def test_a_damaged_run_hides_no_other(tmp_path, capsys):
    (tmp_path / "coin").mkdir()
    (tmp_path / "coin" / "20260104-000000").mkdir()
    (tmp_path / "coin" / "20260104-000000" / "config.json").symlink_to(UNREADABLE)
    make_run(tmp_path, "20260101-000000", results=FINISHED, total=2)
    (make_run(tmp_path, "20260102-000000") / "config.json").write_text("{")
    (make_run(tmp_path, "20260103-000000") / "config.json").write_text('{"model_type": "qwen2_5_vl"}')
    foreign = json.loads((make_run(tmp_path, "20260105-000000") / "config.json").read_text())
    write_json(tmp_path / "coin" / "20260105-000000" / "config.json", foreign | {"experiment": "die"})
    (make_run(tmp_path, "20260106-000000", results=FINISHED) / "config.json").unlink()
    for arguments in (["list"], ["list", "coin"]):
        assert main([*arguments, "--runs-dir", str(tmp_path)], package=FAKES) == 0
        out = capsys.readouterr().out
        assert "20260101-000000  default, code 0123456+: finished, 2 s" in out
        assert "20260102-000000/config.json is damaged" in out
        assert "20260103-000000/config.json is not that of a run" in out
        assert "20260104-000000/config.json'" in out
        assert f"20260105-000000 is a run of die: move it to {tmp_path / 'die'}" in out
        assert "20260106-000000 lacks its config.json: put a copy back" in out
        assert out.count("must be readable; correct its permissions") == 1
    (tmp_path / "coin").rename(tmp_path / "away")
    (tmp_path / "coin").symlink_to(UNREADABLE)
    assert main(["list", "--runs-dir", str(tmp_path)], package=FAKES) == 0
    assert "coin': must be readable" in capsys.readouterr().out


@pytest.mark.parametrize("file", ["config.json", "results.json", "timing.json", ".lock"])
@pytest.mark.parametrize("make", [os.mkfifo, os.mkdir])
def test_no_command_waits_at_a_pipe(tmp_path, capsys, file, make):
    place = make_run(tmp_path, "20260101-000000", results=FINISHED, total=2) / file
    place.unlink(missing_ok=True)
    make(place)
    assert main(["list", "coin", "--runs-dir", str(tmp_path)], package=FAKES) == 0
    assert (f"{file} is damaged (it is a folder, a pipe" in capsys.readouterr().out) == (file != ".lock")


@pytest.mark.parametrize(
    ("file", "content"),
    [
        *(("config.json", text) for text in ("{}", "[]", "7", '{"config": {}}', FOREIGN % "3", FOREIGN % "{}")),
        *(("results.json", text) for text in ("{}", "1", '{"verdict": 2}', '{"verdict": [2]}')),
        ("results.json", '{"verdict": [], "requirements": [1]}'),
        ("timing.json", "[]"),
        ("timing.json", '{"total": NaN}'),
    ],
)
def test_a_foreign_file_is_named(tmp_path, file, content):
    directory = make_run(tmp_path, "20260101-000000")
    (directory / file).write_text(content)
    with pytest.raises(DamagedFileError, match=rf"{file} is not that of a run"):
        runs.read_run(directory)
    if file == "config.json":
        with pytest.raises(DamagedFileError, match=rf"{file} is not that of a run"):
            runs.newest(tmp_path / "coin", {}, finished=False)


@pytest.mark.parametrize("name", ["experiment", "scale", "config", "git"])
def test_results_of_another_run_are_named(tmp_path, name):
    directory = make_run(tmp_path, "20260101-000000")
    own = {"experiment": "coin", "scale": "default", "config": {"steps": 9}, "git": "0123456789-dirty"}
    write_json(directory / "results.json", FINISHED | own)
    assert runs.read_run(directory).state == "finished"
    write_json(directory / "results.json", FINISHED | own | {name: {"steps": 8} if name == "config" else "other"})
    with pytest.raises(DamagedFileError, match=f"is of another run, with another {name}: put its own copy back"):
        runs.read_run(directory)


def test_a_file_in_a_part_of_a_run_names_the_run_and_the_part(tmp_path):
    one, other = (make_run(tmp_path / n, "20260101-000000") for n in "ab")
    write_json(other / "config.json", runs.read_description(other) | {"config": {"steps": 8}})
    assert len({runs.labelled(run / part, "answers/sft-0") for run in (one, other) for part in ("", "x", "y")}) == 6
    (tmp_path / "b" / "config.json").write_text('{"model_type": "qwen2_5_vl"}')  # in the folder of a model's weights
    assert runs.labelled(tmp_path / "a" / "x", "sft/0") == runs.labelled(tmp_path / "b" / "x", "sft/0")  # of no run


def test_a_run_is_named_by_path_stamp_or_experiment(tmp_path):
    directory = make_run(tmp_path, "20260101-000000")
    (tmp_path / "coin" / "latest").symlink_to(directory.name)
    for name in (str(directory), "coin/20260101-000000", "coin", str(tmp_path / "coin")):
        assert runs.locate(name, tmp_path) == directory.resolve()
    with pytest.raises(FileNotFoundError, match=r"'dice' is no run: must be a directory with config\.json"):
        runs.locate("dice", tmp_path)
    with pytest.raises(FileNotFoundError, match=r"holds no config\.json"):
        runs.read_run(tmp_path)


@pytest.mark.parametrize(
    ("seconds", "text"), [(0.4, "0 s"), (59.4, "59 s"), (59.6, "1 min 0 s"), (1170, "19 min 30 s"), (7500, "2 h 5 min")]
)
def test_times_are_read_easily(seconds, text):
    assert duration(seconds) == text


def test_listing_runs_imports_nothing_heavy():
    """JAX, SciPy and charts take seconds to import, of use to runs alone."""
    source = "import sys, experiments.__main__; sys.exit(bool({'jax', 'scipy', 'matplotlib'} & set(sys.modules)))"
    assert subprocess.run([sys.executable, "-c", source], check=False).returncode == 0


def test_an_experiment_without_runs_and_an_unknown_one_are_named(tmp_path, capsys):
    assert main(["list", "coin", "--runs-dir", str(tmp_path)], package=FAKES) == 0
    assert f"has not run under {tmp_path}" in capsys.readouterr().out
    assert main(["list", "coyn", "--runs-dir", str(tmp_path)], package=FAKES) == 2
    assert "Did you mean coin?" in capsys.readouterr().err
    (tmp_path / "file").touch()
    for wrong in (str(tmp_path / "file"), str(tmp_path / "nowhere"), "s3://bucket/runs"):
        assert main(["list", "--runs-dir", wrong], package=FAKES) == 2
        assert "must be a folder of this machine" in capsys.readouterr().err


@pytest.mark.parametrize("place", ["file", "file/below", "s3://bucket/data"])
@pytest.mark.parametrize("command", [["coin"], ["ask", "generated"]])
def test_a_cache_that_is_no_folder_is_refused_before_anything_is_made(tmp_path, monkeypatch, capsys, command, place):
    monkeypatch.chdir(tmp_path)
    Path("file").touch()
    run = main if command == ["coin"] else run_asking
    assert run([*command, "--cache-dir", place], **({"package": FAKES} if run is main else {})) == 1
    assert f"cache-dir is {Path(place)}: must be a folder that can be written" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


@pytest.mark.parametrize("place", ["memory://x/runs", "memory:/x"])
@pytest.mark.parametrize(
    "words", [["coin", "--runs-dir", "{}"], ["export", "touch-small", "{}"], ["list", "--into={}"]]
)
def test_what_would_end_with_the_process_is_no_place(monkeypatch, capsys, words, place):
    monkeypatch.setattr(sys, "argv", ["experiments", *(word.format(place) for word in words)])
    with pytest.raises(SystemExit) as stop:
        start()
    assert stop.value.code == 2
    assert "is kept in the memory of this process alone; name a folder" in capsys.readouterr().err


@pytest.mark.parametrize("words", [["sweep", "ablation_ordinal", "--into", ""], ["list", "--runs-dir="], ["list", ""]])
def test_an_empty_word_is_not_the_current_folder(monkeypatch, capsys, words):
    monkeypatch.setattr(sys, "argv", ["experiments", *words])
    with pytest.raises(SystemExit) as stop:
        start()
    assert stop.value.code == 2
    assert re.fullmatch(
        r"ValueError: (--into|--runs-dir|an argument) is '': must not be empty; .*\n", capsys.readouterr().err
    )
