"""VTV150K (Xie et al., arXiv 2505.22566): videos of hand-held objects by GelSight Mini, DIGIT or Tac3D.

    DIR/<object>_<n>.mp4

The names do not say which sensor took a video, so that the videos of each sensor are imported apart, with its name.
Levels are published as questions and answers, not as a table: they stay unknown.
"""

import dataclasses
import functools
import pathlib
import re

import numpy as np

from sensors_io.importers.catalogue import Catalogue, Listed, Taken, bare_catalogue, require_files
from sensors_io.importers.keep import ImportConfig, Skip
from sensors_io.importers.pictures import film, natural, nominal_ns
from sensors_io.importers.video import read_video
from sensors_io.schema import ContactKey

_NAME = re.compile(r"([A-Za-z0-9][A-Za-z0-9_.\-]*)_(\d{1,9})")


@dataclasses.dataclass(frozen=True, kw_only=True)
class VTVConfig(ImportConfig):
    """Selection, and the sensor that took the videos of the directory, such as gelsight_mini, digit or tac3d."""

    sensor: str


def list_vtv150k(source: pathlib.Path, config: VTVConfig) -> Catalogue:
    """Catalogue of a flat directory of videos of one sensor; a video of another name is skipped.

    Raises:
      ImportSourceError: no .mp4 there.
    """
    videos = sorted((path for path in source.glob("[!.]*") if path.suffix.lower() == ".mp4"), key=natural)
    require_files(source, videos, "<object>_<n>.mp4")
    named = [(path, match) for path in videos if (match := _NAME.fullmatch(path.stem))]
    skipped = [Skip(name=p.name, reason="is not named <object>_<n>") for p in videos if not _NAME.fullmatch(p.stem)]
    contacts = []
    for path, match in named:
        key = ContactKey(object_id=match[1], site=0, motion="free", trial=int(match[2]))
        contacts.append(Listed(key=key, name=path.name, read=functools.partial(_read, path, key, config)))
    return bare_catalogue(
        source,
        contacts,
        videos,
        config,
        source=f"VTV150K, {config.sensor}",
        licence="not stated by its authors; local use only",
        sensors=(config.sensor,),
        skipped=skipped,
    )


def _read(path: pathlib.Path, key: ContactKey, config: VTVConfig) -> Taken:
    video = read_video(path, config)
    sequence = film(
        key,
        config.sensor,
        gap=np.zeros(len(video.index), np.bool_),
        host_time_ns=nominal_ns(video.index, video.rate_hz),
        camera=video.camera(path),
        frames=video.frames,
    )
    return Taken(sequences=(sequence,))
