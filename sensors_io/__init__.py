"""Tactile sensors in, lossless records and clips out: devices, importers, generated scenes, Grain pipelines."""

import os

# read when OpenCV is imported, which would else decode a gigapixel: 8 GB of memory from a file of 130 kB
os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(1 << 27))
