"""Baselines without a policy, on fixed features of a contact: nearest neighbours and a linear probe.

The features are the recorded fields at the strongest press, the picture of the object, or the encoded touch.  Like
the policies, every baseline answers from all streams together and from each stream alone.
"""

import dataclasses
import functools
from collections.abc import Callable, Sequence

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int

from experiments.core.errors import DataError
from experiments.study.scores import level_answers
from experiments.study.seed import TrainedPolicy
from experiments.study.stages import encode_rows
from sensors_io.records import RecordStore
from sensors_io.schema import Sequence as Recording
from touchr1_jax.bench.metrics import BOTTOM
from touchr1_jax.models.policy import Features
from touchr1_jax.training.evaluation import Evaluation
from touchr1_jax.training.linear_probe import ProbeConfig, probe_log_probs

NEIGHBOURS = 15
"""Contacts that vote; fixed beforehand, about the square root of a level's training contacts."""

CELLS = 8
"""Cells along a side that fields and pictures are averaged to: about 2 mm each on the widest sensor."""

FINE_PX, COARSE_PX = 1, 4  # distances between the pixels whose difference measures texture
TINY = 1e-3  # keeps the logarithm of a flat picture finite; pictures are in 0..1


@dataclasses.dataclass(frozen=True, kw_only=True)
class ContactFeatures:
    """Features of n contacts: float32 [n, S, D], zero where a stream was not recorded, and which were, [n, S]."""

    x: Float[np.ndarray, "n S D"]
    present: Bool[np.ndarray, "n S"]

    def rows(self, rows: np.ndarray) -> "ContactFeatures":
        """Some of the contacts, in the order of `rows`."""
        return ContactFeatures(x=self.x[rows], present=self.present[rows])

    def only(self, stream: int) -> "ContactFeatures":
        """The same contacts with a single stream."""
        return ContactFeatures(x=self.x[:, [stream]], present=self.present[:, [stream]])


Predict = Callable[[ContactFeatures, Int[np.ndarray, "n A"], ContactFeatures], Int[np.ndarray, "m A"]]
"""Features of training contacts, their labels, −1 where nobody annotated, and features of others → their levels."""


def other_objects(objects: np.ndarray, seed: int) -> Int[np.ndarray, "n"]:
    """For every contact the position of a random contact of another object; `objects` [n] is that of each contact."""
    names, index = np.unique(objects, return_inverse=True)
    if len(names) < 2:
        raise DataError(f"objects holds only {names.tolist()}: another object's touch needs two; use more contacts")
    rng, order = np.random.default_rng(seed), np.argsort(index, kind="stable")
    sizes = np.bincount(index)
    first = np.cumsum(sizes) - sizes
    step = rng.integers(0, len(objects) - sizes[index])  # among the contacts that follow the object's own, around
    return order[(first[index] + sizes[index] + step) % len(objects)]


def field_features(
    store: RecordStore, rows: np.ndarray, sensors: Sequence[str], progress: Callable[[], None] = lambda: None
) -> ContactFeatures:
    """Depth and size of the displacement, averaged over 8 × 8 cells, at the strongest press of every stream, in mm.

    A stream without fields counts as not recorded; `progress` is called after every contact.
    """
    x = np.zeros((len(rows), len(sensors), 2 * CELLS**2), np.float32)
    present = np.zeros((len(rows), len(sensors)), bool)
    for n, row in enumerate(rows):
        recorded = store.contact(int(row), fields=True)
        for s, sensor in enumerate(sensors):
            recording = recorded.get(sensor)
            if recording is not None and (recording.depth_mm is not None or recording.deformation_mm is not None):
                x[n, s], present[n, s] = _strongest_fields(recording), True
        progress()
    return ContactFeatures(x=x, present=present)


def picture_features(views: Sequence[np.ndarray | None]) -> ContactFeatures:
    """Mean colours of 8 × 8 cells and the texture of each uint8 picture [H, W, 3], as one stream."""
    empty = np.zeros(3 * CELLS**2 + 2 * 3, np.float32)
    x = np.stack([empty if view is None else _colour_and_texture(view) for view in views])
    return ContactFeatures(x=x[:, None], present=np.array([[view is not None] for view in views]))


def _strongest_fields(recording: Recording) -> Float[np.ndarray, "D"]:
    """The fields of the frame with the greatest force, of the last frame where no force was measured."""
    t = -1 if recording.force_n is None else int(np.argmin(recording.force_n[:, 2]))
    depth, moved, absent = recording.depth_mm, recording.deformation_mm, np.zeros(CELLS**2, np.float32)
    moved_mm = absent if moved is None else _cells(np.linalg.norm(moved[t], axis=-1))
    return np.concatenate([absent if depth is None else _cells(depth[t]), moved_mm])


def _colour_and_texture(view: np.ndarray) -> Float[np.ndarray, "D"]:
    picture = view.astype(np.float32) / 255
    texture = [np.log(np.abs(picture[step:] - picture[:-step]).mean((0, 1)) + TINY) for step in (FINE_PX, COARSE_PX)]
    return np.concatenate([_cells(picture), *texture]).astype(np.float32)


def _cells(image: np.ndarray) -> Float[np.ndarray, "D"]:
    """Means over the cells of an image [H, W] or [H, W, C], flat."""
    return cv2.resize(image.astype(np.float32), (CELLS, CELLS), interpolation=cv2.INTER_AREA).ravel()


