"""A few answers for the report, with the touch that they are about."""

import dataclasses
import re
from collections.abc import Iterable, Mapping

import cv2
import numpy as np

from experiments.core.results import RolloutExample, Slot, Trace
from experiments.study.answers import asked_label, concluded
from experiments.study.stages import Weights
from experiments.study.study import Study
from sensors_io.pipeline import make_clip
from sensors_io.schema import Sequence
from touchr1_jax.text.language import SEGMENTS
from touchr1_jax.text.template import QUESTIONS
from touchr1_jax.training.evaluation import Evaluation, reward_terms

FIELD_PX = 192  # side of a drawn field
ARROWS = 12  # arrows along a side of a drawn field
SCALE_PX = 58  # width of the scale next to it
ARROW_PX = 14.0  # length of the longest arrow: it stays inside its cell


def rollout_examples(
    study: Study, arm: str, weights: Weights, instead: Mapping[str, Evaluation] = {}
) -> tuple[RolloutExample, ...]:
    """For each attribute, the first test question that the arm's first seed got right and the first it got wrong.

    `instead` are answers of the same policy and seed with something else in the place of the touch.
    """
    answers = study.answers[arm][0]
    right = concluded(answers) == asked_label(answers)
    rows = []
    for a in range(len(study.policy.language.attributes)):
        for outcome in (True, False):
            rows += np.flatnonzero((answers.attribute == a) & (right == outcome))[:1].tolist()
    return rollouts_of(study, arm, weights, rows, instead)


def rollouts_of(
    study: Study,
    arm: str,
    weights: Weights,
    rows: Iterable[int],
    instead: Mapping[str, Evaluation] = {},
    group: str = "",
) -> tuple[RolloutExample, ...]:
    """Answers `rows` of the arm's first seed under the heading `group`; other arguments as in `rollout_examples`."""
    data, policy, answers = study.data, study.policy, study.answers[arm][0]
    terms = reward_terms(policy, answers, weights, study.prior)

    def answer(found: Evaluation, row: int) -> Trace:
        concluded, asked = found.parsed.conclude[row], answers.attribute[row]
        right = bool(concluded[asked] == answers.label[row, asked])
        return dataclasses.replace(marked(policy.tokenizer.decode(found.tokens[row])), right=right)

    def example(row: int) -> RolloutExample:
        contact = int(data.parts["test"][answers.contact[row]])
        card = data.store.objects[data.store.contacts[contact].object_id]
        recorded = data.store.contact(contact, fields=True)
        clip = make_clip(recorded, card, data.clip)
        attribute = policy.language.attributes[answers.attribute[row]]
        shown = [(s, name) for s, name in enumerate(data.clip.sensors) if clip.stream_mask[s]]
        trace, reward = answer(answers, row), {name: float(values[row]) for name, values in terms.items()}
        return RolloutExample(
            arm=arm,
            object_id=card.object_id,
            question=f"{QUESTIONS[attribute.name]}?",
            label=f"{attribute.name}: {attribute.levels[answers.label[row, answers.attribute[row]]][0]}",
            trace=trace.text,
            slots=trace.slots,
            reward=reward,
            total=sum(reward.values()),
            frames={name: clip.frames[s][clip.frame_mask[s]] for s, name in shown},
            force_n={name: clip.force_n[s][clip.frame_mask[s]] for s, name in shown},
            view=card.view,
            fields={name: drawn for _, name in shown if (drawn := field_picture(recorded[name])) is not None},
            instead={name: answer(o, row) for name, o in instead.items()},
            others={n: answer(o[0], row) for n, o in study.answers.items() if o and n != arm and n not in instead},
            right=trace.right,
            group=group,
        )

    return tuple(map(example, rows))


def field_picture(recording: Sequence) -> np.ndarray | None:
    """Indentation in colour and displacement as arrows at the strongest press, uint8 RGB; `None` without fields.

    Colours span the frame's own depths, which a scale in mm next to them states; the longest arrow has `ARROW_PX`.
    """
    t = -1 if recording.force_n is None else int(np.argmin(recording.force_n[:, 2]))
    depth, moved = recording.depth_mm, recording.deformation_mm
    if depth is None and moved is None:
        return None
    size = (FIELD_PX, FIELD_PX)
    ground = np.zeros((1, 1), np.float32) if depth is None else depth[t].astype(np.float32)
    grey = cv2.normalize(cv2.resize(ground, size), np.zeros(size, np.uint8), 0, 255, cv2.NORM_MINMAX, cv2.CV_8U)
    picture = cv2.applyColorMap(grey, cv2.COLORMAP_VIRIDIS)
    moves = np.zeros((ARROWS, ARROWS, 2), np.float32)
    if moved is not None:
        moves = cv2.resize(moved[t].astype(np.float32), (ARROWS, ARROWS), interpolation=cv2.INTER_AREA)
    longest = float(np.linalg.norm(moves, axis=-1).max())
    for y, x in np.ndindex(ARROWS, ARROWS) if longest else ():
        start = (np.array([x, y]) + 0.5) * FIELD_PX / ARROWS
        end = start + ARROW_PX * moves[y, x] / longest
        tips = [tuple(round(float(v)) for v in point) for point in (start, end)]
        cv2.arrowedLine(picture, tips[0], tips[1], (255, 255, 255), 1, cv2.LINE_AA, tipLength=0.3)
    if depth is not None:
        picture = np.hstack([picture, depth_scale(float(ground.min()), float(ground.max()))])
    return np.ascontiguousarray(picture[..., ::-1])


def depth_scale(least_mm: float, most_mm: float) -> np.ndarray:
    """The colours of depth from the deepest to the shallowest with their figures, uint8 BGR [FIELD_PX, SCALE_PX, 3]."""
    drawn = np.full((FIELD_PX, SCALE_PX, 3), 255, np.uint8)
    ramp = np.linspace(255, 0, FIELD_PX).astype(np.uint8)[:, None]
    drawn[:, 4:14] = cv2.applyColorMap(ramp, cv2.COLORMAP_VIRIDIS)
    for text, y in ((f"{most_mm:.2f}", 12), ("mm", 26), (f"{max(least_mm, 0.0):.2f}", FIELD_PX - 4)):
        cv2.putText(drawn, text, (17, y), cv2.FONT_HERSHEY_SIMPLEX, 0.42, (60, 60, 60), 1, cv2.LINE_AA)
    return drawn


def marked(text: str) -> Trace:
    """An answer with start, end and name of the body of each segment, in order of the text."""
    found = [(m.start(1), m.end(1), tag) for tag in SEGMENTS for m in re.finditer(rf"<{tag}>\s*(.*?)\s*</{tag}>", text)]
    slots: list[Slot] = []
    for start, end, tag in sorted(found):
        if not slots or start >= slots[-1][1]:
            slots.append((start, end, tag))
    return Trace(text=text, slots=tuple(slots))
