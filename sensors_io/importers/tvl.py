"""TVL, its part HCT (Fu et al., ICML 2024, arXiv 2402.13232): DIGIT and webcam pairs in the wild, with captions.

    DIR/{data1,data2,data3}/{train,test}.csv              url, tactile, tactile_background, caption
    DIR/data1/<n>-<epoch>/{tactile,vision}/<i>-<gap>.jpg  the pictures that they name

DIR is the folder `hct`, or one of its parts.  Of some trajectories the published folders are swapped: a row whose
"tactile" picture has not the 320 × 240 pixels of a DIGIT while its "vision" picture has is turned round.  Objects have
no identity: a trajectory is one, and splits are by trajectory, not upstream's, which tear trajectories apart.  Captions
(of GPT-4V in train.csv, of people in test.csv) are kept in `camera`; levels were not annotated.  Frames of a trajectory
are those with a row, in the order of <i>; the time between them is not published, so that times are those of `RATE_HZ`.
"""

import collections
import dataclasses
import functools
import pathlib

import numpy as np

from sensors_io.importers.catalogue import Catalogue, Listed, Taken, bare_catalogue, require_files
from sensors_io.importers.keep import ImportConfig, ImportSourceError, Skip
from sensors_io.importers.pictures import PictureError, film, inside, natural, nominal_ns, read_picture, read_pictures
from sensors_io.importers.tables import read_table
from sensors_io.schema import ContactKey

SENSOR = "digit"
RATE_HZ = 30.0
"""Nominal rate of the numbers <i>."""

COLUMNS = ("url", "tactile", "tactile_background", "caption")
_DIGIT_PX = (240, 320)


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Pair:
    """One pair: its pictures, its caption, and the table that names it."""

    tactile: pathlib.Path
    vision: pathlib.Path
    caption: str
    table: str


def list_tvl(source: pathlib.Path, config: ImportConfig) -> Catalogue:
    """Catalogue of the tables in a directory; a row that leaves its directory or names no trajectory is skipped.

    Raises:
      ImportSourceError: no table there, or one without the columns.
    """
    found = (path for path in inside(source) if source in (path.parent, path.parent.parent))
    tables = sorted(path for path in found if path.name.lower() in ("train.csv", "test.csv"))
    require_files(source, tables, "train.csv or test.csv, in it or in data1, data2, data3")
    trajectories, skipped = _trajectories(source, tables)
    contacts = []
    for name, rows in trajectories.items():
        rows = sorted(rows, key=lambda row: natural(row.tactile))
        key = ContactKey(object_id=name, site=0, motion="free", trial=0)
        read = functools.partial(_read, key, rows, config)
        contacts.append(Listed(key=key, name=name, read=read, view=_vision(rows[0])))
    pictures = [path for rows in trajectories.values() for row in rows for path in (row.tactile, row.vision)]
    return bare_catalogue(
        source,
        contacts,
        pictures,
        config,
        source="TVL, HCT",
        licence="that of the download",
        sensors=(SENSOR,),
        skipped=skipped,
        listings=tables,
    )


def _trajectories(source: pathlib.Path, tables: list[pathlib.Path]) -> tuple[dict[str, list[_Pair]], list[Skip]]:
    found: dict[str, list[_Pair]] = collections.defaultdict(list)
    skipped = []
    for table in tables:
        name = table.name.lower()
        for row in read_table(table, COLUMNS):
            tactile, vision = pathlib.PurePosixPath(row["tactile"]), pathlib.PurePosixPath(row["url"])
            strays = (
                tactile.is_absolute()
                or vision.is_absolute()
                or len(tactile.parts) != 3
                or len(vision.parts) != 3
                or ".." in (*tactile.parts, *vision.parts)
            )
            if strays or not tactile.name[0].isdecimal():
                reason = "is no <trajectory>/{tactile,vision}/<i>-<gap>.jpg"
                skipped.append(Skip(name=f"{table.parent.name}/{table.name}: {row['tactile']}", reason=reason))
                continue
            part = "" if table.parent == source else f"{table.parent.name}-"
            pair = _Pair(
                tactile=table.parent / tactile, vision=table.parent / vision, caption=row["caption"], table=name
            )
            found[part + tactile.parts[0]].append(pair)
    if not found:
        raise ImportSourceError(f"{tables[0]} names no pair: expected <trajectory>/tactile/<picture> in `tactile`")
    return found, skipped


def _read(key: ContactKey, rows: list[_Pair], config: ImportConfig) -> Taken:
    positions = config.positions(len(rows))
    turned = {i for i in positions.tolist() if _swapped(rows[i])}
    paths = [row.vision if i in turned else row.tactile for i, row in enumerate(rows)]
    pictures = read_pictures(paths, positions, config)
    number = [int(natural(rows[i].tactile)[0][1]) for i in pictures.index]
    camera = {
        "captions": [rows[i].caption for i in pictures.index],
        "captioned_by": ["people" if rows[i].table == "test.csv" else "GPT-4V" for i in pictures.index],
        "turned_round": len(turned),
        "clock": f"number in the name at a nominal {RATE_HZ:g} Hz",
        "size_px": pictures.size_px,
    }
    sequence = film(
        key,
        SENSOR,
        gap=pictures.after_loss(),
        host_time_ns=nominal_ns(np.array(number), RATE_HZ),
        camera=camera,
        frames=pictures.frames,
    )
    return Taken(sequences=(sequence,), left_out=pictures.left_out)


def _swapped(row: _Pair) -> bool:
    """True if the picture called vision is the DIGIT's."""
    return not _of_digit(row.tactile) and _of_digit(row.vision)


def _vision(row: _Pair) -> pathlib.Path:
    return row.tactile if _swapped(row) else row.vision


def _of_digit(path: pathlib.Path) -> bool:
    try:
        rows, columns = read_picture(path).shape[:2]
    except PictureError:
        return False
    return (min(rows, columns), max(rows, columns)) == _DIGIT_PX
