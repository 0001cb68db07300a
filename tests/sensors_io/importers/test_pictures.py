"""Pictures are read whole or left out by name, and what they leave behind is marked as a gap."""

import errno
import os
import pathlib
import struct
import subprocess
import sys
import zlib

import cv2
import numpy as np
import pytest

from sensors_io.importers.keep import ImportConfig, ImportSourceError, Keep, UnreadableError
from sensors_io.importers.octopi import list_octopi
from sensors_io.importers.pictures import (
    PictureError,
    below,
    natural,
    nominal_ns,
    numbered,
    read_picture,
    read_pictures,
)
from sensors_io.importers.tvl import list_tvl
from sensors_io.importers.ycb_slide import list_ycb_slide
from tests.sensors_io.checks import refused
from tests.sensors_io.importers.films import cut, picture

WHOLE = Keep(height=0, max_frames=0)
SEARCHES = {
    "pictures": lambda path: below(path, {".png"}),
    "octopi": lambda path: list_octopi(path, Keep()),
    "tvl": lambda path: list_tvl(path, ImportConfig()),
    "ycb": lambda path: list_ycb_slide(path, ImportConfig()),
}


@pytest.mark.parametrize("name", ["a.png", "a.jpg"])
def test_colours_are_rgb_and_a_picture_that_was_cut_off_is_refused(tmp_path, name):
    path = picture(tmp_path / name)
    image = read_picture(path)
    assert image.shape == (24, 32, 3)
    red, green, blue = image[2, 2].astype(int)
    assert red > 200 > 80 > max(green, blue)
    refused(PictureError, "is cut off", read_picture, cut(path))
    if name == "a.png":
        cv2.imwrite(str(path), np.full((24, 32), 800, np.uint16))  # 12 bits: OpenCV would make 3 of 255 of it
        refused(PictureError, "holds uint16: must hold 8 bits", read_picture, path)


def test_a_stack_of_pictures_is_not_its_first_one(tmp_path):
    pages = [np.full((24, 32, 3), 20 * n, np.uint8) for n in range(3)]
    cv2.imwritemulti(str(tmp_path / "a.tif"), pages)
    refused(PictureError, "holds 3 pictures: must hold one", read_picture, tmp_path / "a.tif")
    cv2.imwritemulti(str(tmp_path / "a.tif"), [pages[1], pages[2][::4, ::4]])  # a preview
    assert read_picture(tmp_path / "a.tif").max() == 20


