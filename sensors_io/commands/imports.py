"""`python -m sensors_io import`."""

import dataclasses
import json
import pathlib
import shlex
from typing import Annotated

import tyro

from sensors_io import overview
from sensors_io.commands.console import OUT, progress_bar
from sensors_io.exporters.exported import import_exported
from sensors_io.importers.catalogue import Catalogue, import_catalogue
from sensors_io.importers.estimate_modulus import list_estimate_modulus
from sensors_io.importers.feelanyforce import FeelAnyForceConfig, list_feelanyforce
from sensors_io.importers.gel import NO_GEL, SourceGel
from sensors_io.importers.hdf5 import HDF5Config, hdf5_files, list_hdf5
from sensors_io.importers.hdf5_inspect import inspect
from sensors_io.importers.hdf5_map import PLACEHOLDER
from sensors_io.importers.hdf5_read import HDF5Error
from sensors_io.importers.keep import ImportConfig, ImportSourceError, Keep, Shares
from sensors_io.importers.octopi import list_octopi
from sensors_io.importers.physiclear import PhysiclearConfig, list_physiclear
from sensors_io.importers.tac3d import list_tac3d
from sensors_io.importers.tacquad import list_tacquad
from sensors_io.importers.touch_and_go import list_touch_and_go
from sensors_io.importers.tvl import list_tvl
from sensors_io.importers.videos import VideosConfig, list_videos
from sensors_io.importers.vtv150k import VTVConfig, list_vtv150k
from sensors_io.importers.ycb_slide import list_ycb_slide
from sensors_io.records import RecordStore
from sensors_io.schema import SPLITS


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Paths:
    """From where to where."""

    source: tyro.conf.Positional[pathlib.Path]
    """Directory of the data set as it is published, or of your clips."""
    out: pathlib.Path
    """Directory of the records."""
    mm_per_px: float | None = None
    """Millimetres per pixel of the published pictures, for `check` and `extract`; kept at the size that is stored."""
    background: pathlib.Path | None = None
    """Picture of the gel at rest at the size of the published pictures, kept for `check` and `extract`."""

    def gel(self) -> SourceGel:
        """The gel of its sensor."""
        return SourceGel(mm_per_px=self.mm_per_px, background=self.background)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Physiclear(_Paths):
    """PhysiCLeAR: labels.json and videos/<object>_<trial>.mov."""

    config: PhysiclearConfig = dataclasses.field(default_factory=PhysiclearConfig)

    def catalogue(self) -> Catalogue:
        return list_physiclear(self.source, self.config)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Octopi(_Paths):
    """Octopi-1.5: <sample>/data.json and <sample>/tactile/*.jpg."""

    config: Keep = dataclasses.field(default_factory=Keep)

    def catalogue(self) -> Catalogue:
        return list_octopi(self.source, self.config)


@dataclasses.dataclass(frozen=True, kw_only=True)
class TouchAndGo(_Paths):
    """Touch and Go: label.txt and dataset/<session>/gelsight_frame/*.jpg."""

    config: ImportConfig = dataclasses.field(default_factory=ImportConfig)

    def catalogue(self) -> Catalogue:
        return list_touch_and_go(self.source, self.config)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Tvl(_Paths):
    """TVL, part HCT: data1/train.csv, data1/test.csv and the pictures that they name."""

    config: ImportConfig = dataclasses.field(default_factory=ImportConfig)

    def catalogue(self) -> Catalogue:
        return list_tvl(self.source, self.config)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Tacquad(_Paths):
    """TacQuad: contact_*.csv and data_*/<item>/{gelsight,digit,duragel}/*.png."""

    config: ImportConfig = dataclasses.field(default_factory=ImportConfig)

    def catalogue(self) -> Catalogue:
        return list_tacquad(self.source, self.config)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Vtv150k(_Paths):
    """VTV150K, videos of one sensor: <object>_<n>.mp4."""

    config: VTVConfig

    def catalogue(self) -> Catalogue:
        return list_vtv150k(self.source, self.config)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Feelanyforce(_Paths):
    """FeelAnyForce: tables of tactile, depth, FT and the pictures that they name."""

    config: FeelAnyForceConfig = dataclasses.field(default_factory=FeelAnyForceConfig)

    def catalogue(self) -> Catalogue:
        return list_feelanyforce(self.source, self.config)


