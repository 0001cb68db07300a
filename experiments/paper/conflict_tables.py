"""The tables of who is believed where sight and touch differ, and of what touch is worth."""

from collections.abc import Mapping

from experiments.core.results import Cell, Column, Table
from experiments.paper.conflict_metrics import Contrast, Use
from touchr1_jax.bench.grounding import CONTROLS, SHUFFLE


def contrast_table(full: Mapping[str, Contrast], sft: Mapping[str, Contrast]) -> Table:
    """Accuracy of vision-only, SFT and the full model on every group, and the lead of the full model.

    Args:
      full, sft: group → the policy against the one without touch, the same groups of both.
    """
    rows: list[tuple[Cell, ...]] = [
        (
            group,
            c.questions,
            c.theirs,
            sft[group].ours,
            c.ours,
            f"{c.seeds.mean:+.1f} [{c.seeds.low:.1f}, {c.seeds.high:.1f}]",
            f"[{c.objects.low:.1f}, {c.objects.high:.1f}]",
        )
        for group, c in full.items()
    ]
    return Table(
        title="Right answers where sight helps and where it lies",
        columns=(
            Column(name="questions"),
            Column(name="number", format=".0f", meaning="mean over seeds"),
            Column(name="vision-only", unit="%", format=".1f", meaning="the policy without touch"),
            Column(name="SFT", unit="%", format=".1f"),
            Column(name="full model", unit="%", format=".1f"),
            Column(
                name="lead", unit="points", meaning="full model less vision-only, with its 95 % interval over seeds"
            ),
            Column(name="over objects", meaning="95 % interval of the lead when whole objects are resampled"),
        ),
        rows=tuple(rows),
        note="All four attributes. Deceptive: the object looks like another, and most policies without touch of other "
        "seeds name another level than the label.",
    )


def use_table(uses: Mapping[tuple[str, str], Use | None]) -> Table:
    """The gain over every control, and the least of them.

    Args:
      uses: policy and questions → what touch is worth, `None` where too few objects have such a question.
    """
    rows: list[tuple[Cell, ...]] = []
    for (name, where), found in uses.items():
        if found is not None:
            spans = [found.gains[c] for c in CONTROLS]
            least = found.least
            cells = [f"{s.mean:+.1f} [{s.low:.1f}, {s.high:.1f}]" for s in (*spans, least.gain)]
            rows.append((f"{name}, {where}", *cells, least.control))
    return Table(
        title="What touch is worth",
        columns=(
            Column(name="policy and questions"),
            *(Column(name=c, unit="points", meaning=MEANINGS[c]) for c in CONTROLS),
            Column(name="least", unit="points", meaning=f"without {SHUFFLE}, since no answer lies in the order here"),
            Column(name="over"),
        ),
        rows=tuple(rows),
        note="Accuracy over hardness, roughness and protrusion given the touch, less that under each control. Policies "
        "never met a prompt without any stream, and what they say then can often not be read: what touch is worth over "
        "having none is told by the policy that was trained without it, in the tables above.",
    )


MEANINGS = {
    "drop": "no stream at all",
    "shuffle": "the time steps of every stream in another order",
    "noise": "encoded noise of each sensor's statistics in the place of its touch",
    "swapped": "another object's touch",
}
