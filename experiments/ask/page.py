"""Answers as a page in one file, with the frames that they are about."""

from pathlib import Path

from experiments.ask.answers import AskedPolicy, verdict
from experiments.core.artifacts import write_text
from experiments.core.report import ENVIRONMENT
from experiments.study.examples import marked


def write_page(path: Path, found: AskedPolicy) -> None:
    """Write the page, whole or not at all."""
    write_text(path, _filled("ask.jinja", found))


def answered_part(found: AskedPolicy) -> str:
    """The answers as a part of a page."""
    return _filled("answered.jinja", found)


def _filled(template: str, found: AskedPolicy) -> str:
    return ENVIRONMENT.get_template(template).render(found=found, verdict=verdict, marked=marked)
