"""Inputs that a policy can be asked about: generated objects, contacts of records, videos, folders of pictures.

generated            a generated object, drawn at random; generated:7 the seventh
generated:soft,wood  one with these properties
RECORDS              a folder of records: its first contact; RECORDS:12 contact 12, RECORDS:mug the first of an object
press.mp4            a video of one sensor
FOLDER               pictures of one sensor, in the order of the numbers in their names
"""

import dataclasses
import itertools
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from experiments.core.errors import DataError
from experiments.study.policies import SCENES, clip_of
from sensors_io.importers.keep import Keep, UnreadableError
from sensors_io.importers.pictures import film, nominal_ns, numbered, read_pictures
from sensors_io.importers.video import read_video
from sensors_io.index import INDEX
from sensors_io.live import LiveScenes
from sensors_io.pipeline import make_clip
from sensors_io.records import RecordStore
from sensors_io.scenes.cards import solid_of
from sensors_io.scenes.config import SceneConfig
from sensors_io.schema import LEVELS, ContactKey, ObjectCard
from sensors_io.schema import Sequence as TouchSequence
from touchr1_jax.asking import TouchInput
from touchr1_jax.models.saved_policy import SavedPolicy, words
from touchr1_jax.training.compilation import compiled_quickly

GENERATED = "generated"

UNSEEN_SEED = 1_000_000
"""Added to the numbers of generated objects, so that none is an object of training."""

MOST_DRAWN = 50_000
"""Objects that are drawn in search of given properties; the rarest combination is one in some thousands."""

FILM_RATE_HZ = 30.0
"""Assumed rate of a folder of pictures; only the order of frames counts."""


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class AskedTouch:
    """An input: its name, its touch, the true level of each attribute in words where known, and remarks."""

    name: str
    touch: TouchInput
    truth: Mapping[str, str] = dataclasses.field(default_factory=dict)
    remarks: tuple[str, ...] = ()
    force_known: bool = False


def read_touch(source: str | Path, saved: SavedPolicy, sensor: str = "") -> AskedTouch:
    """Read an input as a policy reads its training data.

    Args:
      source: as in the docstring of this module.
      saved: the policy.
      sensor: of a video or of pictures; by default the policy's first one.

    Raises:
      DataError: an input that cannot be read.
    """
    text = str(source)
    if sensor and sensor not in saved.sensors:
        raise DataError(f"sensor is {sensor!r}: the policy reads {', '.join(saved.sensors)}; choose one of them")
    if text.partition(":")[0] == GENERATED:
        return _generated(text.partition(":")[2], saved)
    path, _, which = (text, "", "") if Path(text).exists() else text.rpartition(":")
    if (Path(path) / INDEX).exists():
        return _recorded(Path(path), which, saved)
    if not path or not (Path(path).is_file() or Path(path).is_dir()):
        raise DataError(
            f"input is {text!r}: no such file or folder; must be a folder of records (RECORDS:CONTACT), a video, "
            f"a folder of pictures, or {GENERATED}"
        )
    return _filmed(Path(path), saved, sensor)


def read_contacts(store: RecordStore, rows: Sequence[int], saved: SavedPolicy) -> list[AskedTouch]:
    """Some contacts of records."""
    return [_of_contact(store, i, saved, f"contact {i} of {store.path}") for i in rows]


def _generated(which: str, saved: SavedPolicy) -> AskedTouch:
    """A generated object that training never saw, pressed by all sensors as those of training were."""
    known = {word: (name, level) for name in _shared(saved) for level, word in enumerate(words(saved, name))}
    try:
        given = dict(saved.notes.get(SCENES) or {})
        fields = {field.name for field in dataclasses.fields(SceneConfig)} & given.keys() - {"split_shares"}
        config = SceneConfig(**{name: given[name] for name in fields} | {"objects": 1, "sites": 1, "sequences": None})
    except (TypeError, ValueError) as error:
        raise DataError(
            f"policy notes scenes that this version cannot generate ({error}); give another input"
        ) from error
    wanted: dict[str, int] = {}
    counted = re.fullmatch("[0-9]{1,9}", which) is not None
    for word in filter(None, which.split(",")) if not counted else ():
        if word not in known:
            raise DataError(
                f"input is {GENERATED}:{which}: {word!r} is no property; choose from {', '.join(known)}, or a number "
                "of nine digits at most"
            )
        name, level = known[word]
        if wanted.setdefault(name, level) != level:
            raise DataError(f"input is {GENERATED}:{which}: an object has one {name}; drop a word")
    first = int(which) if counted else int(np.random.default_rng().integers(UNSEEN_SEED))
    for number in itertools.islice(itertools.count(first), MOST_DRAWN):
        scene = dataclasses.replace(config, seed=UNSEEN_SEED + number)
        if wanted.items() <= solid_of(scene, 0).labels().items():
            with compiled_quickly():  # programs that run once
                return _of_contact(LiveScenes(scene), 0, saved, f"generated object {number} ({GENERATED}:{number})")
    raise DataError(f"input is {GENERATED}:{which}: no such object in {MOST_DRAWN} draws; ask for fewer properties")


