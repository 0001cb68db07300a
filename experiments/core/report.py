"""Pages of a run from the templates in `templates/`: self-contained, small, without scripts; text is escaped."""

import base64
import functools
import itertools
import json
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import quote

import cv2
import jinja2
import numpy as np

from experiments.core import curves
from experiments.core.artifacts import write_bytes, write_text
from experiments.core.look import marks
from experiments.core.metric_log import read_metrics
from experiments.core.results import Cell, Column, Comparison, Results, RolloutExample, Slot, Table
from experiments.core.text import MEANINGLESS, SMOKE, bounds, number, plain, preset_in_words
from touchr1_jax.bench.scoring import REPORTED

_FIGURES = re.compile(r"[-+−–\d\s.,:;%×()\[\]]{0,40}")  # more of them take several lines, as words do

MOST_BYTES = 3_000_000  # of a page
DETAILS = ((90, 1472), (75, 736), (50, 368), (20, 184))
"""Quality and width in px, at most, of the photographs of a page, which shows a strip of frames 736 px wide.

A page takes the first with which it keeps `MOST_BYTES`, else the last.
"""


ROWS = {
    "sft": "supervised fine-tuning on verified answers (SFT); arms of GRPO start from it",
    "sft_continued": "SFT that goes on for as long as GRPO takes",
    "tactile_blind": "a policy that is trained without touch",
    "constant": "the most frequent level of each attribute, whatever is touched",
    "constant_joint": "the most frequent combination of levels",
    "constant_middle": "the middle level of each attribute",
    "force_only": "a linear classifier of the measured forces alone",
    "full": "GRPO with the whole objective",
    "untrained": "the policy before any training",
    "encoder_probe": "a linear classifier of the touch, as the policy's trained encoders see it",
    "encoder_and_picture_probe": "the same classifier, of touch and picture",
    "shuffled_touch": "the same classifier, of another object's touch",
    "vision_only": "a linear classifier of the picture alone",
    "nearest_fields": "the levels of the training contacts whose recorded fields are most alike",
}
"""Row that many experiments share → what it is."""

SETTINGS = {
    "lr_scale": ("learning rate", "{} × the paper's"),
    "beta": ("weight of the KL β", "{}"),
    "micro_prompts": ("gradients at a time", "of {} prompts"),
    "sft_lr_scale": ("learning rate of SFT", "{} × the paper's"),
}
"""Setting → its name and its value in words."""


def settings_in_words(settings: Mapping[str, Any]) -> dict[str, str]:
    """Settings as the head of a page shows them."""
    is_preset = lambda name: name.partition(" of ")[0] == "preset"  # of an arm, or of all
    shown = {name: (preset_in_words if is_preset(name) else plain)(value) for name, value in settings.items()}
    named = {name: SETTINGS.get(name, (name, "{}")) for name in shown}
    return {named[name][0]: named[name][1].format(value) for name, value in shown.items()}


def write_report(
    directory: Path, results: Results, *, about: str, description: Mapping[str, Any], note: str = ""
) -> Path:
    """Write `report.html` and the pictures in `plots/` of a run and return the path of the report.

    `about` is the docstring of the experiment, `description` the content of the run's `config.json`, `note` a remark on
    the page.
    """
    rows = read_metrics(directory)
    mark, settings = marks(_charted(results.arms, rows)), settings_in_words(results.settings)
    smoke = description["scale"] == SMOKE
    middle, drawn = None, {}
    if results.arms:
        settings["seeds"] = str(len(next(iter(next(iter(results.arms.values())).values())).per_seed))
        middle = curves.accuracy_against_middle(results.arms, results.baselines, mark)
        drawn = curves.draw_phases(rows, results.curves, mark)
    plots = {f"{picture.name}.{picture.kind}": picture.content for picture in results.pictures}
    plots |= {f"curves_{phase}.svg": phase_curves.svg for phase, phase_curves in drawn.items()}
    plots |= {} if middle is None else {"accuracy_against_middle.svg": middle}
    for name, content in plots.items():
        write_bytes(directory / "plots" / name, content)
    measured = {name for row in (*results.arms.values(), *results.baselines.values()) for name in row}
    draw_page = functools.partial(
        render,
        "report.jinja",
        about=about,
        note=note,
        description=description,
        timing=results.timing,
        settings=settings,
        verdict=() if smoke else tuple(line.replace(" %", "\u00a0%") for line in results.verdict),
        requirements=() if smoke else results.requirements,
        data={name: value for name, value in results.data.items() if not isinstance(value, Mapping)},
        data_title="Data and time",
        results=results,
        mark=mark,
        reported=REPORTED,
        row_meanings={name: ROWS[name] for name in (*results.arms, *results.baselines) if name in ROWS},
        metrics={name: metric for name, metric in REPORTED.items() if name in measured},
        best={(metric, arm) for arm in results.arms for metric in REPORTED if is_best(metric, arm, results)},
        pairs=_pairs(results.comparisons),
        compared_over=", ".join(dict.fromkeys(f"{c.n} {c.over}" for c in results.comparisons)),
        middle=middle,
        curves=drawn,
        touches=touches(results.examples),
    )
    for detail in DETAILS:
        page = draw_page(detail=detail)
        if len(page.encode(errors="surrogateescape")) <= MOST_BYTES:
            break
    path = directory / "report.html"
    write_text(path, page)
    return path


