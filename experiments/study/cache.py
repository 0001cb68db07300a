"""Policies that experiments share, trained once for a configuration, its data and the code behind it.

A policy lies in `CACHE/sft/HASH.npz` or `CACHE/grpo/HASH.npz` with the metrics that were logged during its training, so
that the report of an experiment that finds it shows the same curves.  The hash covers every value that training depends
on and the source that it runs through.  For SFT it leaves out the source of rewards and of reinforcement learning: the
checkpoints outlive changes there.
"""

import dataclasses
import functools
import hashlib
import io
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import traverse_util

from experiments.core.artifacts import jsonable, write_bytes
from experiments.core.context import Context, read_metrics
from experiments.core.runs import ROOT, versions
from experiments.study.dataset import Dataset
from experiments.study.stages import EncodedContacts, GRPOArm, StudySFT, run_grpo, run_sft
from touchr1_jax.models.touch_policy import TouchPolicy
from touchr1_jax.types import Params

NEVER = ("touchr1_jax/bench/", "touchr1_jax/distributed/", "sensors_io/commands/", "sensors_io/viewer/")
"""Source that training never runs."""

LATER = (
    "touchr1_jax/rl/",
    "touchr1_jax/rewards/",
    "touchr1_jax/training/evaluation.py",
    "touchr1_jax/training/questions.py",
    "touchr1_jax/training/train_grpo.py",
    *NEVER,
)
"""Source that runs only after SFT, or never."""

USED = ("touchr1_jax/rl/alarms.py", "touchr1_jax/rl/losses.py")
"""Files among `LATER` that SFT and the encoders are built on."""

_LINES = "metrics"  # entry of the file that holds the logged lines as JSON; parameters are named by their path


def cached_sft(
    policy: TouchPolicy,
    data: Dataset,
    evidence: np.ndarray,
    config: StudySFT,
    context: Context,
    *,
    seed: int,
    stage: str,
    blind: bool = False,
    tactile: Params | None = None,
    train: Callable[..., Params] = run_sft,
) -> Params:
    """The result of `train` for the same arguments, from the cache where an experiment already made it."""
    values = {
        "records": data.store.digest,
        "config": config,
        "model": policy.model,
        "clip": data.clip,
        "seed": seed,
        "blind": blind,
        "mesh": context.devices.shape,
    }
    arrays = {"evidence": evidence, "rows": data.parts["sft"], **_flat({} if tactile is None else {"tactile": tactile})}
    return _cached(
        context.cache_dir / "sft" / f"{fingerprint(values, arrays, source_digest())}.npz",
        lambda: train(policy, data, evidence, config, context, seed=seed, stage=stage, blind=blind, tactile=tactile),
        context,
        stage,
    )


def cached_grpo(
    policy: TouchPolicy,
    arm: GRPOArm,
    contacts: EncodedContacts,
    params: Params,
    context: Context,
    *,
    seed: int,
    stage: str,
    train: Callable[..., Params] = run_grpo,
) -> Params:
    """The result of `train` for the same arguments, from the cache where an experiment already made it."""
    values = {
        "weights": list(arm.weights.items()),
        "config": arm.config,
        "steps": arm.loop.steps,
        "lora": arm.lora,
        "model": policy.model,
        "seed": seed,
        "mesh": context.devices.shape,
    }
    named = dataclasses.asdict(contacts.features) | {
        "label": contacts.label,
        "truth": contacts.truth,
        "noise": contacts.noise,
    }
    arrays = _flat(params) | {f"input/{name}": np.asarray(x) for name, x in named.items()} | {"input/prior": arm.prior}
    return _cached(
        context.cache_dir / "grpo" / f"{fingerprint(values, arrays, source_digest(NEVER))}.npz",
        lambda: train(policy, arm, contacts, params, context, seed=seed, stage=stage),
        context,
        stage,
    )


def _cached(path: Path, make: Callable[[], Params], context: Context, stage: str) -> Params:
    """The policy at `path`, made and published there first where there is none."""
    if path.exists():
        context.print(f"{stage}: made before, {path}")
        with context.timed(stage):
            return _found(path, context, stage)
    params = make()
    context.processes.write_once(lambda: _publish(path, params, _logged(context, stage)))
    return params


def fingerprint(values: dict[str, Any], arrays: dict[str, np.ndarray], source: str) -> str:
    """Sixteen digits of the hash of configurations, arrays, package versions, device, compilation, and source."""
    sum_ = hashlib.sha256()
    machine = {"device": jax.default_backend(), "quickly": jax.config.values["jax_disable_most_optimizations"]}
    about = {**jsonable(values), **machine, "versions": versions(), "source": source}
    sum_.update(json.dumps(about, sort_keys=True).encode())
    for name, x in sorted(arrays.items()):
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


def _flat(params: Params) -> dict[str, np.ndarray]:
    """Arrays named by their path, joined by "/"."""
    return {name: np.asarray(x) for name, x in traverse_util.flatten_dict(params, sep="/").items()}


def _publish(path: Path, params: Params, lines: list[dict[str, Any]]) -> None:
    arrays: dict[str, Any] = {_LINES: np.frombuffer(json.dumps(lines).encode(), np.uint8), **_flat(params)}
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    write_bytes(path, buffer.getvalue())


def _found(path: Path, context: Context, stage: str) -> Params:
    with np.load(path) as file:
        lines = json.loads(file[_LINES].tobytes())
        flat = {name: jnp.asarray(file[name]) for name in file.files if name != _LINES}
        params = traverse_util.unflatten_dict(flat, sep="/")
    if _logged(context, stage) != lines:  # a resumed run has them already, and its log must not be reordered
        context.rewind(stage, 0)
        for line in lines:
            context.log(stage, **line)
    return params


def _logged(context: Context, stage: str) -> list[dict[str, Any]]:
    """The logged lines of a stage without its name."""
    return [
        {name: value for name, value in line.items() if name != "stage"}
        for line in read_metrics(context.directory)
        if line["stage"] == stage
    ]