def _recorded(path: Path, which: str, saved: SavedPolicy) -> AskedTouch:
    store = RecordStore(path)
    row = contact_row(store, which)
    return _of_contact(store, row, saved, f"contact {row} of {path}")


def contact_row(store: RecordStore, which: str) -> int:
    """The first contact with this number or of this object, of all if `which` is empty.

    Raises:
      DataError: there is none.
    """
    rows = [i for i, key in enumerate(store.contacts) if which in ("", str(i), key.object_id)]
    if not rows:
        raise DataError(
            f"input is {store.path}:{which}: must name a contact 0..{len(store) - 1} or an object; "
            f"`python -m sensors_io list {store.path}` shows them"
        )
    return rows[0]


def _of_contact(store: RecordStore | LiveScenes, i: int, saved: SavedPolicy, name: str) -> AskedTouch:
    """A contact with its object's card."""
    card = store.objects[store.contacts[i].object_id]
    return _asked(store.contact(i, fields=saved.reads.show == "fields"), card, saved, name)


def _filmed(path: Path, saved: SavedPolicy, sensor: str) -> AskedTouch:
    """A video, or a folder of pictures, of one sensor."""
    named = sensor or saved.sensors[0]
    sequence = filmed_sequence(path, named)
    card = ObjectCard(object_id=sequence.key.object_id, split="unlabelled", labels={}, annotator="")
    asked = _asked({named: sequence}, card, saved, str(path))
    remark = () if sensor else (f"read as pictures of {named}; --sensor names another",)
    return dataclasses.replace(asked, remarks=(*remark, *asked.remarks))


def filmed_sequence(path: Path, sensor: str) -> TouchSequence:
    """A video, or a folder of pictures, as the sequence of a sensor.

    Raises:
      DataError: neither, or one that cannot be read.
    """
    keep = Keep()
    arrays: dict[str, Any]
    try:
        if path.is_dir():
            files = numbered(path)
            if not files:
                raise UnreadableError("holds neither records nor pictures (.jpg, .png)")
            pictures = read_pictures(files, keep.positions(len(files)), keep)
            if pictures.left_out:
                raise UnreadableError(f"{pictures.left_out[0].name} {pictures.left_out[0].reason}, remove it")
            times = nominal_ns(pictures.index, FILM_RATE_HZ)
            arrays = {"frames": pictures.frames, "gap": pictures.after_loss()}
        else:
            video = read_video(path, keep)
            times = video.time_ns
            arrays = {"frames": video.frames, "gap": np.zeros(len(video.index), bool)}
    except UnreadableError as error:
        raise DataError(f"input is {path}: {error}; give a video, a folder of pictures or of records") from error
    name = re.sub(r"[^A-Za-z0-9]+", "-", path.stem).strip("-") or "object"
    key = ContactKey(object_id=name, site=0, motion="free", trial=0)
    return film(key, sensor, host_time_ns=times, **arrays)


def _asked(contact: Mapping[str, TouchSequence], card: ObjectCard, saved: SavedPolicy, name: str) -> AskedTouch:
    """The clip of a contact as a touch, with what training had and this input lacks."""
    sensors = [sensor for sensor in saved.sensors if sensor in contact]
    if not sensors:
        raise DataError(
            f"input is {name}, recorded by {', '.join(contact)}: the policy reads {', '.join(saved.sensors)}; "
            "ask a policy that was trained on this sensor"
        )
    clip = make_clip(contact, card, clip_of(saved))
    real = {sensor: clip.frame_mask[s] for s, sensor in enumerate(saved.sensors) if sensor in sensors}
    of = lambda array: {sensor: array[saved.sensors.index(sensor)][mask] for sensor, mask in real.items()}
    known = {a: level for a, level in card.labels.items() if level >= 0 and a in _shared(saved)}
    remarks = []
    force_known = any(contact[sensor].force_n is not None for sensor in sensors)
    if saved.reads.force and not force_known:
        remarks.append("no force was measured; the policy was trained with it")
    if saved.reads.view and card.view is None:
        remarks.append("there is no picture of the object; the policy was trained with one")
    if len(sensors) < len(saved.sensors):
        remarks.append(f"touched by {', '.join(sensors)} alone; the policy reads {', '.join(saved.sensors)}")
    return AskedTouch(
        name=name,
        touch=TouchInput(frames=of(clip.frames), force_n=of(clip.force_n), index=of(clip.frame_index), view=card.view),
        truth={a: words(saved, a)[level] for a, level in known.items()},
        remarks=tuple(remarks),
        force_known=force_known,
    )


def _shared(saved: SavedPolicy) -> list[str]:
    """Attributes of which the labels of records and a policy have the same levels."""
    return [name for name, levels in LEVELS.items() if name in saved.questions and len(words(saved, name)) == levels]
