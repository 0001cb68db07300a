"""`python -m sensors_io generate`."""

import dataclasses
import pathlib
from typing import Annotated

import tyro

from sensors_io import overview
from sensors_io.commands.console import OUT, progress_bar
from sensors_io.generate import generate_records
from sensors_io.records import RecordStore
from sensors_io.scenes.backend import require_backend
from sensors_io.scenes.config import SceneConfig
from sensors_io.schema import SENSORS
from sensors_io.units import Launcher


@dataclasses.dataclass(frozen=True, kw_only=True)
class Generate:
    """Generate scenes.  An interrupted generation resumes.

    `--objects 1000 --sequences 14700` is the set of the paper's size: 1.32 million records.
    """

    out: pathlib.Path
    """Directory of the records."""
    config: SceneConfig = dataclasses.field(default_factory=SceneConfig)
    launcher: Annotated[Launcher, tyro.conf.arg(name="")] = dataclasses.field(default_factory=Launcher)

    def run(self) -> int:
        require_backend()
        each = len(SENSORS) * self.config.frame_count
        with progress_bar("records") as progress:
            report = lambda done, total: progress(done * each, total * each)
            generate_records(self.config, self.out, progress=report, launcher=self.launcher)
        OUT.print(overview.summary_table(RecordStore(self.out)))
        return 0
