"""The code of the documents and the notebooks runs as it stands."""

import json
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
CODE = re.compile(r"^```python\n(.*?)^```$", re.MULTILINE | re.DOTALL)


@pytest.mark.long
def test_another_encoder_is_built_as_the_page_says(capsys):
    blocks = CODE.findall((ROOT / "docs" / "ENCODER.md").read_text(encoding="utf-8"))
    known: dict[str, object] = {}
    for block in blocks:
        exec(block, known)
    assert capsys.readouterr().out == "(4, 2, 4, 96)\n"


@pytest.mark.long
@pytest.mark.parametrize("path", sorted((ROOT / "docs" / "notebooks").glob("*.ipynb")), ids=lambda path: path.stem)
def test_a_notebook_runs_and_keeps_no_outputs(path, capsys):
    cells = [c for c in json.loads(path.read_text(encoding="utf-8"))["cells"] if c["cell_type"] == "code"]
    known: dict[str, object] = {"__name__": path.stem}
    for cell in cells:
        assert cell["outputs"] == []
        assert cell["execution_count"] is None
        exec("".join(cell["source"]), known)
    assert {"ask": "<conclude>", "reward": "brevity"}[path.stem] in capsys.readouterr().out


def test_the_log_is_a_dated_list_of_short_findings():
    text = (ROOT / "experiments" / "LOG.md").read_text(encoding="utf-8")
    dates = re.findall(r"^## (.*)$", text, re.MULTILINE)
    assert dates == sorted(set(dates), reverse=True)
    assert all(re.fullmatch(r"\d{4}-\d\d-\d\d", date) for date in dates)
    findings = [line for line in text[text.index("\n## ") :].splitlines() if line and not line.startswith("#")]
    assert len(findings) > 50
    for finding in findings:
        assert finding.startswith("- "), f"a finding is one line of a list; a table belongs into docs/log/: {finding}"
        words = len(re.sub(r"\]\([^)]*\)", "]", finding).split())
        assert words < 80, f"{words} words; move what is longer to docs/log/: {finding}"
        assert re.search(r"\]\([^)]+\)", finding), f"no link: {finding}"


@pytest.mark.parametrize("path", sorted((ROOT / "docs" / "log").glob("*.md")), ids=lambda path: path.stem)
def test_findings_of_the_log_lead_to_their_figures(path):
    text = (ROOT / "experiments" / "LOG.md").read_text(encoding="utf-8")
    headings = re.findall(r"^## (.*)$", path.read_text(encoding="utf-8"), re.MULTILINE)
    anchors = {re.sub(r"\s", "-", re.sub(r"[^\w\s-]", "", heading.lower())) for heading in headings}
    assert set(re.findall(rf"docs/log/{path.stem}\.md#([^)]+)\)", text)) == anchors
