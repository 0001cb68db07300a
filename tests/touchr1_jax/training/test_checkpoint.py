"""Checkpoints: what comes back is what went in, and nothing half-written counts."""

import logging
import resource
import shutil
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import orbax.checkpoint as ocp
import pytest

from tests.touchr1_jax.training.stepping import feed, start, step
from touchr1_jax.training import checkpoint
from touchr1_jax.training.checkpoint import CheckpointError, Checkpoints, DamagedCheckpointError, digest
from touchr1_jax.training.checksums import CHECKSUMS, old_checkpoints

UNREAD = ("_CHECKPOINT_METADATA", "commit_success.txt")
"""Files that Orbax writes after the checksums; no state depends on them."""


def test_an_empty_directory_holds_none(tmp_path):
    with Checkpoints(tmp_path / "new") as checkpoints:
        assert checkpoints.latest() is None
        assert checkpoints.restore(start()) is None


def test_state_key_and_iterator_come_back(tmp_path):
    batches = feed()
    state, _ = step(start(), next(batches))
    with Checkpoints(tmp_path) as checkpoints:
        checkpoints.save(1, state, batches.get_state())
    expected = next(batches)
    with Checkpoints(tmp_path) as checkpoints:
        found = checkpoints.restore(start())
    assert found.step == 1
    assert found.state.key == state.key
    for a, b in zip(jax.tree.leaves(found.state.params), jax.tree.leaves(state.params), strict=True):
        np.testing.assert_array_equal(a, b)
        assert a.dtype == b.dtype
    assert jax.tree.structure(found.state) == jax.tree.structure(state)
    again = feed()
    again.set_state(found.data)
    np.testing.assert_array_equal(next(again), expected)


def test_newest_are_kept(tmp_path):
    with Checkpoints(tmp_path, keep=2) as checkpoints:
        for n in range(1, 6):
            checkpoints.save(n, {"x": jnp.full(3, n)}, n)
    assert sorted(int(p.name) for p in tmp_path.iterdir() if p.name.isdigit()) == [4, 5]
    with Checkpoints(tmp_path, keep=2) as checkpoints:
        found = checkpoints.restore({"x": jnp.zeros(3, jnp.int32)})
    assert (found.step, found.data) == (5, 5)
    np.testing.assert_array_equal(found.state["x"], 5)


def test_what_must_come_before_a_checkpoint_does(tmp_path):
    with Checkpoints(tmp_path, before_save=[].pop) as checkpoints, pytest.raises(IndexError):
        checkpoints.save(1, start(), None)
    with Checkpoints(tmp_path) as checkpoints:
        assert checkpoints.latest() is None


def test_saved_arrays_are_those_of_the_call_not_of_later_steps(tmp_path):
    """The writer works in the background while the next step takes the buffers over."""
    state = start()
    batches = feed()
    with Checkpoints(tmp_path) as checkpoints:
        state, _ = step(state, next(batches))
        expected = np.asarray(state.params["w"]).copy()
        checkpoints.save(1, state, None)
        for _ in range(20):
            state, _ = step(state, next(batches))
    with Checkpoints(tmp_path) as checkpoints:
        np.testing.assert_array_equal(checkpoints.restore(start()).state.params["w"], expected)


def test_another_shape_is_an_error(tmp_path):
    with Checkpoints(tmp_path) as checkpoints:
        checkpoints.save(1, {"w": jnp.arange(3.0)}, None)
    with Checkpoints(tmp_path) as checkpoints, pytest.raises(ValueError, match="shape"):
        checkpoints.restore({"w": jnp.zeros(4)})


def test_a_save_that_was_cut_off_does_not_count(tmp_path):
    with Checkpoints(tmp_path) as checkpoints:
        checkpoints.save(1, {"w": jnp.arange(3.0)}, None)
    (tmp_path / "2.orbax-checkpoint-tmp").mkdir()
    (tmp_path / "2.orbax-checkpoint-tmp" / "state").mkdir()
    with Checkpoints(tmp_path) as checkpoints:
        assert checkpoints.latest() == 1
        assert checkpoints.restore({"w": jnp.zeros(3)}).step == 1


