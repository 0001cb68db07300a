"""Recordings for encoders: other scenes than those of the later stages, split by object."""

import dataclasses

import numpy as np

from experiments.core.context import Context
from experiments.encoder.held_out import HeldOutContacts
from experiments.study.dataset import Dataset, open_dataset
from experiments.study.sources import SourceConfig, prepare_records
from sensors_io.pipeline import ClipConfig
from sensors_io.scenes.config import SceneConfig
from sensors_io.schema import Flag
from touchr1_jax.training.linear_probe import ProbeConfig

STAGE_ONE_SEED = 1
"""Seed of the scenes of stage 1: its objects differ from those of seed 0, on which later stages train and test."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class StageOneDataConfig(SourceConfig):
    """The recordings, and the largest number of labelled contacts to fit the probes on."""

    scenes: SceneConfig = SceneConfig(objects=2400, sites=1, seed=STAGE_ONE_SEED)
    probe_fit: int = 1680
    probe: ProbeConfig = ProbeConfig()


def open_touch(config: StageOneDataConfig, frames: int, image_px: int, context: Context) -> Dataset:
    """The records, made first if the cache lacks them; frames past the strain limit stay in, as in the studies."""
    clip = ClipConfig(frames=frames, image_px=image_px, rejected=(Flag.NOT_CONVERGED, Flag.SATURATED))
    return open_dataset(prepare_records(config, context), clip, grpo_share=0.5)


def training_rows(data: Dataset) -> np.ndarray:
    """Contacts of all training objects, ascending; all are used, since no later stage shares these scenes."""
    return np.sort(np.concatenate([data.parts["sft"], data.parts["grpo"]]))


def held_out_contacts(data: Dataset, part: str, config: StageOneDataConfig, fit: int | None = None) -> HeldOutContacts:
    """Contacts of a part to measure on, and training contacts to fit the probes on.

    Args:
      data: the records.
      part: "val" for choosing, "test" for reporting.
      config: number of contacts to fit on, and the probe.
      fit: another number of contacts to fit on.
    """
    return HeldOutContacts(
        store=data.store,
        clip=data.clip,
        fit_rows=training_rows(data)[: config.probe_fit if fit is None else fit],
        read_rows=data.parts[part],
        label=data.label,
        objects=data.object_ids,
        probe=config.probe,
    )
