"""One shape for all sources: a catalogue lists what there is without decoding it, and one function imports it.

    catalogue = list_tvl(directory, ImportConfig())
    report = import_catalogue(catalogue, out)

A contact that cannot be read is left out and reported, and so is a single frame of one.  An import that was stopped or
killed goes on behind the contacts that it published; its report is the same as that of one that was never stopped.
"""

import dataclasses
import hashlib
import json
import pathlib
import re
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from collections.abc import Sequence as Seq
from typing import Any

from sensors_io.codec import require_storable
from sensors_io.importers.gel import NO_GEL, SourceGel
from sensors_io.importers.holdout import split_by_name
from sensors_io.importers.keep import ImportSourceError, Shares, Skip, UnreadableError, at_height
from sensors_io.importers.pictures import read_picture
from sensors_io.index import INDEX, Index
from sensors_io.records import RecordsExistError, RecordsMeta, RecordWriter
from sensors_io.schema import ATTRIBUTES, SPLITS, UNKNOWN, ContactKey, ObjectCard, SchemaError, Sequence

_VIEW_ROWS = 240  # of a stored view: twice what a clip shows
_NOTE, _IDENTITY = "left_out", "identity"


@dataclasses.dataclass(frozen=True, kw_only=True)
class Taken:
    """One contact as it was read: a sequence of each sensor, and what of it was left out."""

    sequences: tuple[Sequence, ...]
    left_out: tuple[Skip, ...] = ()


@dataclasses.dataclass(frozen=True, kw_only=True)
class Listed:
    """One contact of a source, not yet read.

    Args:
      key: its identity.
      name: its name in the source, for reports.
      read: reads it; raises UnreadableError.
      view: picture of the object, where there is one; that of the object's first contact is stored.
    """

    key: ContactKey
    name: str
    read: Callable[[], Taken]
    view: pathlib.Path | None = None


@dataclasses.dataclass(frozen=True, kw_only=True)
class Catalogue:
    """Contents of a source.

    Args:
      source, licence: as in the records' meta.
      sensors: names of its sensors.
      annotated: attributes that the source annotates at all.
      cards: one card per object, without view.
      contacts: in the order of import.
      skipped: what the listing left out already.
      config: how it is imported, for the records' notes.
      identity: hash of everything that decides what is imported, see `fingerprint`.
    """

    source: str
    licence: str
    sensors: tuple[str, ...]
    annotated: tuple[str, ...]
    cards: Mapping[str, ObjectCard]
    contacts: tuple[Listed, ...]
    skipped: tuple[Skip, ...]
    config: Mapping[str, Any]
    identity: str


@dataclasses.dataclass(frozen=True, kw_only=True)
class ImportReport:
    """Result of an import; it is stored in the notes of the records' meta.

    Args:
      contacts: contacts imported.
      objects: objects imported, by split.
      skipped: every file, frame or object left out.
      unlabelled: attributes that the source annotates and that it lacks on objects outside the split "unlabelled".
      unannotated: attributes that the source annotates on no object; they are `UNKNOWN`.
    """

    contacts: int
    objects: Mapping[str, int]
    skipped: tuple[Skip, ...]
    unlabelled: tuple[Skip, ...]
    unannotated: tuple[str, ...]


