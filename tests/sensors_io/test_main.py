"""The command line: tables for people, exit status 1 and one line for known errors."""

import importlib
import io
import pathlib
import re
import shutil
import subprocess
import sys
import types

import numpy as np
import pytest
from rich.console import Console

from sensors_io import __main__ as cli
from sensors_io.commands import console as printing
from sensors_io.commands import generate as generating
from sensors_io.commands.console import ERR, OUT
from sensors_io.importers.pictures import read_picture
from sensors_io.records import RecordWriter
from tests.sensors_io import fakes
from tests.sensors_io.importers.films import entry, folder, picture

GELSLAM = pathlib.Path(__file__).resolve().parents[1] / "data" / "gelslam"
LAYOUTS = "octopi touch-and-go tvl tacquad feelanyforce ycb-slide tac3d estimate-modulus"


@pytest.fixture
def run(monkeypatch):
    """Run a command; returns its status, its output and its messages."""

    def call(*args):
        out, err = io.StringIO(), io.StringIO()
        for console, file in ((OUT, out), (ERR, err)):
            monkeypatch.setattr(console, "_file", file)  # `file` would come back as the stream of this test
            monkeypatch.setattr(console, "width", 200)
        return cli.main([str(arg) for arg in args]), out.getvalue(), err.getvalue()

    return call


def test_import_reports_what_it_skipped(run, tmp_path):
    source = folder(tmp_path / "in", entry("ball", videos=2))
    (source / "videos" / "ball_1.avi").write_bytes(b"broken")
    status, out, _ = run(
        "import", "physiclear", source, "--out", tmp_path / "out", "--test-share", "0", "--stride", "3"
    )
    assert status == 0
    assert "does not open as a video" in out
    _, out, _ = run("check", tmp_path / "out")
    assert re.search(r"does not open as a video.* 1 ", out)
    status, out, _ = run("list", tmp_path / "out")
    assert status == 0
    assert "ball" in out
    assert "1 sequences, 4 frames" in out


