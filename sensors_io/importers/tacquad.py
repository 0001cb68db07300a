"""TacQuad (Feng et al., ICLR 2025, arXiv 2502.12191): the same touch by GelSight Mini, DIGIT and DuraGel.

    DIR/data_{indoor,outdoor,fine}/<item>/{gelsight,digit,duragel}/<t>.png
    DIR/data_{indoor,outdoor,fine}/<item>/img_gelsight/<t>.png      the scene
    DIR/contact_{indoor,outdoor,fine}.csv                           without header: item, then first and last contact
                                                                    frame of gelsight, digit, duragel

An earlier release calls DuraGel tirgel and its tables contact_coarse.csv (indoor) and contact_out.csv.  The three
sequences of a row are one contact; they were taken one after the other and are aligned in place, not in time.  A robot
pressed for the fine part (motion "press"), hands moved the others ("free").  Frames from the first to the last of
contact are imported; Tac3D has no pictures there.  Levels were not annotated (the texts are GPT-4o's), and no rate is
published: times are those of `RATE_HZ`.
"""

import collections
import functools
import pathlib

import numpy as np

from sensors_io.importers.catalogue import Catalogue, Listed, Taken, bare_catalogue, require_files
from sensors_io.importers.keep import ImportConfig, Skip
from sensors_io.importers.pictures import PictureError, film, nominal_ns, numbered, read_pictures
from sensors_io.importers.tables import read_rows
from sensors_io.schema import ContactKey, SchemaError, Sequence

FOLDERS = {"gelsight_mini": ("gelsight",), "digit": ("digit",), "duragel": ("duragel", "tirgel")}
"""Names of each sensor's folder, in the order of the table's columns."""

TABLES = {
    "contact_indoor.csv": "data_indoor",
    "contact_coarse.csv": "data_indoor",
    "contact_outdoor.csv": "data_outdoor",
    "contact_out.csv": "data_outdoor",
    "contact_fine.csv": "data_fine",
}
RATE_HZ = 30.0
"""Nominal."""

_MOST_FRAMES = 10**6  # nine hours; a path is made for each


def list_tacquad(source: pathlib.Path, config: ImportConfig) -> Catalogue:
    """Catalogue of the tables in a directory; a row that is not an item and six frame numbers is skipped.

    Raises:
      ImportSourceError: no table with its folder there.
    """
    tables = [
        source / name for name, folder in TABLES.items() if (source / name).is_file() and (source / folder).is_dir()
    ]
    require_files(source, tables, f"one of {', '.join(TABLES)} with its data_indoor, data_outdoor or data_fine")
    contacts, trials = [], collections.Counter[str]()
    named = {TABLES[table.name] for table in tables}
    others = {folder: name for name, folder in reversed(TABLES.items()) if folder not in named}
    there = [folder for folder in others if (source / folder).is_dir()]
    skipped = [Skip(name=folder, reason=f"has no {others[folder]}") for folder in there]
    for table in tables:
        part = TABLES[table.name]
        for row in read_rows(table):
            try:
                item, spans = row[0].strip(), _spans(row[1:])
                name = f"{part.removeprefix('data_')}-{item.replace(' ', '_')}"
                motion = "press" if part == "data_fine" else "free"
                key = ContactKey(object_id=name, site=0, motion=motion, trial=trials[name])
            except (ValueError, SchemaError) as error:
                skipped.append(Skip(name=f"{table.name}: {','.join(row)}", reason=str(error)))
                continue
            trials[name] += 1
            folder = source / part / item
            read = functools.partial(_read, folder, key, spans, config)
            contacts.append(Listed(key=key, name=f"{part}/{item}", read=read, view=folder / "img_gelsight" / "0.png"))
    places = sorted({place for table in tables for place in (source / TABLES[table.name]).glob("*/*")})
    pictures = [path for place in places for path in numbered(place)]
    return bare_catalogue(
        source,
        contacts,
        pictures,
        config,
        source="TacQuad",
        licence="that of the download",
        sensors=tuple(FOLDERS),
        skipped=skipped,
        listings=tables,
    )


def _spans(cells: list[str]) -> dict[str, tuple[int, int]]:
    """First and last contact frame of each sensor."""
    numbers = [int(cell) for cell in cells]
    if len(numbers) != 2 * len(FOLDERS):
        raise ValueError(f"has {len(numbers)} numbers after the item: expected {2 * len(FOLDERS)}")
    if max(numbers) > _MOST_FRAMES:
        raise ValueError(f"names frame {max(numbers)}: must be ≤ {_MOST_FRAMES}")
    return {sensor: (numbers[2 * i], numbers[2 * i + 1]) for i, sensor in enumerate(FOLDERS)}


def _read(folder: pathlib.Path, key: ContactKey, spans: dict[str, tuple[int, int]], config: ImportConfig) -> Taken:
    sequences, left_out, reasons = [], [], []
    for sensor, (first, last) in spans.items():
        try:
            sequence, lost = _sequence(folder, key, sensor, range(first, last + 1), config)
        except PictureError as error:
            reasons.append(Skip(name=f"{folder.name}/{sensor}", reason=str(error)))
            continue
        sequences.append(sequence)
        left_out += lost
    if not sequences:
        raise PictureError("; ".join(f"{skip.name} {skip.reason}" for skip in reasons))
    return Taken(sequences=tuple(sequences), left_out=(*reasons, *left_out))


def _sequence(
    folder: pathlib.Path, key: ContactKey, sensor: str, numbers: range, config: ImportConfig
) -> tuple[Sequence, list[Skip]]:
    places = [folder / name for name in FOLDERS[sensor] if (folder / name).is_dir()]
    if not places:
        raise PictureError("has no folder")
    paths = [places[0] / f"{number}.png" for number in numbers]
    pictures = read_pictures(paths, config.positions(len(paths)), config)
    camera = {"clock": f"frame number at a nominal {RATE_HZ:g} Hz", "size_px": pictures.size_px}
    sequence = film(
        key,
        sensor,
        gap=pictures.after_loss(),
        host_time_ns=nominal_ns(np.array(numbers)[pictures.index], RATE_HZ),
        camera=camera,
        frames=pictures.frames,
    )
    return sequence, [Skip(name=f"{folder.name}/{skip.name}", reason=skip.reason) for skip in pictures.left_out]
