"""Presets as they are published and reported."""

import dataclasses

import pytest

from touchr1_jax.rl.config import GRPOConfig, preset_name


def test_paper_preset():
    c = GRPOConfig.paper()
    assert (c.group, c.beta, c.learning_rate, c.kl) == (8, 1e-3, 1e-6, "k3")
    assert (c.gamma, c.clip_low, c.clip_high, c.epsilon) == (0.01, 0.2, 0.2, 1e-4)
    assert c.normalise
    assert not c.drop_degenerate
    assert not c.grounding_stop_masked
    assert c.grounding_cap_nat is None


def test_stable_preset():
    c = GRPOConfig.stable()
    assert (c.kl, c.grounding_stop_masked, c.grounding_cap_nat, c.drop_degenerate) == ("exact", True, 1.0, True)
    assert c.gamma == 0.01


def test_micro_batches_must_divide():
    with pytest.raises(ValueError, match="micro_prompts 3 must divide prompts 8; choose a divisor"):
        GRPOConfig(prompts=8, micro_prompts=3)


def test_reports_name_the_nearest_preset_and_what_differs():
    assert preset_name(GRPOConfig.paper()) == "paper"
    assert preset_name(GRPOConfig.stable()) == "stable"
    assert preset_name(dataclasses.replace(GRPOConfig.stable(), gamma=0.0)) == "stable with gamma=0.0"
