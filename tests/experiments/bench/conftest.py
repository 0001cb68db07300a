"""One made-up bench for all tests, and the items drawn from it."""

import pytest

from experiments.bench.draw import Quota
from experiments.bench.generate import generate
from tests.experiments.bench import made_up

QUOTA = Quota(identify=144, scale=108, compose=72, compare=108, order=54, one_sensor=72, conflict=72)


@pytest.fixture(scope="session")
def source():
    return made_up.source()


@pytest.fixture(scope="session")
def quota():
    return QUOTA


@pytest.fixture(scope="session")
def found(source):
    return generate(source, QUOTA, seed=0)


@pytest.fixture(scope="session")
def items(found):
    return found.kept
