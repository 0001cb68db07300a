"""The data of a policy that chooses: encoded contacts, the split of the objects, and beliefs of probes."""

import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import traverse_util
from jaxtyping import Array, Float, Int, UInt8

from experiments.active.contacts import LEVELS, PROPERTIES, ContactBank, ContactsConfig, contacts_hash, generate
from experiments.active.encoder import (
    ContactEncoderConfig,
    ContactReader,
    belief_scale,
    belief_tokens,
    of_contacts,
    patch_statistics,
    read_contacts,
    train_reader,
)
from experiments.active.headroom import Beliefs
from experiments.core.context import Context
from experiments.core.errors import ConfigurationError
from experiments.study.cache import fingerprint
from touchr1_jax.rl.environment import TouchBank, TouchChoice
from touchr1_jax.training.linear_probe import ProbeConfig, group_folds, probe_log_probs, stream_features

PROBE = ProbeConfig(folds=3, penalty=0.2)


@jax.jit
def frame_features(frames: UInt8[Array, "C F H W 3"]) -> Float[Array, "C F D"]:
    """Fixed features of each kept frame: those of the picture and those of the fields below it, without the force."""
    edge, no_force = frames.shape[3], jnp.zeros((frames.shape[1], 3))

    def of_contact(frames: UInt8[Array, "F H W 3"]) -> Float[Array, "F D"]:
        parts = [stream_features(x, no_force) for x in (frames[:, :edge], frames[:, edge:])]
        return jnp.concatenate([x.reshape(len(frames), -1) for x in parts], -1)

    return jax.lax.map(of_contact, frames)  # one contact after the other stays in the processor's cache


def probe_beliefs(
    features: Float[np.ndarray, "O C F D"],
    label: Int[np.ndarray, "O A"],
    fitted: Int[np.ndarray, "n"],
    context: Context,
) -> Float[np.ndarray, "O C A K"]:
    """Log-probabilities of every level from every contact, by a probe of each choice and property.

    Beliefs about the objects that the probes are fitted on are too good.
    """
    objects, choices = features.shape[:2]
    weights = np.zeros((1, objects), bool)
    weights[0, fitted] = True
    found = np.empty((objects, choices, len(PROPERTIES), LEVELS), np.float32)
    for choice in context.each("probes", range(choices)):
        of_choice = features[:, choice].reshape(objects, -1)
        for a in range(len(PROPERTIES)):
            found[:, choice, a] = probe_log_probs(of_choice, label[:, a], weights, LEVELS, PROBE)[0]
    return found


def crossed(
    read: Callable[[Int[np.ndarray, "m"], int], Float[np.ndarray, "O C A K"]], objects: Int[np.ndarray, "n"]
) -> Float[np.ndarray, "O C A K"]:
    """Beliefs about all contacts by readers of which none learned from the object that it reads.

    What a policy observes of the objects that it learns from is then as fallible as of unseen ones.

    Args:
      read: (objects to learn from, number of the reader) → its log-probabilities for all contacts.
      objects: dealt to folds; each is read by the reader of the other folds, all others by the mean of all readers.
    """
    fold = group_folds(objects, PROBE)
    found = np.stack([read(objects[fold != k], k) for k in range(PROBE.folds)])
    mixed = np.array(jax.nn.log_softmax(found.mean(0)))
    mixed[objects] = found[fold, objects]
    return mixed


PARTS = ("warm", "reinforced", "val", "test")
"""Parts of the objects: those that the warm start learns from, reinforcement; look-ups; scores.

They are disjoint: a policy that is reinforced on objects that its warm start knows by heart finds every touch equally
good.  The encoders learn from the first two, each object read by one that did not."""

READERS = "readers"  # prefix of their arrays

VERSION = 4  # raised whenever the same configuration would give other tokens or beliefs


@dataclasses.dataclass(frozen=True, kw_only=True)
class WorldConfig:
    """Contacts, encoder, and the share of the objects in each of `PARTS`."""

    contacts: ContactsConfig = ContactsConfig()
    encoder: ContactEncoderConfig = ContactEncoderConfig()
    shares: tuple[float, ...] = (0.42, 0.26, 0.16, 0.16)

    def __post_init__(self) -> None:
        if len(self.shares) != len(PARTS) or min(self.shares) <= 0 or abs(sum(self.shares) - 1) > 1e-6:
            raise ConfigurationError(
                f"shares is {self.shares}: must be {len(PARTS)} shares above 0 that sum to 1; correct it"
            )

    @property
    def parts(self) -> dict[str, Int[np.ndarray, "n"]]:
        """Rows of the objects of each part, ascending."""
        order = np.random.default_rng(self.contacts.seed).permutation(self.contacts.objects)
        edges = np.round(np.cumsum(self.shares) * self.contacts.objects).astype(int)[:-1]
        return {name: np.sort(rows) for name, rows in zip(PARTS, np.split(order, edges), strict=True)}


