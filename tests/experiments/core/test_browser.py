"""A report in a real browser: every picture shows, nothing is wider than the page, nothing is asked of the network."""

import dataclasses
import re
import shutil
import subprocess

import numpy as np
import pytest

from experiments.core.report import write_report
from experiments.core.results import Results, Trace
from experiments.study.examples import field_picture
from tests.experiments.core.test_report import DESCRIPTION, row
from tests.experiments.fakes import coin

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")

ASK = """<script>window.addEventListener("load", () => {
  const images = [...document.images], root = document.documentElement;
  document.body.dataset.seen = JSON.stringify({
    images: images.length, broken: images.filter(i => !i.naturalWidth || !i.width).length,
    wide: root.scrollWidth > root.clientWidth, requests: performance.getEntriesByType("resource")
      .filter(e => !e.name.startsWith("data:")).length,
    marks: document.querySelectorAll(".rollout mark").length, instead: document.querySelectorAll("td .trace").length});
});</script>"""
"""Asks the browser what it shows; only the copy that the test opens has it."""


@pytest.fixture
def report(tmp_path):
    """A report with a rollout, its fields, and what is said without the touch."""
    example = coin.example()
    drawn = {"xense": np.zeros((192, 192, 3), np.uint8)}
    instead = {c: Trace(text=example.trace, slots=example.slots) for c in ("drop", "noise")}
    results = Results(
        arms={"paid": row(60.0), "unpaid": row(50.0)},
        baselines={"blind": row(30.0)},
        settings={"preset": "paper", "lr_scale": 100.0},
        verdict=("Being paid helps.",),
        examples=(dataclasses.replace(example, fields=drawn, instead=instead),),
    )
    return write_report(tmp_path, results, about="Does it pay?", description=DESCRIPTION)


def test_what_is_said_without_touch_stands_beside(report):
    page = report.read_text(encoding="utf-8")
    assert "In place of the touch" in page
    assert page.count('class="trace"') == 3
    assert "Fields of xense" in page


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="no chromium here")
def test_a_browser_shows_all_of_it(report, tmp_path):
    asked = tmp_path / "asked.html"
    asked.write_text(report.read_text(encoding="utf-8").replace("</body>", f"{ASK}</body>"), encoding="utf-8")
    flags = ["--headless", "--no-sandbox", "--disable-gpu", "--window-size=1000,2000", "--virtual-time-budget=5000"]
    command = [str(CHROMIUM), *flags, f"--user-data-dir={tmp_path / 'profile'}", "--dump-dom", asked.as_uri()]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)
    (seen,) = re.findall(r'data-seen="([^"]*)"', done.stdout)
    found = dict(re.findall(r"&quot;(\w+)&quot;:(\w+)", seen))
    assert int(found["images"]) >= 4  # view, frames, fields, chart
    assert found["broken"] == found["requests"] == "0"
    assert found["wide"] == "false"
    assert (int(found["marks"]), found["instead"]) == (9, "2")


def test_fields_are_drawn_in_colour_with_arrows(data):
    recorded = data.store.contact(int(data.parts["test"][0]))
    picture = field_picture(recorded["tac3d"])
    assert picture.shape == (192, 192, 3)
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 20
    still = dataclasses.replace(recorded["tac3d"], deformation_mm=np.zeros_like(recorded["tac3d"].deformation_mm))
    assert not np.array_equal(field_picture(still), picture)
    bare = dataclasses.replace(
        recorded["tac3d"],
        depth_mm=None,
        deformation_mm=None,
        frames=np.zeros((len(recorded["tac3d"]), 4, 4, 3), np.uint8),
    )
    assert field_picture(bare) is None
