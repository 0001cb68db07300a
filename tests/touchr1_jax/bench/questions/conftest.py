"""One made-up bench for all tests: levels on a grid, measurements that follow them, no records."""

import numpy as np
import pytest

from sensors_io.measures import Measured
from touchr1_jax.bench.items import Touch
from touchr1_jax.bench.questions.contacts import MeasuredContact, SplitContacts
from touchr1_jax.bench.questions.draw import Quota
from touchr1_jax.bench.questions.generate import BenchSource, generate
from touchr1_jax.bench.questions.thresholds import fit_thresholds

SENSORS = ("xense", "tac3d")


def contacts(prefix: str, seed: int) -> tuple[MeasuredContact, ...]:
    """Every combination of three levels, two objects each, two sites; stiffness, texture and relief follow."""
    rng, found = np.random.default_rng(seed), []
    for n in range(27 * 2):
        for site in range(2):
            h, r, p = n % 3, n // 3 % 3, n // 9 % 3
            values = {
                "stiffness": 2.0 + 3 * h + rng.normal(0, 0.5),
                "fine texture": 1.0 + 2 * r + rng.normal(0, 0.5),
                "relief": 0.1 + 0.2 * p + rng.normal(0, 0.05),
                "coarse texture": 5.0 + 4 * p + rng.normal(0, 1.2),
                "force": 10.0 + rng.normal(),
            }
            measured = Measured(frame=3, quantities=values, at=(0.5, 0.45), box=(0.3, 0.3, 0.7, 0.7))
            contact = MeasuredContact(
                touch=Touch(object=f"{prefix}{n}", site=site, motion="press", trial=0),
                labels={"hardness": h, "roughness": r, "protrusion": p, "material": n % 9},
                deceptive=n % 3 != 1,
                measured=dict.fromkeys(SENSORS, measured),
                fingerprint=f"{prefix}{n}/{site}",
            )
            found.append(contact)
    return tuple(found)


@pytest.fixture(scope="session")
def source():
    """54 objects to ask about, 54 others to fit thresholds on."""
    train = contacts("train", 1)
    return BenchSource(
        bench=SplitContacts(contacts=contacts("test", 0), skipped={}),
        train=SplitContacts(contacts=train, skipped={}),
        reader=fit_thresholds(train),
        sensors=SENSORS,
    )


@pytest.fixture(scope="session")
def quota():
    return Quota(identify=144, scale=108, compose=72, compare=108, order=54, one_sensor=72, conflict=72)


@pytest.fixture(scope="session")
def found(source, quota):
    return generate(source, quota, seed=0)


@pytest.fixture(scope="session")
def items(found):
    return found.kept
