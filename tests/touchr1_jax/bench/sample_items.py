"""A few items of every kind."""

from touchr1_jax.bench.items import Ask, Citation, Item, Touch

A, B, C = (Touch(object=name, site=0, motion="press", trial=0) for name in "abc")
SENSORS = ("xense", "tac3d")


def item(kind, answer, touches=(A,), attributes=("hardness",), **fields):
    ask = Ask(
        id=fields.pop("id", f"{kind}-{answer}"),
        kind=kind,
        attributes=attributes,
        touches=touches,
        sensors=fields.pop("sensors", SENSORS),
        answer=answer,
        **fields,
    )
    cited = Citation(touch=0, sensor="xense", quantity="stiffness", value=2.0, unit="N/mm", at=(0.5, 0.25))
    return Item(ask=ask, question="What? – “ρ”\u2028", rationale="so", evidence=(cited,))


def items():
    return (
        item("identify", (2,), id="h", deceptive=False),
        item("identify", (5,), id="m", attributes=("material",)),
        item("scale", (1,), id="s", touches=(B,)),
        item("compose", (0, 2), id="c", attributes=("hardness", "roughness")),
        item("compare", (0,), id="p0", touches=(A, B), group="1", position=0),
        item("compare", (1,), id="p1", touches=(B, A), group="1", position=1),
        item("order", (3,), id="o", touches=(A, B, C)),
        item("one_sensor", (1,), id="x", sensors=("xense",), group="g", position=0),
        item("one_sensor", (1,), id="t", sensors=("tac3d",), group="g", position=1),
        item("conflict", (0,), id="d", deceptive=True, touches=(C,)),
    )
