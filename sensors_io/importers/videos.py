"""Somebody's own clips of one sensor, and a table that labels them.

    FOLDER/press_1.mp4, FOLDER/mug/2.avi    each video is a clip, wherever it lies in FOLDER
    FOLDER/cup_3/*.png                      each folder of pictures is a clip, in the order of the numbers in the names
    labels.csv                              clip,object_id,hardness,…

A clip is named by its path in FOLDER, with or without the ending of its file, and FOLDER itself by its own name.  All
columns of the table but `clip` may be missing.  Without `object_id` every clip is an object of its own, named after its
file.  Clips state no force and no motion, which is "free".
"""

import dataclasses
import functools
import mimetypes
import pathlib
import unicodedata
from collections import Counter
from collections.abc import Container, Iterator, Mapping
from collections.abc import Sequence as Seq

import numpy as np

from sensors_io.importers.catalogue import Catalogue, Listed, Taken, fingerprint, plain_names, require_files
from sensors_io.importers.holdout import split_by_name
from sensors_io.importers.keep import LEAST_HZ, MOST_HZ, ImportConfig, ImportSourceError, Skip
from sensors_io.importers.label_table import COLUMNS, ID, NAME, SPLIT, LabelRow, LabelsError, read_labels
from sensors_io.importers.pictures import film, inside, natural, nominal_ns, numbered, read_pictures
from sensors_io.importers.video import read_video
from sensors_io.schema import ATTRIBUTES, ContactKey, ObjectCard, SchemaError

CLIP = "clip"
"""Column of the table that names a clip."""

SUFFIXES = (".mp4", ".avi", ".mov", ".mkv", ".webm", ".m4v")
"""Of videos."""

_KINDS = f"videos ({', '.join(SUFFIXES)}) or pictures (.jpg, .jpeg, .png)"


@dataclasses.dataclass(frozen=True, kw_only=True)
class VideosConfig(ImportConfig):
    """Selection of frames and objects, and what the files do not say.

    Args:
      sensor: that took the clips, such as gelsight_mini or digit.
      labels: CSV table of labels; without one, all objects are unlabelled.
      annotator: name of who labelled.
      licence: of the clips.
      rate_hz: of pictures in a folder; a video states its own.
    """

    sensor: str
    labels: pathlib.Path | None = None
    annotator: str = "not named"
    licence: str = "all rights reserved"
    rate_hz: float = 30.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if not LEAST_HZ <= self.rate_hz <= MOST_HZ:
            raise ImportSourceError(
                f"rate_hz is {self.rate_hz}: must lie in {LEAST_HZ:g} … {MOST_HZ:g}; give that of the pictures"
            )


def list_videos(source: pathlib.Path, config: VideosConfig) -> Catalogue:
    """Catalogue of the clips of a folder; with a table, of those that it names.

    Labelled objects without a split are dealt out by their ids, one at least to val and to test from three on.

    Raises:
      ImportSourceError: no clip there.
      LabelsError: as `read_labels`; a clip that is not there, or rows of one object that contradict each other.
    """
    clips = _clips(source)
    require_files(source, clips, f"{_KINDS}, folders of them")
    named = {(p.relative_to(source).as_posix() if p != source else p.resolve().name): p for p in clips}
    rows = {} if config.labels is None else read_labels(config.labels, CLIP, (CLIP, *COLUMNS))
    if config.labels is not None and not rows:
        raise LabelsError(f"{config.labels} has no row: must list clips; complete it, or leave --labels out")
    by_name: dict[str, list[str]] = {}
    for clip in named:
        for known in {clip, _plain(clip)}:
            by_name.setdefault(_composed(known), []).append(clip)
    row_of: dict[str, LabelRow] = {}
    for name, row in rows.items():
        if row_of.setdefault(found := _find(name, row, by_name, source), row) is not row:
            raise LabelsError(f"{row.place}: {CLIP} {name!r} is {found}, as in {row_of[found].place}; keep one line")
    names = plain_names(map(_plain, named), CLIP)
    objects = {clip: _given(row_of.get(clip)) or names[_plain(clip)] for clip in named}  # as in mug_2 for mug/2.mp4
    _require_own(row_of, objects)
    cards = _cards(row_of, objects, config)
    contacts, trials = [], Counter[str]()
    for name, path in named.items():
        if rows and name not in row_of:
            continue
        object_id = objects[name]
        key = ContactKey(object_id=object_id, site=0, motion="free", trial=trials[object_id])
        trials[object_id] += 1
        contacts.append(Listed(key=key, name=name, read=functools.partial(_read, path, key, config)))
    files = [file for path in clips for file in ([path] if path.is_file() else numbered(path))]
    unlisted = f"is not listed in {config.labels}"
    skipped = [Skip(name=name, reason=unlisted) for name in named if rows and name not in row_of]
    return Catalogue(
        source=f"own clips, {config.sensor}",
        licence=config.licence,
        sensors=(config.sensor,),
        annotated=tuple(a for a in ATTRIBUTES if any(a in card.labels for card in cards.values())),
        cards=cards,
        contacts=tuple(contacts),
        skipped=(*skipped, *_of_other_kinds(source, {*files, *clips})),
        config=dataclasses.asdict(config) | {"labels": None if config.labels is None else config.labels.name},
        identity=fingerprint(
            source,
            files,
            dataclasses.replace(config, labels=None),
            () if config.labels is None else (config.labels,),
        ),
    )


