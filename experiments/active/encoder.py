"""Beliefs about single contacts by a network that reads fixed statistics of patches, and tokens made of beliefs.

The network learns all five properties of a contact at once.  It never sees the measured force, which would directly
show friction.
"""

import dataclasses
import functools
from collections.abc import Callable, Iterator
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import struct
from jaxtyping import Array, Float, Int, UInt8

from experiments.active.contacts import LEVELS, PROPERTIES, ContactBank
from experiments.core.concurrency import in_threads
from experiments.core.context import Context
from experiments.core.loops import run_loop
from touchr1_jax.models.frame_statistics import scaled_statistics
from touchr1_jax.training.loop import LoopConfig
from touchr1_jax.training.optimizer import OptimizerConfig, make_optimizer
from touchr1_jax.types import Params
from touchr1_jax.validation import within


class DrawnFeed:
    """Batches made by a function of a generator of random numbers; batch t depends on the seed and t alone."""

    def __init__(self, make: Callable[[np.random.Generator], Any], seed: int) -> None:
        self._make, self._seed, self._step = make, seed, 0

    def __iter__(self) -> Iterator[Any]:
        return self

    def __next__(self) -> Any:
        rng = np.random.default_rng([self._seed, self._step])
        self._step += 1
        return self._make(rng)

    def get_state(self) -> int:
        """Number of the next batch."""
        return self._step

    def set_state(self, state: int) -> None:
        """Go to a batch."""
        self._step = state


FAR = 5.0  # standard deviations beyond which statistics are cut off

_CONSTANT = 1e-4  # spread below which a statistic of a choice says nothing


@dataclasses.dataclass(frozen=True, kw_only=True)
class ContactEncoderConfig:
    """Sizes and training of the encoders.

    Args:
      width, layers: of the network.
      dropout: share of the entries that training sets to 0, against learning objects by heart.
      steps, batch_size: of training, contacts drawn at random.
      optimizer: of training.
    """

    width: int = 192
    layers: int = 2
    dropout: float = 0.3
    steps: int = 1500
    batch_size: int = 256
    optimizer: OptimizerConfig = OptimizerConfig(learning_rate=1e-5, lr_scale=100.0, weight_decay=0.1)

    def __post_init__(self) -> None:
        within(self, 0, 0.99, "dropout")


class SingleContact(nn.Module):
    """Scores of the levels of every property from the statistics of one contact and the choice that made it."""

    config: ContactEncoderConfig
    choices: int

    @nn.compact
    def __call__(
        self, statistics: Float[Array, "n D"], choice: Int[Array, "n"], train: bool = False
    ) -> Float[Array, "n A K"]:
        c = self.config
        drop = nn.Dropout(c.dropout, deterministic=not train)
        of_choice = lambda: nn.Embed(self.choices, c.width)(choice)
        x = nn.gelu(nn.Dense(c.width)(drop(statistics)) + of_choice())
        for _ in range(c.layers - 1):
            x = x + nn.gelu(nn.Dense(c.width)(drop(x)) + of_choice())
        return nn.Dense(len(PROPERTIES) * LEVELS)(drop(x)).reshape(-1, len(PROPERTIES), LEVELS)


@struct.dataclass
class EncoderState:
    """Everything that a step changes."""

    params: Params
    opt_state: optax.OptState
    step: Int[Array, ""]


@struct.dataclass
class ContactBatch:
    """Contacts that a step learns from."""

    statistics: Float[Array, "n D"]
    choice: Int[Array, "n"]
    label: Int[Array, "n A"]


