"""The golden model on this side: config, checkpoint files, parameters and inputs."""

import functools
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from tests.touchr1_jax.models.qwen import cases
from tests.touchr1_jax.models.qwen.cases import CASES, Case, Video
from touchr1_jax.models.qwen import safetensors
from touchr1_jax.models.qwen.config import QwenConfig, parse_config
from touchr1_jax.models.qwen.geometry import Grid
from touchr1_jax.models.qwen.model import Inputs
from touchr1_jax.models.qwen.names import published, sources
from touchr1_jax.models.qwen.positions import Seen, picture, position_ids, video
from touchr1_jax.models.qwen.weights import load_params
from touchr1_jax.types import Params


def config_of(case: Case) -> QwenConfig:
    return parse_config(case.config())


def tensors(config: QwenConfig) -> dict[str, np.ndarray]:
    """Weights by formula under their published names."""
    return {published(s.key): cases.tensor(s.key, s.shape) for s in sources(config).values()}


def write_weights(directory: Path, config: QwenConfig) -> None:
    """A checkpoint of one file."""
    safetensors.write_file(directory / "model.safetensors", tensors(config))


def params_of(case: Case, directory: Path) -> Params:
    """Parameters, by way of a checkpoint."""
    write_weights(directory, config_of(case))
    return load_params(directory, config_of(case), jnp.float32)


def grids_of(case: Case) -> tuple[Grid, ...]:
    return tuple(Grid(cases.steps(part), part.rows, part.columns) for part in case.seen())


def runs_of(case: Case) -> list[int | Seen]:
    """The prompt as `position_ids` reads it."""
    config, runs = config_of(case), []
    for part in case.parts:
        if isinstance(part, int):
            runs.append(part)
            continue
        grid = Grid(cases.steps(part), part.rows, part.columns)
        if isinstance(part, Video):
            seen = video(grid, cases.MERGE, part.seconds_per_step, config.vision.tokens_per_second)
        else:
            seen = picture(grid, cases.MERGE)
        runs += [1, seen, 1]
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