def test_a_picture_of_more_pixels_than_any_camera_has_is_refused(tmp_path):
    """A gigapixel of one colour is a file of 130 kB and takes 8 GB; commands import this package before OpenCV."""
    cv2.imwrite(str(tmp_path / "a.png"), np.zeros((12_000, 12_000), np.uint8))
    source = (
        "import pathlib, sys; from sensors_io.importers.pictures import read_picture as r; r(pathlib.Path(sys.argv[1]))"
    )
    order = [sys.executable, "-c", source, str(tmp_path / "a.png")]
    env = {name: value for name, value in os.environ.items() if name != "OPENCV_IO_MAX_IMAGE_PIXELS"}
    env["PYTHONPATH"] = os.pathsep.join(sys.path)
    done = subprocess.run(order, env=env, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert "PictureError: is larger than any picture" in done.stderr


def test_lost_pictures_are_named_and_mark_the_frame_behind_them(tmp_path):
    paths = [picture(tmp_path / "f" / f"{n}.png", 20 * n) for n in range(6)]
    cut(paths[1])
    paths[2].unlink()
    picture(paths[4], shape=(10, 32))
    pictures = read_pictures(paths, np.arange(6), WHOLE)
    assert pictures.index.tolist() == [0, 3, 5]
    assert pictures.after_loss().tolist() == [False, True, True]
    assert [skip.name for skip in pictures.left_out] == ["f/1.png", "f/2.png", "f/4.png"]
    np.testing.assert_array_equal(pictures.frames[:, 20, 20, 0], [0, 60, 100])
    picture(paths[0], shape=(10, 32))  # a preview ahead of the others
    pictures = read_pictures([paths[0], paths[3], paths[5]], np.arange(3), WHOLE)
    assert pictures.index.tolist() == [1, 2]
    assert [skip.reason for skip in pictures.left_out] == ["has (10, 32) pixels, most have (24, 32)"]


def test_pictures_are_shrunk_and_chosen_by_position(tmp_path):
    paths = [picture(tmp_path / f"{n}.png", 20 * n) for n in range(6)]
    pictures = read_pictures(paths, np.array([1, 4]), Keep(height=12))
    assert pictures.frames.shape == (2, 12, 16, 3)
    assert pictures.size_px == (24, 32)
    np.testing.assert_array_equal(pictures.frames[:, 10, 10, 0], [20, 80])


def test_names_are_ordered_by_their_numbers(tmp_path):
    for name in ("frame_10.png", "frame_9.png", "frame_100.png", "notes.txt"):
        (tmp_path / name).touch()
    assert [path.name for path in numbered(tmp_path)] == ["frame_9.png", "frame_10.png", "frame_100.png"]
    assert numbered(tmp_path / "absent") == []
    for name in ("b3/shot (2).png", "b3/shot.png", "b4/1.5.png", "b4/1.png"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    ordered = [path.name for folder in ("b3", "b4") for path in numbered(tmp_path / folder)]
    assert ordered == ["shot.png", "shot (2).png", "1.png", "1.5.png"]
    (tmp_path / "a2").mkdir()
    for name in ("a2/0.2.png", "a2/0.15.png"):
        (tmp_path / name).touch()
    refused(ImportSourceError, "a2: 0.2.png and 0.15.png: their order", numbered, tmp_path / "a2")
    (tmp_path / "a2" / "0.2.png").rename(tmp_path / "a2" / "0.20.png")
    (tmp_path / "a10").mkdir()
    (tmp_path / "a10" / "1.png").touch()
    names = [path.relative_to(tmp_path).as_posix() for path in below(tmp_path, {".png"})]
    assert names[2:6] == ["frame_100.png", "a2/0.15.png", "a2/0.20.png", "a10/1.png"]
    assert natural(tmp_path / "a2b") < natural(tmp_path / "a10b")
    assert natural(tmp_path / "a٢b") < natural(tmp_path / "a10b") < natural(tmp_path / "a10²1")


def test_frame_numbers_whose_times_64_bits_cannot_hold_are_refused():
    refused(UnreadableError, "reach 3.33e\\+37, which 64 bits", nominal_ns, np.array([1, 10**30]), 30.0)


def test_links_are_followed_and_hidden_names_are_left_alone(tmp_path):
    """macOS writes ._1.png next to 1.png on the disks of others, and a disk keeps what was deleted in .Trashes."""
    folder = tmp_path / "clips"
    for name in ("1.png", "._1.png", ".Trashes/2.png", "mug/3.png"):
        picture(folder / name)
    (folder / "back").symlink_to(folder)
    picture(tmp_path / "elsewhere" / "deep" / "4.png")
    (folder / "linked").symlink_to(tmp_path / "elsewhere")
    for link, target in (("latest", folder / "mug"), ("z", tmp_path / "elsewhere"), ("mug/l", tmp_path / "elsewhere")):
        (folder / link).symlink_to(target)
    (tmp_path / "elsewhere" / "to_mug").symlink_to(folder / "mug")  # each leads to the other, without end
    names = [path.relative_to(folder).as_posix() for path in below(folder, {".png"})]
    assert names == ["1.png", "linked/deep/4.png", "mug/3.png"]
    assert [path.name for path in numbered(folder)] == ["1.png"]


@pytest.mark.parametrize("source", SEARCHES)
def test_a_folder_that_cannot_be_listed_is_named(tmp_path, monkeypatch, source):
    """As lost+found, which only its owner reads; what it holds would be missing without a word."""
    (tmp_path / "lost+found").mkdir()
    listed = os.scandir
    denied = PermissionError(errno.EACCES, "Permission denied", str(tmp_path / "lost+found"))
    deny = lambda path: listed(path) if pathlib.Path(path) == tmp_path else (_ for _ in ()).throw(denied)
    monkeypatch.setattr(os, "scandir", deny)
    said = "lost.found cannot be listed .Permission denied.: .* make it readable, or move it away"
    refused(ImportSourceError, said, SEARCHES[source], tmp_path)


@pytest.mark.parametrize(
    ("keep", "total", "positions", "pieces"),
    [
        (Keep(), 3, [0, 1, 2], [[0, 1, 2]]),
        (Keep(stride=2, max_frames=2), 9, [0, 8], [[0, 2], [4, 6], [8]]),
        (Keep(max_frames=0), 4, [0, 1, 2, 3], [[0, 1, 2, 3]]),
        (Keep(), 0, [], []),
    ],
)
def test_frames_are_thinned_or_cut_into_pieces(keep, total, positions, pieces):
    assert keep.positions(total).tolist() == positions
    assert [piece.tolist() for piece in keep.pieces(total)] == pieces


def test_pictures_that_would_fill_the_memory_are_refused(tmp_path):
    """One that states 10¹⁰ pixels; smaller ones are never enlarged."""
    chunk = lambda kind, data: struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
    head = chunk(b"IHDR", struct.pack(">IIBBBBB", 100_000, 100_000, 8, 2, 0, 0, 0))
    (tmp_path / "a.png").write_bytes(b"\x89PNG\r\n\x1a\n" + head + chunk(b"IDAT", b"") + chunk(b"IEND", b""))
    refused(PictureError, "is larger than any picture", read_picture, tmp_path / "a.png")
    assert [Keep().shrink(np.zeros((rows, 200, 3), np.uint8)).shape[:2] for rows in (1, 240)] == [(1, 200), (120, 100)]
