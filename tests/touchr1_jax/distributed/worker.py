"""A process that trains a problem on a mesh and writes the losses: `python -m tests.touchr1_jax.distributed.worker`."""

import argparse
import json
from pathlib import Path
from typing import Any

import jax

from tests.touchr1_jax.distributed.problems import PROBLEMS, ROWS, STEPS, TrainingProblem, feed
from touchr1_jax.distributed.mesh import MeshConfig
from touchr1_jax.distributed.placement import local_rows, place_batch, place_state, shard_step
from touchr1_jax.training.checkpoint import Checkpoints
from touchr1_jax.training.loop import Hooks, LoopConfig, fit

SAVE_AT = 10


class Placed:
    """A feed whose batches lie on the mesh."""

    def __init__(self, batches: Any, mesh: jax.sharding.Mesh) -> None:
        self.batches, self.mesh = batches, mesh
        self.get_state, self.set_state = batches.get_state, batches.set_state

    def __iter__(self) -> "Placed":
        return self

    def __next__(self) -> Any:
        return place_batch(self.mesh, next(self.batches), ROWS)


def plain_losses(problem: TrainingProblem) -> list[dict[str, float]]:
    """Metrics of the step as it is, on one device, without anything of a mesh."""
    state, batches, found = jax.tree.map(jax.numpy.copy, problem.state), feed(problem), []
    for _ in range(STEPS):
        state, metrics = problem.step(state, next(batches), *problem.shared)
        found.append({k: float(v) for k, v in metrics.items()})
    return found


def train(name: str, config: MeshConfig, directory: Path, devices: list[jax.Device] | None = None) -> dict[str, Any]:
    """Metrics of every step on a mesh, going on from the checkpoint in the directory, and how the state lies there."""
    problem, mesh = PROBLEMS[name](), config.build(devices)
    rows = local_rows(mesh, ROWS)
    batches = Placed(feed(problem, rows), mesh)
    example = next(feed(problem))
    step = shard_step(problem.step_on(mesh), mesh, problem.state, example, *problem.shared)
    shared = tuple(place_state(mesh, x) for x in problem.shared)
    found: list[dict[str, float]] = []
    with Checkpoints(directory) as checkpoints:
        end = fit(
            lambda s, b: step(s, b, *shared),
            place_state(mesh, problem.state),
            batches,
            LoopConfig(steps=STEPS, save_every=SAVE_AT),
            Hooks(checkpoints=checkpoints, log=lambda _, metrics: found.append(metrics)),
        )
    held = sum(x.addressable_shards[0].data.nbytes for x in jax.tree.leaves(end.params))
    whole = sum(x.nbytes for x in jax.tree.leaves(end.params))
    return {"metrics": found, "held_share": held / whole, "rows_read": len(rows)}


def main() -> None:
    """Train; the process is one of several where a coordinator is named."""
    parser = argparse.ArgumentParser()
    parser.add_argument("problem", choices=PROBLEMS)
    parser.add_argument("mesh", help="data,fsdp,tensor")
    parser.add_argument("directory", type=Path)
    parser.add_argument("--process", nargs=3, metavar=("COORDINATOR", "COUNT", "ID"))
    args = parser.parse_args()
    if args.process:
        jax.config.update("jax_cpu_collectives_implementation", "gloo")
        coordinator, count, number = args.process
        jax.distributed.initialize(coordinator, int(count), int(number))
    data, fsdp, tensor = map(int, args.mesh.split(","))
    found = train(args.problem, MeshConfig(data=data, fsdp=fsdp, tensor=tensor), args.directory / "checkpoints")
    args.directory.mkdir(parents=True, exist_ok=True)
    (args.directory / f"found-{jax.process_index()}.json").write_text(json.dumps(found))


if __name__ == "__main__":
    main()
