"""A trained policy as a folder that describes itself, in the layout of model hubs.

DIR/config.json         sizes, language, questions, the frames that it reads, its training, checksums
DIR/model.safetensors   parameters
DIR/tokenizer.json      vocabulary, as the `tokenizers` library writes it
DIR/README.md           model card
"""

import contextlib
import ctypes
import dataclasses
import errno
import functools
import glob
import hashlib
import json
import os
import shutil
import typing
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from flax import traverse_util

from touchr1_jax.models.load import TOKENIZER_FILE, WeightsError
from touchr1_jax.models.qwen.config import CONFIG_FILE
from touchr1_jax.models.qwen.safetensors import read_header, read_tensor, write_file
from touchr1_jax.models.qwen.weights import SINGLE
from touchr1_jax.models.stacked import restacked, unstacked
from touchr1_jax.models.touch_policy import ModelConfig, TouchConfig, TouchPolicy, assemble_policy, touch_shapes
from touchr1_jax.text.language import Language
from touchr1_jax.text.template import QUESTIONS
from touchr1_jax.text.tokenizer import word_library, word_tokenizer
from touchr1_jax.types import Params

FORMAT, VERSION = "touchr1-policy", 1
CARD = "README.md"
SCALE = ":step"
"""Ends the name of the steps of a tensor that is stored in whole numbers."""

RENAME_SWAP = 2  # RENAME_EXCHANGE of Linux, the same of macOS

CHECKSUM = "checksum"
"""Field of `config.json`: the SHA-256 of all other fields."""

Precision = Literal["float32", "float16", "int8"]
"""Type of the stored parameters; `int8` stores a matrix as 127 steps of each output's largest weight."""

MISFITS = (ValueError, TypeError, LookupError, AttributeError, ArithmeticError, RecursionError, AssertionError)
"""Errors that a config of another version raises where it is read."""


class PolicyError(WeightsError):
    """A folder that is no policy which this version can read; the message names it, the problem and the fix."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class PolicyInput:
    """Frames that a policy reads of a recording, and what its training data had besides them.

    Attributes:
      rejected: names of the quality flags whose frames are left out.
      choose: rule by which the frames of a sequence are chosen (`sensors_io.selection.choose_frames`).
      show: camera pictures, or their fields, as images (`sensors_io.selection.field_images`).
      force, view: whether a force was measured, and whether objects had a picture.
    """

    rejected: tuple[str, ...] = ()
    choose: str = "auto"
    show: str = "pictures"
    force: bool = True
    view: bool = True


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class SavedPolicy:
    """A trained policy and what must be known to ask it about new data; `notes` say in JSON where it comes from."""

    policy: TouchPolicy
    params: Params
    reads: PolicyInput
    notes: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    questions: Mapping[str, str] = dataclasses.field(default_factory=lambda: QUESTIONS)

    @property
    def sensors(self) -> tuple[str, ...]:
        """Names of the streams, in order."""
        return tuple(sensor.name for sensor in self.policy.language.sensors)

    @property
    def model(self) -> TouchConfig:
        """Sizes."""
        return self.policy.model

    @property
    def view_px(self) -> int:
        """Rows and columns of the object's picture."""
        model: Any = self.policy.model
        return model.vision.image_px if isinstance(model, ModelConfig) else model.view_px


def save_policy(folder: Path, saved: SavedPolicy, *, precision: Precision = "float32", card: str = "") -> None:
    """Publish a policy as a folder in one move; a policy that is there already is replaced.

    Args:
      folder: where.
      saved: the policy.
      precision: of the parameters on disk.
      card: the model card; by default a table of `notes`.

    Raises:
      PolicyError: the folder exists and holds something else, even next to a policy; a parameter is beyond the range
        of that precision.
    """
    if folder.exists() and format_of(folder) != FORMAT and (not folder.is_dir() or any(folder.iterdir())):
        raise PolicyError(f"folder is {folder}: it exists and is no policy; choose a new one")
    with published(folder, (SINGLE, TOKENIZER_FILE, CARD, CONFIG_FILE)) as unfinished:
        write_file(unfinished / SINGLE, _stored(saved.params, precision))
        words = [piece.decode().strip() for piece in saved.policy.tokenizer.pieces if piece]
        (unfinished / TOKENIZER_FILE).write_text(word_library(words).to_str(pretty=True), encoding="utf-8")
        (unfinished / CARD).write_text(card or default_card(saved, precision), encoding="utf-8")
        (unfinished / CONFIG_FILE).write_text(seal(_config(saved, precision, unfinished)), encoding="utf-8")


