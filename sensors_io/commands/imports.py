"""`python -m sensors_io import`."""

import dataclasses
import pathlib
from typing import Annotated

import tyro

from sensors_io import overview
from sensors_io.commands.console import OUT, progress_bar
from sensors_io.importers.physiclear import PhysiclearConfig, import_physiclear


@dataclasses.dataclass(frozen=True, kw_only=True)
class Physiclear:
    """Import the PhysiCLeAR videos.  An interrupted import goes on where it stopped."""

    source: tyro.conf.Positional[pathlib.Path]
    """Directory with labels.json and videos/."""
    out: pathlib.Path
    """Directory of the records."""
    config: PhysiclearConfig = dataclasses.field(default_factory=PhysiclearConfig)

    def run(self) -> int:
        with progress_bar("videos") as progress:
            report = import_physiclear(self.source, self.out, config=self.config, progress=progress)
        OUT.print(overview.import_table(report))
        return 0


@dataclasses.dataclass(frozen=True, kw_only=True)
class Import:
    """Import published recordings."""

    dataset: Annotated[Physiclear, tyro.conf.subcommand("physiclear")] | Annotated[None, tyro.conf.Suppress]

    def run(self) -> int:
        return self.dataset.run() if self.dataset else 2