def test_check_counts_flags_and_verifies(run, tmp_path):
    fakes.write(tmp_path, 4, per_shard=2)
    status, out, err = run("check", tmp_path)
    assert (status, err.strip()) == (0, "")
    assert "4 sequences, 48 frames" in out
    assert "strain_limit" in out
    by_filters = out[out.index("flags by the filters") :]
    assert re.search(r"incomplete\W+0 ", by_filters)
    assert re.search(r"border_contact\W+· ", by_filters)  # no filter of recorded numbers can tell
    shard = tmp_path / "contacts-00001.arrayrecord"
    data = bytearray(shard.read_bytes())
    data[len(data) // 4] ^= 255
    shard.write_bytes(data)
    status, _, err = run("check", tmp_path)
    assert status == 1
    assert "CorruptRecordsError" in err
    assert "contacts-00001.arrayrecord" in err


@pytest.mark.parametrize("name", ["cups [v2]", "[/x]"])
def test_brackets_in_the_name_of_a_folder_are_shown(run, tmp_path, name):
    records = tmp_path / name / "records"
    fakes.write(records, 1)
    export = ("export", records, "--to", "hdf5", "--out", tmp_path / name / "a")
    for command in (("list", records), ("check", records), export):
        status, out, err = run(*command)
        assert (status, name in out) == (0, True), (command, out, err)


def test_record_and_check_count_what_a_recording_leaves_out(run, tmp_path):
    """A camera that is plugged in again comes back with its own size; a killed session leaves a journal."""
    for n in range(12):
        picture(tmp_path / "shots" / f"{n}.png", shape=(10, 32) if n < 4 else (24, 32))
    out = tmp_path / "records"
    (out / ".journals").mkdir(parents=True)
    _, _, err = run("list", out)
    assert "has no index.json: give the directory of a data set, or write one there first (a recording was" in err
    words = ["record", "--out", out, "--object-id", "cup", "--free-s", "0.4"]
    status, said, _ = run(*words, "replay", "--path", tmp_path / "shots", "--seconds", "5")
    assert status == 0
    assert "4 frames were left out: their size or arrays differ from most of their contact; fix the size of the" in said
    (out / ".journals" / "cup-0-free-0.refused").touch()
    status, said, err = run("check", out)
    assert (status, err) == (0, "")
    assert re.search(r"frame of another size or with other arrays than.* 4 ", said)
    assert "holds 1 contacts that were refused when they were recorded; move them away or delete them" in said
    (out / ".journals" / "cup-1-free-0.journal").touch()
    status, _, err = run("check", out)
    assert status == 1
    assert "holds 1 contacts that are not in the records" in err


def test_generate_hands_its_options_on(run, tmp_path, monkeypatch):
    asked = []

    def generate(config, out, *, progress, launcher):
        asked.append((config.objects, config.frames, launcher.engine, launcher.workers))
        progress(1, 2)
        fakes.write(out, 2)

    monkeypatch.setattr(generating, "generate_records", generate)
    status, out, _ = run(
        "generate", "--objects", "7", "--frames", "5", "--launcher.workers", "3", "--out", tmp_path / "r"
    )
    assert status == 0
    assert asked == [(7, 5, "local", 3)]
    assert "2 sequences" in out


REPLAY = ["replay", "--path", str(GELSLAM)]
BOARD = ["--rows", "7", "--columns", "9", "--pitch-mm", "2", "--out", "o.json"]


@pytest.mark.parametrize(
    ("args", "devices"),
    [
        (["check", "records", "--pictures"], []),
        (["geometry", "board.png", *BOARD], []),
        (["view", "--port", "0"], REPLAY),
    ],
    ids=["check", "geometry", "view"],
)
def test_a_picture_that_there_is_not_is_one_line(run, tmp_path, monkeypatch, args, devices):
    monkeypatch.chdir(tmp_path)
    fakes.write(tmp_path / "records", 1, sensors=("tac3d",))
    shutil.copy(GELSLAM / "background.png", "board.png")
    status, _, err = run(*args, "--background", "nowhere.png", *devices)
    assert status == 1
    assert err == "SourceError: nowhere.png is absent: must be a whole picture; replace it\n"


EXTRACT = ["extract", "p", "--background", "b", "--out", "o"]
REST = str(GELSLAM / "background.png")
GEOMETRY = ["geometry", REST, "--background", REST, "--pitch-mm", "2", "--out", "o.json"]
NO_DIRECTORY = [[*name.split(), "nowhere"] for name in (*LAYOUTS.split(), "vtv150k --sensor digit")]


@pytest.mark.parametrize(
    ("status", "args", "message"),
    [
        (1, ["list", "nowhere"], "MissingIndexError: nowhere has no index.json"),
        (1, ["import", "physiclear", "nowhere", "--out", "o"], "ImportSourceError: nowhere/labels.json is missing"),
        *((1, ["import", *of, "--out", "o"], "ImportSourceError: nowhere is no directory: ") for of in NO_DIRECTORY),
        (1, [*GEOMETRY, "--rows", "0", "--columns", "9"], "GeometryError: rows and columns are 0 and 9: must be ≥ 1"),
        (1, [*GEOMETRY, "--rows", "7", "--columns", "-1"], "GeometryError: rows and columns are 7 and -1: must be"),
        (2, [*EXTRACT, "--nodes", "0"], "ValueError: nodes is 0: must be ≥ 4"),
        (2, [*EXTRACT, "--mm-per-px", "nan"], "ValueError: mm_per_px is nan: must be"),
        (2, [*EXTRACT, "--smoothing-mm", "inf"], "ValueError: smoothing_mm is inf: must be"),
        (2, ["extract", "/dev/zero", *EXTRACT[2:]], "ValueError: inputs is /dev/zero: must be a file"),
        (2, ["devices", "--tac3d-port", "-1"], "ValueError: tac3d_port is -1: must lie in 0 … 65535"),
        (2, ["devices", "--wait-s", "1e300"], "ValueError: wait_s is 1e+300: must be"),
        *(
            (2, [*command.split(), "-1", *device], f"ValueError: {name} is -1.0: must be ≥ 0")
            for command, name, device in (
                ("devices --wait-s", "wait_s", []),
                ("view tac3d --wait-s", "wait_s", []),
                ("sync netft + tac3d --wait-s", "wait_s", []),
                ("view tac3d + bridge --wait-s", "wait_s", []),
                ("force-zero --out o --wait-s", "wait_s", ["netft"]),
                ("zero --seconds", "seconds", ["netft"]),
                ("sync --most-s", "most_s", ["netft"]),
                ("record --out o --object-id a --free-s", "free_s", ["tac3d"]),
            )
        ),
        (2, ["view", "--port", "99999", *REPLAY], "ValueError: port is 99999: must lie in 0 … 65535"),
        (2, ["view", *REPLAY, "+", "tac3d", "--port", "70000"], "ValueError: port is 70000: must lie in 0 … 65535"),
        (2, ["list", "/dev/zero"], "ValueError: records is /dev/zero: must be a file or a folder, not a pipe"),
        (2, ["label", "r", "--labels", "/dev/zero", "--annotator", "a"], "ValueError: labels is /dev/zero: must be"),
        (
            2,
            ["geometry", "same", *GEOMETRY[2:-1], "same", "--rows", "7", "--columns", "9"],
            "ValueError: out is same: ",
        ),
        (2, ["extract", "same", *EXTRACT[2:-1], "same"], "ValueError: out is same: is inputs as well"),
        (2, [*EXTRACT[:-1], "s3://b/x.npz"], "ValueError: out is s3:/b/x.npz: must be a path on this machine"),
        (2, ["import", "tvl", "t", "--out", ""], "ValueError: --out is '': must not be empty; give its value"),
        (2, ["import", "tvl", "t", "--out="], "ValueError: --out is '': must not be empty; give its value"),
        (2, ["check", ""], "ValueError: an argument is '': must not be empty; give its value"),
        (2, ["import", "tvl", "t", "--out=~/r"], "ValueError: --out=~/r: the shell leaves this ~ as it is; write the"),
        (2, ["check", "~/r"], "ValueError: ~/r: the shell leaves this ~ as it is; write the whole path"),
    ],
)
def test_known_errors_are_one_line(run, tmp_path, monkeypatch, status, args, message):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "same").touch()
    found, out, err = run(*args)
    assert (found, out) == (status, "")
    assert err.startswith(message)
    assert len(err.strip().splitlines()) == 1


