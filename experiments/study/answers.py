"""Answers of a policy to the test questions, kept as one file of a run."""

import dataclasses
import io
from pathlib import Path
from typing import Any

import numpy as np

from experiments.core.artifacts import write_bytes
from sensors_io.arrays import load_arrays
from touchr1_jax.training.evaluation import Evaluation
from touchr1_jax.types import Parsed


def save_answers(path: Path, evaluation: Evaluation) -> None:
    """Publish answers as one file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    flat: dict[str, Any] = {f: getattr(evaluation, f) for f in _FLAT if getattr(evaluation, f) is not None}
    flat |= {f"parsed_{f}": getattr(evaluation.parsed, f) for f in _PARSED}
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **flat)
    write_bytes(path, buffer.getvalue())


def load_answers(path: Path) -> Evaluation:
    """Answers that `save_answers` published.

    Raises:
      ValueError, KeyError: the file is damaged.
    """
    arrays = load_arrays(path)
    flat: dict[str, Any] = {f: arrays.get(f) for f in _FLAT}
    parsed: dict[str, Any] = {f: arrays[f"parsed_{f}"] for f in _PARSED}
    return Evaluation(**flat, parsed=Parsed(**parsed))


_FLAT = tuple(f.name for f in dataclasses.fields(Evaluation) if f.name != "parsed")
_PARSED = tuple(f.name for f in dataclasses.fields(Parsed))