# Orbax gives up at the first array that it cannot read; what the others call back then finds its loop closed
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
class TestDamage:
    @pytest.fixture
    def stage(self, tmp_path):
        """Checkpoints 1 and 2 of a thousand numbers, which compression does not spare."""
        with Checkpoints(tmp_path) as checkpoints:
            for n in (1, 2):
                checkpoints.save(n, self.numbers(n), {"at": n})
        return tmp_path

    def numbers(self, n: int) -> dict[str, jax.Array]:
        return {"w": jax.random.normal(jax.random.key(n), (1000,)), "key": jax.random.key(n)}

    def largest(self, checkpoint):
        return max((p for p in (checkpoint / "state" / "d").iterdir()), key=lambda p: p.stat().st_size)

    def spoil(self, path, at: float) -> None:
        content = bytearray(path.read_bytes())
        content[int(at * len(content))] ^= 16
        path.write_bytes(content)

    def save(self, stage, n: int) -> None:
        with Checkpoints(stage) as checkpoints:
            checkpoints.save(n, self.numbers(n), None)

    def restored(self, stage):
        printed = []
        with Checkpoints(stage, print_=printed.append) as checkpoints:
            return checkpoints.restore(self.numbers(0)), printed

    @pytest.mark.parametrize("at", [0.5, *(pytest.param(at, marks=pytest.mark.slow) for at in (0.3, 0.7))])
    def test_an_older_checkpoint_takes_the_place_of_one_with_a_flipped_bit(self, stage, at):
        """Most bits lie in the numbers themselves, where reading notices nothing."""
        self.spoil(self.largest(stage / "2"), at)
        found, printed = self.restored(stage)
        assert (found.step, found.data) == (1, {"at": 1})
        np.testing.assert_array_equal(found.state["w"], self.numbers(1)["w"])
        assert len(printed) == 1
        assert str(stage / "2") in printed[0]
        assert (stage / "damaged-2").is_dir()
        with Checkpoints(stage) as checkpoints:
            checkpoints.save(2, self.numbers(2), None)  # its place is free
            checkpoints.save(3, self.numbers(3), None)
        assert (stage / "damaged-2").is_dir()

    def test_a_changed_iterator_does_not_pass(self, stage):
        path = stage / "2" / "data" / "metadata"
        path.write_text(path.read_text().replace('"at": 2', '"at": 7'))
        found, printed = self.restored(stage)
        assert found.data == {"at": 1}
        assert "the checksum of data/metadata does not hold" in printed[0]

    @pytest.mark.parametrize(("source", "left"), [("mine", 1), ("other", 2)])
    def test_a_whole_checkpoint_of_another_step_or_stage_does_not_pass(self, tmp_path, source, left):
        for of in ("mine", "other"):
            with Checkpoints(tmp_path / of, of=of) as checkpoints:
                for n in (1, 2):
                    checkpoints.save(n, self.numbers(n), None)
        (tmp_path / source / "2").rename(tmp_path / "mine" / "3")
        printed: list[str] = []
        with Checkpoints(tmp_path / "mine", print_=printed.append, of="mine") as checkpoints:
            assert checkpoints.restore(self.numbers(0)).step == left
        assert f"is of {source} step 2: must be of mine step 3" in printed[0]
        with Checkpoints(tmp_path / "mine") as checkpoints:
            assert checkpoints.restore(self.numbers(0)).step == left
        with Checkpoints(tmp_path / "unnamed") as checkpoints:
            checkpoints.save(1, self.numbers(1), None)
        with Checkpoints(tmp_path / "unnamed", of="mine") as checkpoints:
            assert checkpoints.restore(self.numbers(0)).step == 1

    def test_a_flipped_bit_of_any_file_does_not_pass(self, stage):
        """Of a few places of each, its checksums among them, before Orbax reads anything."""
        files = [p for p in sorted((stage / "2").rglob("*")) if p.is_file() and p.name not in UNREAD]
        assert {"_METADATA", "metadata", CHECKSUMS} <= {path.name for path in files}
        for path in files:
            content = path.read_bytes()
            for at in (0.1, 0.6) if content else ():
                self.spoil(path, at)
                with Checkpoints(stage) as checkpoints, pytest.raises(DamagedCheckpointError, match="checksum"):
                    checkpoints._read(2, self.numbers(0))
                path.write_bytes(content)

    def test_none_intact_is_an_error_that_says_so(self, stage):
        for n in (1, 2):
            self.largest(stage / str(n)).write_bytes(b"")
        with pytest.raises(DamagedCheckpointError, match=r"no checkpoint is intact, \[2, 1\].*put copies back"):
            self.restored(stage)
        assert sorted(p.name for p in stage.iterdir()) == ["damaged-1", "damaged-2"]
        assert self.restored(stage)[0] is None

    def test_another_state_is_no_damage(self, stage):
        with Checkpoints(stage) as checkpoints, pytest.raises(CheckpointError, match="holds another state"):
            checkpoints.restore({"other": jnp.zeros(2)})
        assert sorted(p.name for p in stage.iterdir()) == ["1", "2"]

    def test_a_full_disk_is_named_and_costs_no_older_checkpoint(self, stage, monkeypatch):
        monkeypatch.setattr(sys, "dont_write_bytecode", True)  # a module that is cut off breaks every later import
        limits = resource.getrlimit(resource.RLIMIT_FSIZE)
        resource.setrlimit(resource.RLIMIT_FSIZE, (600, limits[1]))
        try:
            with pytest.raises(CheckpointError, match=r"did not reach the disk.*free some space"):
                self.save(stage, 3)
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        found, printed = self.restored(stage)
        assert (found.step, printed) == (2, [])

    def test_a_checkpoint_that_will_not_fit_is_refused_before_it_is_written(self, stage, monkeypatch):
        usage = shutil.disk_usage(stage)
        monkeypatch.setattr(shutil, "disk_usage", lambda path: usage._replace(free=100_000))
        with pytest.raises(CheckpointError, match=r"0\.1 MB are free, and a checkpoint needs 0\.3.*free some space"):
            self.save(stage, 3)
        assert sorted(p.name for p in stage.iterdir()) == ["1", "2"]


