"""From stored contacts to training clips: which frames, at which size, in which order.

Dimensions as in the schema: N frames of a sequence, F of a clip, S sensors, P clips of a batch.
"""

import dataclasses
import threading
from collections.abc import Callable, Mapping
from collections.abc import Sequence as Seq
from typing import Any, Protocol, get_args

import absl.flags
import cv2
import grain
import numpy as np

from sensors_io.augment import AugmentConfig, apply_symmetry, draw_kept, draw_symmetry, jitter_exposure
from sensors_io.records import RecordStore
from sensors_io.schema import SENSORS, Clip, ContactKey, Flag, ObjectCard, SchemaError, Sequence
from sensors_io.selection import Chooser, Shown, choose_frames, field_images, pick_frames


@dataclasses.dataclass(frozen=True, kw_only=True)
class ClipConfig:
    """Shape of a clip and what may enter it.

    Args:
      frames: F, frames of each stream.
      image_px: rows and columns of a tactile image.
      view_px: rows and columns of the object's view.
      sensors: the streams, in order.
      rejected: a frame with one of these flags is left out where a sequence has others.
      choose: by what the frames of a stream are chosen, see `choose_frames`.
      show: camera pictures, or fields as images (`field_images`); a sequence without pictures shows its fields anyway.
    """

    frames: int = 8
    image_px: int = 112
    view_px: int = 64
    sensors: tuple[str, ...] = SENSORS
    rejected: tuple[Flag, ...] = (Flag.STRAIN_LIMIT, Flag.NOT_CONVERGED, Flag.SATURATED)
    choose: Chooser = "auto"
    show: Shown = "pictures"

    def __post_init__(self) -> None:
        for name in ("frames", "image_px", "view_px"):
            if getattr(self, name) < 1:
                raise SchemaError(f"{name} is {getattr(self, name)}: must be ≥ 1; raise it")
        if not self.sensors or len(set(self.sensors)) != len(self.sensors):
            raise SchemaError(f"sensors is {self.sensors}: at least one, each once; correct the list")
        for name, known in (("choose", get_args(Chooser)), ("show", get_args(Shown))):
            if getattr(self, name) not in known:
                raise SchemaError(f"{name} is {getattr(self, name)!r}: must be one of {', '.join(known)}; correct it")


class ClipMemory:
    """Clips that were made once and stay in memory; those that do not fit are made again each time.

    Args:
      config: shape of the clips.
      most_bytes: bytes of arrays that may stay.
    """

    def __init__(self, config: ClipConfig, most_bytes: int) -> None:
        self.config = config
        self.contacts: Contacts | None = None
        """Whose clips they are: of those that are read first."""
        self._most, self._held = most_bytes, 0
        self._clips: dict[tuple[int, bool], dict[str, np.ndarray]] = {}
        self._lock = threading.Lock()

    @property
    def held_bytes(self) -> int:
        """Bytes of the clips that stay."""
        return self._held

    def get(
        self, i: int, make: Callable[[], dict[str, np.ndarray]], *, with_touch: bool = True
    ) -> dict[str, np.ndarray]:
        """The arrays of contact i, with touch or without, from memory or made now; they must not be written to."""
        kept = self._clips.get((i, with_touch))
        if kept is not None:
            return kept
        arrays = make()
        size = sum(array.nbytes for array in arrays.values())
        with self._lock:
            if (i, with_touch) not in self._clips and self._held + size <= self._most:
                self._clips[i, with_touch] = arrays
                self._held += size
        return arrays


class Contacts(Protocol):
    """Contacts by number: `records.RecordStore`, or `live.LiveScenes`, which generates them on request."""

    @property
    def contacts(self) -> Seq[ContactKey]:
        """Identity of every contact."""

    @property
    def objects(self) -> Mapping[str, ObjectCard]:
        """Cards of all objects by id."""

    def __len__(self) -> int: ...

    def contact(self, i: int, *, fields: bool = True) -> Mapping[str, Sequence]:
        """Contact i by sensor; without `fields`, those of sequences that have camera frames may be missing."""


