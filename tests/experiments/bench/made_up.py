"""A bench of made-up contacts: levels on a grid, numbers that follow them, no records."""

import numpy as np

from experiments.bench.contacts import MeasuredContact, SplitContacts
from experiments.bench.generate import BenchSource
from experiments.bench.thresholds import fit_thresholds
from sensors_io.measures import Measured
from touchr1_jax.bench.items import Touch

SENSORS = ("xense", "tac3d")


def contacts(prefix: str, seed: int, copies: int = 2) -> tuple[MeasuredContact, ...]:
    """Every combination of three levels, `copies` objects each, two sites; stiffness, texture and relief follow."""
    rng, found = np.random.default_rng(seed), []
    for n in range(27 * copies):
        h, r, p = n % 3, n // 3 % 3, n // 9 % 3
        for site in range(2):
            levels = {"hardness": h, "roughness": r, "protrusion": p}
            found.append(_contact(f"{prefix}{n}", site, levels, n, rng))
    return tuple(found)


def _contact(name: str, site: int, levels: dict[str, int], n: int, rng: np.random.Generator) -> MeasuredContact:
    values = {
        "stiffness": 2.0 + 3 * levels["hardness"] + rng.normal(0, 0.5),
        "fine texture": 1.0 + 2 * levels["roughness"] + rng.normal(0, 0.5),
        "relief": 0.1 + 0.2 * levels["protrusion"] + rng.normal(0, 0.05),
        "coarse texture": 5.0 + 4 * levels["protrusion"] + rng.normal(0, 1.2),
        "force": 10.0 + rng.normal(),
    }
    box = (0.3, 0.3, 0.7, 0.7)
    measured = {s: Measured(frame=3, quantities=values, at=(0.5, 0.45), box=box) for s in SENSORS}
    return MeasuredContact(
        touch=Touch(object=name, site=site, motion="press", trial=0),
        labels=levels | {"material": n % 9},
        deceptive=n % 3 != 1,
        measured=measured,
        fingerprint=f"{name}/{site}",
    )


def source() -> BenchSource:
    """54 objects to ask about, 54 others to read numbers by."""
    train = contacts("train", 1)
    return BenchSource(
        bench=SplitContacts(contacts=contacts("test", 0), skipped={}),
        train=SplitContacts(contacts=train, skipped={}),
        reader=fit_thresholds(train),
        sensors=SENSORS,
    )
