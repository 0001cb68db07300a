"""Learning curves over labelled contacts: comparisons, table, chart and verdict of `few_labels`."""

from collections.abc import Mapping, Sequence
from typing import Literal

import numpy as np

from experiments.core.charts import Panel, draw, estimates
from experiments.core.results import Cell, Comparison, Estimate, Table, named_table
from experiments.core.text import bounds, interval

Method = Literal["sft", "two_phases", "grpo", "agreement", "physics"]
METHODS: tuple[Method, ...] = ("sft", "two_phases", "grpo", "agreement", "physics")

RANDOM, PRETRAINED = "random", "pretrained"  # encoders that SFT starts from

COMPARED = ("acc", "omae", "mat_acc")


def compared_pairs(count: int) -> list[tuple[str, str]]:
    """Policies that are compared: each method with the one that it starts from, and pretrained with random encoders."""
    before: Mapping[Method, Method] = {"two_phases": "sft", "grpo": "two_phases"}
    before = {**before, "agreement": "two_phases", "physics": "two_phases"}
    of_methods = [(f"{a}-{count}-{e}", f"{b}-{count}-{e}") for e in (RANDOM, PRETRAINED) for a, b in before.items()]
    of_encoders = [(f"{m}-{count}-{PRETRAINED}", f"{m}-{count}-{RANDOM}") for m in ("sft", "two_phases")]
    return of_methods + of_encoders


def verdict(comparisons: Sequence[Comparison], counts: Sequence[int]) -> tuple[str, ...]:
    """For each step of training, numbers of labels at which it pays, and at which it costs, beyond both intervals."""
    steps = {
        "SFT in two phases": ("two_phases", "sft", None),
        "GRPO on labelled contacts": ("grpo", "two_phases", None),
        "agreement of sensors without labels": ("agreement", "two_phases", None),
        "measured physics without labels": ("physics", "two_phases", None),
        "stage 1": ("two_phases", "two_phases", PRETRAINED),
    }
    sentences = []
    for title, (a, b, encoder) in steps.items():
        pays, costs = [], []
        for count in counts:
            for start in (RANDOM, PRETRAINED) if encoder is None else (encoder,):
                of = f"{a}-{count}-{start}", f"{b}-{count}-{start if encoder is None else RANDOM}"
                found = [c for c in comparisons if (c.arm, c.against) == of and c.metric == "acc"]
                label = f"{count} labels" + (f" ({start} encoder)" if encoder is None else "")
                if found and all(c.low > 0 for c in found):
                    pays.append(f"{label} {found[0].difference:+.1f}")
                if found and all(c.high < 0 for c in found):
                    costs.append(f"{label} {found[0].difference:+.1f}")
        sentences.append(
            f"{title[0].upper()}{title[1:]} raises accuracy beyond chance at {', '.join(pays) or 'no number of labels'}"
            f" and lowers it at {', '.join(costs) or 'none'}."
        )
    return tuple(sentences)


def curve_table(
    rows: Mapping[str, Mapping[str, Estimate]], comparisons: Sequence[Comparison], counts: Sequence[int]
) -> Table:
    """Every policy with its difference from the one that it starts from."""
    lines: list[dict[str, Cell]] = []
    for encoder in (RANDOM, PRETRAINED):
        for count in counts:
            for method in METHODS:
                name = f"{method}-{count}-{encoder}"
                row = rows[name]
                line: dict[str, Cell] = {"policy": name, "accuracy": interval(row["acc"], ".1f")}
                line |= {"OMAE": row["omae"].mean, "material": row["mat_acc"].mean if "mat_acc" in row else None}
                for c in comparisons:
                    same = c.arm == name and c.metric == "acc" and c.against.endswith(f"-{encoder}")
                    if same and c.over == "objects":
                        line["gain"] = f"{c.difference:+.1f} {bounds(c.low, c.high, '.1f')}"
                lines.append(line)
    return named_table(
        "Policies by method, labelled contacts and encoder",
        lines,
        formats={"OMAE": ".3f", "material": ".1f"},
        units={"accuracy": "%", "OMAE": "levels", "material": "%", "gain": "points"},
        meanings={"gain": "accuracy minus that of the policy that training starts from, 95 % over objects"},
        note="sft is end to end; GRPO, agreement and physics start from two_phases.",
    )


def curve_chart(rows: Mapping[str, Mapping[str, Estimate]], counts: Sequence[int]) -> bytes:
    """Draw accuracy over the number of labels, a panel for each encoder."""
    panels = []
    for encoder in (RANDOM, PRETRAINED):
        series = []
        for i, method in enumerate(METHODS):
            found = [rows[f"{method}-{count}-{encoder}"]["acc"] for count in counts]
            series.append(estimates(method, found, at=np.arange(len(counts)), shift=0.06 * (i - 2)))
        ticks = {float(i): str(count) for i, count in enumerate(counts)}
        panels.append(
            Panel(series, title=f"{encoder} encoder", x_label="labelled contacts", y_label="right (%)", x_ticks=ticks)
        )
    return draw(panels, size=(10.0, 4.0))
