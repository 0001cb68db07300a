"""Pages in a real browser, as wide as a desk, a tablet and a telephone: nothing is cut, missing or without a name."""

import html
import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from urllib.parse import quote

import pytest

from experiments.core.commands import find
from experiments.core.recorded import recorded_names
from experiments.core.report import MOST_BYTES
from experiments.core.runs import ROOT

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
WIDTHS_PX = (1280, 800, 390)
RECORDINGS = "TOUCHR1_RECORDINGS"
"""Variable that names a folder of recordings, which the repository does not contain."""

DATA = {"physiclear": "physiclear", "real_sensors": ".", "scene_realism": "gelslam"}
"""Experiment that cannot do without recordings → their place in that folder."""

LOOK = """<script>window.addEventListener("load", () => {
  const width = document.documentElement.clientWidth, cut = [];
  for (const closed of document.querySelectorAll("details")) closed.open = true;
  for (const one of document.body.querySelectorAll("*")) {
    if (one.parentElement.closest(".wide, pre")) continue;  // these scroll
    const edge = one.getBoundingClientRect().right;
    if (edge > width + 1) cut.push(`${one.tagName}.${one.className} ends at ${Math.round(edge)} of ${width} px`);
  }
  const broad = [];
  for (const one of document.querySelectorAll(".wide > img")) {
    const shown = one.getBoundingClientRect().width, frame = one.parentElement, px = Math.round(shown);
    if (shown > one.naturalWidth + 1) broad.push(`${one.alt} is enlarged to ${px} px`);
    if (frame.scrollWidth <= frame.clientWidth + 1) continue;
    const said = getComputedStyle(one).mixBlendMode === "multiply";  // else its white covers the frame's shadow
    if (width > 480 || shown > 3 * width || !said) broad.push(`${one.alt} has ${px} of ${width} px`);
  }
  const unnamed = [...document.querySelectorAll("tbody tr:not(.more)")].filter(row => !row.cells[0].textContent.trim());
  document.body.dataset.seen = JSON.stringify({
    cut: cut.slice(0, 3), broad: broad.slice(0, 3),
    missing: [...document.images].filter(i => !i.naturalWidth).length, unnamed: unnamed.length});
});</script>"""
"""Lists what ends beyond the page, charts that are enlarged or that scroll where a reader does not expect it, and what
has no name; only the copy that the test opens has it."""

FRAME = """<body><iframe src="page.html" style="width:{width}px;height:2000px;border:0"></iframe><script>
window.addEventListener("load", () => {{
  document.body.dataset.seen = document.querySelector("iframe").contentDocument.body.dataset.seen;
}});</script>"""
"""A browser's own window cannot be as narrow as a telephone."""

pytestmark = [pytest.mark.slow, pytest.mark.skipif(CHROMIUM is None, reason="no chromium here")]


def look(page: Path, width: int, folder: Path) -> dict[str, object]:
    """What a browser finds on a page of some width."""
    copied = page.read_text(encoding="utf-8").replace("</body>", f"{LOOK}</body>")
    (folder / "page.html").write_text(copied, encoding="utf-8")
    (folder / "frame.html").write_text(FRAME.format(width=width), encoding="utf-8")
    flags = ["--headless", "--no-sandbox", "--disable-gpu", "--allow-file-access-from-files"]
    size = ["--window-size=1400,2000", "--virtual-time-budget=10000", f"--user-data-dir={folder / 'profile'}"]
    command = [str(CHROMIUM), *flags, *size, "--dump-dom", (folder / "frame.html").as_uri()]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)
    (seen,) = re.findall(r'<body data-seen="([^"]*)"', done.stdout)
    return json.loads(html.unescape(seen))


def check(page: Path, folder: Path) -> None:
    assert page.stat().st_size <= MOST_BYTES
    for width in WIDTHS_PX:
        assert look(page, width, folder) == {"cut": [], "broad": [], "missing": 0, "unnamed": 0}, (
            f"{page.name} at {width} px"
        )


def run(*arguments: str) -> None:
    done = subprocess.run([sys.executable, "-m", "experiments", *arguments], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    return tmp_path_factory.mktemp("cache")


def test_a_column_that_is_cut_is_found(tmp_path):
    page = tmp_path / "report.html"
    rows = "<tr><td>sft</td></tr><tr><td> </td></tr>"
    page.write_text(f'<body><p style="width:900px">wide</p><img src="none.png"><table>{rows}</table></body>')
    assert look(page, 1280, tmp_path) == {"cut": [], "broad": [], "missing": 1, "unnamed": 1}
    assert look(page, 800, tmp_path)["cut"] == ["P. ends at 908 of 800 px"]


def test_a_chart_that_is_enlarged_or_scrolls_unseen_is_found(tmp_path):
    page = tmp_path / "report.html"
    chart = quote('<svg xmlns="http://www.w3.org/2000/svg" width="500" height="9"/>')
    frame = '<div class="wide" style="overflow-x:auto"><img alt="{}" style="{}" src="data:image/svg+xml,{}"></div>'
    looks = {"said": "mix-blend-mode:multiply", "unsaid": "", "large": "width:510px;mix-blend-mode:multiply"}
    page.write_text("".join(frame.format(name, style, chart) for name, style in looks.items()) + "</body>")
    assert look(page, 800, tmp_path)["broad"] == ["large is enlarged to 510 px"]
    assert look(page, 390, tmp_path)["broad"] == ["unsaid has 500 of 390 px", "large is enlarged to 510 px"]


@pytest.mark.parametrize("name", recorded_names())
def test_pages_of_recorded_runs_fit(name, tmp_path):
    run("show", name, "--runs-dir", str(tmp_path))
    check(tmp_path / name / "recorded" / "report.html", tmp_path)


@pytest.mark.parametrize("name", sorted(find("experiments")))
def test_pages_of_smoke_runs_fit(name, tmp_path, cache):
    data = []
    if name in DATA:
        if RECORDINGS not in os.environ:
            pytest.skip(f"{RECORDINGS} does not name a folder of recordings")
        data = ["--data-dir", str(Path(os.environ[RECORDINGS]) / DATA[name])]
    run(name, "--scale", "smoke", *data, "--runs-dir", str(tmp_path), "--cache-dir", str(cache))
    check(tmp_path / name / "latest" / "report.html", tmp_path)
