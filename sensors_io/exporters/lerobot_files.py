"""Files of a LeRobotDataset v3: Parquet tables and videos of several episodes each, and the tables that find them."""

import json
import pathlib
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from sensors_io.exporters.selection import ExportError, library

VERSION = "v3.0"
FRAMES_PER_FILE, FILES_PER_CHUNK = 10_000, 1000
KEY_FRAMES = 8
"""Frames between two that decode alone: a reader that seeks decodes at most as many."""

_FILE = "chunk-{chunk_index:03d}/file-{file_index:03d}"
_DATA, _VIDEO = f"data/{_FILE}.parquet", f"videos/{{video_key}}/{_FILE}.mp4"
_EPISODES, _TASKS = f"meta/episodes/{_FILE}.parquet", "meta/tasks.parquet"
_INFO, _STATS = "meta/info.json", "meta/stats.json"
_COUNTS = ("timestamp", "frame_index", "episode_index", "index", "task_index")
_CODEC, _PIXELS = "libx264rgb", "rgb24"
_LOSSLESS = {"qp": "0", "preset": "veryfast", "g": str(KEY_FRAMES), "bf": "0"}

_TEXT = {"pandas_type": "unicode", "numpy_type": "object", "metadata": None}
_NUMBER = {"pandas_type": "int64", "numpy_type": "int64", "metadata": None}
_TASK_INDEX = {
    "index_columns": ["task"],
    "column_indexes": [{"name": None, "field_name": None, **_TEXT}],
    "columns": [
        {"name": "task_index", "field_name": "task_index", **_NUMBER},
        {"name": "task", "field_name": "task", **_TEXT},
    ],
}
"""By which pandas, and so LeRobot, finds the number of a task by its text."""


def feature(array: np.ndarray) -> dict[str, Any]:
    """Entry of a column [N, …] in `info.json`."""
    shape = list(array.shape[1:]) or [1]
    if array.dtype == np.uint8 and array.ndim == 4:
        return {"dtype": "video", "shape": shape, "names": ["height", "width", "channels"]}
    return {"dtype": str(array.dtype), "shape": shape, "names": None}


