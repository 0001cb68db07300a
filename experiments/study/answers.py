"""Answers of a policy, kept as one file of a run; the levels that they conclude."""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Int

from experiments.core.artifacts import read_arrays, write_arrays
from experiments.core.context import Context
from experiments.core.runs import labelled
from sensors_io.arrays import ArraysError
from touchr1_jax.training.evaluation import Evaluation
from touchr1_jax.types import Parsed


def concluded(answers: Evaluation) -> Int[np.ndarray, "N"]:
    """The level that each answer concludes for the attribute in question, −1 for ⊥."""
    return np.asarray(answers.parsed.conclude)[np.arange(len(answers.contact)), answers.attribute]


def asked_label(answers: Evaluation) -> Int[np.ndarray, "N"]:
    """The level of the attribute in question."""
    return answers.label[np.arange(len(answers.contact)), answers.attribute]


def share_right(answers: Evaluation) -> float:
    """Right answers in percent."""
    return 100 * float(np.mean(concluded(answers) == asked_label(answers)))


def answers_path(context: Context, name: str, seed: int) -> Path:
    """Where a run keeps the answers of a policy."""
    return context.directory / "answers" / f"{name}-{seed}.npz"


def save_answers(path: Path, evaluation: Evaluation) -> None:
    """Publish answers as one file."""
    flat: dict[str, Any] = {f: getattr(evaluation, f) for f in _FLAT if getattr(evaluation, f) is not None}
    flat |= {f"parsed_{f}": getattr(evaluation.parsed, f) for f in _PARSED}
    write_arrays(path, flat, compressed=True, of=_label(path))


def load_answers(path: Path) -> Evaluation:
    """Answers that `save_answers` published in this place; `ArraysError` of others, and of a damaged file."""
    arrays = read_arrays(path, _label(path))
    flat: dict[str, Any] = {f: arrays.get(f) for f in _FLAT}
    parsed: dict[str, Any] = {f: arrays.get(f"parsed_{f}") for f in _PARSED}
    if missing := [name for name, x in (*flat.items(), *parsed.items()) if x is None and name not in _OPTIONAL]:
        raise ArraysError(f"{path} lacks {', '.join(missing)}: put its own copy back, or remove it")
    return Evaluation(**flat, parsed=Parsed(**parsed))


def _label(path: Path) -> str:
    """Label of the answers in a run's file."""
    return labelled(path.parents[1], f"answers/{path.stem}")


_OPTIONAL = ("alone", "truth", "sampled", "marginal")
_FLAT = tuple(f.name for f in dataclasses.fields(Evaluation) if f.name != "parsed")
_PARSED = tuple(f.name for f in dataclasses.fields(Parsed))
