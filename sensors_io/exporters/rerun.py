"""Records as a Rerun recording (.rrd): pictures, depth, vector fields, force and flags of every contact over time."""

import pathlib
from typing import Any

import numpy as np

from sensors_io.exporters.selection import ExportError, Progress, Selected, library, published
from sensors_io.schema import Flag, Phase, Sequence

_ARROWS = 16
"""Arrows of a vector field along its longer side."""

_WAIT_S, MOST_WAITS = 5.0, 12  # without a byte written, after which a disk takes no more
_STUCK: list[Any] = []
"""Recordings that a disk did not take: to close one, or to end with one, may wait for ever, deaf to Ctrl-C."""


def export_rerun(selected: Selected, out: pathlib.Path, progress: Progress) -> None:
    """Write contacts as one recording, whole or not at all.

    Entities are <contact>_<object>_<motion>/<sensor>/{camera, depth, deformation, shear, force, flags}; the timeline
    `time` is that of the recording computer, in seconds since the first frame of the contact.

    Raises:
      ExportError: `out` exists, or rerun-sdk is not installed.
    """
    rr = library("rerun", "rerun")
    with published(out) as temporary:
        log = rr.RecordingStream("touchr1")
        try:
            log.save(str(temporary))
        except RuntimeError as error:
            raise ExportError(f"--out is {out}: cannot be written ({error}); name another path") from error
        for number, contact in selected.contacts(progress):
            key = next(iter(contact.values())).key
            card = selected.store.objects[key.object_id]
            name = rr.escape_entity_path_part(f"{number:05d}_{key.object_id}_{key.motion}")
            labels = ", ".join(f"{attribute} {level}" for attribute, level in card.labels.items()) or "no labels"
            log.log(name, rr.TextDocument(f"{card.name or key.object_id}: {labels}"), static=True)
            if card.view is not None:
                log.log(f"{name}/view", rr.Image(card.view), static=True)
            start = min(int(sequence.host_time_ns[0]) for sequence in contact.values())
            for sensor, sequence in contact.items():
                _log_sequence(rr, log, f"{name}/{rr.escape_entity_path_part(sensor)}", sequence, start)
        try:
            _flush(log, temporary)
        except RuntimeError as error:  # the library says on standard error which
            _STUCK.append(log.to_native())
            rr.unregister_shutdown()
            raise ExportError(f"--out is {out}: cannot be written ({error}); free some space in its folder") from error
        log.disconnect()


def _flush(log: Any, file: pathlib.Path) -> None:
    """Wait for what was logged as long as the file grows.

    Raises:
      RuntimeError: it could not be written.
    """
    size, still = -1, 0
    while True:
        try:
            log.flush(timeout_sec=_WAIT_S)  # at once where the library writes no more
        except RuntimeError:
            now = file.stat().st_size
            size, still = now, still + 1 if now == size else 0
            if still == MOST_WAITS:
                raise
        else:
            return


def _log_sequence(rr: Any, log: Any, name: str, sequence: Sequence, start_ns: int) -> None:
    for n in range(len(sequence)):
        log.set_time("time", duration=1e-9 * (int(sequence.host_time_ns[n]) - start_ns))
        if sequence.frames is not None:
            log.log(f"{name}/camera", rr.Image(sequence.frames[n]))
        if sequence.depth_mm is not None:
            log.log(f"{name}/depth", rr.DepthImage(sequence.depth_mm[n], meter=1000.0))
        for field in ("deformation_mm", "shear_mm"):
            vectors = getattr(sequence, field)
            if vectors is not None:
                log.log(f"{name}/{field.removesuffix('_mm')}", _arrows(rr, vectors[n]))
        if sequence.force_n is not None:
            log.log(f"{name}/force", rr.Scalars(sequence.force_n[n].astype(np.float64)))
        flags = [str(flag.name).lower() for flag in Flag if int(sequence.flags[n]) & flag]
        phase = int(sequence.phase[n])
        word = Phase(phase).name.lower() if phase in set(Phase) else f"phase {phase}"
        log.log(f"{name}/flags", rr.TextLog(" ".join([word, *flags])))


def _arrows(rr: Any, field: np.ndarray) -> Any:
    """Some arrows of a vector field [h, w, 2], mm, on its own grid and ten times as long as they are there."""
    step = max(1, max(field.shape[:2]) // _ARROWS)
    chosen = field[::step, ::step]
    y, x = np.mgrid[: field.shape[0] : step, : field.shape[1] : step]
    return rr.Arrows2D(origins=np.stack([x, y], -1).reshape(-1, 2), vectors=10 * chosen.reshape(-1, 2))