def _charted(arms: Mapping[str, Any], rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Arms with a curve or a rate of middle answers, in the tables' order; others need no mark."""
    curved = dict.fromkeys("/".join(line["stage"].split("/")[1:-1]) for line in rows)
    shown = [arm for arm, row in arms.items() if arm in curved or {"acc", "middle_rate"} <= row.keys()]
    return shown + [arm for arm in curved if arm and arm not in shown]


def is_best(metric: str, arm: str, results: Results) -> bool:
    """True if an arm has the best mean, and the paired interval between it and every other arm excludes 0."""
    means = {name: row[metric].mean for name, row in results.arms.items() if metric in row}
    others = set(means) - {arm}
    if arm not in means or not others or REPORTED[metric].better == "none":
        return False
    sign = 1.0 if REPORTED[metric].better == "higher" else -1.0

    def clear(other: str) -> bool:
        found = [c for c in results.comparisons if c.metric == metric and {c.arm, c.against} == {arm, other}]
        return bool(found) and all(c.low > 0 or c.high < 0 for c in found)

    return all(sign * (means[arm] - means[other]) > 0 and clear(other) for other in others)


def _pairs(comparisons: Sequence[Comparison]) -> dict[tuple[str, str, str], dict[str, Comparison]]:
    """Metric, arm, other arm → the comparison over seeds and over objects, all pairs of a metric together."""
    pairs: dict[tuple[str, str, str], dict[str, Comparison]] = {}
    metrics = list(dict.fromkeys(c.metric for c in comparisons))
    for c in sorted(comparisons, key=lambda c: metrics.index(c.metric)):
        pairs.setdefault((c.metric, c.arm, c.against), {})[c.over] = c
    return pairs


def render(
    template: str, *, about: str, description: Mapping[str, Any], timing: Mapping[str, float], **rest: Any
) -> str:
    """Fill a template that extends `page.jinja`; `timing` is stage, or stage and seed → seconds."""
    question, _, more = about.strip().partition("\n")
    times: dict[str, list[float]] = {}
    for stage, seconds in timing.items():
        times.setdefault(stage.rpartition("/")[0] or stage, []).append(seconds)
    banner = MEANINGLESS if description["scale"] == SMOKE else ""
    page = {"banner": banner, "question": question, "rest": more.strip(), "description": description, "times": times}
    return ENVIRONMENT.get_template(template).render(**page, **rest)


def cell_text(cell: Cell, column: Column) -> str:
    """A cell of a table as it is shown."""
    return number(cell, column.format) if isinstance(cell, float | None) else plain(cell)


def word_columns(table: Table) -> list[bool]:
    """For each column of a table whether its cells are words; figures, also those with intervals, are aligned right."""
    cells = zip(*table.rows, strict=True)
    return [any(isinstance(x, str) and not _FIGURES.fullmatch(x) for x in column) for column in cells]


def pieces(text: str, slots: Sequence[Slot]) -> Iterator[tuple[str, str]]:
    """Pieces of a text, each with the segment that it belongs to; the name is empty between segments."""
    end = 0
    for start, stop, kind in slots:
        yield text[end:start], ""
        yield text[start:stop], kind
        end = stop
    yield text[end:], ""


def strip(frames: np.ndarray) -> np.ndarray:
    """Frames [F, H, W, 3] side by side with two white pixels between them, uint8 [H, F (W + 2), 3]."""
    return np.concatenate(list(np.pad(frames, ((0, 0), (0, 0), (1, 1), (0, 0)), constant_values=255)), axis=1)


def webp(picture: np.ndarray, quality: int = DETAILS[0][0], most_px: int = DETAILS[0][1]) -> bytes:
    """Encode a uint8 RGB picture [H, W, 3], reduced to a width of `most_px`."""
    height, width = picture.shape[:2]
    if width > most_px:
        size = most_px, max(1, round(height * most_px / width))
        picture = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
    options = cv2.IMWRITE_WEBP_QUALITY, quality
    done, content = cv2.imencode(".webp", np.ascontiguousarray(picture[..., ::-1]), options)
    if not done:
        raise ValueError(f"picture is {picture.dtype}{list(picture.shape)}: OpenCV cannot encode it; give uint8 RGB")
    return content.tobytes()


def touches(examples: Iterable[RolloutExample]) -> list[tuple[str, list[list[RolloutExample]]]]:
    """Neighbours of one group → for each contact the examples about it, so that a page shows its pictures once."""
    groups = []
    for name, members in itertools.groupby(examples, lambda example: example.group):
        contacts: dict[Any, list[RolloutExample]] = {}
        for one in members:
            frames = tuple((sensor, seen.shape, seen.tobytes()) for sensor, seen in one.frames.items())
            contacts.setdefault((one.object_id, frames), []).append(one)
        groups.append((name, list(contacts.values())))
    return groups


def _data_uri(content: bytes, kind: str) -> str:
    if kind == "svg":  # as text, which is a fourth shorter than base64
        return "data:image/svg+xml," + quote(content.replace(b"\n", b" "), safe=" ,;=/")
    return f"data:image/{kind};base64,{base64.b64encode(content).decode()}"


def width_px(content: bytes, kind: str) -> float:
    """Width of a picture as a browser shows it; the charts state theirs in points."""
    if kind == "svg":
        found = re.search(rb'<svg[^>]* width="([\d.]+)(pt)?"', content)
        return float(found[1]) * (96 / 72 if found[2] else 1) if found else 0.0
    return float(int.from_bytes(content[16:20]))  # in the first chunk of a PNG


ENVIRONMENT = jinja2.Environment(
    loader=jinja2.FileSystemLoader(Path(__file__).parent / "templates"),
    autoescape=True,
    undefined=jinja2.StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
)
ENVIRONMENT.filters |= {
    "bounds": lambda found, spec: bounds(found.low, found.high, spec),
    "cell": cell_text,
    "data_uri": _data_uri,
    "indented": lambda value: json.dumps(value, indent=2, ensure_ascii=False),
    "number": number,
    "pieces": pieces,
    "plain": plain,
    "strip": strip,
    "webp": webp,
    "width_px": width_px,
    "word_columns": word_columns,
}
