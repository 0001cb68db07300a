"""A pretrained tactile encoder as one file: its shape, its sensors and its parameters."""

import dataclasses
import io
import json
import tokenize
import zipfile
import zlib
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import traverse_util

from touchr1_jax.models.load import WeightsError
from touchr1_jax.models.tactile_vit import TactileViTConfig
from touchr1_jax.types import Params

_ABOUT = "about"  # entry of the file that holds its JSON; parameters are named by their path, joined by "/"


_BROKEN = (
    OSError, ValueError, TypeError, LookupError, AttributeError, RuntimeError, EOFError, SyntaxError,
    zipfile.BadZipFile, zlib.error, tokenize.TokenError,
)  # fmt: skip
"""Errors that damaged bytes raise in NumPy and zipfile."""


class EncoderError(WeightsError):
    """A file that is no encoder to start from; the message names it and the fix."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class PretrainedEncoder:
    """An encoder and the names of its sensors, in the order of its embedding; `notes` describe its training."""

    config: TactileViTConfig
    sensors: tuple[str, ...]
    params: Params
    notes: dict[str, Any] = dataclasses.field(default_factory=dict)

    def for_sensors(self, sensors: tuple[str, ...]) -> "PretrainedEncoder":
        """The same encoder for other sensors, in another order; an unknown one gets the mean embedding."""
        table = self.params["sensor"]["embedding"]
        rows = [table[self.sensors.index(s)] if s in self.sensors else table.mean(0) for s in sensors]
        params = {**self.params, "sensor": {"embedding": jnp.stack(rows)}}
        config = dataclasses.replace(self.config, sensors=len(sensors))
        return dataclasses.replace(self, config=config, sensors=sensors, params=params)

    def to_bytes(self) -> bytes:
        """Content of an `.npz` file that `load_encoder` reads."""
        about = {"config": dataclasses.asdict(self.config), "sensors": self.sensors, "notes": self.notes}
        arrays: dict[str, Any] = {_ABOUT: np.frombuffer(json.dumps(about).encode(), np.uint8)}
        arrays |= traverse_util.flatten_dict(self.params, sep="/")
        buffer = io.BytesIO()
        np.savez(buffer, **arrays)
        return buffer.getvalue()


def load_encoder(path: Path) -> PretrainedEncoder:
    """Read an encoder from its file; a run's directory stands for its `encoder.npz`.

    Raises:
      EncoderError: there is no such file, it is no encoder, or one of another version of its config.
    """
    path = path / "encoder.npz" if path.is_dir() else path
    if not path.is_file():
        raise EncoderError(f"encoder is {path}: no such file; give the run directory of pretrain_encoder")
    fix = "give a file that pretrain_encoder wrote"
    try:
        with zipfile.ZipFile(path) as archive:
            if any(member.comment or member.extra for member in archive.infolist()):
                raise ValueError("a flipped bit in its list of entries hides some of them")
            entries = {name.removesuffix(".npy"): _array(archive.read(name)) for name in archive.namelist()}
        about = json.loads(entries.pop(_ABOUT).tobytes()) if _ABOUT in entries else None
    except _BROKEN as error:
        raise EncoderError(f"encoder is {path}: cannot be read ({type(error).__name__}: {error}); {fix}") from error
    if about is None:
        raise EncoderError(f"encoder is {path}: it has no entry {_ABOUT!r}; {fix}")
    try:
        odd = sorted(set(about["config"]) ^ {f.name for f in dataclasses.fields(TactileViTConfig)})
        if odd:
            raise EncoderError(
                f"encoder is {path}: its config differs in {odd}, it is of another version; train it again"
            )
        return PretrainedEncoder(
            config=TactileViTConfig(**about["config"]),
            sensors=tuple(about["sensors"]),
            params=jax.tree.map(jnp.asarray, traverse_util.unflatten_dict(entries, sep="/")),
            notes=dict(about["notes"]),
        )
    except EncoderError:
        raise
    except (*_BROKEN, ArithmeticError) as error:
        raise EncoderError(f"encoder is {path}: its entry {_ABOUT!r} is of another form ({error!r}); {fix}") from error


def _array(content: bytes) -> np.ndarray:
    """The array of a .npy file, whose checksum was verified when all of it was read."""
    found: np.ndarray = np.lib.format.read_array(io.BytesIO(content), allow_pickle=False)
    return found
