"""The golden model on this side: config, checkpoint files, parameters, position ids and inputs."""

import functools
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from tests.touchr1_jax.models.qwen import cases
from tests.touchr1_jax.models.qwen.cases import CASES, Case, Video
from touchr1_jax.models.qwen import safetensors
from touchr1_jax.models.qwen.config import QwenConfig
from touchr1_jax.models.qwen.config_file import parse_config
from touchr1_jax.models.qwen.geometry import Grid
from touchr1_jax.models.qwen.model import Inputs
from touchr1_jax.models.qwen.names import published, sources
from touchr1_jax.models.qwen.weights import load_params
from touchr1_jax.types import Params


def config_of(case: Case) -> QwenConfig:
    return parse_config(case.config())


def tensors(config: QwenConfig) -> dict[str, np.ndarray]:
    """Weights by formula under their published names."""
    return {published(s.key, config): cases.tensor(s.key, s.shape) for s in sources(config).values()}


def write_weights(directory: Path, config: QwenConfig) -> None:
    """A checkpoint of one file."""
    safetensors.write_file(directory / "model.safetensors", tensors(config))


def params_of(case: Case, directory: Path) -> Params:
    """Parameters, by way of a checkpoint."""
    write_weights(directory, config_of(case))
    return load_params(directory, config_of(case), jnp.float32)


def grids_of(case: Case) -> tuple[Grid, ...]:
    return tuple(Grid(cases.steps(part), part.rows, part.columns) for part in case.seen())


class Block(NamedTuple):
    """Tokens of one picture, video or tactile stream: the time id of each step, and rows × columns of a step."""

    times: Sequence[int]
    rows: int
    columns: int


def position_ids(runs: Sequence[int | Block]) -> np.ndarray:
    """(time, row, column) ids [3, L] of a prompt of text tokens (their number) and blocks.

    A block starts one after the largest id before it (Qwen2-VL, arXiv 2409.12191, §2.1).
    """
    start, columns = 0, []
    for run in runs:
        text = isinstance(run, int)
        ids = (
            [(i, i, i) for i in range(run)]
            if text
            else [(t, y, x) for t in run.times for y in range(run.rows) for x in range(run.columns)]
        )
        columns.append(start + np.array(ids).T)
        start = int(columns[-1].max()) + 1
    return np.concatenate(columns, 1)


def runs_of(case: Case) -> list[int | Block]:
    """A case as `position_ids` reads it; step t of a video has the time id ⌊t · seconds per step · 2⌋, in Qwen3-VL a
    block of its own after words."""
    runs: list[int | Block] = []
    for part in case.parts:
        if isinstance(part, int):
            runs.append(part)
            continue
        rows, columns = part.rows // cases.MERGE, part.columns // cases.MERGE
        if case.shape is not None:
            for _ in range(cases.steps(part)):
                runs += [cases.STAMP * isinstance(part, Video) + 1, Block([0], rows, columns), 1]
            continue
        times = [int(2 * t * part.seconds_per_step) for t in range(part.steps)] if isinstance(part, Video) else [0]
        runs += [1, Block(times, rows, columns), 1]
    return runs


@functools.cache
def inputs_of(name: str) -> Inputs:
    case = CASES[name]
    ids = cases.prompt_ids(case)
    seen = [cases.patches(f"{name} {i}", part) for i, part in enumerate(case.seen())]
    with jax.ensure_compile_time_eval():
        return Inputs(
            ids=jnp.asarray(ids, jnp.int32),
            positions=jnp.asarray(position_ids(runs_of(case)), jnp.int32),
            slots=jnp.asarray(np.flatnonzero((ids == cases.IMAGE) | (ids == cases.VIDEO)), jnp.int32),
            patches=jnp.asarray(np.concatenate([np.zeros((0, cases.PIXELS), np.float32), *seen])),
        )