@contextlib.contextmanager
def published(folder: Path, parts: Collection[str] = ()) -> Iterator[Path]:
    """A new folder that takes the place of `folder` if the block ends without an error, and else vanishes.

    A killed process leaves the old one or the new one; where the file system cannot exchange two folders, the old one
    may be in the same folder under a hidden name, which `read_sealed` reports.  A link is followed.

    Args:
      folder: where; only `parts` of what is there, by their names, may be replaced.

    Raises:
      PolicyError: there is something else.
    """
    folder = Path(os.path.realpath(folder))  # `resolve` raises RuntimeError for links in a circle
    others = sorted(path.name for path in folder.glob("*") if path.name not in parts)
    if others or folder.is_file():
        found = f"it also holds {', '.join(others[:3])}, which would be lost" if others else "a file"
        raise PolicyError(f"folder is {folder}: {found}; move it away, or choose a new one")
    unfinished, old = (folder.with_name(f".{folder.name}.{os.getpid()}{end}") for end in ("", ".old"))
    shutil.rmtree(unfinished, ignore_errors=True)
    unfinished.mkdir(parents=True)
    try:
        yield unfinished
        if not folder.exists() or not exchanged(unfinished, folder):
            if folder.exists():
                folder.rename(old)
            try:
                unfinished.rename(folder)
            except OSError as error:  # not empty: another process was faster, as if it had begun earlier
                if error.errno != errno.ENOTEMPTY or not exchanged(unfinished, folder):
                    raise
    except BaseException:
        if old.exists() and not folder.exists():
            old.rename(folder)
        raise
    finally:
        for rest in (unfinished, old):
            shutil.rmtree(rest, ignore_errors=True)


def exchanged(a: Path, b: Path) -> bool:
    """Exchange two folders of one file system; False, and nothing is changed, where it cannot be done in one step."""
    library, (source, target) = ctypes.CDLL(None), map(os.fsencode, (a, b))
    if hasattr(library, "renameat2"):  # Linux; the paths begin at the working directory, AT_FDCWD
        return library.renameat2(-100, source, -100, target, RENAME_SWAP) == 0
    return hasattr(library, "renamex_np") and library.renamex_np(source, target, RENAME_SWAP) == 0


def read_policy(folder: Path) -> SavedPolicy:
    """The policy of a folder that `save_policy` wrote.

    Raises:
      PolicyError: no such folder, a folder of something else, of a newer version, or damaged.
    """
    config = read_sealed(folder, FORMAT, VERSION)
    try:
        require_files(folder, config["files"], (SINGLE, TOKENIZER_FILE))
        notes = {**config["notes"]}
        # policies saved before these could be chosen read pictures, and the pixels of a view
        sizes = {**config["model"], "vision": {"stem": "pixels", **config["model"]["vision"]}}
        shown = {"show": PolicyInput.show, **config["input"]}
        model, language = rebuilt(ModelConfig, sizes), rebuilt(Language, config["language"])
        reads, questions = rebuilt(PolicyInput, shown), dict(config["questions"])
        vocabulary = json.loads((folder / TOKENIZER_FILE).read_text(encoding="utf-8"))["model"]["vocab"]
        words = sorted(vocabulary, key=vocabulary.__getitem__)[len(word_library(()).get_vocab()) :]
        if word_library(words).get_vocab() != vocabulary:
            raise ValueError(f"ids of the words in {TOKENIZER_FILE} must be 0, 1, 2 …, special tokens first")
        policy = assemble_policy(model, language, word_tokenizer(words), questions)
        if tuple(config["sensors"]) != (sensors := tuple(sensor.name for sensor in language.sensors)):
            raise ValueError(f"sensors are {config['sensors']}, its language has {sensors}")
        wanted = jax.eval_shape(functools.partial(policy.init, 0), touch_shapes(model, model.vision.image_px, sensors))
    except PolicyError:
        raise
    except MISFITS as error:
        misfit = f"policy is {folder}: its config does not fit this version ({error}); save it anew"
        raise PolicyError(misfit) from error
    params = fitting(folder, _read_params(folder), wanted)
    return SavedPolicy(policy=policy, params=params, reads=reads, notes=notes, questions=questions)


