"""Predicted films: training of a video predictor as a stage of a run."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from experiments.core.context import Context
from experiments.core.loops import run_loop
from experiments.encoder.pretrain import ClipFeed
from experiments.study.dataset import Dataset
from experiments.study.feeds import touch_batch
from experiments.study.pretrained import PretrainedEncoder
from touchr1_jax.training.loop import LoopConfig
from touchr1_jax.training.optimizer import OptimizerConfig, make_optimizer
from touchr1_jax.training.video import VideoConfig, VideoState, make_video_step, start_video
from touchr1_jax.types import Params


@dataclasses.dataclass(frozen=True, kw_only=True)
class VideoTrainingConfig:
    """Training of one predictor."""

    steps: int = 300
    batch_size: int = 8
    save_every: int = 100
    optimizer: OptimizerConfig = OptimizerConfig(learning_rate=1e-5, lr_scale=200.0)


def train_predictor(
    video: VideoConfig,
    config: VideoTrainingConfig,
    data: Dataset,
    rows: np.ndarray,
    context: Context,
    *,
    stage: str,
    seed: int,
    start: PretrainedEncoder | None = None,
) -> Params:
    """Train a predictor on some contacts; a stopped stage goes on where it was.

    Args:
      video: networks and skips.
      config: training.
      data: the records.
      rows: contacts to train on.
      context: the run.
      stage: its name.
      seed: of parameters and order.
      start: an encoder to begin with, of the shape that `video` says.
    """
    feed = ClipFeed(data.store, rows, data.clip, batch_size=config.batch_size, seed=seed)
    optimizer = make_optimizer(config.optimizer, config.steps)
    one = next(iter(data.batches(rows[:1], batch_size=1, seed=0, repeat=False)))
    state: VideoState = jax.jit(lambda key, batch: start_video(video, optimizer, key, batch))(
        jax.random.key(seed), touch_batch(one)
    )
    if start is not None:
        params = {**state.params, "encoder": jax.tree.map(jnp.array, start.for_sensors(data.clip.sensors).params)}
        state = dataclasses.replace(state, params=params)
    step, loop = make_video_step(video, optimizer), LoopConfig(steps=config.steps, save_every=config.save_every)
    return run_loop(step, state, feed, loop, context, stage).params
