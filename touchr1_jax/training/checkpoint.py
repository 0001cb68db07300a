"""Checkpoints by Orbax: state, data iterator and step together, published atomically; the newest N and the best kept.

Every file of a checkpoint is compared with its checksum before it is read, and every array with its digest afterwards,
because a flipped bit on a disk raises no error.  A damaged checkpoint is set aside, and an older one is used.
"""

import contextlib
import itertools
import json
import math
import shutil
import sys
import threading
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal, NamedTuple, Self

import jax
import jax.numpy as jnp
import orbax.checkpoint as ocp
from jax.experimental import multihost_utils
from jaxtyping import Array, UInt32
from orbax.checkpoint.checkpoint_managers import AnyPreservationPolicy, BestN, LatestN

from touchr1_jax.training.background_saves import FAILURES, failed_save, wait_for_save
from touchr1_jax.training.checksums import CHECKSUMS, changed_files, file_checksums, old_checkpoints

MOST_SAID = 240
"""Characters of a library's error that a message quotes."""

_OVERHEAD_BYTES = 256 * 1024
"""Room for the files of a checkpoint besides its arrays: some 20, of which each takes a block."""

_MIX = 0x9E3779B1
"""2³² over the golden ratio, odd: multiples of it spread over all 32 bits (Knuth, TAOCP 3, §6.4)."""

_SAVES = threading.Lock()
"""Of the thread that saves: Orbax numbers the saves of a process, and mixes up those of two threads."""


class CheckpointError(ValueError):
    """A checkpoint that cannot be written or read; the message names the path, the problem and the fix."""


class DamagedCheckpointError(CheckpointError):
    """Files that differ from what was saved."""


class Restored(NamedTuple):
    """Contents of a checkpoint, and step and score of the best checkpoint so far."""

    step: int
    state: Any
    data: Any
    best: tuple[int, float] | None = None


def _complain(text: str) -> None:
    sys.stderr.write(f"{text}\n")


