"""The part of a report that shows single answers: the touch, the trace with its parsed slots, the reward."""

import itertools
from collections.abc import Iterable, Mapping, Sequence

import cv2
import numpy as np

from experiments.core.page import Html, image, join, row, table, tag
from experiments.core.results import RolloutExample, Slot


def rollouts(examples: Sequence[RolloutExample], colour: Mapping[str, str]) -> Html:
    """A section with one card per example, empty where there are none; those of a group fold away under its heading."""
    if not examples:
        return Html("")
    kinds = [tag("mark", kind, class_=kind) for kind in ("perceive", "compare", "conclude")]
    marks = [part for kind in kinds for part in (kind, " ")]
    note = tag("p", "Under each frame its normal force. Parsed slots of the trace: ", *marks, class_="note")
    parts = [
        _group(group, [_card(example, colour) for example in members], opened=not number)
        for number, (group, members) in enumerate(itertools.groupby(examples, lambda example: example.group))
    ]
    return tag("section", tag("h2", "A few rollouts"), note, *parts)


def _group(heading: str, cards: Iterable[Html], *, opened: bool) -> Html:
    """Cards under a heading that folds them away; as they are where there is none."""
    if not heading:
        return join([*cards])
    unfolded: dict[str, str | int] = {"open": "open"} if opened else {}
    return tag("details", tag("summary", tag("b", heading)), *cards, **unfolded)


def strip_png(frames: np.ndarray) -> bytes:
    """The frames of one sensor side by side with two white pixels between them, as a PNG.

    Args:
      frames: uint8 [F, H, W, 3], RGB.
    """
    apart = np.pad(frames, ((0, 0), (0, 0), (1, 1), (0, 0)), constant_values=255)
    return _png(np.concatenate(list(apart), axis=1))


def highlighted(trace: str, slots: Sequence[Slot]) -> Html:
    """The trace with each slot marked by the segment it belongs to."""
    parts: list[str] = []
    end = 0
    for start, stop, kind in slots:
        parts += [trace[end:start], tag("mark", trace[start:stop], class_=kind)]
        end = stop
    return tag("div", *parts, trace[end:], class_="trace")


def _card(example: RolloutExample, colour: Mapping[str, str]) -> Html:
    swatch = [tag("span", class_="swatch", style=f"background:{colour[example.arm]}")] if example.arm in colour else []
    view = [] if example.view is None else [_view(example.view)]
    strips = tag("div", *[_strip(sensor, example) for sensor in example.frames], class_="strips")
    return tag(
        "article",
        tag("h3", *swatch, f"{example.arm} · {example.object_id}"),
        tag("p", tag("b", "Question "), example.question),
        tag("div", *view, strips, class_="touch"),
        *_fields(example),
        highlighted(example.trace, example.slots),
        tag("p", tag("b", "Label "), example.label),
        *_instead(example),
        _reward(example),
        class_="rollout",
    )


def _view(view: np.ndarray) -> Html:
    return tag("figure", image(_png(view), "png", "Picture of the object", class_="view"), tag("figcaption", "view"))


def _strip(sensor: str, example: RolloutExample) -> Html:
    frames = example.frames[sensor]
    picture = image(strip_png(frames), "png", f"{len(frames)} frames of {sensor}", class_="strip")
    parts = [tag("figcaption", sensor), picture]
    if sensor in example.force_n:
        pushes = [tag("span", f"{-float(force[2]):.1f} N") for force in example.force_n[sensor]]
        parts.append(tag("div", *pushes, class_="forces", style=f"grid-template-columns:repeat({len(pushes)},1fr)"))
    return tag("figure", *parts)


def _fields(example: RolloutExample) -> list[Html]:
    """The drawn fields side by side, none where there are none."""
    if not example.fields:
        return []
    shown = [
        tag("figure", image(_png(picture), "png", f"Fields of {sensor}", class_="field"), tag("figcaption", sensor))
        for sensor, picture in example.fields.items()
    ]
    note = "Strongest press: indentation in colour, from dark to bright; displacement of the gel as arrows."
    return [tag("div", *shown, class_="fields"), tag("p", note, class_="note")]


def _instead(example: RolloutExample) -> list[Html]:
    """What is said when the touch is taken away or replaced, none where that was not asked."""
    if not example.instead:
        return []
    rows = [
        row(name, tag("td", highlighted(said.text, said.slots), class_="text"), head=1)
        for name, said in example.instead.items()
    ]
    return [table(["In the place of the touch", tag("th", "what is said then", class_="text")], rows)]


def _reward(example: RolloutExample) -> Html:
    largest = max(1.0, *(abs(value) for value in (*example.reward.values(), example.total)))
    terms = [*example.reward.items(), ("total", example.total)]
    rows = [
        row(name, f"{value:.2f}".replace("-", "−"), tag("td", _bar(value / largest)), head=1) for name, value in terms
    ]
    return table(["Reward", "", ""], rows)


def _bar(share: float) -> Html:
    """A bar of a signed share of its width; negative values in their own colour."""
    kind = "negative" if share < 0 else "positive"
    return tag("div", tag("i", class_=kind, style=f"left:0;width:{100 * abs(share):.1f}%"), class_="bar")


def _png(picture: np.ndarray) -> bytes:
    done, content = cv2.imencode(".png", np.ascontiguousarray(picture[..., ::-1]))
    if not done:
        raise ValueError(f"picture is {picture.dtype}{list(picture.shape)}: OpenCV cannot encode it; give uint8 RGB")
    return content.tobytes()
