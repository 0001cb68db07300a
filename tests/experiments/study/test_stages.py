"""Evidence of the contacts of a study."""

import dataclasses

import numpy as np
import pytest

from experiments.study.stages import ProbeFeatures, gather_evidence
from sensors_io.schema import LEVELS
from touchr1_jax.training.linear_probe import ProbeConfig

PROBE = ProbeConfig(folds=2, iterations=4)


@pytest.fixture(scope="module")
def probed(data):
    """Random features of every stream; sensors 0 and 1 miss one contact each, sensor 2 saw one alone, sensor 3 none."""
    n = len(data.store)
    present = np.ones((n, 4), bool)
    present[data.parts["sft"][:2], [0, 1]] = False
    present[:, 2] = np.arange(n) == data.parts["sft"][0]
    present[:, 3] = False
    streams = np.random.default_rng(0).normal(size=(n, 4, 5)).astype(np.float32)
    return ProbeFeatures(streams=streams, present=present, force=np.zeros((n, 1), np.float32))


def test_evidence_of_what_was_felt_is_a_distribution_and_of_the_rest_nothing(data, probed, context):
    evidence = gather_evidence(data, probed, PROBE, context)
    sft = np.isin(np.arange(len(data.store)), data.parts["sft"])
    for a, levels in enumerate(LEVELS.values()):
        assert (evidence[:, :, a, levels:] == -np.inf).all()
        for s in (0, 1):
            felt = sft & probed.present[:, s]
            known = evidence[:, s, a, :levels]
            np.testing.assert_allclose(np.exp(known[felt]).sum(-1), 1, atol=1e-5)
            assert np.ptp(known[felt], axis=-1).min() > 0
            assert (known[~felt] == 0).all()
        assert (evidence[:, 3, a, :levels] == 0).all()  # sensor 3 was never there
        assert (evidence[:, 2, a, :levels] == 0).all()  # one object cannot be held out


def test_an_attribute_that_nobody_annotated_has_no_evidence(data, probed, context):
    label = np.where(np.arange(4) == 0, -1, data.label)
    evidence = gather_evidence(dataclasses.replace(data, label=label), probed, PROBE, context)
    assert (evidence[:, :, 0, :3] == 0).all()
    assert (evidence[data.parts["sft"][1:], 0, 1, :3] != 0).all()
