"""A run at a URL goes on from any copy of it, on any machine."""

import pathlib
import shutil

import pytest
from fsspec.implementations.memory import MemoryFileSystem

from experiments.core.remote_runs import run_at

RUN = "20260101-000000"


@pytest.fixture
def sent(monkeypatch, tmp_path):
    """Names of the files that were sent to a store in memory, in their order."""
    monkeypatch.setenv("TOUCHR1_CACHE", str(tmp_path / "cache"))
    names, put = [], MemoryFileSystem.put_file

    def noted(store, path, name, **options):
        names.append(name.partition("/runs/toy/")[2])
        return put(store, path, name, **options)

    monkeypatch.setattr(MemoryFileSystem, "put_file", noted)
    return names


@pytest.fixture
def url(tmp_path):
    """Of a folder of runs that is not there yet."""
    return f"memory://{tmp_path.name}/runs"


def write(folder, **files: str):
    for name, text in files.items():
        path = folder / RUN / name.replace("__", "/")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)


def test_an_unfinished_run_goes_on_elsewhere_and_a_finished_one_stays_where_it_is(sent, url):
    seen = []

    def begin(runs_dir):
        write(runs_dir / "toy", config="{}", stages__one="1", stages__logged__one="1", metrics="a\n")
        (runs_dir / "toy" / "latest").symlink_to(RUN)
        write(runs_dir / "toy", **{".lock": "", "checkpoints__sft__5.orbax-checkpoint-tmp__x": "half"})
        seen.append(runs_dir)
        return 130

    def go_on(runs_dir):
        run = runs_dir / "toy" / RUN
        seen.append({p.relative_to(run).as_posix(): p.read_text() for p in run.rglob("*") if p.is_file()})
        write(runs_dir / "toy", metrics="a\nb\n", **{"results.json": "{}"})
        return 0

    def look(runs_dir):
        seen.append(list((runs_dir / "toy").glob("*")))
        return 0

    assert run_at(url, "toy", begin) == 130
    MemoryFileSystem().pipe_file(f"{url}/toy/{RUN}/stages/logged/two", b"1")  # by an earlier version
    assert [run_at(url, "toy", each) for each in (go_on, look)] == [0, 0]
    first, second, third = seen
    assert not first.exists()  # all of it is at the URL
    assert second == {"config": "{}", "stages/one": "1", "metrics": "a\n"}
    assert third == []
    assert sent[3:] == [f"{RUN}/metrics", f"{RUN}/results.json"]  # what has not changed is not sent again


def test_a_copy_that_breaks_off_has_the_log_of_each_stage_and_no_results_without_the_rest(sent, url):
    def execute(runs_dir):
        write(runs_dir / "toy", stages__one="1", checkpoints__sft__5__x="1", metrics="a\n", config="{}")
        write(runs_dir / "toy", **{"results.json": "{}"})
        return 0

    assert run_at(url, "toy", execute) == 0
    order = [name.removeprefix(f"{RUN}/") for name in sent]
    assert max(order.index("metrics"), order.index("config")) < min(
        map(order.index, ("stages/one", "checkpoints/sft/5/x"))
    )
    assert order[-1] == "results.json"


def test_a_checkpoint_whose_copy_broke_off_is_not_taken(sent, url):
    def begin(runs_dir):
        write(runs_dir / "toy", metrics="a\n", **{"checkpoints__sft__5__checksums.json": "{}"})
        write(runs_dir / "toy", checkpoints__sft__5__x="1", checkpoints__sft__9__x="half")
        return 130

    found = []

    def go_on(runs_dir):
        found.extend(p.relative_to(runs_dir / "toy" / RUN).as_posix() for p in runs_dir.rglob("*") if p.is_file())
        return 130

    assert [run_at(url, "toy", each) for each in (begin, go_on)] == [130, 130]
    assert sent[-1] == f"{RUN}/checkpoints/sft/5/checksums.json"
    assert sorted(found) == ["checkpoints/sft/5/checksums.json", "checkpoints/sft/5/x", "metrics"]


def test_a_checkpoint_that_vanishes_while_files_are_listed_ends_no_copy(sent, url, monkeypatch):
    is_file, folders = pathlib.Path.is_file, []

    def execute(runs_dir):
        write(runs_dir / "toy", a="1", checkpoints__sft__5__x="1", checkpoints__sft__10__x="1", metrics="a\n")
        folders.append(runs_dir / "toy" / RUN / "checkpoints" / "sft")
        return 0

    def removing(path):
        for folder in folders if path.name == "x" else ():
            shutil.rmtree(folder / "5", ignore_errors=True)
            shutil.rmtree(folder / "10", ignore_errors=True)
        return is_file(path)

    monkeypatch.setattr(pathlib.Path, "is_file", removing)
    assert run_at(url, "toy", execute) == 0
    assert sorted(sent) == [f"{RUN}/a", f"{RUN}/metrics"]


def test_what_an_error_of_the_code_leaves_is_copied_too(sent, url):
    def execute(runs_dir):
        write(runs_dir / "toy", config="{}")
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        run_at(url, "toy", execute)
    assert sent == [f"{RUN}/config"]


def test_a_run_that_the_store_does_not_take_stays_on_this_machine(sent, url, monkeypatch, capsys):
    def refuse(store, path, name, **options):
        raise PermissionError(name)

    monkeypatch.setattr(MemoryFileSystem, "put_file", refuse)
    seen = []

    def execute(runs_dir):
        write(runs_dir / "toy", config="{}")
        seen.append(runs_dir / "toy")
        return 0

    assert run_at(url, "toy", execute) == 1
    assert str(seen[0]) in capsys.readouterr().err
    assert (seen[0] / RUN / "config").exists()
