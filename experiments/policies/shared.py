"""SFT checkpoints that experiments share: made once for a configuration, its data and the code behind it.

A checkpoint lies in `CACHE/sft/HASH.npz` with the metrics that were logged while it was made, so that the report of an
experiment that finds it shows the same curves.  The hash covers every value that SFT depends on and the source that it
runs through.  The source of rewards and of reinforcement learning is not part of it, so that who works on those finds
the checkpoints again.
"""

import functools
import hashlib
import io
import json
from pathlib import Path
from typing import Any

import jax
import numpy as np

from experiments.policies.arrays import flat, nested
from experiments.policies.assembly import Assembly
from experiments.policies.dataset import Dataset
from experiments.policies.stages import SFTConfig, run_sft
from experiments.running.artifacts import jsonable, write_bytes
from experiments.running.context import Context, read_metrics
from experiments.running.runs import ROOT, versions
from touchr1_jax.types import Params

LATER = (
    "touchr1_jax/rl",
    "touchr1_jax/rewards",
    "touchr1_jax/bench",
    "touchr1_jax/distributed",
    "sensors_io/commands",
    "sensors_io/viewer",
)
"""Source that is at work only after SFT, or never in training."""

USED = ("touchr1_jax/rl/alarms.py", "touchr1_jax/rl/losses.py")
"""Files among `LATER` that SFT and the encoders are built on."""

_LINES = "metrics"  # entry of the file that holds the logged lines as JSON; parameters are named by their path


def shared_sft(
    assembly: Assembly,
    data: Dataset,
    evidence: np.ndarray,
    config: SFTConfig,
    context: Context,
    *,
    seed: int,
    stage: str,
    blind: bool = False,
    tactile: Params | None = None,
) -> Params:
    """What `run_sft` gives for these arguments, from the cache where some experiment already made it.

    Args:
      assembly, data, evidence, config, context, seed, stage, blind, tactile: as in `run_sft`.
    """
    values = {
        "records": data.store.digest,
        "config": config,
        "model": assembly.model,
        "clip": data.clip,
        "seed": seed,
        "blind": blind,
        "mesh": context.devices.shape,
    }
    felt = {} if tactile is None else {f"tactile/{name}": x for name, x in flat(tactile).items()}
    arrays = {"evidence": evidence, "rows": data.parts["sft"], **felt}
    path = context.cache_dir / "sft" / f"{fingerprint(values, arrays)}.npz"
    if path.exists():
        context.say(f"{stage}: made before, {path}")
        with context.timed(stage):
            return _found(path, context, stage)
    params = run_sft(assembly, data, evidence, config, context, seed=seed, stage=stage, blind=blind, tactile=tactile)
    context.team.once(lambda: _publish(path, params, _logged(context, stage)))
    return params


def fingerprint(values: dict[str, Any], arrays: dict[str, np.ndarray]) -> str:
    """Sixteen digits of the hash of configurations, arrays, package versions, the kind of device, and source."""
    sum_ = hashlib.sha256()
    about = {**jsonable(values), "versions": versions(), "device": jax.default_backend(), "source": source_digest()}
    sum_.update(json.dumps(about, sort_keys=True).encode())
    for name, x in sorted(arrays.items()):
        sum_.update(f"{name} {x.dtype.str} {x.shape}".encode())
        sum_.update(np.ascontiguousarray(x).tobytes())
    return sum_.hexdigest()[:16]


@functools.cache
def source_digest(root: Path = ROOT) -> str:
    """Hash of the source that decides what SFT computes: the packages and `experiments/policies` without `LATER`."""
    sum_ = hashlib.sha256()
    for folder in ("touchr1_jax", "sensors_io", "experiments/policies"):
        for path in sorted((root / folder).rglob("*.py")):
            name = path.relative_to(root).as_posix()
            if not name.startswith(tuple(f"{later}/" for later in LATER)) or name in USED:
                sum_.update(name.encode() + b"\0" + path.read_bytes() + b"\0")
    return sum_.hexdigest()


def _publish(path: Path, params: Params, lines: list[dict[str, Any]]) -> None:
    arrays: dict[str, Any] = {_LINES: np.frombuffer(json.dumps(lines).encode(), np.uint8), **flat(params)}
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    write_bytes(path, buffer.getvalue())


def _found(path: Path, context: Context, stage: str) -> Params:
    with np.load(path) as file:
        lines = json.loads(file[_LINES].tobytes())
        params = nested({name: file[name] for name in file.files if name != _LINES})
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