def together_and_alone(
    predict: Predict, known: ContactFeatures, label: Int[np.ndarray, "n A"], asked: ContactFeatures
) -> tuple[Int[np.ndarray, "m A"], Int[np.ndarray, "m S A"]]:
    """Levels by `nearest` or `linear_probe` from all streams and from each alone; ⊥ where none was recorded."""

    def levels(k: ContactFeatures, a: ContactFeatures) -> np.ndarray:
        return np.where(np.any(a.present, axis=1, keepdims=True), predict(k, label, a), BOTTOM)

    single = [levels(known.only(s), asked.only(s)) for s in range(asked.x.shape[1])]
    return single[0] if len(single) == 1 else levels(known, asked), np.stack(single, 1)


def nearest(
    known: ContactFeatures,
    label: np.ndarray,
    asked: ContactFeatures,
    *,
    levels: tuple[int, ...],
    neighbours: int = NEIGHBOURS,
) -> Int[np.ndarray, "m A"]:
    """The vote of the k nearest training contacts, each weighing 1/d; features without spread do not count.

        d² = mean over streams that both have of mean_D ((x − x′)/σ)²

    `levels` are K of each attribute; there are fewer neighbours where fewer contacts are annotated.
    """
    distance = _distances(known, asked)
    out = np.zeros((len(asked.x), len(levels)), int)
    for a, count in enumerate(levels):
        rows = _annotated(label[:, a], a)
        near = np.argsort(distance[:, rows], axis=1, kind="stable")[:, :neighbours]
        weight = 1 / np.maximum(np.take_along_axis(distance[:, rows], near, 1), np.finfo(np.float32).tiny)
        votes = label[rows, a][near]
        out[:, a] = np.stack([(weight * (votes == k)).sum(1) for k in range(count)], 1).argmax(1)
    return out


def linear_probe(
    known: ContactFeatures, label: np.ndarray, asked: ContactFeatures, *, levels: tuple[int, ...], config: ProbeConfig
) -> Int[np.ndarray, "m A"]:
    """The likeliest level by a multinomial probe on the concatenated streams; arguments as of `nearest`."""
    x = np.concatenate([features.x.reshape(len(features.x), -1) for features in (known, asked)])
    every = np.concatenate([label, np.full((len(asked.x), label.shape[1]), -1)])
    columns = []
    for a, count in enumerate(levels):
        weight = np.isin(np.arange(len(x)), _annotated(label[:, a], a))[None]
        columns.append(probe_log_probs(x, every[:, a], weight, count, config)[0, len(label) :].argmax(-1))
    return np.stack(columns, 1)


def encoder_probe(trained: TrainedPolicy, *, swapped: bool = False, picture: bool = False) -> Evaluation:
    """Levels by a linear probe on the encoded touch; `swapped` gives every contact the touch of another object.

    With `picture` the probe reads the encoded picture too, with all streams together and with each alone.
    """
    data = trained.data
    rows = data.training
    encoded = encode_rows(trained.policy, trained.params, data, rows, trained.context), trained.test
    known, asked = (mean_tokens(features, picture=picture) for features in encoded)
    if swapped:
        known = known.rows(other_objects(data.object_ids[rows], trained.seed))
        asked = asked.rows(other_objects(data.object_ids[data.parts["test"]], trained.seed))
    probe = functools.partial(linear_probe, levels=trained.policy.levels, config=trained.config.probe)
    return level_answers(trained.policy, trained.evaluation, *together_and_alone(probe, known, data.label[rows], asked))


def mean_tokens(features: Features, *, picture: bool = False) -> ContactFeatures:
    """Mean over the tokens of each stream; with `picture` the mean over its tokens follows in every stream."""
    there = (np.asarray(features.touch_time) >= 0) & np.asarray(features.stream_mask)[..., None]
    total = (np.asarray(features.touch) * there[..., None]).sum(-2)
    x = total / np.maximum(there.sum(-1), 1)[..., None]
    if picture:
        view = np.asarray(features.view).mean(-2) * np.asarray(features.view_mask)[:, None]
        x = np.concatenate([x, np.broadcast_to(view[:, None], (*x.shape[:2], view.shape[-1]))], -1)
    return ContactFeatures(x=x.astype(np.float32), present=there.any(-1))


def _distances(known: ContactFeatures, asked: ContactFeatures) -> Float[np.ndarray, "m n"]:
    """Root mean square difference in units of the training spread; infinite where no stream is shared."""
    total = np.zeros((len(asked.x), len(known.x)))
    shared = np.zeros_like(total)
    for s in range(known.x.shape[1]):
        x, recorded = known.x[:, s].astype(float), known.present[:, s]
        if not recorded.any():
            continue
        centre, spread = x[recorded].mean(0), x[recorded].std(0)
        varies = spread > 0
        z, q = ((v[:, varies] - centre[varies]) / spread[varies] for v in (x, asked.x[:, s].astype(float)))
        square = (q**2).sum(1)[:, None] + (z**2).sum(1) - 2 * q @ z.T
        both = asked.present[:, s, None] & recorded
        total += np.where(both, np.maximum(square, 0) / max(varies.sum(), 1), 0)
        shared += both
    return np.sqrt(np.where(shared > 0, total / np.maximum(shared, 1), np.inf))


def _annotated(label: np.ndarray, attribute: int) -> np.ndarray:
    rows = np.flatnonzero(label >= 0)
    if not len(rows):
        raise ValueError(f"label[:, {attribute}] is −1 throughout: a baseline needs annotated contacts; leave it out")
    return rows