class Checkpoints:
    """The checkpoints of one stage; a context manager that waits for the last save.

    Half-written files of a killed process are removed.

    Args:
      directory: their folder; created if necessary.
      keep: how many of the newest stay.
      better: which held-out scores are better, to keep the best checkpoint too; `None` if checkpoints have no score.
      print_: receives a line about each damaged checkpoint that is skipped; standard error by default.
      of: what the checkpoints say that they are of; those of something else, or of another step, count as damaged.
        Without it all are read.
      before_save: called before each checkpoint is written; where it raises, none is.

    Raises:
      CheckpointError: the directory cannot be read or written.
    """

    def __init__(
        self,
        directory: Path,
        keep: int = 2,
        *,
        better: Literal["higher", "lower"] | None = None,
        print_: Callable[[str], None] = _complain,
        of: str = "",
        before_save: Callable[[], object] = lambda: None,
    ) -> None:
        if keep < 1:
            raise ValueError(f"keep is {keep}: must be at least 1; raise it")
        self._directory, self._better, self._print, self._of = directory.absolute(), better, print_, of
        self._before_save = before_save
        self._saving: int | None = None
        self._best: tuple[int, float] | None = None
        policy = LatestN(keep)
        if better is not None:
            best = BestN(get_metric_fn=_score, reverse=better == "lower", n=1, keep_checkpoints_without_metrics=False)
            policy = AnyPreservationPolicy([policy, best])
        options = ocp.CheckpointManagerOptions(
            preservation_policy=policy,
            best_fn=_score if better is not None else None,
            best_mode="min" if better == "lower" else "max",
            create=True,
            cleanup_tmp_directories=True,
            async_options=ocp.AsyncOptions(post_finalization_callback=self._sign),
        )
        try:
            self._remove_old(keep)
            self._set_aside_unscored()
            self._manager = ocp.CheckpointManager(self._directory, options=options)
        except FAILURES as error:
            raise CheckpointError(
                f"{self._directory}: its checkpoints cannot be opened ({_brief(error)}); make the folder writable, or "
                "move it away to train this stage from its beginning"
            ) from error

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        try:
            self._wait()
        finally:
            if jax.process_count() == 1 or failed_save(self._directory) is None:
                self._manager.close()

    def save(self, step: int, state: Any, data: Any, score: float | None = None) -> None:
        """Save a pytree of arrays and a JSON value as checkpoint `step`; writing goes on in the background.

        The arrays are copied first, because the next step overwrites donated buffers.  If several threads train, the
        save is complete when this returns.

        Args:
          step: its number.
          state: arrays.
          data: any JSON value.
          score: held-out score; only if `better` is set.

        Raises:
          CheckpointError: this checkpoint does not fit on the disk, or the one before it did not reach it.
          ValueError: a score that is not finite, or one without `better`.
        """
        if score is not None and not (self._better and math.isfinite(score)):
            raise ValueError(f"score is {score}: must be finite, and `better` must be set; score held-out data")
        self._require_room(state)
        state = jax.tree.map(jnp.copy, state)
        if score is not None and self._is_best(score):
            self._best = step, score
        kept = {"data": data, "digests": _digests(state)} | ({"of": self._label(step)} if self._of else {})
        kept |= {"best": self._best} if self._better else {}
        args = ocp.args.Composite(
            state=ocp.args.StandardSave(state), data=ocp.args.JsonSave(kept | {"crc32": _crc32(kept)})
        )
        others = threading.current_thread() is not threading.main_thread()
        self._before_save()
        self._wait()
        try:
            self._saving = step
            with _SAVES if others else contextlib.nullcontext():
                self._manager.save(step, args=args, metrics=None if score is None else {"score": score})
                if others:
                    self._manager.wait_until_finished()
        except FAILURES as error:
            raise self._unsaved(error) from error

    def latest(self) -> int | None:
        """Step of the newest checkpoint, intact or not."""
        return self._manager.latest_step()

    def restore(self, like: Any) -> Restored | None:
        """The newest intact checkpoint in the shapes, dtypes and placement of `like`, or `None` if there is none.

        Damaged checkpoints are renamed to `damaged-STEP` and reported.  A lost best checkpoint is reported too; the
        loss matters only if no later one is as good.

        Raises:
          CheckpointError: it holds another tree or other shapes.
          DamagedCheckpointError: all are damaged.
        """
        damaged: list[int] = []
        for step in sorted(self._manager.all_steps(), reverse=True):
            try:
                found = self._read(step, like)
            except DamagedCheckpointError as error:
                damaged.append(step)
                self._print(f"{error}; it is kept as {self._set_aside(step).name}")
                self._manager.reload()
            else:
                self._best = found.best
                self._look_for_best(found.step)
                return found
        if damaged:
            raise DamagedCheckpointError(
                f"{self._directory}: no checkpoint is intact, {damaged} are damaged and were set aside as damaged-*; "
                "put copies back, or start again to train this stage from its beginning"
            )
        return None

    def best(self, like: Any) -> Restored | None:
        """The checkpoint with the best score, or `None` if none has a score.

        Raises:
          CheckpointError: it is damaged, or holds another tree or other shapes; the last save did not reach the disk.
        """
        self._wait()
        if self._better and self._best is None:
            self.restore(like)
        if not self._better or self._best is None:
            return None
        try:
            return self._read(self._best[0], like)
        except DamagedCheckpointError as error:
            raise DamagedCheckpointError(
                f"{error}; it is the best of its stage: put a copy back, or move {self._directory} away to train this "
                "stage from its beginning"
            ) from error

    def _wait(self) -> None:
        try:
            wait_for_save(self._manager, self._directory)
        except FAILURES as error:
            raise self._unsaved(error) from error

    def _is_best(self, score: float) -> bool:
        """True if no checkpoint so far is better; of equal ones Orbax keeps the newest."""
        if self._best is None:
            return True
        return score <= self._best[1] if self._better == "lower" else score >= self._best[1]

    def _look_for_best(self, restored: int) -> None:
        """Say so if the best checkpoint up to the one that was restored is not whole."""
        if self._best is None or self._best[0] == restored:
            return
        where = self._directory / str(self._best[0])
        if not where.is_dir() or changed_files(where):
            self._print(f"{where}, the best so far, is damaged or gone: put a copy back, unless a later one is as good")

    def _remove_old(self, keep: int) -> None:
        """Remove what a killed process had not removed, or only in part."""
        if jax.process_index() == 0:
            for where in old_checkpoints(self._directory, keep, self._better is not None):
                try:
                    shutil.rmtree(where)
                except OSError as error:
                    self._print(f"{where} is old and cannot be removed ({error}): remove it")
        multihost_utils.sync_global_devices("removed old checkpoints")

    def _set_aside_unscored(self) -> None:
        """Set checkpoints aside whose score is not what was saved, before Orbax ranks by it."""
        for where in sorted(self._directory.glob("[0-9]*")) if self._better else ():
            if where.name.isdigit() and changed_files(where, "metrics"):
                name = self._set_aside(int(where.name)).name
                self._print(f"{where}: the checksum of its score does not hold; it is kept as {name}")

    def _read(self, step: int, like: Any) -> Restored:
        where = self._directory / str(step)
        changed = changed_files(where)
        if changed:
            raise DamagedCheckpointError(f"{where}: the checksum of {', '.join(changed)} does not hold")
        try:
            found = self._restored(step, like)
            kept = {name: value for name, value in found.data.items() if name != "crc32"}
            data, digests = kept["data"], kept["digests"]
            intact = found.data["crc32"] == _crc32(kept)
        except FAILURES as error:
            if self._readable(step):
                raise CheckpointError(
                    f"{where} holds another state than the one that is trained: {_brief(error)}; go back to the code "
                    "and the configuration that saved it, or move it away to train this stage from its beginning"
                ) from error
            raise DamagedCheckpointError(f"{where} cannot be read ({_brief(error)})") from error
        if not intact:
            raise DamagedCheckpointError(f"{where}: the checksum of its data does not hold")
        label = self._label(step)  # in a checkpoint of an earlier version there is none
        if self._of and kept.get("of", label) != label:
            raise DamagedCheckpointError(f"{where} is of {kept['of']}: must be of {label}")
        changed = [name for name, value in _digests(found.state).items() if digests.get(name) != value]
        if changed:
            raise DamagedCheckpointError(f"{where}: the digest of {', '.join(changed)} does not hold")
        best = kept.get("best") or self._ranked()
        return Restored(step, found.state, data, None if best is None else (best[0], best[1]))

    def _label(self, step: int) -> str:
        return f"{self._of} step {step}"

    def _ranked(self) -> tuple[int, float] | None:
        """The best by Orbax's scores, for checkpoints of earlier versions, which do not name it."""
        step = self._manager.best_step() if self._better else None
        return None if step is None else (step, _score(self._manager.metrics(step)))

    def _restored(self, step: int, like: Any = None) -> Any:
        args = ocp.args.Composite(state=ocp.args.StandardRestore(like), data=ocp.args.JsonRestore())
        return self._manager.restore(step, args=args)

    def _readable(self, step: int) -> bool:
        """True if the checkpoint is readable, whatever its structure."""
        try:
            self._restored(step)
        except FAILURES:
            return False
        return True

    def _sign(self) -> None:
        """Write the checksums of a checkpoint into its temporary folder, before Orbax renames it."""
        if jax.process_index() == 0:
            (where,) = self._directory.glob(f"{self._saving}.orbax-checkpoint-tmp*")
            (where / CHECKSUMS).write_text(json.dumps(file_checksums(where)), encoding="utf-8")

    def _set_aside(self, step: int) -> Path:
        names = itertools.chain([f"damaged-{step}"], (f"damaged-{step}-{i}" for i in itertools.count(2)))
        multihost_utils.sync_global_devices(f"damaged {step}")  # all processes have read it
        aside = next(path for name in names if not (path := self._directory / name).exists())
        multihost_utils.sync_global_devices(f"named {step}")  # all of them found the same name free
        if jax.process_index() == 0:
            (self._directory / str(step)).rename(aside)
        multihost_utils.sync_global_devices(f"set aside {step}")
        return aside

    def _require_room(self, state: Any) -> None:
        """Refuse a save before it begins: the threads of one that fails halfway print tracebacks of their own."""
        needed = sum(x.nbytes for x in jax.tree.leaves(state)) + _OVERHEAD_BYTES
        free = shutil.disk_usage(self._directory).free
        if free < needed:
            raise CheckpointError(
                f"{self._directory}: {free / 1e6:,.1f} MB are free, and a checkpoint needs {needed / 1e6:,.1f}; "
                "what was saved before is whole: free some space, then resume"
            )

    def _unsaved(self, error: Exception) -> CheckpointError:
        return CheckpointError(
            f"{self._directory}: the last checkpoint did not reach the disk ({_brief(error)}); the one before it is "
            "whole: free some space or make the folder writable, then resume"
        )