class TestBest:
    @pytest.mark.parametrize(("better", "best"), [("higher", 2), ("lower", 4)])
    def test_the_best_is_kept_beside_the_newest(self, tmp_path, better, best):
        with Checkpoints(tmp_path, keep=1, better=better) as checkpoints:
            assert checkpoints.best({"x": jnp.zeros(2)}) is None
            for n, score in enumerate((3.0, 5.0, 4.0, 1.0, 2.0, None), 1):
                checkpoints.save(n, {"x": jnp.full(2, n, jnp.float32)}, n, score)
        assert sorted(int(p.name) for p in tmp_path.iterdir()) == [best, 6]
        with Checkpoints(tmp_path, better=better) as checkpoints:
            found = checkpoints.best({"x": jnp.zeros(2)})
            assert checkpoints.restore({"x": jnp.zeros(2)}).step == 6
        assert (found.step, found.data) == (best, best)
        np.testing.assert_array_equal(found.state["x"], best)

    def test_a_last_save_that_fails_is_named_where_the_best_is_asked(self, tmp_path, monkeypatch):
        def fail(manager, directory):
            raise ValueError("quota")

        with Checkpoints(tmp_path, better="higher") as checkpoints:
            checkpoints.save(1, LIKE, None, 3.0)
            checkpoints.best(LIKE)
            monkeypatch.setattr(checkpoint, "wait_for_save", fail)
            with pytest.raises(CheckpointError, match=r"did not reach .*: quota"):
                checkpoints.best(LIKE)
            monkeypatch.undo()

    @pytest.mark.parametrize(("better", "score"), [("higher", float("nan")), (None, 1.0)])
    def test_a_score_that_ranks_nothing_is_refused(self, tmp_path, better, score):
        with Checkpoints(tmp_path, better=better) as checkpoints, pytest.raises(ValueError, match="score is"):
            checkpoints.save(1, {"x": jnp.zeros(2)}, None, score)