def fitting(folder: Path, flat: Mapping[str, np.ndarray], wanted: Params) -> Params:
    """Parameters by dotted names as the tree that a model has.

    Raises:
      PolicyError: others than the model's, of other shapes, or numbers that are not finite.
    """
    shapes = {name: x.shape for name, x in traverse_util.flatten_dict(wanted, sep=".").items()}
    odd = sorted(n for n in shapes.keys() | flat.keys() if n not in flat or shapes.get(n) != flat[n].shape)
    if odd:
        raise PolicyError(
            f"policy is {folder}: parameters differ from this version's model in {', '.join(odd[:5])}; save it anew"
        )
    infinite = sorted(name for name, x in flat.items() if not np.isfinite(x).all())
    if infinite:
        raise PolicyError(
            f"policy is {folder}: {', '.join(infinite[:5])} hold numbers that are not finite: its training diverged; "
            "train it again"
        )
    return traverse_util.unflatten_dict({name: jnp.asarray(x) for name, x in flat.items()}, sep=".")


def default_card(saved: SavedPolicy, precision: Precision) -> str:
    """A model card of the policy's sizes, inputs and notes."""
    size = sum(x.size for x in jax.tree.leaves(saved.params))
    attributes = [attribute.name for attribute in saved.policy.language.attributes]
    rows: dict[str, object] = {
        "parameters": f"{size:,}, stored as {precision}",
        "sensors": ", ".join(saved.sensors),
        "frames of each sensor": f"{saved.model.frames} of {saved.model.image_px} × {saved.model.image_px} pixels",
        "force, picture of the object in training": f"{_yes(saved.reads.force)}, {_yes(saved.reads.view)}",
        "questions": ", ".join(f"{saved.questions[a]}? ({', '.join(words(saved, a))})" for a in attributes),
        **{name: value for name, value in saved.notes.items() if not isinstance(value, Mapping)},
    }
    table = "\n".join(f"| {name} | {value} |" for name, value in rows.items())
    return (
        "---\nlibrary_name: touchr1-jax\nlicense: apache-2.0\ntags: [tactile, reinforcement-learning, jax]\n---\n\n"
        f"# {saved.notes.get('name', 'A policy of touch')}\n\n| | |\n|---|---|\n{table}\n\n"
        'Use: `touchr1_jax.load_policy("FOLDER").ask({"SENSOR": frames}, "How hard is it?")`, or\n'
        '`python -m experiments ask FOLDER INPUT --question "How hard is it?"`.\n'
    )


def words(saved: SavedPolicy, attribute: str) -> list[str]:
    """The word for each level of an attribute."""
    language = saved.policy.language
    return [level[0] for level in language.attributes[language.attribute_index(attribute)].levels]


def _yes(value: bool) -> str:
    return "yes" if value else "no"


def _config(saved: SavedPolicy, precision: Precision, folder: Path) -> dict[str, Any]:
    """Contents of `config.json`, with the checksums of the files that are in the folder."""
    return {
        "model_type": FORMAT,
        "version": VERSION,
        "precision": precision,
        "sensors": saved.sensors,
        "model": dataclasses.asdict(saved.model),
        "language": dataclasses.asdict(saved.policy.language),
        "questions": {a.name: saved.questions[a.name] for a in saved.policy.language.attributes},
        "input": dataclasses.asdict(saved.reads),
        "notes": dict(saved.notes),
        "files": {name: digest_of(folder / name) for name in (SINGLE, TOKENIZER_FILE)},
    }


def seal(fields: Mapping[str, Any]) -> str:
    """The text of a `config.json` with the checksum of its fields."""
    plain = json.loads(json.dumps(fields))
    text = json.dumps(plain | {CHECKSUM: _digest(plain)}, indent=2, ensure_ascii=False) + "\n"
    return text.encode(errors="backslashreplace").decode()  # bytes of a name that are no UTF-8