def make_clip(
    contact: Mapping[str, Sequence],
    card: ObjectCard,
    config: ClipConfig,
    *,
    augment: AugmentConfig | None = None,
    rng: np.random.Generator | None = None,
) -> Clip:
    """One training example from one contact: F chosen frames of each sensor, resized, with masks for what is missing.

    The whole window is stretched to the square image.  A sequence without camera frames shows its fields instead, and
    so does every sequence if the config says so, see `field_images`.  A sensor that did not see the contact has zeros
    and `stream_mask` False.  `frame_index` is the position of a frame in its sequence.  `force_n` is zero where it was
    not measured: a zero vector means unknown.

    Args:
      contact: the sequences of one contact by sensor; sensors outside `config.sensors` are ignored.
      card: the touched object.
      config: shape of the clip.
      augment: random changes; None for none.
      rng: source of their randomness.

    Raises:
      SchemaError: the contact is empty or belongs to another object, random changes without a source of randomness, or
        fields of a sequence that has pictures alone.
    """
    if not contact:
        raise SchemaError("contact is {}: a clip needs at least one sequence; skip empty contacts")
    key = next(iter(contact.values())).key
    if key.object_id != card.object_id:
        raise SchemaError(f"card is of object {card.object_id!r}: the contact is of {key.object_id!r}; pass its card")
    streams = _streams(contact, config, augment or AugmentConfig(), rng)
    return _clip(key, card, config, stream_mask=np.array([s in contact for s in config.sensors]), **streams)


def make_clip_without_touch(key: ContactKey, card: ObjectCard, config: ClipConfig) -> Clip:
    """The same contact for a policy without touch: view and labels, no stream present, images of one pixel."""
    shape = (len(config.sensors), config.frames)
    return _clip(
        key,
        card,
        config,
        frames=np.zeros((*shape, 1, 1, 3), np.uint8),
        force_n=np.zeros((*shape, 3), np.float32),
        frame_index=np.zeros(shape, np.int32),
        frame_mask=np.zeros(shape, np.bool_),
        stream_mask=np.zeros(len(config.sensors), np.bool_),
    )


def clip_batches(
    store: Contacts,
    indices: Any,
    config: ClipConfig,
    *,
    batch_size: int,
    seed: int,
    shuffle: bool = True,
    repeat: bool = True,
    drop_remainder: bool = False,
    own: Any = None,
    with_touch: bool = True,
    augment: AugmentConfig | None = None,
    memory: ClipMemory | None = None,
    workers: int = 0,
    threads: int = 1,
) -> grain.IterDataset:
    """Batches of clips: dicts of the arrays of `CLIP_ARRAYS` with a leading P, and `contact`, their indices, int32 [P].

    The order is a function of `seed` alone and differs from epoch to epoch; batches run across the ends of epochs.  An
    iterator's `get_state` and `set_state` resume it exactly.

    Args:
      store: the data set.
      indices: contacts to draw from, e.g. `store.contacts_of_split("train")`.
      batch_size: P.
      seed: seed of the order, 0 ≤ seed < 2³².
      shuffle: False keeps the order of `indices`.
      repeat: False ends after one epoch.
      drop_remainder: whether the last, smaller batch of an unrepeated epoch is dropped.
      own: rows of each batch that are read, where machines share it; None for all.  States are those of the whole.
      with_touch: False reads no touch, for policies that have none (`make_clip_without_touch`).
      augment: random changes of the touch, for training; a function of `seed` and of the clip's place in the order.
      memory: where clips stay that are not changed at random; None for nowhere.
      workers: reading processes; 0 reads in threads of this one.  States carry over between equal numbers of workers.
      threads: reading threads of each process.

    Raises:
      SchemaError: no contact, or one that the store does not hold; a memory for other clips or with `workers`; rows
        that a batch does not have.
    """
    rows = _checked_rows(indices, len(store))
    _bind_memory(memory, store, config, workers)
    dataset = grain.MapDataset.source(rows).seed(seed)
    dataset = dataset.shuffle() if shuffle else dataset
    if with_touch and isinstance(store, RecordStore):
        store.fetch_ahead(dataset[i] for i in range(len(rows)))
    if repeat:
        dataset = dataset.repeat()
    # grain rounds the number of batches up in floating point, to 2⁶³ for the 2⁶³ − 1 rows of an endless data set: one
    # more than it can count to.  Without a remainder it divides whole numbers, and an endless data set never has one
    whole = drop_remainder or repeat
    reader = _Reader(store, config, with_touch, augment or AugmentConfig())
    if with_touch and reader.augment.active:
        clips = dataset.random_map(reader)
    elif memory is not None:
        clips = dataset.map(lambda i: memory.get(i, lambda: reader(i), with_touch=with_touch))
    else:
        clips = dataset.map(reader)
    return _read_ahead(_batched(clips, batch_size, own, whole), workers, threads)


