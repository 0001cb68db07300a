"""Fixed features of every contact, linear probes on them, and beliefs about objects that no reader learned from."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, UInt8

from experiments.active.contacts import LEVELS, PROPERTIES, ContactBank
from experiments.core.context import Context
from touchr1_jax.training.linear_probe import ProbeConfig, group_folds, probe_log_probs, stream_features

PROBE = ProbeConfig(folds=3, penalty=0.2)


@jax.jit
def frame_features(frames: UInt8[Array, "C F H W 3"]) -> Float[Array, "C F D"]:
    """Fixed features of each kept frame: those of the picture and those of the fields below it, without the force."""
    edge = frames.shape[3]
    no_force = jnp.zeros((*frames.shape[:2], 3))
    parts = [stream_features(x, no_force) for x in (frames[..., :edge, :, :], frames[..., edge:, :, :])]
    return jnp.concatenate([x.reshape(*frames.shape[:2], -1) for x in parts], -1)


def contact_features(bank: ContactBank, context: Context) -> Float[np.ndarray, "O C F D"]:
    """`frame_features` of all contacts."""
    return np.stack([np.asarray(frame_features(x)) for x in context.each("features of contacts", bank.frames)])


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

    Raises:
      ValueError: fewer objects than folds.
    """
    fold = group_folds(objects, PROBE)
    found = np.stack([read(objects[fold != k], k) for k in range(PROBE.folds)])
    mixed = np.array(jax.nn.log_softmax(found.mean(0)))
    mixed[objects] = found[fold, objects]
    return mixed
