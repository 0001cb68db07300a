"""Policies that experiments share, trained once for a configuration, its data and the code behind it.

A policy lies in `CACHE/sft/HASH.npz` or `CACHE/grpo/HASH.npz` with the metrics that were logged during its training, so
that the report of an experiment that finds it shows the same curves.  The hash covers every value that training depends
on and the source that it runs through.  For SFT it leaves out the source of rewards and of reinforcement learning: the
checkpoints outlive changes there.
"""

import functools
import hashlib
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Literal

import jax.numpy as jnp
import numpy as np
from flax import traverse_util

from experiments.core import numerics
from experiments.core.artifacts import jsonable, read_arrays, write_arrays
from experiments.core.context import Context
from experiments.core.metric_log import by_stage, read_metrics
from experiments.core.runs import ROOT, versions
from touchr1_jax.types import Params

NEVER = (
    "experiments/study/policies.py",
    "touchr1_jax/asking.py",
    "touchr1_jax/bench/",
    "touchr1_jax/distributed/",
    "touchr1_jax/models/adapted_folder.py",
    "touchr1_jax/models/description_policy.py",
    "touchr1_jax/models/saved_policy.py",
    "touchr1_jax/models/touch_input.py",
    "touchr1_jax/text/plain_questions.py",
    "touchr1_jax/training/description_tuning.py",
    "touchr1_jax/training/exploration.py",
    "touchr1_jax/training/kernel_probe.py",
    "sensors_io/commands/",
    "sensors_io/viewer/",
)
"""Source that the training of these policies never runs."""

LATER = (
    "touchr1_jax/rl/",
    "touchr1_jax/rewards/",
    "touchr1_jax/training/evaluation.py",
    "touchr1_jax/training/questions.py",
    "touchr1_jax/training/rollout_server.py",
    "touchr1_jax/training/train_grpo.py",
    *NEVER,
)
"""Source that runs only after SFT, or never."""

USED = ("touchr1_jax/rl/alarms.py", "touchr1_jax/rl/gradient.py", "touchr1_jax/rl/losses.py")
"""Files among `LATER` that SFT and the encoders are built on."""

DAMAGED = (ValueError, KeyError)  # errors of a file of the cache that is not what was written

_LINES = "metrics"  # entry of the file that holds the logged lines as JSON; parameters are named by their path


def cached(
    kind: Literal["sft", "grpo"],
    values: Mapping[str, Any],
    arrays: Mapping[str, Any],
    train: Callable[[], Params],
    context: Context,
    stage: str,
) -> Params:
    """The result of `train`, which logs under `stage`, from the cache where an experiment already made it.

    `kind` decides the source that counts; values and nested arrays are everything else that the result depends on.
    """
    digest = fingerprint(values, arrays, source_digest(LATER if kind == "sft" else NEVER))
    path = context.cache_dir / kind / f"{digest}.npz"
    if path.exists():
        try:
            with context.timed(stage):
                found = _found(path, context, stage)
            context.print(f"{stage}: made before, {path}")
            return found
        except DAMAGED as error:
            context.print(f"{stage}: {path} is damaged ({error.__cause__ or error}), and is made again")
    params = train()
    lines = np.frombuffer(json.dumps(_logged(context, stage)).encode(), np.uint8)
    context.processes.write_once(lambda: write_arrays(path, {_LINES: lines, **_flat(params)}, of=digest))
    return params


def fingerprint(values: Mapping[str, Any], arrays: Mapping[str, Any], source: str) -> str:
    """Sixteen digits of the hash of configurations, arrays, package versions, settings, machine and source."""
    sum_ = hashlib.sha256()
    machine = {**numerics.machine(), "settings": numerics.settings()}
    about = {**jsonable(values), **machine, "versions": versions(), "source": source}
    sum_.update(json.dumps(about, sort_keys=True).encode())
    for name, x in sorted(_flat(arrays).items()):
        sum_.update(f"{name} {x.dtype.str} {x.shape}".encode())
        sum_.update(np.ascontiguousarray(x).tobytes())
    return sum_.hexdigest()[:16]


@functools.cache
def source_digest(without: tuple[str, ...] = LATER, root: Path = ROOT) -> str:
    """Hash of the source that decides what is computed: the packages and `experiments/study` but some folders."""
    sum_ = hashlib.sha256()
    for folder in ("touchr1_jax", "sensors_io", "experiments/study"):
        for path in sorted((root / folder).rglob("*.py")):
            name = path.relative_to(root).as_posix()
            if not name.startswith(without) or name in USED:
                sum_.update(name.encode() + b"\0" + path.read_bytes() + b"\0")
    return sum_.hexdigest()


def _flat(tree: Mapping[str, Any]) -> dict[str, Any]:
    """Arrays named by their path, joined by "/"."""
    return {name: np.asarray(x) for name, x in traverse_util.flatten_dict(tree, sep="/").items()}


def read_policy(path: Path) -> tuple[Params, list[dict[str, Any]]]:
    """Parameters of a policy in the cache, and the lines that its training logged; errors are those of `DAMAGED`."""
    arrays = read_arrays(path, path.stem)
    lines = json.loads(arrays.pop(_LINES).tobytes())
    return traverse_util.unflatten_dict({name: jnp.asarray(x) for name, x in arrays.items()}, sep="/"), lines


def _found(path: Path, context: Context, stage: str) -> Params:
    params, lines = read_policy(path)
    if _logged(context, stage) != lines:  # a resumed run has them already, and its log must not be reordered
        context.rewind(stage, 0)
        for line in lines:
            context.log(stage, **line)
        context.seal_log(stage)
    return params


def _logged(context: Context, stage: str) -> list[dict[str, Any]]:
    """The logged lines of a stage without its name."""
    lines = by_stage(read_metrics(context.directory)).get(stage, ())
    return [{name: value for name, value in line.items() if name != "stage"} for line in lines]
