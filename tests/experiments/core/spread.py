"""A tiny training that spreads over processes, each of which draws its rows of random targets."""

import dataclasses
import sys
import time

import grain
import jax
import jax.numpy as jnp
import numpy as np

from experiments.core.loops import run_loop
from experiments.core.results import Results
from experiments.core.runner import Experiment, run_experiment
from touchr1_jax.training.loop import LoopConfig

BATCH = 4


@dataclasses.dataclass(frozen=True, kw_only=True)
class SpreadConfig:
    """Steps, and seconds that a batch takes."""

    steps: int = 12
    pause: float = 0.0


@jax.jit
def step(state, batch):
    x = state["params"]["scale"]
    moved = {"params": {"scale": x + 0.1 * jnp.mean(batch["target"] - x, 0)}}
    return moved, {"first": moved["params"]["scale"][0]}


def run(config, context):
    rows = context.devices.local_rows(BATCH)

    def batch(i):
        time.sleep(config.pause)
        return {"target": np.random.default_rng(i).normal(size=(BATCH, 8)).astype(np.float32)[rows]}

    options = grain.ReadOptions(num_threads=1, prefetch_buffer_size=1)
    batches = iter(grain.MapDataset.range(config.steps).map(batch).to_iter_dataset(options))
    order = step, {"params": {"scale": jnp.zeros(8)}}, batches, BATCH
    placed = context.devices.shard(*order)
    end = run_loop(*placed, LoopConfig(steps=config.steps, save_every=2), context, "count/0")
    return Results(verdict=(f"{np.asarray(context.devices.gather(end['params']['scale']))}",))


EXPERIMENT = Experiment(name="spread", config=SpreadConfig(), run=run, spreads=True)

if __name__ == "__main__":
    sys.exit(run_experiment(EXPERIMENT, sys.argv[1:], __doc__))
