"""A tiny checkpoint that is taught to write, in the place of a released one, which knows language and nothing of touch.

All weights of its decoder are trained to write answers, by the step of SFT that trains policies.  A prompt names its
sensors and shows neither touch nor picture, and the levels of an answer are drawn: how answers are put can be learned,
which level is right cannot.
"""

import dataclasses
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from experiments.core.context import Context
from experiments.paper.released_policy import ReleasedAssembly, ReleasedModel, assemble_released
from experiments.study.assembly import touch_shapes
from experiments.study.feeds import random_streams
from sensors_io.schema import SENSORS
from touchr1_jax.models.load import load_checkpoint
from touchr1_jax.models.qwen.weights import SINGLE, save_params
from touchr1_jax.models.tactile_vit import TactileViTConfig
from touchr1_jax.text.template import answer_text, encode_answer
from touchr1_jax.training.optimizer import OptimizerConfig, make_optimizer
from touchr1_jax.training.sft import SFTBatch, SFTState, make_sft_step
from touchr1_jax.types import TouchBatch
from touchr1_jax.validation import at_least, within

STAGE = "teach"

BESIDE = ReleasedModel(
    tactile=TactileViTConfig(sensors=0, width=8, num_layers=0, num_heads=1, stem_width=1),
    frames=1,
    image_px=28,
    completion_tokens=48,
    view_px=16,
    dtype="float32",
)
"""What would feel and see: it is shown nothing, learns nothing, and is thrown away."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class TeachingConfig:
    """How a tiny checkpoint is taught to write; 0 steps leave its weights as they were drawn."""

    steps: int = 0
    batch_size: int = 32
    agreement: float = 0.7
    """How often a sensor of a drawn answer perceives the level that the answer was drawn for; else any."""
    optimizer: OptimizerConfig = OptimizerConfig(learning_rate=1e-5, lr_scale=300.0)

    def __post_init__(self) -> None:
        at_least(self, 0, "steps")
        at_least(self, 1, "batch_size")
        within(self, 0, 1, "agreement")


def teach(directory: Path, config: TeachingConfig, context: Context, seed: int = 0) -> None:
    """Train the decoder of a checkpoint on drawn answers, and write its weights back in bfloat16.

    Args:
      directory: as `write_tiny` makes it; its weights are replaced.
      config: how long, how fast.
      context: the run, whose log gets the steps under `STAGE`.
      seed: of what is drawn.
    """
    if not config.steps:
        return
    found = load_checkpoint(directory, jnp.float32)
    assembly = assemble_released(BESIDE, found, SENSORS)
    shown = nothing(config.batch_size)
    params = assembly.init(seed, shown)
    optimizer = make_optimizer(config.optimizer, config.steps)
    step = make_sft_step(assembly.fns, optimizer)
    state = SFTState(params=params, opt_state=optimizer.init(params), step=jnp.zeros((), jnp.int32))
    with context.timed(STAGE):
        for t in context.each(STAGE, range(config.steps)):
            state, metrics = step(state, drawn_batch(assembly, shown, config, np.random.default_rng((seed, t))))
            context.log(STAGE, t, **jax.device_get(metrics))
    taught = {"vision": state.params["vision"]["tower"], "decoder": state.params["decoder"]}
    save_params(directory / SINGLE, jax.tree.map(lambda x: x.astype(jnp.bfloat16), taught), found.config)


def drawn_batch(
    assembly: ReleasedAssembly, shown: TouchBatch, config: TeachingConfig, rng: np.random.Generator
) -> SFTBatch:
    """One question with a drawn answer for each contact of a batch that shows nothing."""
    layout, (p, s) = assembly.layout, shown.stream_mask.shape
    asked = rng.integers(len(layout.asked), size=p)
    streams = random_streams(np.ones((p, s), bool), 0.5, rng)
    pairs = [_answer(assembly, layout.asked[q], felt, config, rng) for q, felt in zip(asked, streams, strict=True)]
    tokens, masks = (np.stack(x)[:, None] for x in zip(*pairs, strict=True))
    written: dict[str, Any] = {
        "ids": layout.ids[asked][:, None],
        "mask": layout.mask[asked][:, None],
        "streams": streams[:, None],
        "tokens": tokens,
        "token_mask": masks,
    }
    return SFTBatch(touch=shown, **written)


def _answer(
    assembly: ReleasedAssembly,
    asked: np.ndarray,
    streams: np.ndarray,
    config: TeachingConfig,
    rng: np.random.Generator,
) -> tuple[np.ndarray, np.ndarray]:
    """An answer whose sensors mostly agree: compared is what most of them perceive, concluded what was compared."""
    levels = np.array(assembly.levels)
    drawn_for, other = rng.integers(levels), rng.integers(levels, size=(len(streams), len(levels)))
    perceive = np.where(rng.random(other.shape) < config.agreement, drawn_for, other)
    most = np.array([np.bincount(perceive[streams, a]).argmax() for a in range(len(levels))])
    text = answer_text(assembly.language, asked=asked, streams=streams, perceive=perceive, compare=most, conclude=most)
    return encode_answer(assembly.tokenizer, text, assembly.model.completion_tokens)


def nothing(contacts: int) -> TouchBatch:
    """Contacts of which no frame was recorded and no picture was taken, with the names of all sensors."""
    shapes = touch_shapes(BESIDE, BESIDE.view_px, SENSORS)
    zeros = jax.tree.map(lambda x: np.zeros((contacts, *x.shape[1:]), x.dtype), shapes)
    return dataclasses.replace(zeros, stream_mask=np.ones_like(zeros.stream_mask))
