"""Files that are whole or not there: JSON values of anything an experiment holds, published atomically.

The files of a run are *sealed*: the last key of their JSON object is the CRC-32 of the text before it, since a flipped
bit on a disk raises no error of its own.  Files without this key, such as those of earlier versions, are read as well.
"""

import contextlib
import dataclasses
import enum
import io
import json
import math
import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from sensors_io.arrays import ArraysError, load_arrays
from sensors_io.json_files import require_regular, seal, unseal
from sensors_io.remote import at_url

_OF = "of"  # entry of a file of arrays that says what they are


class DamagedFileError(ValueError):
    """A file of a run with other content than was written."""


class UnwrittenError(OSError):
    """A file that did not reach the disk; an older version is still there."""


def jsonable(value: Any, where: str = "value") -> Any:
    """The same value in JSON's own types: dataclasses and mappings become objects, tuples and arrays lists.

    Raises:
      ValueError: a number is not finite (JSON has no such number), or an object's key is no string.
      TypeError: a type that has no JSON form.
    """
    if isinstance(value, enum.Enum):
        return jsonable(value.value, where)
    if value is None or isinstance(value, bool | int | str):
        return value
    if isinstance(value, float):
        if not math.isfinite(value):
            raise ValueError(f"{where} is {value}: must be finite to be written as JSON; leave undefined numbers out")
        return value
    if isinstance(value, Path):
        return str(value)
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {f.name: jsonable(getattr(value, f.name), f"{where}.{f.name}") for f in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        for key in value:
            if not isinstance(key, str):
                raise ValueError(f"{where} has the key {key!r}: keys must be strings in JSON; rename it")
        return {key: jsonable(item, f"{where}.{key}") for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [jsonable(item, f"{where}[{i}]") for i, item in enumerate(value)]
    if hasattr(value, "__array__"):  # NumPy and JAX arrays and scalars alike
        return jsonable(np.asarray(value).tolist(), where)
    raise TypeError(f"{where} is a {type(value).__name__}: it has no JSON form; convert it to numbers, text or lists")


def make_folder(folder: Path, option: str, value: Path) -> None:
    """Make a folder in the one that an option names; `UnwrittenError` if that is none or cannot be written."""
    try:
        if at_url(value):  # a path of that name would be made here
            raise OSError("it is a URL")
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise no_place(option, value, error) from error


def no_place(option: str, value: Path, error: OSError) -> UnwrittenError:
    """The error of a folder that an option names, in which nothing can be made."""
    return UnwrittenError(
        f"{option} is {value}: must be a folder that can be written ({error}); name another by --{option}"
    )


def write_bytes(path: Path, content: bytes) -> None:
    """Publish a file by way of a flushed temporary sibling; `UnwrittenError` if it does not reach the disk."""
    if path.exists() and not path.is_file():  # a device would be replaced by a file
        raise UnwrittenError(f"{path} is a folder or a device: must be a file, or not there; name another path")
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        with temporary.open("wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except OSError as error:
        raise UnwrittenError(
            f"{path} cannot be written ({error}): free some space or make its folder writable, then continue"
        ) from error
    finally:
        temporary.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """Publish a UTF-8 text atomically; bytes of a file's name that are no UTF-8 are written as escapes."""
    write_bytes(path, text.encode(errors="backslashreplace"))


def write_arrays(path: Path, arrays: Mapping[str, Any], *, compressed: bool = False, of: str = "") -> None:
    """Publish arrays as one NumPy file, atomically; `of` says what they are, for `read_arrays`."""
    buffer = io.BytesIO()
    (np.savez_compressed if compressed else np.savez)(buffer, **({**arrays, _OF: np.array(of)} if of else arrays))
    write_bytes(path, buffer.getvalue())


def read_arrays(path: Path, of: str, *, earlier: bool = True) -> dict[str, np.ndarray]:
    """Arrays that `write_arrays` published; files of earlier versions, which `earlier` takes, do not say what they are.

    Raises:
      ArraysError: they cannot be read, or are of something else, as a whole file that was put in this place.
    """
    arrays = load_arrays(path)
    label = str(arrays.pop(_OF, of if earlier else ""))
    if label != of:
        reason = ValueError(f"it {f'is of {label}' if label else 'does not say what it is'}: must be of {of}")
        raise ArraysError(f"{path} belongs elsewhere ({reason}); put its own copy back, or remove it") from reason
    return arrays


def write_json(path: Path, value: Any) -> None:
    """Publish a value as indented JSON, atomically."""
    write_text(path, json.dumps(jsonable(value), indent=2, ensure_ascii=False) + "\n")


def write_sealed(path: Path, value: Any) -> None:
    """Publish a dataclass or a mapping as indented JSON with its checksum, atomically."""
    write_text(path, seal(json.dumps(jsonable(value), indent=2, ensure_ascii=False)) + "\n")


def read_json(path: Path) -> Any:
    """The value of a JSON file, without its checksum; `DamagedFileError` if either does not hold."""
    try:
        require_regular(path)
        return unseal(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise DamagedFileError(
            f"{path} is damaged ({error}): put a copy back, or move its run away and start a new one"
        ) from error


@contextlib.contextmanager
def fitting(path: Path | str) -> Iterator[None]:
    """`DamagedFileError` that names a file of a run, where its contents raise an error by their shape in the block."""
    try:
        yield
    except DamagedFileError:
        raise
    except (LookupError, TypeError, AttributeError, ValueError, OverflowError) as error:
        raise DamagedFileError(
            f"{path} is not that of a run ({error!r}): put a copy back, or move its run away"
        ) from error


def read_times(path: Path) -> dict[str, float]:
    """Seconds by stage in the `timing.json` of a run, empty before any was timed; `DamagedFileError` if damaged."""
    found = read_json(path) if path.exists() else {}
    with fitting(path):
        return {name: float(seconds) for name, seconds in found.items()}


def require_link(link: Path) -> None:
    """`FileExistsError` if something that is no symbolic link, such as a copy of its target, is in its place."""
    if link.exists() and not link.is_symlink():
        raise FileExistsError(f"{link} is no symbolic link, so it is not replaced; move it away")


def point_link(link: Path, target: str) -> None:
    """Make `link` a symbolic link to `target`, replacing an older link, and nothing else, atomically."""
    require_link(link)
    temporary = link.with_name(f".{link.name}.{os.getpid()}")
    temporary.unlink(missing_ok=True)
    temporary.symlink_to(target)
    os.replace(temporary, link)
