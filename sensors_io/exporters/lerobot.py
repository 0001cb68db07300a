"""Records as a LeRobotDataset v3, an episode for each contact, and back without loss.

Written by its documented layout with pyarrow and PyAV, since the library `lerobot` wants versions of NumPy and OpenCV
that exclude those of this project; its own loader reads what is written here.

    observation.images.<sensor>             RGB pictures, a video that loses nothing (H.264 of RGB, quantiser 0)
    observation.tactile.<sensor>.<array>    every other array of FRAME_ARRAYS, integers as int64
    timestamp                               frame_index / fps, as LeRobot wants it; true times are …host_time_ns
    meta/touchr1/…                          keys, labels, views, cameras: the rest of the records

LeRobot has one row for all sensors and one shape for all episodes: contacts that differ in their sensors, arrays,
shapes, or in the number of frames of their sensors, are refused by name.
"""

import collections
import contextlib
import pathlib
from typing import Any

import numpy as np

from sensors_io.codec import decode_card, encode_card
from sensors_io.contents import put_rest_pictures, rest_pictures
from sensors_io.exporters.lerobot_files import EpisodeFiles, EpisodeReader, feature, write_table
from sensors_io.exporters.selection import (
    ExportError,
    FoundExport,
    Progress,
    Selected,
    head_of,
    head_text,
    published,
    sequence_of,
    sequence_text,
)
from sensors_io.schema import FRAME_ARRAYS, Sequence

OURS = "meta/touchr1"
"""Folder of what LeRobot has no place for."""

PICTURES, TOUCH = "observation.images", "observation.tactile"

Contact = dict[str, Sequence]


def export_lerobot(selected: Selected, out: pathlib.Path, fps: int, progress: Progress) -> None:
    """Write contacts as a LeRobotDataset v3, whole or not at all.

    Args:
      selected: contacts.
      out: folder to write.
      fps: nominal frame rate; 0 takes that of the first contact's times.
      progress: called with the number of contacts done and their total.

    Raises:
      ExportError: `out` exists, pyarrow or PyAV is not installed, or the contacts do not share one shape.
    """
    with published(out) as temporary, contextlib.ExitStack() as stack:
        files, tasks = None, dict[str, int]()
        rows: list[dict[str, Any]] = []
        for episode, (_, contact) in enumerate(selected.contacts(progress)):
            columns = _columns(contact)
            if files is None:
                fps = fps or _rate(next(iter(contact.values())))
                files = EpisodeFiles(temporary, {name: feature(x) for name, x in columns.items()}, fps)
                stack.callback(files.abandon)
            _check(columns, files.features, next(iter(contact.values())))
            task = _task(contact, selected)
            files.add(columns, task, tasks.setdefault(task, len(tasks)))
            rows += [
                {"episode_index": episode, "sensor": name, "plain": sequence_text(sequence)}
                for name, sequence in contact.items()
            ]
        if files is None:
            raise ExportError(f"contacts is {selected.rows}: none was seen by {', '.join(selected.meta.sensors)}")
        files.close(tasks)
        write_table(temporary / OURS / "sequences.parquet", rows)
        cards = [{"object_id": card.object_id, "card": encode_card(card)} for card in selected.cards()]
        write_table(temporary / OURS / "objects.parquet", cards)
        put_rest_pictures(temporary / OURS, rest_pictures(selected.store.path))
        (temporary / OURS / "records.json").write_text(head_text(selected), encoding="utf-8")


def read_lerobot(path: pathlib.Path) -> FoundExport:
    """Open an export that `export_lerobot` wrote to `path`; damaged parts raise errors of the libraries.

    Raises:
      ExportError: an export of another version, or a library is not installed.
    """
    head, reading = head_of((path / OURS / "records.json").read_text(encoding="utf-8"), path), EpisodeReader(path)
    plain = collections.defaultdict(list)
    for row in reading.table(f"{OURS}/sequences.parquet"):
        plain[row["episode_index"]].append((row["sensor"], row["plain"]))
    return FoundExport(
        head=head,
        cards=[decode_card(row["card"]) for row in reading.table(f"{OURS}/objects.parquet")],
        rests=rest_pictures(path / OURS),
        count=len(plain),
        contacts=(
            [_sequence(sensor, text, columns) for sensor, text in plain[episode]]
            for episode, columns in enumerate(reading.episodes())
        ),
    )


def _columns(contact: Contact) -> dict[str, np.ndarray]:
    """Arrays of a contact by the names that LeRobot shows, [N, …]."""
    found = {}
    for sensor, sequence in contact.items():
        for name, spec in FRAME_ARRAYS.items():
            array = getattr(sequence, name)
            if name == "frames" and array is not None:
                found[f"{PICTURES}.{sensor}"] = array
            elif array is not None:
                whole = np.issubdtype(spec.dtype, np.integer)
                found[f"{TOUCH}.{sensor}.{name}"] = array.astype(np.int64) if whole else array
    return found


def _check(columns: dict[str, np.ndarray], features: dict[str, dict[str, Any]], sequence: Sequence) -> None:
    """Refuse a contact that has not the shape of the first one, or whose sensors differ in their frames."""
    name = sequence.name
    other = "name sensors by --sensors, contacts by --contacts, or export to zarr or hdf5"
    if differ := sorted(columns.keys() ^ features.keys()):
        raise ExportError(f"{name} and the first contact differ in {', '.join(differ)}: LeRobot wants one set; {other}")
    for column, array in columns.items():
        want = feature(array)
        if want != features[column]:
            raise ExportError(
                f"{name}: {column} has shape {want['shape']}, {features[column]['shape']} in the first contact: "
                f"LeRobot wants one; {other}"
            )
    lengths = {column: len(array) for column, array in columns.items()}
    if len(set(lengths.values())) > 1:
        few, many = min(lengths, key=lengths.__getitem__), max(lengths, key=lengths.__getitem__)
        raise ExportError(
            f"{name}: {few} has {lengths[few]} frames, {many} {lengths[many]}: LeRobot has one row for all; {other}"
        )


def _rate(sequence: Sequence) -> int:
    """Frame rate by the median step of the times, at least 1 Hz."""
    steps = np.diff(sequence.host_time_ns)
    return max(1, round(1e9 / float(np.median(steps)))) if len(steps) and np.median(steps) > 0 else 30


def _task(contact: Contact, selected: Selected) -> str:
    key = next(iter(contact.values())).key
    card = selected.store.objects[key.object_id]
    return f"{key.motion.replace('_', ' along ')}: {card.name or key.object_id}"


def _sequence(sensor: str, text: str, columns: dict[str, np.ndarray]) -> Sequence:
    arrays: dict[str, np.ndarray] = {}
    for name, spec in FRAME_ARRAYS.items():
        column = f"{PICTURES}.{sensor}" if name == "frames" else f"{TOUCH}.{sensor}.{name}"
        if column in columns:
            arrays[name] = columns[column].astype(spec.dtype)
    return sequence_of(text, arrays)
