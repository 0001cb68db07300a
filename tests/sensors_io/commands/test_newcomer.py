"""The README alone leads from a camera to depth: its commands run on a replayed GelSight Mini."""

import pathlib
import re
import shlex

import cv2
import numpy as np
import pytest

from sensors_io.__main__ import main

ROOT = pathlib.Path(__file__).parents[3]
CLIPS = ROOT / "tests" / "data" / "gelslam"


@pytest.mark.long
def test_the_commands_of_the_readme_lead_to_a_depth_map(tmp_path: pathlib.Path) -> None:
    """14 presses, recorded at a third of the width: the pitch is three times the README's."""
    camera = tmp_path / "camera"
    camera.mkdir()
    rest = cv2.imread(str(CLIPS / "background.png"))
    presses = [cv2.imread(str(path)) for path in sorted(CLIPS.glob("press_*.png"))]
    for i, frame in enumerate([rest] * 20 + [frame for press in presses for frame in [press] * 5 + [rest] * 2]):
        cv2.imwrite(str(camera / f"{i:03d}.png"), frame)

    part = (ROOT / "sensors_io" / "README.md").read_text().partition("## From a GelSight Mini")[2].partition("\n## ")[0]
    commands = re.findall(r"^    python -m sensors_io (.*)$", part, re.M)
    assert [command.split()[0] for command in commands] == ["snap", "calibrate", "extract", "view"]
    ending = {"snap": "--port 0", "view": "--port 0 --seconds 0.5"}
    for command in commands:
        name, rest_of_it = command.replace("MINI", str(tmp_path / "mini")).replace("0.0634", "0.1902").split(" ", 1)
        rest_of_it = re.sub(" uvc .*", f" {ending.get(name, '')} replay --path {camera} --rate-hz 200", rest_of_it)
        assert main([name, *shlex.split(rest_of_it)]) == 0
    with np.load(tmp_path / "mini" / "depth.npz") as fields:
        assert fields["depth_mm"].shape == (1, 80, 106)
        assert 0.5 < fields["depth_mm"].max() < 1.5
        assert fields["contact"].any()
