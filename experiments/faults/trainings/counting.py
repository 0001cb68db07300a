"""Where do three numbers end that follow random targets?

    main(["counting"], package="experiments.faults.trainings")

The smallest training with all parts of a training: a data iterator, AdamW, a random key, checkpoints, a log.  A session
starts in a second, so that it can be disturbed hundreds of times.
"""

import dataclasses
from typing import Any

import grain
import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import struct
from jaxtyping import Array, Float, Int

from experiments.core.context import Context
from experiments.core.loops import run_loop
from experiments.core.results import Results
from experiments.core.runner import Experiment
from touchr1_jax.training.loop import LoopConfig
from touchr1_jax.training.optimizer import falling_adamw

STAGE = "count/0"


@dataclasses.dataclass(frozen=True, kw_only=True)
class CountingConfig:
    """Steps, steps between checkpoints, and the steps from and to which targets are NaN."""

    steps: int = 12
    save_every: int = 4
    poison_from: int | None = None
    poison_to: int | None = None

    def __post_init__(self) -> None:
        self.loop()  # refuses its own values

    def loop(self) -> LoopConfig:
        """Settings of the loop; at most three updates in a row may be skipped."""
        return LoopConfig(steps=self.steps, save_every=self.save_every, most_skipped=3)


@struct.dataclass
class CountingState:
    """State that a step changes."""

    params: Float[Array, "3"]
    opt_state: optax.OptState
    step: Int[Array, ""]
    key: Array


def run(config: CountingConfig, context: Context) -> Results:
    """Train to the end."""
    optimizer = falling_adamw(0.1, 1.0, config.steps, max_grad_norm=1.0)
    params = jnp.zeros(3)
    zero, key = jnp.zeros((), jnp.int32), jax.random.key(0)
    state = CountingState(params=params, opt_state=optimizer.init(params), step=zero, key=key)
    end = run_loop(_step(optimizer), state, targets(config), config.loop(), context, STAGE)
    return Results(verdict=(f"They went to {', '.join(f'{x:.3f}' for x in end.params)}.",))


def targets(config: CountingConfig) -> grain.DatasetIterator:
    """Three random numbers a step, NaN between two steps of the config."""
    first = config.steps if config.poison_from is None else config.poison_from
    last = config.steps if config.poison_to is None else config.poison_to

    def target(i: int) -> np.ndarray:
        x = np.random.default_rng(i).normal(size=3).astype(np.float32)
        return np.full_like(x, np.nan) if first <= i < last else x

    return iter(grain.MapDataset.range(config.steps).map(target).to_iter_dataset())


def _step(optimizer: optax.GradientTransformation) -> Any:
    @jax.jit
    def step(state: CountingState, target: Array) -> tuple[CountingState, dict[str, Array]]:
        noise = jax.random.normal(jax.random.fold_in(state.key, state.step), target.shape)
        loss, grad = jax.value_and_grad(lambda p: jnp.mean((p + noise - target) ** 2))(state.params)
        update, opt_state = optimizer.update(grad, state.opt_state, state.params)
        params = optax.apply_updates(state.params, update)
        after = CountingState(params=params, opt_state=opt_state, step=state.step + 1, key=state.key)
        return after, {"loss": loss, "first": state.params[0]}

    return step


EXPERIMENT = Experiment(name="counting", config=CountingConfig(), run=run)
