"""The levels that the policies of a study answer, beside the true ones: what every report of a study shows."""

from collections.abc import Sequence

import numpy as np

from experiments.core.charts import PALETTE
from experiments.core.levels import Levels, confusion_chart, reliability_table, trust_chart
from experiments.core.results import Picture, Table
from experiments.study.answers import Evaluated
from experiments.study.study import BLIND, SFT, Study
from sensors_io.schema import ATTRIBUTES
from touchr1_jax.bench.metrics import BOTTOM, ORDINAL

_COLUMNS = [ATTRIBUTES.index(name) for name in ORDINAL]


def level_report(study: Study) -> tuple[tuple[Picture, ...], tuple[Table, ...]]:
    """Confusions of every policy, what agreement of its sensors says, and the reliability of each level."""
    objects = study.data.object_ids[study.data.parts["test"]]
    rows = {name: _levels(study.answers[name], objects) for name in (SFT, *study.arms, BLIND)}
    language = study.assembly.language
    words = {n: [level[0] for level in language.attributes[language.attribute_index(n)].levels] for n in ORDINAL}
    felt = {name: said for name, said in rows.items() if said.agree is not None}
    if len(felt) > len(PALETTE):  # more lines than colours: where training begins, and where it ends
        felt = {name: said for name, said in felt.items() if name in (SFT, list(study.arms)[-1])}
    pictures = [
        Picture(
            name="confusions",
            title="Which level is taken for which",
            caption="Share of each answer among the test questions with one label, and their number; seeds pooled.",
            content=confusion_chart(rows, words),
        )
    ]
    if felt:
        pictures.append(
            Picture(
                name="trust",
                title="How far an answer can be trusted",
                caption="Right answers, given how many sensors alone say the same as all together; areas are shares of "
                "the answers, lines 95 % over objects; hardness, roughness, protrusion and all seeds pooled.",
                content=trust_chart(felt),
            )
        )
    return tuple(pictures), (reliability_table({name: rows[name] for name in (SFT, *study.arms)}, words),)


def _levels(seeds: Sequence[Evaluated], objects: np.ndarray) -> Levels:
    agree = [_agree(said) for said in seeds]
    return Levels(
        answer=np.concatenate([np.asarray(said.parsed.conclude)[:, _COLUMNS] for said in seeds]),
        label=np.concatenate([said.label[:, _COLUMNS] for said in seeds]),
        objects=np.concatenate([objects[said.contact] for said in seeds]),
        agree=np.concatenate([x for x in agree if x is not None]) if all(x is not None for x in agree) else None,
    )


def _agree(said: Evaluated) -> np.ndarray | None:
    """How many sensors alone say what all together say, int [N, A]; `None` where none was asked alone."""
    if said.alone is None:
        return None
    together = np.asarray(said.parsed.conclude)
    same = (said.alone == together[:, None]) & (said.alone != BOTTOM) & said.streams[:, :, None]
    return same.sum(1)[:, _COLUMNS]
