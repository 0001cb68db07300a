"""The data that moves through one rollout, as frozen pytrees: batch → prefix → rollout → parsed → reward → update.

Dimensions, used in every name and shape of this package:
  P prompts, G rollouts of one prompt, T completion tokens, L prefix tokens, V vocabulary, S tactile streams (stream s
  is sensor s of the language), F frames, H W C image, A attributes, K levels of an attribute, D model width.
"""

from typing import Any, NamedTuple

from flax import struct
from jaxtyping import Array, Bool, Float, Int, UInt8

Params = Any  # a pytree of float arrays, as flax.linen returns it


@struct.dataclass
class TouchBatch:
    """P contacts, each recorded by all sensors; the JAX side of `sensors_io.schema.CLIP_ARRAYS`.

    The statistics of the patches of `frames` may take their place, for an encoder that reads these alone.
    """

    frames: UInt8[Array, "P S F H W 3"] | Float[Array, "P S F patch statistic"]
    force_n: Float[Array, "P S F 3"]
    frame_index: Int[Array, "P S F"]
    frame_mask: Bool[Array, "P S F"]
    stream_mask: Bool[Array, "P S"]
    view: UInt8[Array, "P Hv Wv 3"]
    view_mask: Bool[Array, "P"]
    label: Int[Array, "P A"]


@struct.dataclass
class Target:
    """The truth that a rollout is scored against: the level of every attribute, asked or not; −1 marks an unknown one.

    `asked` selects the attributes of the question, `streams` the sensors that were present.
    """

    asked: Bool[Array, "A"]
    label: Int[Array, "A"]
    levels: Int[Array, "A"]
    ordinal: Bool[Array, "A"]
    streams: Bool[Array, "S"]


@struct.dataclass
class Parsed:
    """The levels that a completion states; −1 is ⊥, unparsable.

    `perceive[s, a]` is the level reported for sensor s, `compare[a]` the cross-sensor summary, `conclude[a]` the
    answer.  `formatted` means each of the six tags exactly once, in order, no empty body, only white space after the
    last.  `truncated` means that no end token came.  `length` counts the tokens before the end token.
    """

    perceive: Int[Array, "S A"]
    compare: Int[Array, "A"]
    conclude: Int[Array, "A"]
    formatted: Bool[Array, ""]
    truncated: Bool[Array, ""]
    length: Int[Array, ""]


@struct.dataclass
class Rollout:
    """Sampled completions: token ids, the sampler's log-probabilities and which positions count.

    `mask` covers every token up to and including the end token.
    """

    tokens: Int[Array, "*batch T"]
    log_prob: Float[Array, "*batch T"]
    mask: Bool[Array, "*batch T"]
    head_ids: Int[Array, "*batch K T"] | None = None
    """The sampler's K most likely tokens at each place; `None` where nothing needs them."""
    head_log_prob: Float[Array, "*batch K T"] | None = None


SAMPLE = "sample"
"""Name under which a step that was asked for one returns a `StepSample` with its metrics."""


class StepSample(NamedTuple):
    """The first answer of a step to its first question: what people look at while training runs."""

    asked: Bool[Array, "A"]
    label: Int[Array, "A"]
    tokens: Int[Array, "T"]
    reward: Float[Array, ""]