@dataclasses.dataclass(frozen=True, kw_only=True)
class YcbSlide(_Paths):
    """YCB-Slide, real: <object>/dataset_<k>/frames/*.jpg and digit_data.npy."""

    config: ImportConfig = dataclasses.field(default_factory=ImportConfig)

    def catalogue(self) -> Catalogue:
        return list_ycb_slide(self.source, self.config)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Tac3d(_Paths):
    """Recordings of a Tac3D: <name>_<serial>.npz."""

    config: Shares = dataclasses.field(default_factory=Shares)

    def catalogue(self) -> Catalogue:
        return list_tac3d(self.source, self.config)


@dataclasses.dataclass(frozen=True, kw_only=True)
class EstimateModulus(_Paths):
    """EstimateModulus: <object>_<n>.avi with its forces and widths."""

    config: ImportConfig = dataclasses.field(default_factory=ImportConfig)

    def catalogue(self) -> Catalogue:
        return list_estimate_modulus(self.source, self.config)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Videos(_Paths):
    """Your own clips of one sensor: videos, or folders of pictures, and a table of labels."""

    config: VideosConfig

    def catalogue(self) -> Catalogue:
        return list_videos(self.source, self.config)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Hdf5:
    """HDF5 files of any layout, by a mapping of their paths, units and axes."""

    source: tyro.conf.Positional[pathlib.Path]
    """Directory of the files, or one file."""
    out: pathlib.Path = pathlib.Path("records")
    """Directory of the records."""
    inspect: tyro.conf.FlagCreatePairsOff[bool] = False
    """Print what the files contain, and a mapping to begin with, and import nothing."""
    config: HDF5Config = dataclasses.field(default_factory=HDF5Config)

    def catalogue(self) -> Catalogue:
        return list_hdf5(self.source, self.config)

    def show(self) -> int:
        """Print contents and proposal."""
        try:
            lines, proposal = inspect(hdf5_files(self.source))
        except HDF5Error as error:
            raise ImportSourceError(str(error)) from error
        for line in (*lines, "", f"A mapping; replace each {PLACEHOLDER!r}, and save it for --map:", ""):
            OUT.print(line, markup=False, highlight=False, soft_wrap=True)
        OUT.print(json.dumps(proposal, indent=2), markup=False, highlight=False, soft_wrap=True)
        return 0


@dataclasses.dataclass(frozen=True, kw_only=True)
class Exported:
    """LeRobotDataset, Zarr folder or HDF5 file that `export` wrote."""

    source: tyro.conf.Positional[pathlib.Path]
    """The export."""
    out: pathlib.Path
    """Directory of the records."""

    def run(self) -> int:
        """Write the records, and say what they hold."""
        with progress_bar("contacts") as progress:
            import_exported(self.source, self.out, progress)
        OUT.print(overview.summary_table(RecordStore(self.out)))
        return 0


DataSet = (
    Annotated[Videos, tyro.conf.subcommand("videos")]
    | Annotated[Hdf5, tyro.conf.subcommand("hdf5")]
    | Annotated[Exported, tyro.conf.subcommand("exported")]
    | Annotated[Physiclear, tyro.conf.subcommand("physiclear")]
    | Annotated[Octopi, tyro.conf.subcommand("octopi")]
    | Annotated[TouchAndGo, tyro.conf.subcommand("touch-and-go")]
    | Annotated[Tvl, tyro.conf.subcommand("tvl")]
    | Annotated[Tacquad, tyro.conf.subcommand("tacquad")]
    | Annotated[Vtv150k, tyro.conf.subcommand("vtv150k")]
    | Annotated[Feelanyforce, tyro.conf.subcommand("feelanyforce")]
    | Annotated[YcbSlide, tyro.conf.subcommand("ycb-slide")]
    | Annotated[Tac3d, tyro.conf.subcommand("tac3d")]
    | Annotated[EstimateModulus, tyro.conf.subcommand("estimate-modulus")]
)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Import:
    """Import published recordings, or your own.  An interrupted import resumes."""

    dataset: DataSet

    def run(self) -> int:
        if isinstance(self.dataset, Exported):
            return self.dataset.run()
        if isinstance(self.dataset, Hdf5) and self.dataset.inspect:
            return self.dataset.show()
        gel = self.dataset.gel() if isinstance(self.dataset, _Paths) else NO_GEL
        catalogue = self.dataset.catalogue()
        with progress_bar("contacts") as progress:
            report = import_catalogue(catalogue, self.dataset.out, gel=gel, progress=progress)
        OUT.print(overview.import_table(report))
        if any(report.objects[split] for split in SPLITS if split != "unlabelled"):
            train = (
                f"python -m experiments ablation_ordinal --data records --data-dir {shlex.quote(str(self.dataset.out))}"
            )
            OUT.print(f"to train on them: {train}", markup=False, highlight=False, soft_wrap=True)
        return 0
