"""A small encoder, trained on single contacts with questions about all five properties, and the tokens that it makes.

It reads fixed features of each kept frame, not pixels, so that training it takes seconds, and never the measured force,
in which friction could simply be read.
"""

import dataclasses
import functools
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import struct
from jaxtyping import Array, Float, Int

from experiments.active.contacts import LEVELS, PROPERTIES, ContactsConfig
from experiments.active.feed import DrawnFeed
from experiments.core.context import Context
from experiments.core.loops import run_loop
from touchr1_jax.models.tactile_vit import EncoderLayer, QueryPool
from touchr1_jax.training.loop import LoopConfig
from touchr1_jax.training.optimizer import OptimizerConfig, make_optimizer
from touchr1_jax.types import Params


@dataclasses.dataclass(frozen=True, kw_only=True)
class ContactEncoderConfig:
    """Sizes and training of the encoder.

    Args:
      width, layers, heads: of the transformer over the frames of a contact.
      tokens: N, to which a contact is pooled; they are what a policy observes.
      dropout: share of the entries that training sets to 0, against learning objects by heart.
      steps, batch_size: of training, contacts drawn at random.
      optimizer: of training.
    """

    width: int = 96
    layers: int = 2
    heads: int = 3
    tokens: int = 4
    dropout: float = 0.2
    steps: int = 3000
    batch_size: int = 128
    optimizer: OptimizerConfig = OptimizerConfig(learning_rate=1e-5, lr_scale=100.0, weight_decay=0.1)


class SingleContact(nn.Module):
    """Scores of the levels of every property from the features of one contact."""

    config: ContactEncoderConfig
    sensors: int
    choices: int

    def setup(self) -> None:
        c = self.config
        self.enter, self.of_sensor = nn.Dense(c.width), nn.Embed(self.sensors, c.width)
        self.layers = [EncoderLayer(c.width, c.heads, 2) for _ in range(c.layers)]
        self.pool = QueryPool(c.tokens)
        self.of_choice = nn.Embed(self.choices, 2 * c.width)
        self.hidden, self.out = nn.Dense(2 * c.width), nn.Dense(len(PROPERTIES) * LEVELS)
        self.drop = nn.Dropout(c.dropout)

    @nn.compact
    def tokens(
        self, features: Float[Array, "n F D"], sensor: Int[Array, "n"], train: bool = False
    ) -> Float[Array, "n N W"]:
        """Tokens of contacts."""
        frames = features.shape[1]
        place = self.param("place", nn.initializers.normal(0.5), (frames, self.config.width))
        x = self.enter(self.drop(features, deterministic=not train)) + self.of_sensor(sensor)[:, None] + place
        for layer in self.layers:
            x = layer(x, jnp.ones(x.shape[:2], bool))
        return self.pool(x)

    def __call__(
        self, features: Float[Array, "n F D"], sensor: Int[Array, "n"], choice: Int[Array, "n"], train: bool = False
    ) -> Float[Array, "n A K"]:
        x = self.drop(self.tokens(features, sensor, train), deterministic=not train)
        x = nn.gelu(self.hidden(x.reshape(len(x), -1)) + self.of_choice(choice))
        return self.out(self.drop(x, deterministic=not train)).reshape(-1, len(PROPERTIES), LEVELS)


@struct.dataclass
class EncoderState:
    """Everything that a step changes."""

    params: Params
    opt_state: optax.OptState
    step: Int[Array, ""]


@struct.dataclass
class ContactBatch:
    """Contacts that a step learns from."""

    features: Float[Array, "n F D"]
    sensor: Int[Array, "n"]
    choice: Int[Array, "n"]
    label: Int[Array, "n A"]


def encode_contacts(
    config: ContactEncoderConfig,
    contacts: ContactsConfig,
    features: Float[np.ndarray, "O C F D"],
    label: Int[np.ndarray, "O A"],
    objects: Int[np.ndarray, "n"],
    context: Context,
    *,
    seed: int = 0,
) -> tuple[Float[np.ndarray, "O C N W"], Float[np.ndarray, "O C A K"]]:
    """Train the encoder on all contacts of some objects, then encode those of all.

    Returns:
      The tokens of every contact at unit scale, and the log-probabilities of the encoder's own head.
    """
    sensor = np.array([contacts.sensors.index(name) for name, _, _ in contacts.choices], np.int32)
    centre, spread = features[objects].mean((0, 1)), features[objects].std((0, 1))
    features = np.where(spread > 1e-6, (features - centre) / np.maximum(spread, 1e-6), 0.0).astype(np.float32)
    module = SingleContact(config, len(contacts.sensors), len(contacts.choices))
    choice = np.arange(len(sensor), dtype=np.int32)

    def draw(rng: np.random.Generator) -> ContactBatch:
        which, chosen = rng.choice(objects, config.batch_size), rng.choice(choice, config.batch_size)
        drawn: Any = (features[which, chosen], sensor[chosen], chosen, label[which])
        return ContactBatch(*drawn)

    params = module.init(jax.random.key(seed), features[0], sensor, choice)["params"]
    optimizer = make_optimizer(config.optimizer, config.steps)
    state = EncoderState(params=params, opt_state=optimizer.init(params), step=jnp.zeros((), jnp.int32))
    step = jax.jit(functools.partial(_update, module, optimizer, jax.random.key(seed)), donate_argnums=0)
    loop = LoopConfig(steps=config.steps, save_every=max(1, config.steps))
    params = run_loop(step, state, DrawnFeed(draw, seed), loop, context, f"encoder/{seed}").params

    @jax.jit
    def read(of_object: Float[Array, "C F D"]) -> tuple[Array, Array]:
        tokens: Any = module.apply({"params": params}, of_object, sensor, method=SingleContact.tokens)
        scores: Any = module.apply({"params": params}, of_object, sensor, choice)
        return tokens, jax.nn.log_softmax(scores)

    found = [jax.device_get(read(x)) for x in features]
    tokens = np.stack([tokens for tokens, _ in found])
    return tokens / tokens.std(), np.stack([scores for _, scores in found])


def _update(
    module: SingleContact, optimizer: optax.GradientTransformation, key: Array, state: EncoderState, batch: ContactBatch
) -> tuple[EncoderState, dict[str, Array]]:
    """One step of gradient descent on the mean cross-entropy of all properties."""
    noise = {"dropout": jax.random.fold_in(key, state.step)}

    def loss(params: Params) -> tuple[Array, Array]:
        inputs = batch.features, batch.sensor, batch.choice
        scores: Any = module.apply({"params": params}, *inputs, train=True, rngs=noise)
        cost = optax.softmax_cross_entropy_with_integer_labels(scores, batch.label).mean()
        return cost, 100 * (scores.argmax(-1) == batch.label).mean()

    (cost, right), grads = jax.value_and_grad(loss, has_aux=True)(state.params)
    updates, opt_state = optimizer.update(grads, state.opt_state, state.params)
    after = EncoderState(params=optax.apply_updates(state.params, updates), opt_state=opt_state, step=state.step + 1)
    return after, {"loss": cost, "right": right, "grad_norm": optax.tree.norm(grads)}