def import_catalogue(
    catalogue: Catalogue,
    out: pathlib.Path,
    *,
    gel: SourceGel = NO_GEL,
    progress: Callable[[int, int], None] | None = None,
) -> ImportReport:
    """Write what a catalogue lists as records in `out`; an interrupted import goes on, a finished one is kept.

    Args:
      catalogue: the source.
      out: directory of the records.
      gel: of its sensor, kept with the records.
      progress: called with the number of contacts done and their total.

    Raises:
      ImportSourceError: no contact of the source can be read, or a gel for several sensors.
      RecordsExistError: `out` holds other records, or the source changed since they were imported.
    """
    gel.require_one_sensor(catalogue.sensors)
    meta = RecordsMeta(
        source=catalogue.source,
        licence=catalogue.licence,
        config_hash=gel.identity(catalogue.identity),
        sensors=catalogue.sensors,
        notes={"config": catalogue.config, _IDENTITY: catalogue.identity},
    )
    _require_same_files(out, meta)
    with RecordWriter(out, meta=meta, resume=True) as writer:
        gel.store(out)
        run = _Run(writer, catalogue, gel, dict(writer.notes.get(_NOTE, {})))
        for n, listed in enumerate(catalogue.contacts):
            run.add(n, listed)
            if progress is not None:
                progress(n + 1, len(catalogue.contacts))
        report = run.report()
        if not report.contacts:
            skip = next(iter((*run.unread, *report.skipped)), None)
            first = "nothing is listed" if skip is None else f"{skip.name}: {skip.reason}"
            raise ImportSourceError(f"{catalogue.source}: no contact can be read; the first: {first}")
        writer.note(report=dataclasses.asdict(report))
    return report


def _require_same_files(out: pathlib.Path, meta: RecordsMeta) -> None:
    """Refuse to continue with a source that changed; other options of the import have a message of their own."""
    if not (out / INDEX).is_file():
        return
    before, now = Index.read(out).meta.notes, json.loads(json.dumps(meta.notes))
    if _IDENTITY in before and before[_IDENTITY] != now[_IDENTITY] and before["config"] == now["config"]:
        raise RecordsExistError(
            f"{out} was imported with these options when the source had other files, or by an earlier version, which "
            "read hidden files and no links: the name, size or time of change of one differs, or a table; choose "
            f"another directory, or delete {out} to import it anew"
        )


@dataclasses.dataclass
class _Run:
    """One import under way; `notes` are what was left out of stored contacts by number, published with them."""

    writer: RecordWriter
    catalogue: Catalogue
    gel: SourceGel
    notes: dict[str, list[dict[str, str]]]
    unread: list[Skip] = dataclasses.field(default_factory=list)
    named: dict[ContactKey, str] = dataclasses.field(default_factory=dict)

    def add(self, n: int, listed: Listed) -> None:
        """Import contact n of the catalogue if it is not there yet, or note why not."""
        if (first := self.named.setdefault(listed.key, listed.name)) != listed.name:
            self.unread.append(Skip(name=listed.name, reason=f"has the object, site and trial of {first}"))
            return
        if listed.key in self.writer:
            return
        try:
            taken = listed.read()
            sequences = [self.gel.kept(sequence) for sequence in taken.sequences]
            for sequence in sequences:
                require_storable(sequence)
        except (UnreadableError, SchemaError) as error:
            self.unread.append(Skip(name=listed.name, reason=str(error)))
            return
        left_out = list(taken.left_out)
        if listed.key.object_id not in self.writer.objects_done:
            card, missing = _with_view(self.catalogue.cards[listed.key.object_id], listed.view)
            left_out += missing
            self.writer.write_object(card)
        if left_out:
            self.notes[str(n)] = [dataclasses.asdict(skip) for skip in left_out]
            self.writer.note(**{_NOTE: self.notes})
        self.writer.write_contact(sequences)

    def report(self) -> ImportReport:
        """Report of recordings that were imported and left out."""
        done, cards = self.writer.objects_done, self.catalogue.cards
        empty = [Skip(name=name, reason="object without a readable contact") for name in cards if name not in done]
        kept = [card for name, card in cards.items() if name in done]
        frames = [Skip(**skip) for n in range(len(self.catalogue.contacts)) for skip in self.notes.get(str(n), [])]
        annotated = self.catalogue.annotated
        return ImportReport(
            contacts=self.writer.contacts_done,
            objects={split: sum(card.split == split for card in kept) for split in SPLITS},
            skipped=(*self.catalogue.skipped, *self.unread, *frames, *empty),
            unlabelled=tuple(
                Skip(name=card.object_id, reason=f"{attribute} is not annotated")
                for card in kept
                for attribute in annotated
                if card.split != "unlabelled" and card.labels.get(attribute, UNKNOWN) == UNKNOWN
            ),
            unannotated=tuple(a for a in ATTRIBUTES if a not in annotated),
        )