class EpisodeFiles:
    """Writer of a data set, one episode after the other.

    Args:
      root: folder, created.
      features: of the columns.
      fps: nominal frame rate.
    """

    def __init__(self, root: pathlib.Path, features: Mapping[str, dict[str, Any]], fps: int):
        self._pa, self._pq, self._av = (library(name, "lerobot") for name in ("pyarrow", "pyarrow.parquet", "av"))
        self.features, self._root, self._fps = dict(features), root, fps
        self._episodes: list[dict[str, Any]] = []
        self._stats: dict[str, _Moments] = {}
        self._file, self._in_file, self._total = -1, 0, 0
        self._table: Any = None
        self._videos: dict[str, tuple[Any, Any]] = {}

    def add(self, columns: Mapping[str, np.ndarray], task: str, task_index: int) -> None:
        """Append an episode: columns [N, …] named as the features."""
        count = len(next(iter(columns.values())))
        if self._file < 0 or self._in_file + count > FRAMES_PER_FILE:
            self._next_file()
        episode, number = len(self._episodes), np.arange(count)
        counts: dict[str, np.ndarray] = {
            "timestamp": (number / self._fps).astype(np.float32),
            "frame_index": number,
            "episode_index": np.full(count, episode),
            "index": self._total + number,
            "task_index": np.full(count, task_index),
        }
        for name, array in {**columns, **counts}.items():
            self._stats.setdefault(name, _Moments(name in self._videos)).add(array)
        data = {n: x for n, x in columns.items() if n not in self._videos}
        self._table.write_table(self._arrow(data | counts))
        for name in self._videos:
            self._film(name, columns[name])
        where = {"chunk_index": self._file // FILES_PER_CHUNK, "file_index": self._file % FILES_PER_CHUNK}
        row = {"episode_index": episode, "tasks": [task], "length": count}
        row |= {f"data/{key}": value for key, value in where.items()}
        row |= {"dataset_from_index": self._total, "dataset_to_index": self._total + count}
        for name in self._videos:
            row |= {f"videos/{name}/{key}": value for key, value in where.items()}
            row[f"videos/{name}/from_timestamp"] = self._in_file / self._fps
            row[f"videos/{name}/to_timestamp"] = (self._in_file + count) / self._fps
        self._episodes.append(row | {"meta/episodes/chunk_index": 0, "meta/episodes/file_index": 0})
        self._in_file, self._total = self._in_file + count, self._total + count

    def close(self, tasks: Mapping[str, int]) -> None:
        """Finish the files and write the tables that find episodes in them."""
        self._end_file()
        write_table(self._root / _EPISODES.format(chunk_index=0, file_index=0), self._episodes)
        rows = [{"task_index": number, "task": task} for task, number in tasks.items()]
        write_table(self._root / _TASKS, rows, {b"pandas": json.dumps(_TASK_INDEX).encode()})
        plain = {"float32": ["timestamp"], "int64": list(_COUNTS[1:])}
        counted = {n: {"dtype": t, "shape": [1], "names": None} for t, names in plain.items() for n in names}
        info = {
            "codebase_version": VERSION,
            "robot_type": None,
            "total_episodes": len(self._episodes),
            "total_frames": self._total,
            "total_tasks": len(tasks),
            "chunks_size": FILES_PER_CHUNK,
            "fps": self._fps,
            "splits": {"train": f"0:{len(self._episodes)}"},
            "data_path": _DATA,
            "video_path": _VIDEO,
            "features": {**{n: self._described(n) for n in self.features}, **counted},
        }
        (self._root / _INFO).write_text(json.dumps(info, indent=2), encoding="utf-8")
        stats = {name: moments.figures() for name, moments in self._stats.items()}
        (self._root / _STATS).write_text(json.dumps(stats), encoding="utf-8")

    def abandon(self) -> None:
        """Write no more: a table that the disk did not take would be closed, and fail, once more when it is freed."""
        if self._table is not None:
            self._table.is_open = False

    def _described(self, name: str) -> dict[str, Any]:
        entry = self.features[name]
        if entry["dtype"] != "video":
            return entry
        height, width, channels = entry["shape"]
        info = {"height": height, "width": width, "channels": channels, "codec": "h264", "pix_fmt": "gbrp"}
        details = {f"video.{key}": value for key, value in {**info, "fps": self._fps, "g": KEY_FRAMES}.items()}
        return {**entry, "info": {**details, "video.is_depth_map": False, "is_depth_map": False, "has_audio": False}}

    def _next_file(self) -> None:
        self._end_file()
        self._file, self._in_file = self._file + 1, 0
        where = {"chunk_index": self._file // FILES_PER_CHUNK, "file_index": self._file % FILES_PER_CHUNK}
        path = self._root / _DATA.format(**where)
        path.parent.mkdir(parents=True, exist_ok=True)
        self._table = self._pq.ParquetWriter(path, self._schema())
        for name, entry in self.features.items():
            if entry["dtype"] == "video":
                path = self._root / _VIDEO.format(video_key=name, **where)
                path.parent.mkdir(parents=True, exist_ok=True)
                film = self._av.open(str(path), "w")
                stream = film.add_stream(_CODEC, rate=self._fps, options=_LOSSLESS)
                stream.height, stream.width, stream.pix_fmt = entry["shape"][0], entry["shape"][1], _PIXELS
                self._videos[name] = film, stream

    def _end_file(self) -> None:
        if self._table is not None:
            self._table.close()
        for film, stream in self._videos.values():
            film.mux(stream.encode(None))
            film.close()

    def _film(self, name: str, frames: np.ndarray) -> None:
        film, stream = self._videos[name]
        for n, picture in enumerate(frames):
            frame = self._av.VideoFrame.from_ndarray(np.ascontiguousarray(picture), format=_PIXELS)
            frame.pts = self._in_file + n
            film.mux(stream.encode(frame))

    def _schema(self) -> Any:
        pa = self._pa
        fields = []
        for name, entry in self.features.items():
            if entry["dtype"] != "video":
                shape, kind = entry["shape"], pa.from_numpy_dtype(entry["dtype"])
                details = None
                if len(shape) > 1:  # the types of the library `datasets`, by which LeRobot reads them
                    details = {
                        "ARROW:extension:name": f"datasets.features.features.Array{len(shape)}DExtensionType",
                        "ARROW:extension:metadata": json.dumps([shape, entry["dtype"]]),
                    }
                    for _ in shape:
                        kind = pa.list_(kind)
                elif shape != [1]:
                    kind = pa.list_(kind, shape[0])
                fields.append(pa.field(name, kind, metadata=details))
        counts = [pa.field(name, pa.float32() if name == "timestamp" else pa.int64()) for name in _COUNTS]
        return pa.schema([*fields, *counts])

    def _arrow(self, columns: Mapping[str, np.ndarray]) -> Any:
        """A table [N] of columns [N, …]; the outer dimensions are lists."""
        pa, arrays = self._pa, []
        for field in self._schema():
            array = columns[field.name]
            shape = array.shape[1:]
            flat = pa.array(np.ascontiguousarray(array).reshape(-1))
            if len(shape) == 1 and shape != (1,):
                flat = pa.FixedSizeListArray.from_arrays(flat, shape[0])
            for size in shape[::-1] if len(shape) > 1 else ():
                flat = pa.ListArray.from_arrays(np.arange(0, len(flat) + 1, size, dtype=np.int32), flat)
            arrays.append(flat)
        return pa.Table.from_arrays(arrays, schema=self._schema())


class _Moments:
    """Least, greatest, mean and standard deviation of a column over all frames; of pictures by channel, in 0 … 1."""

    def __init__(self, pictures: bool):
        self._pictures = pictures
        self._count, self._sum, self._squares = 0, np.zeros(()), np.zeros(())
        self._least, self._most = np.full((), np.inf), np.full((), -np.inf)
        self._frames = 0

    def add(self, array: np.ndarray) -> None:
        """Count an episode, [N, …]."""
        over = (0, 1, 2) if self._pictures else (0,)
        x = array.astype(np.float64) / (255 if self._pictures else 1)
        x = x.reshape(len(x), 1) if x.ndim == 1 else x
        self._frames += len(array)
        self._count += int(np.prod([x.shape[axis] for axis in over]))
        self._sum, self._squares = self._sum + x.sum(over), self._squares + (x**2).sum(over)
        self._least, self._most = np.minimum(self._least, x.min(over)), np.maximum(self._most, x.max(over))

    def figures(self) -> dict[str, Any]:
        """The entry of `stats.json`."""
        mean = self._sum / self._count
        spread = np.sqrt(np.maximum(self._squares / self._count - mean**2, 0))
        found = {"min": self._least, "max": self._most, "mean": mean, "std": spread}
        as_pictures = lambda x: x[:, None, None] if self._pictures else x
        return {name: as_pictures(x).tolist() for name, x in found.items()} | {"count": [self._frames]}


class EpisodeReader:
    """Reader of a data set that `EpisodeFiles` wrote.

    Args:
      root: its folder.
    """

    def __init__(self, root: pathlib.Path):
        self._pq, self._av = library("pyarrow.parquet", "lerobot"), library("av", "lerobot")
        self._root, self._info = root, json.loads((root / _INFO).read_text(encoding="utf-8"))
        if self._info["codebase_version"] != VERSION:
            raise ExportError(f"{root} is version {self._info['codebase_version']}: must be {VERSION}; convert it")

    def table(self, name: str) -> list[dict[str, Any]]:
        """Rows of a Parquet file."""
        found: list[dict[str, Any]] = self._pq.read_table(self._root / name).to_pylist()
        return found

    def episodes(self) -> Iterator[dict[str, np.ndarray]]:
        """Columns [N, …] of each episode, in order."""
        rows = self.table(_EPISODES.format(chunk_index=0, file_index=0))
        films: dict[str, tuple[pathlib.Path, Iterator[np.ndarray]]] = {}
        opened: tuple[pathlib.Path, Any] | None = None
        start = 0
        for row in rows:
            path = self._root / _DATA.format(chunk_index=row["data/chunk_index"], file_index=row["data/file_index"])
            if opened is None or opened[0] != path:
                opened, start = (path, self._pq.read_table(path)), row["dataset_from_index"]
            part = opened[1].slice(row["dataset_from_index"] - start, row["length"])
            yield {name: self._column(name, row, part, films) for name in self._info["features"] if name not in _COUNTS}

    def _column(self, name: str, row: dict[str, Any], part: Any, films: dict[str, Any]) -> np.ndarray:
        entry = self._info["features"][name]
        if entry["dtype"] != "video":
            flat, shape = part.column(name).combine_chunks(), entry["shape"]
            for _ in shape if shape != [1] else ():
                flat = flat.flatten()
            whole = np.asarray(flat.to_numpy(zero_copy_only=False), entry["dtype"])
            return whole.reshape(row["length"], *shape) if shape != [1] else whole
        where = {key: row[f"videos/{name}/{key}"] for key in ("chunk_index", "file_index")}
        path = self._root / _VIDEO.format(video_key=name, **where)
        if name not in films or films[name][0] != path:
            films[name] = path, self._film(path)
        return np.stack([next(films[name][1]) for _ in range(row["length"])])

    def _film(self, path: pathlib.Path) -> Iterator[np.ndarray]:
        with self._av.open(str(path)) as film:
            for frame in film.decode(video=0):
                yield frame.to_ndarray(format=_PIXELS)


def write_table(path: pathlib.Path, rows: list[dict[str, Any]], metadata: dict[bytes, bytes] | None = None) -> None:
    """A Parquet file of rows."""
    path.parent.mkdir(parents=True, exist_ok=True)
    table = library("pyarrow", "lerobot").Table.from_pylist(rows)
    library("pyarrow.parquet", "lerobot").write_table(table.replace_schema_metadata(metadata), path)