@pytest.mark.parametrize(
    ("option", "value"), [("--rate-hz", "0"), ("--seconds", "-1"), ("--contact", "-1"), ("--seed", "-1")]
)
def test_a_replay_refuses_numbers_while_the_command_is_read(run, capsys, option, value):
    with pytest.raises(SystemExit) as stop:
        run("view", *REPLAY, option, value)
    assert stop.value.code == 2
    assert f"{option[2:].replace('-', '_')} is {value}" in capsys.readouterr().err


@pytest.mark.parametrize("program", ["sensors_io", "experiments", "experiments.bench"])
def test_an_encoding_without_a_letter_ends_no_program(program, monkeypatch):
    streams = [io.TextIOWrapper(io.BytesIO(), encoding="ascii") for _ in range(2)]
    for name, stream in zip(("stdout", "stderr"), streams, strict=True):
        monkeypatch.setattr(sys, name, stream)
    monkeypatch.setattr(sys, "argv", [program, "--help"])
    try:
        status = importlib.import_module(f"{program}.__main__").main()
    except SystemExit as end:
        status = end.code
    assert status == 0
    assert b"?" in b"".join(stream.detach().getvalue() for stream in streams)


def test_help_names_every_command_and_a_wrong_one_is_told_the_right_ones(run):
    status, out, _ = run("--help")
    assert status == 0
    assert [line.split()[0] for line in out.splitlines()[1:]] == list(cli.COMMANDS)
    status, out, err = run("lst")
    assert (status, out) == (2, "")
    assert "There is no command 'lst'. Did you mean list?" in err
    assert "  label       Give recorded objects labels" in err


@pytest.mark.long
def test_only_generating_scenes_waits_for_jax():
    """Importing it takes longer than most commands work; `list` begins without SciPy, too."""
    others = {place.partition(".")[0] for place in cli.COMMANDS.values()} - {"generate"}
    source = f"""
import importlib, sys
import sensors_io.__main__, sensors_io.commands.list
assert not {{"jax", "scipy", "grain"}} & set(sys.modules)
for module in {sorted(others)}:
    importlib.import_module(f"sensors_io.commands.{{module}}")
assert not {{"jax", "grain"}} & set(sys.modules)
"""
    subprocess.run([sys.executable, "-c", source], check=True)


def test_check_says_that_records_are_incomplete(run, tmp_path):
    with RecordWriter(tmp_path, meta=fakes.META) as writer:
        writer.publish()
        status, _, err = run("check", tmp_path)
    assert status == 1
    assert err.strip().startswith("IncompleteRecordsError: ")


def test_an_interrupt_says_how_to_go_on(run, tmp_path, monkeypatch, capsys):
    def stop(*args, **kwargs):
        raise KeyboardInterrupt

    monkeypatch.setattr(generating, "generate_records", stop)
    assert run("generate", "--out", tmp_path / "r")[0] == 130
    assert "run the same command again" in capsys.readouterr().err


def test_check_looks_at_pictures_where_it_can(run, tmp_path):
    """Real presses of a Mini and their gel at rest; the other sensors' noise has no background and says so."""
    names = ("background", "press_12", "press_14", "press_18")
    frames = np.stack([read_picture(GELSLAM / f"{name}.png") for name in names])
    fakes.write(tmp_path, 1, sensors=("tac3d",))
    with RecordWriter(tmp_path, meta=fakes.META, resume=True) as writer:
        n = len(frames)
        shown = fakes.sequence(0, length=n, trial=1, frames=frames, camera={"recording": {"background": "rest.png"}})
        writer.write_contact([shown])
        writer.write_contact([fakes.sequence(0, trial=2)])
    shutil.copy(GELSLAM / "background.png", tmp_path / "rest.png")
    status, out, _ = run("check", tmp_path, "--pictures")
    assert status == 0
    looked = out[out.index("flags by the pictures") :]
    assert re.search(r"no_contact\W+1 ", looked)
    assert "not looked at: 1 sequences, they hold no pictures" in out
    assert "not looked at: 1 sequences, no gel at rest was recorded" in out


def test_progress_without_a_terminal_is_written_in_lines(monkeypatch):
    """The first contact was there before; what came within ten seconds of the last line, or ends it, is not written."""
    written = io.StringIO()
    monkeypatch.setattr(printing, "ERR", Console(file=written, width=200))
    clock = iter([0.0, 5.0, 10.0, 12.0, 20.0])
    monkeypatch.setattr(printing, "time", types.SimpleNamespace(monotonic=lambda: next(clock)))
    with printing.progress_bar("contacts") as progress:
        for done in (2, 3, 4, 5):
            progress(done, 5)
    assert written.getvalue() == "contacts: 3/5, 0.2/s, 10 s left\n"