def _batched(clips: grain.MapDataset, batch_size: int, own: Any, whole: bool) -> grain.MapDataset:
    """Batches of clips, or those rows of each that this machine reads."""
    if own is None:
        return clips.batch(batch_size, drop_remainder=whole)
    rows = _checked_own(own, batch_size, whole)
    return _OwnRows(clips, batch_size, rows).batch(len(rows), drop_remainder=True)


class _OwnRows(grain.MapDataset):
    """Of every `batch_size` elements those at `own`; the others are never made."""

    def __init__(self, parent: grain.MapDataset, batch_size: int, own: list[int]) -> None:
        super().__init__(parent)
        self._size, self._own = batch_size, own

    def __len__(self) -> int:
        return len(self._parent) // self._size * len(self._own)

    def __getitem__(self, index: Any) -> Any:
        if isinstance(index, slice):
            return self.slice(index)
        batch, place = divmod(index, len(self._own))
        return self._parent[batch * self._size + self._own[place]]


def _read_ahead(batches: grain.MapDataset, workers: int, threads: int) -> grain.IterDataset:
    """Batches read by threads of this process or by workers."""
    # a batch or two ahead: grain's default of 500 would hold gigabytes of frames
    iterable = batches.to_iter_dataset(grain.ReadOptions(num_threads=threads, prefetch_buffer_size=1 + threads))
    if not workers:
        return iterable
    if not absl.flags.FLAGS.is_parsed():
        absl.flags.FLAGS.mark_as_parsed()  # grain's workers read flags that only absl programs parse
    return iterable.mp_prefetch(grain.MultiprocessingOptions(num_workers=workers))


def _checked_rows(indices: Any, contacts: int) -> list[int]:
    rows = [int(i) for i in indices]
    if not rows:
        raise SchemaError("indices is empty: a pipeline needs at least one contact; choose a split that has some")
    if min(rows) < 0 or max(rows) >= contacts:
        raise SchemaError(f"indices reach {min(rows)}..{max(rows)}: must lie in 0..{contacts - 1}; use this store's")
    return rows


def _checked_own(own: Any, batch_size: int, whole: bool) -> list[int]:
    rows = [int(i) for i in own]
    if not rows or rows != sorted({*rows} & {*range(batch_size)}) or not whole:
        raise SchemaError(
            f"own is {rows} of batches of {batch_size}, {'all whole' if whole else 'the last perhaps smaller'}: must "
            f"be ascending rows 0..{batch_size - 1} of whole batches; ask for them, and for repeat or drop_remainder"
        )
    return rows


def _bind_memory(memory: ClipMemory | None, store: Contacts, config: ClipConfig, workers: int) -> None:
    if memory is None:
        return
    if memory.contacts is not None and memory.contacts is not store:
        raise SchemaError(
            f"memory keeps clips of {memory.contacts}: the contacts are those of {store}, with the same numbers; make "
            "a memory for them"
        )
    if memory.config != config or workers:
        raise SchemaError(
            f"memory keeps {memory.config} of one process: the clips are {config}, read by {workers} worker processes; "
            "make it for these clips and leave workers at 0"
        )
    memory.contacts = store