def fingerprint(root: pathlib.Path, files: Seq[pathlib.Path], config: Any, listings: Seq[pathlib.Path] = ()) -> str:
    """Hash of everything that decides what is imported: config, names, sizes and times of the files, whole listings.

    Args:
      root: directory of the source; where it lies does not matter, as long as a copy keeps the times of its files.
      files: recordings and pictures, below `root`; one that is absent counts as such.
      config: a dataclass.
      listings: tables and labels, read whole.
    """
    states = [(f.relative_to(root).as_posix(), *_state(f)) for f in files]
    digest = hashlib.sha256(json.dumps([type(config).__name__, dataclasses.asdict(config), states]).encode())
    for listing in listings:
        digest.update(listing.read_bytes())
    return digest.hexdigest()[:16]


def _state(file: pathlib.Path) -> tuple[int, ...]:
    """Bytes and time of the last change of a file; none of one that is absent."""
    if not file.is_file():
        return ()
    found = file.stat()
    return found.st_size, found.st_mtime_ns


def require_files(root: pathlib.Path, found: Seq[Any], expected: str) -> None:
    """Refuse a directory that does not hold the layout.

    Raises:
      ImportSourceError: saying what was expected there.
    """
    if not found:
        state = "holds none" if root.is_dir() else "is no directory"
        raise ImportSourceError(f"{root} {state}: expected {expected}; give the directory that holds them")


def plain_names(texts: Iterable[str], otherwise: str) -> dict[str, str]:
    """A name that a key may have for each text, another for each: a number follows where two would have the same."""
    plain = {text: re.sub(r"[^A-Za-z0-9.\-]+", "_", text).strip("_.-") or otherwise for text in texts}
    names = {text: text for text, name in plain.items() if text == name}
    taken, counts = set(names), Counter[str]()
    for text, name in plain.items():
        new = name
        while text not in names and new in taken:
            counts[name] += 1
            new = f"{name}_{counts[name] + 1}"
        taken.add(names.setdefault(text, new))
    return names


def bare_catalogue(
    root: pathlib.Path,
    contacts: Seq[Listed],
    files: Seq[pathlib.Path],
    config: Shares,
    *,
    source: str,
    licence: str,
    sensors: tuple[str, ...],
    skipped: Seq[Skip] = (),
    listings: Seq[pathlib.Path] = (),
) -> Catalogue:
    """The catalogue of objects that nobody annotated: split by their ids, named by them in words.

    Args:
      root: directory of the source.
      contacts: in the order of import; the objects are those that they name.
      files, listings: as `fingerprint` takes them.
      config: a dataclass, whose shares are held out.
      source, licence, sensors, skipped: as in `Catalogue`.
    """
    objects = (listed.key.object_id for listed in contacts)
    splits = split_by_name(objects, val_share=config.val_share, test_share=config.test_share)
    return Catalogue(
        source=source,
        licence=licence,
        sensors=sensors,
        annotated=(),
        cards={name: _bare_card(name, split) for name, split in splits.items()},
        contacts=tuple(contacts),
        skipped=tuple(skipped),
        config=dataclasses.asdict(config),
        identity=fingerprint(root, files, config, listings),
    )


def _bare_card(name: str, split: str) -> ObjectCard:
    return ObjectCard(object_id=name, split=split, labels={}, annotator="nobody", name=name.replace("_", " "))


def _with_view(card: ObjectCard, path: pathlib.Path | None) -> tuple[ObjectCard, list[Skip]]:
    if path is None:
        return card, []
    try:
        view = at_height(read_picture(path), _VIEW_ROWS)
    except UnreadableError as error:
        return card, [Skip(name=path.name, reason=f"view {error}")]
    return dataclasses.replace(card, view=view), []