LIKE = {"x": jnp.zeros(2)}


class TestDamagedBest:
    """Scores 3, 5, 4: checkpoint 2 is the best, 3 the newest."""

    @pytest.fixture
    def stage(self, tmp_path):
        with Checkpoints(tmp_path, keep=1, better="higher") as checkpoints:
            self.save(checkpoints, 3.0, 5.0, 4.0)
        return tmp_path

    def save(self, checkpoints, *scores):
        for n, score in enumerate(scores, 1):
            checkpoints.save(n, {"x": jnp.full(2, n, jnp.float32)}, n, score)

    @pytest.mark.parametrize(
        "text", ['{"score": 1.0}', '{"score": NaN}', '{"score": "5"}', "{}", "[1]", "{garbage", None]
    )
    def test_another_is_not_taken_for_it(self, stage, text):
        """Orbax reads scores before any checksum is compared, and leaves checkpoints without one out."""
        path = stage / "2" / "metrics" / "metrics"
        path.unlink() if text is None else path.write_text(text)
        printed = []
        wanted = pytest.raises(DamagedCheckpointError, match=r"best of its stage: put a copy back, or move .* away")
        with Checkpoints(stage, better="higher", print_=printed.append) as checkpoints, wanted:
            assert checkpoints.restore(LIKE).step == 3
            checkpoints.best(LIKE)
        assert "2: the checksum of its score does not hold; it is kept as damaged-2" in printed[0]
        assert "2, the best so far, is damaged or gone: put a copy back, unless a later one is as good" in printed[1]

    @pytest.mark.parametrize("score", [4.5, 5.0])
    def test_without_it_a_later_one_must_be_as_good(self, stage, score):
        shutil.rmtree(stage / "2")
        with Checkpoints(stage, better="higher", print_=lambda text: None) as checkpoints:
            checkpoints.restore(LIKE)
            checkpoints.save(4, LIKE, 4, score)
            if score == 5.0:
                assert checkpoints.best(LIKE).step == 4
            else:
                with pytest.raises(DamagedCheckpointError, match="best of its stage"):
                    checkpoints.best(LIKE)

    def test_a_damaged_one_says_what_to_do(self, stage):
        with Checkpoints(stage, better="higher", print_=lambda text: None) as checkpoints:
            checkpoints.restore(LIKE)
            shutil.rmtree(stage / "2" / "data")
            with pytest.raises(DamagedCheckpointError, match=r"best of its stage: put a copy back, or move .* away"):
                checkpoints.best(LIKE)

    def test_the_score_of_another_than_the_best_costs_that_one_alone(self, stage):
        (stage / "3" / "metrics" / "metrics").write_text("{garbage")
        with Checkpoints(stage, better="higher", print_=lambda text: None) as checkpoints:
            assert checkpoints.restore(LIKE).step == 2
            assert checkpoints.best(LIKE).step == 2

    def test_what_a_killed_process_had_not_removed_is_removed(self, stage, tmp_path_factory):
        """An old checkpoint, whole or without one of its files; the newest must be intact."""
        old = tmp_path_factory.mktemp("old") / "1"
        with Checkpoints(old.parent, better="higher") as checkpoints:
            checkpoints.save(1, {"x": jnp.full(2, 1)}, 1, 1.0)
        printed: list[str] = []
        for file in (None, *(path for path in old.rglob("*") if path.is_file())):
            shutil.copytree(old, stage / "1")
            if file is not None:
                (stage / "1" / file.relative_to(old)).unlink()
            with Checkpoints(stage, keep=1, better="higher", print_=printed.append):
                assert sorted(path.name for path in stage.iterdir()) == ["2", "3"]
        assert not printed
        shutil.copytree(old, stage / "1")
        with Checkpoints(stage, keep=2, better="higher"):
            assert sorted(path.name for path in stage.iterdir()) == ["2", "3"]

    @pytest.mark.parametrize("lost", ["the newest is damaged", "the best is gone"])
    def test_an_old_checkpoint_that_may_be_needed_stays(self, stage, lost):
        best, newest = sorted(path.name for path in stage.iterdir())
        shutil.copytree(stage / best, stage / "1")
        if lost == "the best is gone":
            (stage / best).rename(stage / "away")
        else:
            state = next(path for path in (stage / newest / "state").rglob("*") if path.is_file())
            state.write_bytes(b"")
        assert old_checkpoints(stage, 1, True) == []

    @pytest.mark.parametrize(("better", "best"), [("higher", 3), ("lower", 4)])
    def test_of_equal_ones_the_newest_is_the_best_however_often_the_run_is_resumed(self, tmp_path, better, best):
        for n, score in enumerate((4.0, 5.0, 5.0, 4.0, 4.5), 1):
            with Checkpoints(tmp_path, keep=1, better=better) as checkpoints:
                checkpoints.restore(LIKE)
                checkpoints.save(n, LIKE, n, score)
        with Checkpoints(tmp_path, better=better) as checkpoints:
            assert checkpoints.best(LIKE).step == best

    def test_checkpoints_that_do_not_name_the_best_are_ranked_by_their_scores(self, tmp_path, monkeypatch):
        monkeypatch.setattr(Checkpoints, "_is_best", lambda self, score: False)
        with Checkpoints(tmp_path, keep=1, better="higher") as checkpoints:
            self.save(checkpoints, 3.0, 5.0, 4.0)
        monkeypatch.undo()
        with Checkpoints(tmp_path, better="higher") as checkpoints:
            assert checkpoints.best(LIKE).step == 2


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.bfloat16, jnp.int32, jnp.uint8, jnp.bool_])
def test_a_digest_tells_every_element_and_its_place(dtype):
    x = np.arange(24).reshape(2, 3, 4) % 2
    changed = [np.abs(x - (np.arange(24) == i).reshape(x.shape)) for i in range(24)]
    seen = digest([jnp.asarray(y, dtype) for y in (x, *changed)])
    assert len(set(seen.tolist())) == 25


