"""Released weights on disk: unchanged during a run, written back as a policy, and the share that merging keeps.

DIR/model.safetensors, config.json, tokenizer.json, …    the released folder with the merged weights
DIR/touch.npz                                            tactile encoder and the projection of its tokens
"""

import io
import shutil
import zlib
from collections.abc import Mapping
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from flax import traverse_util

from experiments.core.artifacts import write_bytes
from experiments.core.context import Context
from experiments.core.loops import KEPT
from experiments.core.progress import in_megabytes
from experiments.core.results import Requirement, Table, named_table
from experiments.study.stages import encode_rows, untrained
from experiments.study.study import BLIND, SFT, TrainedPolicy, ask_policy
from touchr1_jax.models.load import WeightsError
from touchr1_jax.models.qwen.config import read_config
from touchr1_jax.models.qwen.safetensors import Tell
from touchr1_jax.models.qwen.weights import INDEX, SINGLE, load_params, save_params
from touchr1_jax.training.evaluation import Evaluation
from touchr1_jax.types import Params

TOUCH_FILE = "touch.npz"

COPIED = (".json", ".jinja", ".txt", ".md")
"""Endings of the small files of a released folder, which are copied."""

LEAST_KEPT = 0.9
"""Share of the adapters' change that the weights must keep that are scored and written."""


def require_same(source: Path, context: Context) -> None:
    """Refuse to continue a run with other weights than it began with, by the fingerprints of their files.

    Raises:
      WeightsError: a file changed, came or went.
    """
    marks = {path.name: file_fingerprint(path) for path in sorted(source.iterdir()) if path.is_file()}
    if not context.done("weights"):
        context.save_stage("weights", marks)
    began = context.load_stage("weights")
    changed = sorted(name for name in {*began, *marks} if began.get(name) != marks.get(name))
    if changed:
        raise WeightsError(
            f"{source} is not what this run began with: {', '.join(changed)} changed; put it back, or say --fresh"
        )


def file_fingerprint(path: Path) -> list[int]:
    """Size of a file and the CRC-32 of its first and of its last mebibyte: shards of gigabytes are not read twice."""
    size, ends = path.stat().st_size, []
    with path.open("rb") as file:
        for start in (0, max(0, size - 2**20)):
            file.seek(start)
            ends.append(zlib.crc32(file.read(2**20)))
    return [size, *ends]


def write_policy(
    directory: Path, source: Path, params: Params, progress: Tell = lambda done_bytes, all_bytes: None
) -> None:
    """Publish a policy in one move, so that `directory` is never half written.

    Args:
      directory: replaced if it exists.
      source: the released folder that the policy started from.
      params: of the policy, adapters merged.
      progress: called as the released weights are written.
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
    added = {name: x for name, x in params.items() if name not in released}
    np.savez(buffer, allow_pickle=False, **traverse_util.flatten_dict(added, sep="/"))
    write_bytes(unfinished / TOUCH_FILE, buffer.getvalue())
    unfinished.rename(directory)


def read_policy(
    directory: Path, dtype: jnp.dtype | type, progress: Tell = lambda done_bytes, all_bytes: None
) -> Params:
    """The parameters that `write_policy` wrote.

    Args:
      directory: the folder.
      dtype: of the released towers.
      progress: called as these are read.

    Raises:
      FileNotFoundError, ValueError: as `read_config` and `load_params`, or no tactile encoder.
    """
    if not (directory / TOUCH_FILE).is_file():
        raise FileNotFoundError(
            f"{directory} holds no {TOUCH_FILE}: must be a folder that `touch_r1` wrote; correct it"
        )
    released = load_params(directory, read_config(directory), dtype, progress=progress)
    with np.load(directory / TOUCH_FILE) as file:
        touch = traverse_util.unflatten_dict({name: jnp.asarray(file[name]) for name in file.files}, sep="/")
    return {**touch, "vision": {"tower": released["vision"]}, "decoder": released["decoder"]}


def zero_shot(trained: TrainedPolicy) -> Evaluation:
    """The released model before any training: it sees the object's picture and no touch, which it never learned to
    read; the system prompt describes the form of an answer."""
    policy, data = trained.policy, trained.data
    params = untrained(policy, data, trained.seed)
    test = encode_rows(policy, params, data, data.parts["test"], trained.context, blind=True)
    return ask_policy(policy, params, test, trained.label, trained.context)


def written(source: Path, trained: TrainedPolicy) -> Evaluation:
    """The policy written to `weights/SEED` of the run, read from there, and evaluated again with all streams.

    Args:
      source: the released folder that it started from.
      trained: the policy.
    """
    policy, data, context = trained.policy, trained.data, trained.context
    folder = context.directory / "weights" / str(trained.seed)
    with context.progress_callback("writing weights, MB") as report:
        context.processes.write_once(lambda: write_policy(folder, source, trained.params, in_megabytes(report)))
    with context.progress_callback("reading weights, MB") as report:
        params = read_policy(folder, policy.fns.cache_dtype, in_megabytes(report))
    test = encode_rows(policy, params, data, data.parts["test"], context)
    return ask_policy(policy, params, test, trained.label, context, alone=False)


def merged_shares(arm: str, seeds: int, context: Context) -> dict[str, float]:
    """Policy → share of its last stage's adapters that merging kept, the least of all seeds."""
    stages = {"sft": SFT, f"grpo/{arm}": arm, "blind": BLIND}
    return {
        name: min(context.load_stage(f"{KEPT}/{stage}/{seed}") for seed in range(seeds))
        for stage, name in stages.items()
    }


def least_merged(kept: Mapping[str, float]) -> Requirement:
    """The least share of all policies: a type too coarse for the changes of training rounds them away."""
    name, note = "least share of the adapters that merging keeps", "below, train faster or in --model.dtype float32"
    return Requirement(name=name, measured=min(kept.values()), bound=LEAST_KEPT, better="higher", note=note)


def merged_table(kept: Mapping[str, float]) -> Table:
    """The share of each policy."""
    return named_table(
        "Share of the adapters that merging keeps",
        [{"policy": name, "kept": 100 * share} for name, share in kept.items()],
        units={"kept": "%"},
        formats={"kept": ".1f"},
        note="Projection of the change of the weights, rounded to their type, on the adapters' change; the least "
        "of all seeds.",
    )
