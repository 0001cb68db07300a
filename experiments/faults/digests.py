"""Digests of a finished run: two runs have the same ones exactly if they ended in the same bits."""

import hashlib
import json
import shutil
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np
import orbax.checkpoint as ocp

from experiments.core.artifacts import read_json
from experiments.core.loops import KEPT
from touchr1_jax.training.checksums import old_checkpoints

STATE = "state of "  # begins the name of the digest of a stage's checkpoints


def digests(directory: Path) -> dict[str, str]:
    """SHA-256 of log lines, answers, results, and the checkpoints that every stage kept."""
    found = {"metrics.jsonl": _hash((directory / "metrics.jsonl").read_bytes())}
    for path in sorted((directory / "answers").glob("*.npz")):
        found[f"answers/{path.name}"] = _hash(path.read_bytes())
    results = read_json(directory / "results.json")
    found["results"] = _hash(json.dumps([results["verdict"], results["data"]]).encode())
    checkpoints = directory / "checkpoints"
    for stage in sorted({s.parent.parent for s in checkpoints.rglob("state") if s.parent.name.isdigit()}):
        old = old_checkpoints(stage, KEPT, scored=False)  # what a kill left of them does not count
        kept = sorted({p for p in stage.iterdir() if p.name.isdigit()} - {*old}, key=lambda path: int(path.name))
        found[f"{STATE}{stage.relative_to(checkpoints)}"] = _hash("".join(map(_state_hash, kept)).encode())
    return found


def differences(a: Mapping[str, str], b: Mapping[str, str]) -> tuple[str, ...]:
    """Names of the digests that differ between two runs."""
    return tuple(sorted(name for name in a.keys() | b.keys() if a.get(name) != b.get(name)))


def _state_hash(checkpoint: Path) -> str:
    """Digest of step, data iterator, score and every array of a checkpoint."""
    digest = hashlib.sha256(checkpoint.name.encode() + (checkpoint / "data" / "metadata").read_bytes())
    score = checkpoint / "metrics" / "metrics"  # next to it Orbax writes its own path
    digest.update(score.read_bytes() if score.exists() else b"")
    for path, array in jax.tree.leaves_with_path(_arrays(checkpoint / "state")):
        digest.update(jax.tree_util.keystr(path).encode() + array.tobytes())
    return digest.hexdigest()


def _arrays(state: Path) -> Any:
    """The arrays of a saved state on the host, read without the file that names the devices that held them.

    Training names its own devices, so damage of that file has no effect on it.
    """
    with tempfile.TemporaryDirectory() as home, ocp.PyTreeCheckpointer() as checkpointer:
        path = shutil.copytree(state, Path(home) / "state", ignore=shutil.ignore_patterns("_sharding"))
        tree = checkpointer.metadata(path).item_metadata.tree
        as_array = jax.tree.map(lambda _: ocp.RestoreArgs(restore_type=np.ndarray), tree)
        return checkpointer.restore(path, restore_args=as_array)


def _hash(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()
