"""`python -m sensors_io export`."""

import dataclasses
import pathlib
from typing import Literal

import tyro

from sensors_io.commands.console import OUT, progress_bar
from sensors_io.exporters.arrays import export_arrays
from sensors_io.exporters.lerobot import export_lerobot
from sensors_io.exporters.ply import export_ply, ply_of_file
from sensors_io.exporters.rerun import export_rerun
from sensors_io.exporters.ros import export_rosbag
from sensors_io.exporters.selection import ExportError, Progress, Selected
from sensors_io.records import RecordStore


@dataclasses.dataclass(frozen=True, kw_only=True)
class Export:
    """Write records in the format of other programs: LeRobotDataset v3, Zarr, HDF5, Rerun, PLY or a bag of ROS 2.

    `import exported` reads the first three back, without loss.  Nothing is half-written.
    """

    records: tyro.conf.Positional[pathlib.Path]
    """Directory of the records; for ply also a file of `extract` (.npz)."""
    to: Literal["lerobot", "zarr", "hdf5", "rerun", "ply", "rosbag"]
    """lerobot, zarr, ply, rosbag: a folder; hdf5, rerun (.rrd): a file."""
    out: pathlib.Path
    """Folder or file to write; must not exist yet."""
    contacts: tuple[int, ...] = ()
    """Numbers of the contacts, from 0, in the order of the records; default: all."""
    sensors: tuple[str, ...] = ()
    """Names of the sensors; default: all."""
    fps: int = 0
    """lerobot: nominal frame rate; default: that of the first contact."""
    points: bool = False
    """ply: a point cloud instead of a mesh."""

    def run(self) -> int:
        for name, target in (("fps", "lerobot"), ("points", "ply")):
            if getattr(self, name) and self.to != target:
                raise ExportError(f"--{name} is of --to {target}, --to is {self.to}: leave it out")
        if not 0 <= self.fps <= 10_000:
            raise ExportError(
                f"--fps is {self.fps}: must lie in 1 … 10,000, or 0 for that of the first contact; correct it"
            )
        if self.records.is_dir() and self.out.resolve().is_relative_to(self.records.resolve()):
            raise ExportError(
                f"--out is {self.out}: lies in the folder of the records, which holds nothing else; name a path outside"
            )
        if self.to == "ply" and self.records.suffix == ".npz":
            count = ply_of_file(self.records, self.out, self.points)
            OUT.print(f"wrote {count} surfaces to {self.out}", highlight=False)
            return 0
        selected = Selected(store=RecordStore(self.records), rows=self.contacts, sensors=self.sensors)
        with progress_bar("contacts") as progress:
            self._write(selected, progress)
        OUT.print(f"wrote {len(selected.numbers)} contacts to {self.out}", highlight=False)
        return 0

    def _write(self, selected: Selected, progress: Progress) -> None:
        if self.to == "lerobot":
            export_lerobot(selected, self.out, self.fps, progress)
        elif self.to == "rerun":
            export_rerun(selected, self.out, progress)
        elif self.to == "ply":
            export_ply(selected, self.out, self.points, progress)
        elif self.to == "rosbag":
            export_rosbag(selected, self.out, progress)
        else:
            export_arrays(selected, self.out, self.to, progress)
