"""Fixed features of every contact, and linear probes on them: what a touch shows without any trained encoder."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, UInt8

from experiments.active.contacts import LEVELS, PROPERTIES, ContactBank
from experiments.core.context import Context
from touchr1_jax.training.linear_probe import ProbeConfig, probe_log_probs, stream_features

PROBE = ProbeConfig()


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

    Args:
      features: of all contacts.
      label: level of each property.
      fitted: objects that the probes are fitted on; beliefs about these are too good.
      context: of the run.
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
