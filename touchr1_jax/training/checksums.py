"""Checksums of the files of a checkpoint, and which checkpoints of a stage are old."""

import json
import zlib
from pathlib import Path

CHECKSUMS = "checksums.json"
"""In a checkpoint's folder: CRC-32 of every file, written once all others are in place."""

_STAMPED = "_CHECKPOINT_METADATA"
"""Orbax's file of times, which it writes once more after the checksums; nothing of the state depends on it."""


def file_checksums(where: Path, inside: str = "") -> dict[str, int]:
    """CRC-32 of every file below a folder, or a folder inside of it, by its path in it."""
    paths = (where / inside).rglob("*")
    files = sorted(path for path in paths if path.is_file() and path.name not in (CHECKSUMS, _STAMPED))
    return {path.relative_to(where).as_posix(): zlib.crc32(path.read_bytes()) for path in files}


def changed_files(where: Path, inside: str = "") -> list[str]:
    """Files of a checkpoint, or of a folder in it, that differ from what was saved; none if it has no checksums, as
    in earlier versions.
    """
    path = where / CHECKSUMS
    if not path.is_file():
        return []
    try:
        saved, found = json.loads(path.read_text(encoding="utf-8")), file_checksums(where, inside)
        return sorted(name for name, x in saved.items() if name.startswith(inside) and found.get(name) != x)
    except (OSError, ValueError, AttributeError):
        return [CHECKSUMS]


def old_checkpoints(directory: Path, keep: int, scored: bool) -> list[Path]:
    """Checkpoints of a stage that are neither among the `keep` newest nor the best, if the newest is intact.

    The newest names the best where checkpoints are `scored`.
    """
    steps = sorted(int(path.name) for path in directory.glob("[0-9]*") if path.name.isdigit())
    newest = directory / str(max(steps, default=0))
    if len(steps) <= keep or not (newest / CHECKSUMS).is_file() or changed_files(newest, "data"):
        return []
    best = json.loads((newest / "data" / "metadata").read_text(encoding="utf-8")).get("best")
    old = set(steps[:-keep]) - {best[0] if best else None}
    lacks_best = best[0] not in steps if best else scored  # then one of the old may be the best that is left
    if not old or lacks_best or changed_files(newest):
        return []
    return [directory / str(step) for step in sorted(old)]
