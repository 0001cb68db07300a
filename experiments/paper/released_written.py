"""A trained policy as a folder: published weights that any loader of Qwen2.5-VL reads, and the tactile encoder.

DIR/model.safetensors, config.json, tokenizer.json, …    the released folder with the merged weights
DIR/touch.npz                                            tactile encoder and what projects its tokens
"""

import io
import shutil
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from experiments.core.artifacts import write_bytes
from experiments.study.arrays import flat, nested
from touchr1_jax.models.qwen.config import read_config
from touchr1_jax.models.qwen.safetensors import Tell
from touchr1_jax.models.qwen.weights import INDEX, SINGLE, load_params, save_params
from touchr1_jax.types import Params

TOUCH_FILE = "touch.npz"

COPIED = (".json", ".jinja", ".txt", ".md")
"""Endings of the small files of a released folder, which are taken over as they are."""


def write_policy(
    directory: Path, source: Path, params: Params, progress: Tell = lambda done_bytes, all_bytes: None
) -> None:
    """Publish a policy in one move: what is at `directory` is whole.

    Args:
      directory: replaced where it is there.
      source: the released folder that the policy began from.
      params: of the policy, adapters merged.
      progress: told of the released weights as they are written.
    """
    unfinished = directory.with_name(f"{directory.name}.unfinished")
    for folder in (unfinished, directory):
        shutil.rmtree(folder, ignore_errors=True)
    unfinished.mkdir(parents=True)
    for path in sorted(source.iterdir()):
        if path.is_file() and path.suffix in COPIED and path.name != INDEX:
            shutil.copy(path, unfinished)
    released = {"vision": params["vision"]["tower"], "decoder": params["decoder"]}
    save_params(unfinished / SINGLE, released, read_config(source), progress)
    buffer = io.BytesIO()
    np.savez(buffer, allow_pickle=False, **flat({name: x for name, x in params.items() if name not in released}))
    write_bytes(unfinished / TOUCH_FILE, buffer.getvalue())
    unfinished.rename(directory)


def read_policy(
    directory: Path, dtype: jnp.dtype | type, progress: Tell = lambda done_bytes, all_bytes: None
) -> Params:
    """The parameters that `write_policy` wrote.

    Args:
      directory: the folder.
      dtype: of the released towers.
      progress: told of these as they are read.

    Raises:
      FileNotFoundError, ValueError: as `read_config` and `load_params`, or without a tactile encoder.
    """
    if not (directory / TOUCH_FILE).is_file():
        raise FileNotFoundError(
            f"{directory} holds no {TOUCH_FILE}: must be a folder that `touch_r1` wrote; correct it"
        )
    released = load_params(directory, read_config(directory), dtype, progress=progress)
    with np.load(directory / TOUCH_FILE) as file:
        touch = nested({name: file[name] for name in file.files})
    return {**touch, "vision": {"tower": released["vision"]}, "decoder": released["decoder"]}
