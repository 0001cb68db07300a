"""Tiny videos and pictures, and a labels.json in the layout of PhysiCLeAR."""

import fractions
import json

import av
import cv2
import numpy as np

from sensors_io.importers.catalogue import import_catalogue
from sensors_io.importers.keep import ImportConfig
from sensors_io.records import RecordStore

MS = fractions.Fraction(1, 1000)
EVERYTHING = ImportConfig(height=0, max_frames=0, val_share=0, test_share=0)


def imported(catalogue, out):
    """Report of an import, and its records."""
    return import_catalogue(catalogue, out), RecordStore(out)


def film(path, frames=12, size=(24, 32), rate=25.0):
    """A Motion-JPEG video whose frame n is a grey of 20 + 10 n (mod 220), with a red corner."""
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), rate, size[::-1])
    for n in range(frames):
        image = np.full((*size, 3), 20 + 10 * n % 220, np.uint8)
        image[:8, :8] = (0, 0, 255)
        writer.write(image)
    writer.release()
    return path


def uneven_film(path, times_ms, sound_s=0.0, **options):
    """A video of 32 × 24 px whose frames have these times, with sound of so many seconds."""
    with av.open(str(path), "w", options=options) as out:
        stream = out.add_stream("mpeg4", rate=30)
        stream.width, stream.height, stream.pix_fmt, stream.codec_context.time_base = 32, 24, "yuv420p", MS
        sound = out.add_stream("aac", rate=48_000) if sound_s else None
        for time_ms in times_ms:
            frame = av.VideoFrame.from_ndarray(np.full((24, 32, 3), 90, np.uint8))
            frame.pts, frame.time_base = time_ms, MS
            out.mux(stream.encode(frame))
        out.mux(stream.encode())
        if sound is not None:
            quiet = av.AudioFrame.from_ndarray(np.zeros((1, round(sound_s * 48_000)), np.float32), "fltp", "mono")
            quiet.sample_rate = 48_000
            out.mux(sound.encode(quiet))
            out.mux(sound.encode())
    return path


def entry(name, /, videos=2, **changes):
    """An object of the list; `videos` are names, or how many there are."""
    names = videos if isinstance(videos, list) else [f"{name}_{k}.avi" for k in range(videos)]
    described = {"object": name, "name": f"a {name}", "split": "train", "material": "rubber", "videos": names}
    return described | {"hardness": 1, "roughness": 0, "bumps": 2} | changes


def folder(path, *entries):
    """A source folder; every listed video is written."""
    (path / "videos").mkdir(parents=True)
    labels(path, *entries)
    for item in entries:
        for name in item["videos"]:
            film(path / "videos" / name)
    return path


def labels(path, *entries):
    (path / "labels.json").write_text(json.dumps({"levels": {}, "objects": list(entries)}))


def picture(path, level=50, shape=(24, 32)):
    """A picture, reddish in its upper left quarter on grey `level`, as JPEG or PNG by its name."""
    image = np.full((*shape, 3), level, np.uint8)
    image[: shape[0] // 2, : shape[1] // 2] = (30, 30, 220)
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), image)
    return path


def cut(path):
    """The same file without its last third, as an interrupted copy leaves it."""
    data = path.read_bytes()
    path.write_bytes(data[: 2 * len(data) // 3])
    return path
