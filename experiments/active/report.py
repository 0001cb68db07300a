"""Tables, charts and pictures of `active_touch`."""

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float, Int

from experiments.active.contacts import PROPERTIES, ContactsConfig
from experiments.active.headroom import EVERY, PLANS, Beliefs, single
from experiments.active.plans import Played
from experiments.core.charts import Panel, draw, estimates
from experiments.core.pictures import Heatmap, heatmaps, image_grid
from experiments.core.results import Cell, Estimate, Picture, Table, named_table
from experiments.study.estimates import RESAMPLES
from touchr1_jax.bench.statistics import clustered_bootstrap
from touchr1_jax.training.exploration import NO_CHOICE

PROCEDURES: Mapping[str, str] = {
    "hardness": "pressure",
    "roughness": "lateral motion",
    "protrusion": "contour following, enclosure",
    "elasticity": "pressure",
    "friction": "lateral motion",
}
"""What people do to find out (Lederman & Klatzky, Cognitive Psychology 19, 342, 1987); elasticity is their compliance,
friction is not among their properties and belongs to the surface, as texture does."""

MOTION_OF: Mapping[str, tuple[str, ...]] = {
    "pressure": ("press", "hold", "tap"),
    "lateral motion": ("slide_x", "slide_y"),
    "contour following, enclosure": ("roll", "twist"),
}
"""Motions of the protocol that are most like a procedure."""


def headroom_table(found: Mapping[tuple[str, int], Float[np.ndarray, "O A"]], source: str) -> Table:
    """Accuracy of every plan by number of contacts."""
    counts = sorted({count for _, count in found if count})
    name = lambda k: f"{k} contact" if k == 1 else f"{k} contacts"
    rows: list[dict[str, Cell]] = [
        {"plan": plan} | {name(k): 100 * float(found[plan, k].mean()) for k in counts} for plan in PLANS
    ]
    rows.append({"plan": EVERY, name(counts[0]): None, "all": 100 * float(found[EVERY, 0].mean())})
    headings = [name(k) for k in counts] + ["all"]
    return named_table(
        f"Headroom, by {source}",
        rows,
        formats=dict.fromkeys(headings, ".1f"),
        units=dict.fromkeys(headings, "%"),
        note="Right answers about test objects, mean over the five questions, before any policy learned to choose. "
        "Beliefs from several contacts are added as if their errors were independent. Plans were looked up on "
        "validation objects; trees choose by the belief so far.",
    )


def probe_table(contacts: ContactsConfig, beliefs: Beliefs) -> Table:
    """Accuracy of one contact by question and motion, each sensor's best force, in the order of the sensors."""
    right = np.stack([single(beliefs, a).mean(0) for a in beliefs.questions])  # A C
    by = right.reshape(len(PROPERTIES), len(contacts.sensors), len(contacts.motions), -1).max(-1)
    rows = [
        {"question": name}
        | {m: " ".join(f"{100 * by[a, s, i]:.0f}" for s in range(by.shape[1])) for i, m in enumerate(contacts.motions)}
        for a, name in enumerate(PROPERTIES)
    ]
    order = ", ".join(contacts.sensors)
    note = f"Right answers of linear probes about test objects, %. Sensors in the order {order}; the best force."
    return named_table("One contact, by probes", rows, note=note)


def first_choices(contacts: ContactsConfig, played: Sequence[Played]) -> Float[np.ndarray, "A C"]:
    """Share of first contacts of each choice by question."""
    first = np.concatenate([p.choices[..., 0] for p in played])  # n A
    return np.stack([(first == c).mean(0) for c in range(len(contacts.choices))], 1)


def first_touch_picture(contacts: ContactsConfig, played: Sequence[Played], beliefs: Beliefs) -> Picture:
    """First touches by question and motion, next to the probes' accuracy."""
    right = np.stack([single(beliefs, a).mean(0) for a in beliefs.questions])
    shape = (len(PROPERTIES), len(contacts.sensors), len(contacts.motions), len(contacts.forces_n))
    columns = [f"{m}\n{s[:2].upper()}" for m in contacts.motions for s in contacts.sensors]
    chosen = first_choices(contacts, played).reshape(shape).sum(-1).swapaxes(1, 2).reshape(len(PROPERTIES), -1)
    probe = right.reshape(shape).max(-1).swapaxes(1, 2).reshape(len(PROPERTIES), -1)
    percent = lambda x: [[f"{100 * v:.0f}" if v >= 0.005 else "" for v in row] for row in x]
    maps = [
        Heatmap(
            chosen, rows=PROPERTIES, columns=columns, title="first touches of the policy, %", cells=percent(chosen)
        ),
        Heatmap(
            probe, rows=PROPERTIES, columns=columns, title="right answers of a probe on it, %", cells=percent(probe)
        ),
    ]
    return Picture(
        name="first_touches",
        title="First touch by question",
        caption="Above: how often the policy begins with a motion and a sensor, over seeds and test objects. Below: "
        "accuracy of linear probes on that contact at its best force. Sensors by their first two letters.",
        content=heatmaps(maps, columns=1, size=(0.42 * len(columns) + 1.6, 5.2)),
    )


