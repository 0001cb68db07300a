"""Stage 1 as a stage of a run: its recordings, pretraining, and measurements on held-out contacts on the way.

The scenes differ from those of the later stages, and are split by object.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from experiments.core.context import Context
from experiments.core.loops import run_loop
from experiments.study.dataset import Dataset
from experiments.study.sources import SourceConfig, open_source
from sensors_io.pipeline import ClipConfig, ClipMemory, Contacts, clip_batches
from sensors_io.scenes.config import SceneConfig
from sensors_io.schema import ATTRIBUTES, Flag
from touchr1_jax.bench.metrics import ORDINAL
from touchr1_jax.training import pretraining
from touchr1_jax.training.dynamics import (
    DynamicsConfig,
    DynamicsState,
    MeasuredTouch,
    encode_each,
    read_frames,
    steps_of,
)
from touchr1_jax.training.feeds import Feed, host_touch, touch_batch
from touchr1_jax.training.latent_probes import collapse_alarms, contact_features, probe_right
from touchr1_jax.training.linear_probe import ProbeConfig
from touchr1_jax.training.loop import LoopConfig
from touchr1_jax.training.pretraining import Encode, EncoderAssessment, PretrainConfig, dynamics_program
from touchr1_jax.types import Params, TouchBatch

BATCH = 32
"""Contacts that are encoded at once."""

STAGE_ONE_SEED = 1
"""Seed of the scenes of stage 1: its objects differ from those of seed 0, on which later stages train and test."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class StageOneDataConfig(SourceConfig):
    """The recordings, and the largest number of labelled contacts to fit the probes on."""

    scenes: SceneConfig = SceneConfig(objects=2400, sites=1, seed=STAGE_ONE_SEED)
    probe_fit: int = 1680
    probe: ProbeConfig = ProbeConfig()


def open_touch(
    config: StageOneDataConfig, frames: int, image_px: int, context: Context, *, memory_gib: float = 0.0
) -> Dataset:
    """The records, made first if the cache lacks them; frames past the strain limit stay in, as in the studies."""
    clip = ClipConfig(frames=frames, image_px=image_px, rejected=(Flag.NOT_CONVERGED, Flag.SATURATED))
    return open_source(config, clip, 0.5, context, memory_gib=memory_gib)


@dataclasses.dataclass(frozen=True, kw_only=True)
class HeldOutContacts:
    """Contacts to measure on: probes are fitted on `fit_rows`, everything is measured on `read_rows`.

    `label` int32 [contact, A] is of the whole store.
    """

    store: Contacts
    clip: ClipConfig
    fit_rows: np.ndarray
    read_rows: np.ndarray
    label: np.ndarray
    probe: ProbeConfig

    @property
    def rows(self) -> np.ndarray:
        """All contacts, those to fit on first, [fit + read]."""
        return np.concatenate([self.fit_rows, self.read_rows])

    @property
    def fitted(self) -> np.ndarray:
        """True for the rows to fit on, bool [fit + read]."""
        return np.arange(len(self.rows)) < len(self.fit_rows)

    def probe_right(self, latent: np.ndarray, exists: np.ndarray) -> np.ndarray:
        """True where a linear probe on the latents of all contacts is right, bool [read, 3]."""
        label = self.label[self.rows][:, [ATTRIBUTES.index(name) for name in ORDINAL]]
        return probe_right(np.asarray(contact_features(latent, exists)), label, self.fitted, self.probe)

    def encode(self, encode: Encode, context: Context) -> dict[str, np.ndarray]:
        """Results of all rows on the host, in their order."""
        with context.progress("encoding", len(padded(self.rows, BATCH))) as advance:
            return read_all(encode, self.store, self.rows, self.clip, advance=advance)