def _clips(source: pathlib.Path) -> list[pathlib.Path]:
    """Videos and folders of pictures, the folder itself last, in the order of the numbers in their names."""
    if not source.is_dir():
        return []
    parts = lambda path: [natural(part) for part in (*reversed(path.parents), path)]
    found = sorted(inside(source), key=lambda path: (parts(path.parent.relative_to(source)), natural(path)))
    return [p for p in (*found, source) if (p.is_file() and p.suffix.lower() in SUFFIXES) or numbered(p)]


def _of_other_kinds(source: pathlib.Path, taken: Container[pathlib.Path]) -> Iterator[Skip]:
    """Pictures and videos that are read by other programs alone."""
    for path in sorted(inside(source)):
        if path not in taken and (mimetypes.guess_type(path.name)[0] or "").startswith(("image/", "video/")):
            name = path.relative_to(source).as_posix()
            problem = f"is not read: must be of {_KINDS}; convert it" if path.exists() else "is a link to nothing"
            yield Skip(name=name, reason=problem)


def _find(name: str, row: LabelRow, by_name: Mapping[str, Seq[str]], source: pathlib.Path) -> str:
    """The clip that a row names; `by_name` has the clips of every name, with and without the ending of a file."""
    found = by_name.get(_composed(name).strip("/"), ())
    if len(found) == 1:
        return found[0]
    state = f"stands for {' and '.join(found)}: must be one clip" if found else f"is no clip of {source}"
    near = f", such as {next(iter(by_name.values()))[0]}" if not found else ""
    raise LabelsError(f"{row.place}: {CLIP} is {name!r}: {state}; give its path in the folder{near}")


def _composed(name: str) -> str:
    """A name with each accent in its letter: macOS writes them apart."""
    return unicodedata.normalize("NFC", name)


def _given(row: LabelRow | None) -> str:
    """The object that a row names."""
    return "" if row is None else row.cells.get(ID, "")


def _require_own(row_of: Mapping[str, LabelRow], objects: Mapping[str, str]) -> None:
    """Refuse a clip without an object that would become the object of another line."""
    given = {_given(row) for row in row_of.values()}
    for clip, row in row_of.items():
        if not _given(row) and objects[clip] in given:
            raise LabelsError(
                f"{row.place}: {CLIP} {clip!r} has no {ID} and would be {objects[clip]!r}, the object of another line: "
                f"must be one of its own; give it an {ID}"
            )


def _plain(clip: str) -> str:
    """The name of a clip without the ending of a video."""
    path = pathlib.PurePosixPath(clip)
    return str(path.with_suffix("")) if path.suffix.lower() in SUFFIXES else clip


def _cards(row_of: Mapping[str, LabelRow], objects: Mapping[str, str], config: VideosConfig) -> dict[str, ObjectCard]:
    """A card for each object, with what the rows of its clips say."""
    cards: dict[str, ObjectCard] = {}
    for clip in row_of or objects:
        row, unlabelled = row_of.get(clip), "unlabelled"
        name = objects[clip]
        try:
            card = ObjectCard(
                object_id=name,
                split=unlabelled if row is None else row.split(name, unlabelled),
                labels={} if row is None else row.labels(name),
                annotator="nobody" if row is None else config.annotator,
                name=name.replace("_", " ") if row is None else row.cells.get(NAME) or name.replace("_", " "),
            )
        except SchemaError as error:
            raise LabelsError(f"{clip if row is None else row.place}: {error}") from error
        if row is not None and cards.setdefault(name, card) != card:
            raise LabelsError(
                f"{row.place}: {name!r} has {_columns(card)}, an earlier line {_columns(cards[name])}: an object has "
                "one of each; correct one of the lines"
            )
        cards.setdefault(name, card)
    given = {objects[clip] for clip, row in row_of.items() if row.cells.get(SPLIT)}
    new = [name for name, card in cards.items() if card.labels and name not in given]
    least = 1 / len(new) if len(new) > 2 else 0.0
    shares = {share: max(x, least) if (x := getattr(config, share)) else 0.0 for share in ("val_share", "test_share")}
    splits = split_by_name(new, **shares)
    return {name: dataclasses.replace(card, split=splits.get(name, card.split)) for name, card in cards.items()}


def _columns(card: ObjectCard) -> str:
    columns = {**card.labels, SPLIT: card.split, NAME: card.name}
    return ", ".join(f"{name} {value}" for name, value in columns.items())


def _read(path: pathlib.Path, key: ContactKey, config: VideosConfig) -> Taken:
    if path.is_file():
        video = read_video(path, config)
        gap = np.zeros(len(video.index), np.bool_)
        camera = video.camera(path)
        sequence = film(key, config.sensor, gap=gap, host_time_ns=video.time_ns, camera=camera, frames=video.frames)
        return Taken(sequences=(sequence,))
    paths = numbered(path)
    pictures = read_pictures(paths, config.positions(len(paths)), config)
    gap, times = pictures.after_loss(), nominal_ns(pictures.index, config.rate_hz)
    camera = {"folder": path.name, "rate_hz": config.rate_hz, "size_px": pictures.size_px, "frames": len(paths)}
    sequence = film(key, config.sensor, gap=gap, host_time_ns=times, camera=camera, frames=pictures.frames)
    return Taken(sequences=(sequence,), left_out=pictures.left_out)
