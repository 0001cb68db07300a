"""The lengths of both phases of SFT: which combinations none beats, and the shrunken run."""

import pytest

from experiments.core.artifacts import read_json
from experiments.paper import pareto_sft
from experiments.paper.pareto_sft import ParetoSFTConfig, PhaseResult, efficient
from tests.experiments import tiny
from tests.experiments.shrunk import run_shrunk


def result(seconds: float, accuracy: float) -> PhaseResult:
    return PhaseResult(seconds=seconds, accuracy=accuracy, material=30.0, omae=0.5)


def test_combinations_that_none_beats_by_hand():
    found = {(1, 0): result(10, 50), (1, 9): result(30, 60), (2, 0): result(20, 49), (2, 9): result(40, 60)}
    assert efficient(found) == [(1, 0), (1, 9)]


@pytest.mark.parametrize(
    ("change", "message"),
    [({"end_to_end": (0,)}, "end_to_end is .0,.: must hold"), ({"decoder": ()}, "decoder is ..: must hold")],
)
def test_lengths_without_a_phase_are_refused(change, message):
    with pytest.raises(ValueError, match=message):
        ParetoSFTConfig(**change)


@pytest.mark.slow
def test_every_combination_is_trained_and_scored_on_validation_objects(tmp_path, cache_dir):
    config = ParetoSFTConfig(study=tiny.STUDY, end_to_end=(1, 2), decoder=(0, 1))
    results = read_json(run_shrunk(pareto_sft, config, tmp_path, "--cache-dir", str(cache_dir)) / "results.json")
    (table,) = results["tables"]
    assert [row[:2] for row in table["rows"]] == [[1, 0], [1, 1], [2, 0], [2, 1]]