@dataclasses.dataclass(frozen=True)
class _Reader:
    """Contact index → arrays of its clip, changed at random by `rng`; a class, so that workers can be sent it."""

    store: Contacts
    config: ClipConfig
    with_touch: bool
    augment: AugmentConfig

    def __call__(self, i: int, rng: np.random.Generator | None = None) -> dict[str, np.ndarray]:
        key = self.store.contacts[i]
        card = self.store.objects[key.object_id]
        if self.with_touch:
            contact = self.store.contact(i, fields=self.config.show == "fields")
            clip = make_clip(contact, card, self.config, augment=self.augment, rng=rng)
        else:
            clip = make_clip_without_touch(key, card, self.config)
        return clip.arrays() | {"contact": np.array(i, np.int32)}


def _clip(key: ContactKey, card: ObjectCard, config: ClipConfig, **streams: np.ndarray) -> Clip:
    """Streams and what the card says of the object."""
    size = (config.view_px, config.view_px)
    return Clip(
        key=key,
        **streams,
        view=np.zeros((*size, 3), np.uint8) if card.view is None else _resize(card.view, size),
        view_mask=np.array(card.view is not None),
        label=card.label_row(),
    )


def _streams(
    contact: Mapping[str, Sequence], config: ClipConfig, augment: AugmentConfig, rng: np.random.Generator | None
) -> dict[str, np.ndarray]:
    """Images, forces, positions and masks of all streams."""
    if augment.active and rng is None:
        raise SchemaError(f"rng is None: {augment} needs a source of randomness; pass one")
    shape, size = (len(config.sensors), config.frames), (config.image_px, config.image_px)
    frames = np.zeros((*shape, *size, 3), np.uint8)
    force_n = np.zeros((*shape, 3), np.float32)
    index, mask = np.zeros(shape, np.int32), np.zeros(shape, np.bool_)
    element = None if rng is None else draw_symmetry(augment, rng)
    for s, sensor in enumerate(config.sensors):
        if sensor not in contact:
            continue
        chosen = choose_frames(contact[sensor], config.frames, config.rejected, config.choose)
        picked = _shown(pick_frames(contact[sensor], chosen), config.show)
        picked = picked if element is None else apply_symmetry(picked, element)
        images, n = _images(picked, size), len(chosen)
        by_camera = picked.frames is not None  # fields in mm know no exposure
        frames[s, :n] = images if rng is None or not by_camera else jitter_exposure(images, augment, rng)
        if picked.force_n is not None:
            force_n[s, :n] = picked.force_n
        index[s, :n], mask[s, :n] = chosen, True
    if rng is not None:
        mask = draw_kept(mask, augment, rng)
        for array in (frames, force_n, index):
            array[~mask] = 0
    return {"frames": frames, "force_n": force_n, "frame_index": index, "frame_mask": mask}


def _shown(sequence: Sequence, show: Shown) -> Sequence:
    """The sequence without its camera frames, if fields are shown."""
    if show == "pictures" or sequence.frames is None:
        return sequence
    if sequence.depth_mm is None and sequence.deformation_mm is None:
        raise SchemaError(
            f"{sequence.name}: has no fields, and show is 'fields': must have depth_mm or deformation_mm; write them "
            "next to its pictures by `python -m sensors_io extract`"
        )
    return dataclasses.replace(sequence, frames=None)


def _images(sequence: Sequence, size: tuple[int, int]) -> np.ndarray:
    """Images of all frames, uint8 [N, *size, 3]."""
    if sequence.frames is not None:
        return np.stack([_resize(frame, size) for frame in sequence.frames])
    images = [cv2.resize(image, size[::-1], interpolation=cv2.INTER_LINEAR) for image in field_images(sequence)]
    return np.clip(np.rint(images), 0, 255).astype(np.uint8)


def _resize(image: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    if image.shape[:2] == size:
        return image
    shrinks = image.shape[0] >= size[0] and image.shape[1] >= size[1]
    return cv2.resize(image, size[::-1], interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR)
