"""The scales beyond a processor: of one kind, of the paper's numbers, asking for a machine."""

import pytest

from experiments.paper import (
    ablation_cumulative,
    ablation_leave_one_out,
    conflict,
    main_table,
    presets,
    qualitative,
    scaling,
)


@pytest.mark.parametrize(
    "module", [ablation_cumulative, ablation_leave_one_out, conflict, main_table, qualitative, scaling]
)
def test_a_large_scale_needs_a_machine(module):
    experiment = module.EXPERIMENT
    large = set(experiment.scales) - {"smoke"}
    assert large >= {"gpu"}
    assert set(experiment.needs) == large
    assert all(experiment.needs[name] == presets.NEEDS[name] for name in large)


def test_the_paper_s_scale_has_the_paper_s_numbers():
    study = presets.PAPER
    assert (study.scenes.objects, study.scenes.sequences, study.scenes.image_px) == (1000, 14_700, 448)
    assert study.scenes.split_shares[2] * study.scenes.objects == 200
    assert (study.model.frames, study.model.image_px, study.grpo.group) == (8, 448, 8)
    decoder = study.model.decoder
    assert (decoder.hidden_size, decoder.num_layers, decoder.mrope_section) == (3584, 28, (16, 24, 24))
    asked = study.sft.steps * study.sft.batch_size * study.sft.questions
    assert 240_000 - 256 < asked <= 240_000
    assert 120_000 - 128 < study.grpo_steps * study.grpo.prompts <= 120_000
