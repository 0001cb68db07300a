"""A few answers for the report, with the touch that they are about."""

import re
from collections.abc import Iterable, Mapping

import cv2
import numpy as np

from experiments.core.results import RolloutExample, Slot, Trace
from experiments.study.stages import Weights
from experiments.study.study import Study
from sensors_io.pipeline import make_clip
from sensors_io.schema import Sequence
from touchr1_jax.text.language import SEGMENTS
from touchr1_jax.text.template import QUESTIONS
from touchr1_jax.training.evaluation import Evaluation, reward_terms

FIELD_PX = 192
"""Side of a drawn field."""

ARROWS = 12
"""Arrows along a side of a drawn field."""

ARROW_PX = 14.0
"""Length of the longest arrow: it stays inside its cell."""


def rollout_examples(
    study: Study, arm: str, weights: Weights, instead: Mapping[str, Evaluation] | None = None
) -> tuple[RolloutExample, ...]:
    """For each attribute, the first test question that the arm's first seed got right and the first it got wrong.

    Args:
      study: whose answers they are.
      arm: who answers.
      weights: of the rewards that are shown.
      instead: answers of the same policy and seed with something else in the place of the touch.
    """
    said = study.answers[arm][0]
    asked = said.label[np.arange(len(said.attribute)), said.attribute]
    right = said.parsed.conclude[np.arange(len(said.attribute)), said.attribute] == asked
    rows = []
    for a in range(len(study.policy.language.attributes)):
        for outcome in (True, False):
            rows += np.flatnonzero((said.attribute == a) & (right == outcome))[:1].tolist()
    return rollouts_of(study, arm, weights, rows, instead)


def rollouts_of(
    study: Study,
    arm: str,
    weights: Weights,
    rows: Iterable[int],
    instead: Mapping[str, Evaluation] | None = None,
    group: str = "",
) -> tuple[RolloutExample, ...]:
    """Chosen answers of the arm's first seed.

    Args:
      study, arm, weights, instead: as in `rollout_examples`.
      rows: numbers of the answers.
      group: heading under which they stand.
    """
    said = study.answers[arm][0]
    terms = reward_terms(study.policy, said, weights, study.prior)
    return tuple(
        _example(study, arm, said, row, {name: float(v[row]) for name, v in terms.items()}, instead or {}, group)
        for row in rows
    )


def _example(
    study: Study,
    arm: str,
    said: Evaluation,
    row: int,
    terms: dict[str, float],
    instead: Mapping[str, Evaluation],
    group: str,
) -> RolloutExample:
    data, policy = study.data, study.policy
    contact = int(data.parts["test"][said.contact[row]])
    card = data.store.objects[data.store.contacts[contact].object_id]
    recorded = data.store.contact(contact, fields=True)
    clip = make_clip(recorded, card, data.clip)
    attribute = policy.language.attributes[said.attribute[row]]
    felt = [(s, name) for s, name in enumerate(data.clip.sensors) if clip.stream_mask[s]]
    trace = policy.tokenizer.decode(said.tokens[row])
    return RolloutExample(
        arm=arm,
        object_id=card.object_id,
        question=f"{QUESTIONS[attribute.name]}?",
        label=f"{attribute.name}: {attribute.levels[said.label[row, said.attribute[row]]][0]}",
        trace=trace,
        slots=bodies(trace),
        reward=terms,
        total=sum(terms.values()),
        frames={name: clip.frames[s][clip.frame_mask[s]] for s, name in felt},
        force_n={name: clip.force_n[s][clip.frame_mask[s]] for s, name in felt},
        view=card.view,
        fields={name: drawn for _, name in felt if (drawn := field_picture(recorded[name])) is not None},
        instead={name: traced(policy.tokenizer.decode(other.tokens[row])) for name, other in instead.items()},
        group=group,
    )


def field_picture(recording: Sequence) -> np.ndarray | None:
    """Indentation in colour and displacement as arrows at the strongest press, uint8 RGB; `None` without fields.

    Colours span the frame's own depths; the longest arrow has `ARROW_PX`, so that pictures show shapes, not sizes.
    """
    t = -1 if recording.force_n is None else int(np.argmin(recording.force_n[:, 2]))
    depth, moved = recording.depth_mm, recording.deformation_mm
    if depth is None and moved is None:
        return None
    size = (FIELD_PX, FIELD_PX)
    ground = np.zeros((1, 1), np.float32) if depth is None else depth[t].astype(np.float32)
    grey = cv2.normalize(cv2.resize(ground, size), np.zeros(size, np.uint8), 0, 255, cv2.NORM_MINMAX, cv2.CV_8U)
    picture = cv2.applyColorMap(grey, cv2.COLORMAP_VIRIDIS)
    if moved is not None:
        _draw_arrows(picture, cv2.resize(moved[t].astype(np.float32), (ARROWS, ARROWS), interpolation=cv2.INTER_AREA))
    return np.ascontiguousarray(picture[..., ::-1])


def _draw_arrows(picture: np.ndarray, moved: np.ndarray) -> None:
    """White arrows from the centres of the cells of `moved` [h, w, 2], drawn in place."""
    longest = float(np.linalg.norm(moved, axis=-1).max())
    if longest == 0:
        return
    cell = FIELD_PX / ARROWS
    for y, x in np.ndindex(ARROWS, ARROWS):
        start = (np.array([x, y]) + 0.5) * cell
        end = start + ARROW_PX * moved[y, x] / longest
        tips = [tuple(round(float(v)) for v in point) for point in (start, end)]
        cv2.arrowedLine(picture, tips[0], tips[1], (255, 255, 255), 1, cv2.LINE_AA, tipLength=0.3)


def traced(text: str) -> Trace:
    """A trace with the bodies of its segments."""
    return Trace(text=text, slots=bodies(text))


def bodies(trace: str) -> tuple[Slot, ...]:
    """Start, end and name of the body of each segment of a trace, in order of the text."""
    found = [
        (m.start(1), m.end(1), tag) for tag in SEGMENTS for m in re.finditer(rf"<{tag}>\s*(.*?)\s*</{tag}>", trace)
    ]
    slots: list[Slot] = []
    for start, end, tag in sorted(found):
        if not slots or start >= slots[-1][1]:
            slots.append((start, end, tag))
    return tuple(slots)