def padded(rows: np.ndarray, size: int) -> np.ndarray:
    """Rows with the last one repeated, so that all batches are whole."""
    return rows[np.minimum(np.arange(-(-len(rows) // size) * size), len(rows) - 1)]


def read_all(
    read: Callable[[TouchBatch], Any],
    store: Contacts,
    rows: np.ndarray,
    clip: ClipConfig,
    *,
    memory: ClipMemory | None = None,
    advance: Callable[[int], object] = lambda contacts: None,
) -> Any:
    """Results of contacts on the host, in their order; every call has `BATCH` of them."""
    order: dict[str, Any] = {"batch_size": BATCH, "seed": 0, "shuffle": False, "repeat": False, "memory": memory}
    parts = []
    for element in clip_batches(store, padded(rows, BATCH), clip, **order):
        parts.append(jax.device_get(read(touch_batch(element))))
        advance(BATCH)
    return jax.tree.map(lambda *x: np.concatenate(x)[: len(rows)], *parts)


def held_out_contacts(data: Dataset, part: str, config: StageOneDataConfig, fit: int | None = None) -> HeldOutContacts:
    """Contacts of a part ("val" for choosing, "test" for reporting) to measure on, and training contacts to fit on.

    `fit` is another number of contacts to fit on than the configured one.
    """
    return HeldOutContacts(
        store=data.store,
        clip=data.clip,
        fit_rows=data.training[: config.probe_fit if fit is None else fit],
        read_rows=data.parts[part],
        label=data.label,
        probe=config.probe,
    )


def assess(
    networks: DynamicsConfig, state: DynamicsState, held_out: HeldOutContacts, context: Context
) -> EncoderAssessment:
    """Measure the averaged encoder and the predictor on held-out contacts."""
    encode_all = lambda encode: held_out.encode(encode, context)
    return pretraining.assess(networks, state, encode_all, held_out.fitted, held_out.probe_right)


def probe_encoder(networks: DynamicsConfig, encoder: Params, held_out: HeldOutContacts, context: Context) -> np.ndarray:
    """True where the probes on an encoder alone are right, bool [read, 3]."""

    def encode(batch: TouchBatch) -> dict[str, Any]:
        batch = read_frames(networks, batch)
        exists = steps_of(batch, networks.encoder.frames_per_step).exists
        return {"latent": encode_each(networks.encoder, encoder, batch), "exists": exists}

    return held_out.probe_right(**held_out.encode(jax.jit(encode), context))


DEPTH_MEASURES = 3
"""Numbers that `depth_measures` gives of a frame."""


def depth_measures(depth_mm: np.ndarray) -> np.ndarray:
    """Greatest depth, root mean square depth, and that of its change from node to node, float32 [N, 3], of depth
    [N, h, w], mm: how far, how widely and how unevenly a gel is pressed in."""
    depth = depth_mm.astype(float)
    across, down = np.diff(depth, axis=2)[:, :-1], np.diff(depth, axis=1)[:, :, :-1]
    rms = lambda x: np.sqrt(np.mean(x, axis=(1, 2)))
    return np.stack([depth.max((1, 2)), rms(depth**2), rms(across**2 + down**2)], 1).astype(np.float32)


class ClipDepth:
    """Measures of the depth of the frames of clips, read from the store once per contact.

    Frames of a sequence without depth have NaN.
    """

    def __init__(self, store: Contacts, sensors: tuple[str, ...]) -> None:
        self._store, self._sensors = store, sensors
        self._known: dict[int, dict[str, np.ndarray]] = {}

    def __call__(self, contact: np.ndarray, frame_index: np.ndarray) -> np.ndarray:
        """Measures of the chosen frames of contacts [P], float32 [P, S, F, 3]; `frame_index` is [P, S, F]."""
        found = np.full((*frame_index.shape, DEPTH_MEASURES), np.nan, np.float32)
        for p, i in enumerate(contact):
            of_contact = self._measures(int(i))
            for s, sensor in enumerate(self._sensors):
                if sensor in of_contact:
                    found[p, s] = of_contact[sensor][frame_index[p, s]]
        return found

    def _measures(self, i: int) -> dict[str, np.ndarray]:
        if i not in self._known:
            contact = self._store.contact(i, fields=True)
            self._known[i] = {s: depth_measures(x.depth_mm) for s, x in contact.items() if x.depth_mm is not None}
        return self._known[i]


class ClipFeed(Feed):
    """Clips in random order, without end; with `depth` they come with measures of it, and `memory` keeps them."""

    def __init__(
        self,
        store: Contacts,
        rows: np.ndarray,
        clip: ClipConfig,
        *,
        batch_size: int,
        seed: int,
        depth: ClipDepth | None = None,
        memory: ClipMemory | None = None,
    ) -> None:
        super().__init__(clip_batches(store, rows, clip, batch_size=batch_size, seed=seed, memory=memory), seed)
        self._depth = depth

    def make(self, element: dict[str, np.ndarray], rng: np.random.Generator) -> TouchBatch | MeasuredTouch:
        """The clips unchanged."""
        del rng
        touch = host_touch(element)
        if self._depth is None:
            return touch
        depth: Any = self._depth(element["contact"], element["frame_index"])
        return MeasuredTouch(touch=touch, depth_mm=depth)


def clip_of(config: PretrainConfig, clip: ClipConfig) -> ClipConfig:
    """The clip with the number and size of frames that the encoder reads."""
    return dataclasses.replace(clip, frames=config.frames, image_px=config.image_px)


def pretrain(
    config: PretrainConfig,
    store: Contacts,
    rows: np.ndarray,
    clip: ClipConfig,
    context: Context,
    *,
    stage: str,
    seed: int,
    held_out: HeldOutContacts | None = None,
    memory: ClipMemory | None = None,
) -> DynamicsState:
    """Train encoder and predictor on the contacts at `rows`, without their labels; a stopped stage resumes.

    The clip gives sensors and flags, the config number and size of the frames; `memory` keeps the clips.  Where
    contacts are `held_out`, it is measured on them every `probe_every` steps.  The stage is named `PHASE/SEED`.

    Raises:
      ValueError: contacts to measure on, for another objective than `dynamics`.
    """
    if held_out is not None and config.objective != "dynamics":
        raise ValueError(
            f"objective is {config.objective!r}: must be 'dynamics' where held-out predictions are measured; "
            "`stage_one` compares the others"
        )
    clip = clip_of(config, clip)
    depth = ClipDepth(store, clip.sensors) if config.objective == "physics" else None
    feed = ClipFeed(store, rows, clip, batch_size=config.batch_size, seed=seed, depth=depth, memory=memory)
    networks = config.dynamics(len(clip.sensors))
    _, step = dynamics_program(networks, config.optimizer, config.steps)
    state = untrained(config, store, rows, clip, seed)
    measure = functools.partial(_measure, networks, context, f"probe/{stage.rpartition('/')[2]}", held_out)
    measure(state, 0)
    for end in range(config.probe_every, config.steps + config.probe_every, config.probe_every):
        loop = LoopConfig(steps=min(end, config.steps), save_every=config.probe_every)
        state = run_loop(step, state, feed, loop, context, stage)
        measure(state, loop.steps, end - config.probe_every)
    return state


def untrained(config: PretrainConfig, store: Contacts, rows: np.ndarray, clip: ClipConfig, seed: int) -> DynamicsState:
    """The state before training on some contacts."""
    one = next(iter(clip_batches(store, rows[:1], clip, batch_size=1, seed=0, repeat=False)))
    batch: TouchBatch | MeasuredTouch = touch_batch(one)
    if config.objective == "physics":
        depth: Any = np.zeros((*one["frame_index"].shape, DEPTH_MEASURES), np.float32)
        batch = MeasuredTouch(touch=touch_batch(one), depth_mm=depth)
    return pretraining.untrained(config, batch, seed)


def _measure(
    networks: DynamicsConfig,
    context: Context,
    stage: str,
    held_out: HeldOutContacts | None,
    state: DynamicsState,
    step: int,
    before: int = 0,
) -> None:
    """Log the measurements after `step` steps, and the alarms since those after `before` steps; once in a run."""
    if held_out is None or context.done(f"{stage}/at{step}"):
        return
    found = assess(networks, state, held_out, context).summary()
    if step:  # the probes are compared with the random encoder, which has no lead over itself
        start = context.load_stage(f"{stage}/at0")
        found |= {"probe_lead": found["probe"] - start["probe"], "kept": found["told_apart"] / start["told_apart"]}
    if before:
        for alarm in collapse_alarms(context.load_stage(f"{stage}/at{before}"), found):
            context.print(f"{stage}, step {step}: {alarm}")
    context.log(stage, step, **found)
    context.print(f"{stage}, step {step}: " + ", ".join(f"{name} {value:.3g}" for name, value in found.items()))
    context.save_stage(f"{stage}/at{step}", found)