def digest_of(path: Path) -> str:
    """SHA-256 of a file."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def require_files(folder: Path, digests: Mapping[str, str], names: Collection[str]) -> None:
    """`PolicyError` that names a file of a policy which is missing or has another digest."""
    for name in names:
        if not (folder / name).is_file() or digest_of(folder / name) != digests[name]:
            raise PolicyError(f"policy is {folder}: {name} is missing or damaged; copy the folder again")


def read_sealed(folder: Path, wanted: str, newest: int) -> dict[str, Any]:
    """Contents of a `config.json` that `seal` wrote, checked against its checksum.

    Args:
      folder: of the policy.
      wanted: its format.
      newest: the version that is read.

    Raises:
      PolicyError: no such file, another format or version, or changed.
    """
    where = f"policy is {folder}"
    if not (folder / CONFIG_FILE).is_file():
        what = f"holds no {CONFIG_FILE}" if folder.is_dir() else "no such folder"
        if left := sorted(folder.parent.glob(f".{glob.escape(folder.name)}.*.old")):
            raise PolicyError(f"{where}: {what}; a killed process left {left[-1]}: rename it to {folder.name}")
        raise PolicyError(f"{where}: {what}; give a folder that `save_policy` or `python -m experiments export` wrote")
    try:
        found = json.loads((folder / CONFIG_FILE).read_text(encoding="utf-8"))
        kind, version = found.get("model_type"), found.get("version")
    except (ValueError, AttributeError, RecursionError) as error:
        raise PolicyError(f"{where}: {CONFIG_FILE} is damaged ({error}); copy the folder again") from error
    if kind != wanted:
        raise PolicyError(
            f"{where}: model_type in {CONFIG_FILE} is {kind!r}: must be {wanted!r}; a released Qwen2.5-VL is read by "
            "`experiments touch_r1 --weights`"
        )
    if version != newest:
        raise PolicyError(f"{where}: version is {version}: this code reads {newest}; update touchr1-jax")
    if found.pop(CHECKSUM, None) != _digest(found):
        raise PolicyError(f"{where}: {CONFIG_FILE} was changed after it was written; copy the folder again")
    return found


def format_of(folder: Path) -> str | None:
    """The `model_type` of a folder, if it has one."""
    path = folder / CONFIG_FILE
    try:
        return json.loads(path.read_text(encoding="utf-8"))["model_type"] if path.is_file() else None  # no pipe
    except (OSError, ValueError, LookupError, TypeError, RecursionError):
        return None


def _stored(params: Params, precision: Precision) -> dict[str, np.ndarray]:
    """Tensors as they are written, by dotted names."""
    by_name = unstacked(traverse_util.flatten_dict(params, sep="."))
    flat = {name: np.asarray(x, np.float32) for name, x in by_name.items()}
    if precision == "float32":
        return flat
    most = np.finfo(np.float16 if precision == "float16" else np.float32).max
    for name, x in flat.items():
        if not (np.abs(x) <= most).all():
            raise PolicyError(
                f"{name} reaches {np.abs(x).max():g}: {precision} needs numbers up to {most:g}; save it in float32"
            )
    if precision == "float16":
        return {name: x.astype(np.float16) for name, x in flat.items()}
    stored: dict[str, np.ndarray] = {}
    for name, x in flat.items():
        if x.ndim < 2:
            stored[name] = x
            continue
        scale = np.maximum(np.abs(x).max(tuple(range(x.ndim - 1))), np.finfo(np.float32).tiny) / 127
        stored[name], stored[name + SCALE] = np.rint(x / scale).astype(np.int8), scale
    return stored


def _read_params(folder: Path) -> dict[str, np.ndarray]:
    """Parameters in float32, by dotted names."""
    try:
        found = {name: read_tensor(entry) for name, entry in read_header(folder / SINGLE).items()}
        params = {name: x for name, x in found.items() if not name.endswith(SCALE)}
        scale = {name: found[name + SCALE] if x.dtype == np.int8 else np.float32(1) for name, x in params.items()}
        return restacked({name: x.astype(np.float32) * scale[name] for name, x in params.items()})
    except (ValueError, LookupError) as error:
        raise PolicyError(f"policy is {folder}: {SINGLE} does not fit this version ({error}); save it anew") from error


def rebuilt(kind: Any, value: Any) -> Any:
    """A value of a type, which may be a dataclass, a tuple of types or a plain value, from its JSON form.

    Raises:
      ValueError, TypeError: fields that the type lacks, or that it has and the value lacks; a value of another type.
    """
    if dataclasses.is_dataclass(kind):
        hints = typing.get_type_hints(kind)
        names = {field.name for field in dataclasses.fields(kind)}
        if names != value.keys():
            raise ValueError(f"{getattr(kind, '__name__', kind)} differs in {sorted(names ^ value.keys())}")
        return kind(**{name: rebuilt(hints[name], value[name]) for name in names})  # type: ignore[operator]
    if typing.get_origin(kind) is tuple:
        if not isinstance(value, list):
            raise ValueError(f"{value!r} is given for a list")
        inner = typing.get_args(kind)
        each = [inner[0]] * len(value) if inner[-1] is Ellipsis else inner
        return tuple(rebuilt(of, item) for of, item in zip(each, value, strict=True))
    origin, allowed = typing.get_origin(kind), typing.get_args(kind)
    types = allowed or (kind,)
    if not (value in types if origin is Literal else type(value) in types or (type(value) is int and float in types)):
        raise ValueError(f"{value!r} is given for {getattr(kind, '__name__', kind)}")
    return value


def _digest(fields: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(fields, sort_keys=True).encode()).hexdigest()
