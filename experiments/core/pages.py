"""Self-contained pages from the templates in `templates/`: text is escaped, pictures travel inside the page."""

import base64
import itertools
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import jinja2
import numpy as np

from experiments.core.results import Cell, Column, Slot
from experiments.core.text import WithInterval, bounds, number, plain

MEDIA = {"svg": "svg+xml", "png": "png"}


def render(
    template: str, *, about: str, description: Mapping[str, Any], timing: Mapping[str, float], **rest: Any
) -> str:
    """Fill a page of a run.

    Args:
      template: name of a file that extends `page.jinja`.
      about: docstring of the experiment; its first line is the question.
      description: content of the run's `config.json`.
      timing: stage, or stage and seed → seconds.
      rest: what else the template names.
    """
    question, _, more = about.strip().partition("\n")
    git = description["git"]
    settings = rest.pop("settings") | {
        "scale": description["scale"],
        "code": git["commit"][:12] + (" with local changes" if git["dirty"] else ""),
    }
    times: dict[str, list[float]] = {}
    for stage, seconds in timing.items():
        times.setdefault(stage.rpartition("/")[0] or stage, []).append(seconds)
    page = {"question": question, "rest": more.strip(), "description": description, "settings": settings}
    return ENVIRONMENT.get_template(template).render(**page, times=times, **rest)


def cell_text(cell: Cell, column: Column) -> str:
    """A cell of a table as it is shown."""
    if isinstance(cell, bool):
        return "yes" if cell else "no"
    return cell if isinstance(cell, str) else number(cell, column.format if isinstance(cell, float) else ",")


def pieces(text: str, slots: Sequence[Slot]) -> Iterator[tuple[str, str]]:
    """Pieces of a text, each with the segment that it belongs to; the name is empty between segments."""
    end = 0
    for start, stop, kind in slots:
        yield text[end:start], ""
        yield text[start:stop], kind
        end = stop
    yield text[end:], ""


def strip(frames: np.ndarray) -> np.ndarray:
    """The frames of a sensor side by side with two white pixels between them, uint8 [H, F (W + 2), 3].

    Args:
      frames: uint8 [F, H, W, 3].
    """
    return np.concatenate(list(np.pad(frames, ((0, 0), (0, 0), (1, 1), (0, 0)), constant_values=255)), axis=1)


def png(picture: np.ndarray) -> bytes:
    """Encode a uint8 RGB picture [H, W, 3]."""
    done, content = cv2.imencode(".png", np.ascontiguousarray(picture[..., ::-1]))
    if not done:
        raise ValueError(f"picture is {picture.dtype}{list(picture.shape)}: OpenCV cannot encode it; give uint8 RGB")
    return content.tobytes()


def _data_uri(content: bytes, kind: str) -> str:
    return f"data:image/{MEDIA[kind]};base64,{base64.b64encode(content).decode()}"


def _consecutive(every: Iterable[Any], attribute: str) -> list[tuple[str, list[Any]]]:
    """Neighbours of one value of an attribute; jinja's own `groupby` sorts."""
    return [(key, list(of)) for key, of in itertools.groupby(every, lambda one: getattr(one, attribute))]


def _bounds(found: WithInterval, spec: str) -> str:
    return bounds(found.low, found.high, spec)


def _environment() -> jinja2.Environment:
    made = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent / "templates"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    made.filters |= {
        "bounds": _bounds,
        "cell": cell_text,
        "consecutive": _consecutive,
        "data_uri": _data_uri,
        "indented": lambda value: json.dumps(value, indent=2, ensure_ascii=False),
        "number": number,
        "pieces": pieces,
        "plain": plain,
        "png": png,
        "strip": strip,
    }
    return made


ENVIRONMENT = _environment()