@jax.jit
def patch_statistics(frames: UInt8[Array, "C F H W 3"]) -> Float[Array, "C D"]:
    """Statistics of the four quarters of every picture and the two halves of the fields below it."""
    edge = frames.shape[3]

    def of_contact(frames: UInt8[Array, "F H W 3"]) -> Float[Array, "D"]:
        parts = [scaled_statistics(x, edge // 2) for x in (frames[:, :edge], frames[:, edge:])]
        of_patch = parts[0].shape[-1] // 2
        split = [(x[..., :of_patch], x[..., :1, of_patch:]) for x in parts]  # those of the whole are the same for all
        return jnp.concatenate([x.ravel() for pair in split for x in pair])

    return jax.lax.map(of_contact, frames)  # one contact after the other stays in the processor's cache


def of_contacts(
    what: str, read: Callable[[UInt8[np.ndarray, "C F H W 3"]], Array], bank: ContactBank, context: Context
) -> Float[np.ndarray, "O C ..."]:
    """Output of a program that reads the frames of all contacts of an object, for every object."""
    with context.progress(f"{what} of contacts", len(bank.frames)) as advance:
        return np.stack(in_threads(lambda frames: np.asarray(read(frames)), bank.frames, advance))


def belief_scale(log_probs: Float[np.ndarray, "*n A K"]) -> float:
    """Standard deviation of the log-probabilities less their mean."""
    return float((log_probs - log_probs.mean(-1, keepdims=True)).std())


def belief_tokens(log_probs: Float[np.ndarray, "*n A K"], scale: float) -> Float[np.ndarray, "*n A W"]:
    """One token for each property, W = A + K: which one it is, and its log-probabilities less their mean, over a scale.

    Contacts that are read later take the `belief_scale` of those that a policy learned from.
    """
    centred = log_probs - log_probs.mean(-1, keepdims=True)
    names = np.broadcast_to(np.eye(log_probs.shape[-2]), (*log_probs.shape[:-1], log_probs.shape[-2]))
    return np.concatenate([names, centred / scale], -1).astype(np.float32)


@struct.dataclass
class ContactReader:
    """A trained network, and the statistics of the objects that it learned from."""

    params: Params
    centre: Float[np.ndarray, "C D"]
    spread: Float[np.ndarray, "C D"]

    def scaled(self, statistics: Float[np.ndarray, "*n D"], choice: Int[np.ndarray, "*n"]) -> Float[np.ndarray, "*n D"]:
        """Statistics of contacts as the network reads them."""
        centre, spread = self.centre[choice], self.spread[choice]
        scaled = (statistics - centre) / np.maximum(spread, _CONSTANT) * (spread > _CONSTANT)
        return np.clip(scaled, -FAR, FAR).astype(np.float32)


def read_contacts(
    config: ContactEncoderConfig,
    reader: ContactReader,
    statistics: Float[np.ndarray, "n D"],
    choice: Int[np.ndarray, "n"],
) -> Float[np.ndarray, "n A K"]:
    """Log-probabilities of every level from contacts."""
    network = _network(SingleContact(config, len(reader.centre)))
    return np.asarray(network(reader.params, reader.scaled(statistics, choice), choice))


@functools.cache
def _network(module: SingleContact) -> Any:
    """Compiled forward pass."""

    def read(params: Params, statistics: Float[Array, "n D"], choice: Int[Array, "n"]) -> Float[Array, "n A K"]:
        scores: Any = module.apply({"params": params}, statistics, choice)
        return jax.nn.log_softmax(scores)

    return jax.jit(read)


def train_reader(
    config: ContactEncoderConfig,
    statistics: Float[np.ndarray, "O C D"],
    label: Int[np.ndarray, "O A"],
    objects: Int[np.ndarray, "n"],
    context: Context,
    seed: int,
) -> ContactReader:
    """A network that learned from the contacts of some objects; `seed` is that of parameters and draws."""
    choice = np.arange(statistics.shape[1], dtype=np.int32)
    fresh = ContactReader(params={}, centre=statistics[objects].mean(0), spread=statistics[objects].std(0))
    scaled = fresh.scaled(statistics, np.broadcast_to(choice, statistics.shape[:2]))
    module = SingleContact(config, len(choice))

    def draw(rng: np.random.Generator) -> ContactBatch:
        which, chosen = rng.choice(objects, config.batch_size), rng.choice(choice, config.batch_size)
        drawn: Any = (scaled[which, chosen], chosen, label[which])
        return ContactBatch(*drawn)

    params = module.init(jax.random.key(seed), scaled[0], choice)["params"]
    optimizer, step = _program(module)
    state = EncoderState(params=params, opt_state=optimizer.init(params), step=jnp.zeros((), jnp.int32))
    loop = LoopConfig(steps=config.steps, save_every=max(1, config.steps))
    params = run_loop(step, state, DrawnFeed(draw, seed), loop, context, f"encoder/{seed}").params
    return dataclasses.replace(fresh, params=jax.device_get(params))


@functools.cache
def _program(module: SingleContact) -> tuple[optax.GradientTransformation, Any]:
    """Optimizer and compiled step, made once for all folds."""
    optimizer = make_optimizer(module.config.optimizer, module.config.steps)
    return optimizer, jax.jit(functools.partial(_update, module, optimizer), donate_argnums=0)


def _update(
    module: SingleContact, optimizer: optax.GradientTransformation, state: EncoderState, batch: ContactBatch
) -> tuple[EncoderState, dict[str, Array]]:
    """One step of gradient descent on the mean cross-entropy of all properties."""
    noise = {"dropout": jax.random.key(state.step)}

    def loss(params: Params) -> tuple[Array, Array]:
        scores: Any = module.apply({"params": params}, batch.statistics, batch.choice, train=True, rngs=noise)
        cost = optax.softmax_cross_entropy_with_integer_labels(scores, batch.label).mean()
        return cost, 100 * (scores.argmax(-1) == batch.label).mean()

    (cost, right), grads = jax.value_and_grad(loss, has_aux=True)(state.params)
    updates, opt_state = optimizer.update(grads, state.opt_state, state.params)
    after = EncoderState(params=optax.apply_updates(state.params, updates), opt_state=opt_state, step=state.step + 1)
    return after, {"loss": cost, "right": right, "grad_norm": optax.tree.norm(grads)}