@jax.jit
def digest(state: Any) -> UInt32[Array, "n"]:
    """One number for each array of a pytree, Σ_i w_i b_i mod 2³² with bits b_i and odd weights w_i of their places.

    A changed element always changes the digest, because an odd weight has an inverse.  Integer sums are equal in any
    order, so the digest does not depend on the placement of the arrays on devices.

    Args:
      state: arrays, PRNG keys among them, of any shape.
    """
    return jnp.stack([_digest(x) for x in jax.tree.leaves(state)])


def _digest(x: Array) -> UInt32[Array, ""]:
    if jax.dtypes.issubdtype(x.dtype, jax.dtypes.prng_key):
        x = jax.random.key_data(x)
    if x.dtype == jnp.bool_:
        x = x.astype(jnp.uint8)
    size = min(x.dtype.itemsize, 4)
    bits = jax.lax.bitcast_convert_type(x, jnp.dtype(f"uint{8 * size}")).astype(jnp.uint32)
    place, stride = jnp.zeros(bits.shape, jnp.uint32), 1
    for axis in reversed(range(bits.ndim)):
        place += jax.lax.broadcasted_iota(jnp.uint32, bits.shape, axis) * jnp.uint32(stride % 2**32)
        stride *= bits.shape[axis]
    return jnp.sum(bits * (place * jnp.uint32(_MIX) | 1), dtype=jnp.uint32)


def _digests(state: Any) -> dict[str, int]:
    """The digest of each array by its path, the same in every process."""
    numbers = digest(state)
    if not (numbers.is_fully_addressable or numbers.is_fully_replicated):
        numbers = multihost_utils.process_allgather(numbers, tiled=True)
    paths = (path for path, _ in jax.tree.leaves_with_path(state))
    names = (jax.tree_util.keystr(path, simple=True, separator="/") for path in paths)
    return dict(zip(names, numbers.tolist(), strict=True))


def _crc32(value: Any) -> int:
    return zlib.crc32(json.dumps(value).encode())


def _score(metrics: dict[str, float]) -> float:
    return metrics["score"]


def _brief(error: Exception) -> str:
    """The beginning of what a library has to say, which may go on for pages."""
    text = " ".join(str(error).split())
    return f"{type(error).__name__}: {text[:MOST_SAID]}" if text else type(error).__name__
