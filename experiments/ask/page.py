"""Answers as a page in one file, with the frames that they are about."""

from pathlib import Path

from experiments.ask.answers import AskedPolicy, verdict
from experiments.core.artifacts import write_text
from experiments.core.report import ENVIRONMENT
from experiments.study.examples import marked

TEMPLATE = "ask.jinja"


def write_page(path: Path, found: AskedPolicy) -> None:
    """Write the page."""
    write_text(path, page(found))


def page(found: AskedPolicy) -> str:
    """The page as HTML."""
    return ENVIRONMENT.get_template(TEMPLATE).render(found=found, verdict=verdict, marked=marked)