def procedures_table(contacts: ContactsConfig, played: Sequence[Played], beliefs: Beliefs) -> Table:
    """First motion by question next to the probes' best motion and to what people do."""
    shape = (len(PROPERTIES), len(contacts.sensors), len(contacts.motions), -1)
    share = first_choices(contacts, played).reshape(shape).sum((1, 3))
    rows: list[dict[str, Cell]] = []
    for a, name in enumerate(PROPERTIES):
        by = motion_accuracy(contacts, beliefs, a)
        best = int(by.argmax())
        motion = int(share[a].argmax())
        procedure = PROCEDURES[name]
        rows.append(
            {
                "question": name,
                "first motion": contacts.motions[motion],
                "share": 100 * float(share[a, motion]),
                "probes' best motion": contacts.motions[best],
                "its accuracy": 100 * float(by[best]),
                "accuracy of the first motion": 100 * float(by[motion]),
                "people": procedure,
                "like people": contacts.motions[motion] in MOTION_OF[procedure],
            }
        )
    return named_table(
        "First motion, probes, people",
        rows,
        formats={"share": ".0f", "its accuracy": ".1f", "accuracy of the first motion": ".1f"},
        units={"share": "%", "its accuracy": "%", "accuracy of the first motion": "%"},
        meanings={"people": "exploratory procedure of Lederman & Klatzky (1987)"},
    )


def motion_accuracy(contacts: ContactsConfig, beliefs: Beliefs, question: int) -> Float[np.ndarray, "M"]:
    """Accuracy of each motion for a question, by its best sensor and force."""
    right = single(beliefs, question).mean(0)
    by: np.ndarray = right.reshape(len(contacts.sensors), len(contacts.motions), -1).max((0, 2))
    return by


def found_motion(contacts: ContactsConfig, first: Int[np.ndarray, "n"], beliefs: Beliefs, question: int) -> bool:
    """True if the commonest first motion is the probes' best or lies within the interval of its accuracy."""
    touched = first[first != NO_CHOICE]
    if not len(touched):
        return False
    per_sensor, per_motion = len(contacts.motions) * len(contacts.forces_n), len(contacts.forces_n)
    motion = np.bincount(touched % per_sensor // per_motion, minlength=len(contacts.motions)).argmax()
    right = single(beliefs, question)
    of_best = right[:, right.mean(0).argmax()].astype(float)
    best = clustered_bootstrap(of_best, np.arange(len(right)), resamples=RESAMPLES)
    return bool(motion_accuracy(contacts, beliefs, question)[motion] >= best.low)


def found_questions(contacts: ContactsConfig, played: Played, beliefs: Beliefs) -> list[str]:
    """Questions whose first motion is the probes' best, or within the interval of its accuracy."""
    found = lambda a: found_motion(contacts, played.choices[:, a, 0], beliefs, a)
    return [name for a, name in enumerate(PROPERTIES) if found(a)]


def seconds_picture(points: Mapping[str, Sequence[tuple[float, Estimate]]]) -> Picture:
    """Accuracy over seconds of touch: plan → its (seconds, accuracy in %)."""
    series = [
        estimates(name, [found for _, found in row], at=[s for s, _ in row], line="-" if len(row) > 1 else "")
        for name, row in points.items()
    ]
    never = any(s == 0 for row in points.values() for s, _ in row)  # a policy that never touches
    panel = Panel(
        series,
        x_label="seconds of touch a question",
        y_label="right on test objects, %",
        x_scale="symlog" if never else "log",
    )
    return Picture(
        name="accuracy_over_seconds",
        title="Accuracy over seconds of touch",
        caption="Right answers about test objects over the mean time of touch, with 95 % intervals over objects.",
        content=draw([panel], size=(7.6, 4.6)),
    )


def trajectory_picture(rows: Mapping[str, np.ndarray]) -> Picture:
    """Contacts that the policy chose, in pictures: name → frames."""
    return Picture(
        name="trajectories",
        title="What the policy touched",
        caption="One row a contact: question, choice, conclusion. Above the picture of the sensor's camera "
        "(black without one), below displacement and depth; time runs to the right.",
        content=image_grid({name: list(frames) for name, frames in rows.items()}, cell_inch=1.1),
        kind="png",
    )
