"""Octopi-1.5 (Yu et al., RSS 2025, arXiv 2507.09985): salient frames of GelSight Mini videos, rated per object.

    DIR/<sample>/data.json              object_id, object, properties, exploratory_procedure, split
    DIR/<sample>/tactile/<number>.jpg   the number counts the frames of the video from 1, with gaps

as its process_datasets.py writes it; DIR is its folder `samples`.  Hardness and roughness are means of people's ratings
from 0 to 10; the level is the third of that range in which the rating r lies, min(2, ⌊3 r / 10⌋), and the rating
itself is kept in `truth`.  On the 66 objects that PhysiCLeAR labels with three levels as well, this rule gives the same
level for 73 % (hardness) and 76 % (roughness), and one two levels off for 0 and 5 %.  Protrusion and material are not
rated.  A sample without properties, as those of other data sets that upstream pretrains on, is in the split
"unlabelled".  The frame rate is not stored: times are those of `RATE_HZ`.
"""

import dataclasses
import functools
import json
import math
import pathlib
from collections import Counter
from typing import Any

import numpy as np

from sensors_io.errors import MALFORMED
from sensors_io.importers.catalogue import Catalogue, Listed, Taken, fingerprint, require_files
from sensors_io.importers.keep import ImportSourceError, Keep, Skip
from sensors_io.importers.pictures import film, inside, natural, nominal_ns, numbered, read_pictures
from sensors_io.schema import UNKNOWN, ContactKey, ObjectCard, SchemaError

SENSOR = "gelsight_mini"
RATE_HZ = 30.0
"""That of the PhysiCLeAR videos."""

MOTION = {"pressing": "press", "rotating": "twist", "rotation": "twist"}
"""Sliding has no stated direction and is "free", as is everything else; the word itself is kept in `camera`."""

TOP_RATING = 10.0
RATED = ("hardness", "roughness")


def list_octopi(source: pathlib.Path, config: Keep) -> Catalogue:
    """Catalogue of a folder of samples.

    A sample without data.json, or whose data.json does not name its object, and an object whose samples contradict each
    other, are skipped.

    Raises:
      ImportSourceError: no sample there.
    """
    found = [path for path in inside(source) if path.parent.parent == source]
    samples = sorted(
        (path for path in found if path.name == "data.json" and path.is_file()), key=lambda path: natural(path.parent)
    )
    require_files(source, samples, "<sample>/data.json and <sample>/tactile/*.jpg")
    cards: dict[str, ObjectCard] = {}
    contacts, trials = [], Counter[tuple[str, str]]()
    named = {path.parent for path in samples}
    bare = sorted(path.parent.name for path in found if path.name == "tactile" and path.parent not in named)
    skipped = [Skip(name=name, reason="has no data.json") for name in bare]
    for path in samples:
        name = path.parent.name
        try:
            data = json.loads(path.read_text(encoding="utf-8-sig"))
            card = _card(data)
            if cards.setdefault(card.object_id, card) != card:
                raise ValueError(f"contradicts an earlier sample of {card.object_id}")
            motion = MOTION.get(data.get("exploratory_procedure", ""), "free")
            trial = trials[card.object_id, motion]
            key = ContactKey(object_id=card.object_id, site=0, motion=motion, trial=trial)
        except (*MALFORMED, SchemaError) as error:
            skipped.append(Skip(name=name, reason=f"data.json: {error}"))
            continue
        trials[card.object_id, motion] += 1
        contacts.append(Listed(key=key, name=name, read=functools.partial(_read, path.parent, key, data, config)))
    pictures = [file for path in samples for file in numbered(path.parent / "tactile")]
    return Catalogue(
        source="Octopi-1.5",
        licence="not stated by its authors; local use only",
        sensors=(SENSOR,),
        annotated=RATED,
        cards=cards,
        contacts=tuple(contacts),
        skipped=tuple(skipped),
        config=dataclasses.asdict(config),
        identity=fingerprint(source, pictures, config, samples),
    )


def level_of(rating: float) -> int:
    """Third of the range 0 … 10 in which a rating lies: 0, 1 or 2.

    Raises:
      ImportSourceError: outside the range.
    """
    if not 0 <= rating <= TOP_RATING:
        raise ImportSourceError(f"rating is {rating}: must lie in 0..{TOP_RATING:g}; correct data.json")
    return min(2, math.floor(3 * rating / TOP_RATING))


def _card(data: dict[str, Any]) -> ObjectCard:
    """Card of a sample's object."""
    ratings = {name: float(value) for name, value in data.get("properties", {}).items() if name in RATED}
    return ObjectCard(
        object_id=data["object_id"].removeprefix("physiclear_"),
        split=data["split"] if ratings else "unlabelled",
        labels={name: level_of(ratings[name]) if name in ratings else UNKNOWN for name in RATED},
        annotator="Octopi-1.5, mean rating per object, cut into thirds",
        truth={f"{name}_rating_of_10": rating for name, rating in ratings.items()},
        name=data.get("object", ""),
    )


def _read(folder: pathlib.Path, key: ContactKey, data: dict[str, Any], config: Keep) -> Taken:
    paths = [path for path in numbered(folder / "tactile") if path.stem.isdecimal()]
    others = sorted({path for path in inside(folder / "tactile") if path.is_file()} - {*paths})
    strange = tuple(Skip(name=f"tactile/{path.name}", reason="is not named <number>.jpg") for path in others)
    pictures = read_pictures(paths, config.positions(len(paths)), config)
    number = np.array([int(paths[i].stem) - 1 for i in pictures.index])
    camera = {
        "sample": folder.name,
        "exploratory_procedure": data.get("exploratory_procedure", ""),
        "clock": f"frame number at a nominal {RATE_HZ:g} Hz",
        "size_px": pictures.size_px,
    }
    sequence = film(
        key,
        SENSOR,
        gap=pictures.after_loss(),
        host_time_ns=nominal_ns(number, RATE_HZ),
        camera=camera,
        frames=pictures.frames,
    )
    return Taken(sequences=(sequence,), left_out=(*pictures.left_out, *strange))