def test_a_digest_is_that_of_the_formula():
    bits, weight = np.array([3, 5, 2**31], np.uint32), np.arange(3, dtype=np.uint32) * np.uint32(0x9E3779B1) | 1
    assert int(digest({"a": jnp.asarray(bits)})[0]) == int(np.sum(bits * weight, dtype=np.uint32))
    a, b = (digest(jax.random.key(n)) for n in (0, 1))
    assert int(a[0]) != int(b[0])


def test_at_least_one_is_kept(tmp_path):
    with pytest.raises(ValueError, match="keep is 0: must be at least 1"):
        Checkpoints(tmp_path, keep=0)


def test_a_failed_save_is_told_once(tmp_path, caplog):
    """Threads of Orbax log tracebacks of the failure that `Checkpoints` raises; other errors pass.

    So does no word that a save at a signal lacks a score.
    """
    where, score = Path(ocp.__file__).parent / "x.py", "Requested `tracked_metric`; did not provide metrics."
    said = [("absl", where, "no space", False), ("absl", tmp_path / "x.py", "no space", True)]
    for name, path, text, printed in (*said, ("orbax", where, "no space", True), ("absl", where, score, False)):
        logger, level = logging.getLogger(name), logging.WARNING if text == score else logging.ERROR
        logger.handle(logger.makeRecord(name, level, str(path), 1, text, (), None))
        assert (text in caplog.text) == printed
        caplog.clear()