@dataclasses.dataclass(frozen=True, kw_only=True)
class TouchWorld:
    """Encoded contacts and what is known of them.

    `probes` are beliefs of probes, and `read` those of probes and readers together, which the tokens hold.  `readers`
    and `scale` make tokens of contacts that come later.
    """

    config: WorldConfig
    contacts: ContactBank
    bank: TouchBank
    parts: dict[str, Int[np.ndarray, "n"]]
    probes: Beliefs
    read: Beliefs
    readers: tuple[ContactReader, ...]
    scale: float


def make_world(config: WorldConfig, context: Context) -> TouchWorld:
    """Generate, encode and probe all contacts, or read them from the cache."""
    contacts, parts = config.contacts, config.parts
    with context.timed("contacts"):
        made = generate(contacts, context)
    values = {"world": config, "contacts": contacts_hash(contacts), "probe": PROBE, "version": VERSION}
    encode = functools.partial(_encoded, config, made, parts, context)
    found = context.cached_arrays(f"touch_bank/{fingerprint(values, {}, '')}", encode)
    shape = made.harm.shape
    bank = TouchBank(
        tokens=jnp.asarray(found["tokens"], jnp.float32),
        available=jnp.ones(shape, bool),
        seconds=jnp.broadcast_to(contacts.seconds, shape),
        harm=jnp.asarray(made.harm, jnp.float32),
        label=jnp.asarray(made.label, jnp.int32),
        choices=tuple(TouchChoice(sensor=s, motion=m, force_n=f) for s, m, f in contacts.choices),
    )
    return TouchWorld(
        config=config,
        contacts=made,
        bank=bank,
        parts=parts,
        probes=Beliefs(found["probes"], made.label),
        read=Beliefs(found["read"], made.label),
        readers=restored(found),
        scale=belief_scale(found["read"]),
    )


def _encoded(
    config: WorldConfig, made: ContactBank, parts: dict[str, Int[np.ndarray, "n"]], context: Context
) -> dict[str, Any]:
    """Tokens, and beliefs of encoders, probes and both; no object that trains is read by what learned from it."""
    fitted = np.concatenate([parts["warm"], parts["reinforced"]])
    features = of_contacts("features", frame_features, made, context)
    statistics = of_contacts("statistics", patch_statistics, made, context)
    with context.timed("probes"):
        probes = crossed(lambda learned, _: probe_beliefs(features, made.label, learned, context), fitted)
    readers: list[ContactReader] = []

    def read(learned: Int[np.ndarray, "m"], k: int) -> Float[np.ndarray, "O C A K"]:
        readers.append(train_reader(config.encoder, statistics, made.label, learned, context, k))
        choice = np.arange(statistics.shape[1], dtype=np.int32)
        return np.stack([read_contacts(config.encoder, readers[-1], of_object, choice) for of_object in statistics])

    with context.timed("encoder"):
        encoder = crossed(read, fitted)
    both = np.asarray(jax.nn.log_softmax((encoder + probes) / 2))
    tokens = belief_tokens(both, belief_scale(both))
    return {"tokens": tokens, "read": both, "encoder": encoder, "probes": probes} | stored(readers)


def stored(readers: Sequence[ContactReader]) -> dict[str, np.ndarray]:
    """Readers as arrays by name."""
    parts = {str(k): {"params": r.params, "centre": r.centre, "spread": r.spread} for k, r in enumerate(readers)}
    return {f"{READERS}/{name}": np.asarray(x) for name, x in traverse_util.flatten_dict(parts, sep="/").items()}


def restored(arrays: Mapping[str, np.ndarray]) -> tuple[ContactReader, ...]:
    """Readers from the arrays of `stored`; others are ignored."""
    own = {name: x for name, x in arrays.items() if name.startswith(f"{READERS}/")}
    parts = traverse_util.unflatten_dict(own, sep="/")[READERS]
    return tuple(ContactReader(**parts[str(k)]) for k in range(len(parts)))
