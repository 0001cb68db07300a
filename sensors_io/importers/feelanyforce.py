"""FeelAnyForce (Shahidzadeh et al., ICRA 2025, arXiv 2410.02048): a GelSight Mini, and an ATI reading of each picture.

    DIR/<table>.csv                        tactile, depth, FT
    DIR/<...>/<indenter>/tactile/<ms>.png  the pictures that it names, by their Unix time in ms

FT is "Fx Fy Fz Tx Ty Tz" in N and N·m, or empty where nothing was read.  A row without a full reading is reported; its
picture, where there is one, is kept with a force of 0 and flagged `INCOMPLETE`; a row that names no picture either is
left out as incomplete.  Pictures are found where the table says, or by their name in DIR/tactile.  The depth maps are
the vendor network's and are not imported, nor are the torques: they are about the force sensor's origin, whose place is
not published.

What the files do not say is the sign of pressing.  `pressing="infer"` takes it from the reading of the largest |Fz|,
because a gel can be pushed hard and hardly pulled; where no |Fz| of a table reaches `LEAST_PUSH_N` nothing was pressed
and the readings are kept as they are.  Readings in which pressing is positive are the reaction to the force on the gel
and are negated in all three components.  How x and y lie in the picture is not published either.

Rows come about a second apart: a table is a slow film of static presses, cut into pieces of `max_frames` rows.
"""

import collections
import dataclasses
import functools
import pathlib
from typing import Literal

import numpy as np

from sensors_io.importers.catalogue import Catalogue, Listed, Taken, bare_catalogue, require_files
from sensors_io.importers.keep import ImportConfig, ImportSourceError, Skip
from sensors_io.importers.pictures import film, read_pictures
from sensors_io.importers.tables import read_table
from sensors_io.schema import ContactKey, Flag

SENSOR = "gelsight_mini"
COLUMNS = ("tactile", "FT")
NO_FORCE = "has no six readings"
NO_ROW = "incomplete row: names no picture and has no reading"
_NS = 1_000_000  # of a millisecond
LEAST_PUSH_N = 1.0
"""Below it drift and noise may have either sign: 0.15 N in a recording that shows no contact."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class FeelAnyForceConfig(ImportConfig):
    """Selection of samples, and the sign of the readings' Fz that means pressing."""

    pressing: Literal["infer", "positive", "negative"] = "infer"


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Reading:
    """One picture and its reading."""

    indenter: str
    path: pathlib.Path
    time_ms: int
    force_n: tuple[float, ...] | None
    table: str


def list_feelanyforce(source: pathlib.Path, config: FeelAnyForceConfig) -> Catalogue:
    """Catalogue of the tables in a directory.

    A row whose picture has no time for a name is skipped, and so is one without a reading whose picture is absent.

    Raises:
      ImportSourceError: no table there, or one without the columns, or no row with a reading.
    """
    tables = sorted(path for path in source.glob("[!.]*") if path.suffix.lower() == ".csv")
    require_files(source, tables, "<table>.csv with the columns tactile, depth, FT")
    rows, skipped = _rows(source, tables)
    if not any(row.force_n for row in rows):
        raise ImportSourceError(f"{tables[0]} has no row with a picture and six readings; give a published table")
    fz_n = {table.name: [r.force_n[2] for r in rows if r.table == table.name and r.force_n] for table in tables}
    sign = {table: pressing_sign(values, config.pressing) for table, values in fz_n.items()}
    films = collections.defaultdict(list)
    for row in sorted(rows, key=lambda row: row.time_ms):
        films[row.indenter, row.table].append(row)
    contacts, trials = [], collections.Counter[str]()
    for (indenter, table), film_rows in films.items():
        for piece in config.pieces(len(film_rows)):
            key = ContactKey(object_id=indenter, site=0, motion="free", trial=trials[indenter])
            trials[indenter] += 1
            chosen = [film_rows[i] for i in piece]
            read = functools.partial(_read, key, chosen, sign[table], config)
            contacts.append(Listed(key=key, name=f"{table}: {chosen[0].path.name}", read=read))
    return bare_catalogue(
        source,
        contacts,
        [row.path for row in rows],
        config,
        source="FeelAnyForce",
        licence="not stated by its authors; local use only",
        sensors=(SENSOR,),
        skipped=skipped,
        listings=tables,
    )


def pressing_sign(fz_n: list[float], pressing: str) -> float:
    """Factor that makes readings the force on the gel, whose Fz is negative when pressed: −1 or 1.

    Args:
      fz_n: all Fz of one table.
      pressing: sign of pressing in the readings, or "infer".
    """
    if pressing != "infer":
        return -1.0 if pressing == "positive" else 1.0
    largest = max(fz_n, key=abs, default=0.0)
    return -1.0 if largest >= LEAST_PUSH_N else 1.0


def _rows(source: pathlib.Path, tables: list[pathlib.Path]) -> tuple[list[_Reading], list[Skip]]:
    rows, skipped = [], []
    for table in tables:
        for line, cells in enumerate(read_table(table, COLUMNS), start=2):
            name = pathlib.PurePosixPath(cells["tactile"])
            if not cells["tactile"].strip() and _force(cells["FT"]) is None:
                skipped.append(Skip(name=f"{table.name}, line {line}", reason=NO_ROW))
                continue
            dated = name.stem.isdecimal() and int(name.stem) * _NS < 2**63
            if not dated or len(name.parts) < 3 or name.is_absolute() or ".." in name.parts:
                reason = "names no <indenter>/tactile/<ms>.png"
                skipped.append(Skip(name=f"{table.name}, line {line}", reason=reason))
                continue
            stated, force_n = source / name, _force(cells["FT"])
            path = stated if stated.is_file() else source / "tactile" / name.name
            if force_n is None:
                reason = NO_FORCE if path.is_file() else f"{NO_FORCE}, and its picture is absent"
                skipped.append(Skip(name=f"{table.name}, line {line}", reason=reason))
            if force_n is not None or path.is_file():
                row = _Reading(
                    indenter=name.parts[-3], path=path, time_ms=int(name.stem), force_n=force_n, table=table.name
                )
                rows.append(row)
    return rows, skipped


def _force(cell: str) -> tuple[float, ...] | None:
    """Force of a reading, N; `None` where it is not six finite numbers."""
    try:
        reading = [float(value) for value in cell.split()]
    except ValueError:
        return None
    return tuple(reading[:3]) if len(reading) == 6 and np.isfinite(reading).all() else None


def _read(key: ContactKey, rows: list[_Reading], sign: float, config: FeelAnyForceConfig) -> Taken:
    pictures = read_pictures([row.path for row in rows], np.arange(len(rows)), config)
    kept = [rows[i] for i in pictures.index]
    camera = {"table": kept[0].table, "clock": "Unix time in the names, ms", "size_px": pictures.size_px}
    force_n = np.array([row.force_n or (0.0, 0.0, 0.0) for row in kept], np.float32)
    incomplete = np.array([row.force_n is None for row in kept])
    sequence = film(
        key,
        SENSOR,
        gap=pictures.after_loss(),
        host_time_ns=np.array([row.time_ms for row in kept], np.int64) * _NS,
        camera=camera | {"force_sign": sign},
        frames=pictures.frames,
        force_n=force_n * np.float32(sign),
    )
    flags = sequence.flags | np.where(incomplete, np.uint32(Flag.INCOMPLETE), np.uint32(0))
    return Taken(sequences=(dataclasses.replace(sequence, flags=flags),), left_out=pictures.left_out)
