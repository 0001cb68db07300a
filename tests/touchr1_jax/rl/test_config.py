"""Presets as they are published, chosen and reported."""

import dataclasses
from typing import get_args

import pytest
import tyro

from touchr1_jax.rl.config import (
    Advantage,
    AnyAlgorithm,
    Average,
    Cispo,
    Dapo,
    DrGrpo,
    GRPOConfig,
    Gspo,
    Norm,
    Paper,
    ReinforcePlusPlus,
    Rloo,
    Stable,
    Surrogate,
    TactileUse,
)


def test_paper_preset():
    c, a = GRPOConfig(), Paper()
    assert (c.group, a.beta, c.learning_rate, a.kl) == (8, 1e-3, 1e-6, "k3")
    assert (a.gamma, a.clip_low, a.clip_high, a.epsilon) == (0.01, 0.2, 0.2, 1e-4)
    assert a.advantage is Advantage.GROUP
    assert not a.drop_degenerate
    assert not a.grounding_stop_masked
    assert a.grounding_cap_nat is None
    assert a.tactile_use is TactileUse.OFF
    assert (a.surrogate, a.average, a.updates, a.candidates) == (Surrogate.TOKEN, Average.ROLLOUT, 1, 1)
    assert c.algorithm == a == GRPOConfig().algorithm
    assert not c.lean_compilation


@pytest.mark.parametrize("kind", [GRPOConfig, *get_args(AnyAlgorithm)])
def test_settings_are_given_by_name_and_never_change(kind):
    assert all(field.kw_only for field in dataclasses.fields(kind))
    with pytest.raises(dataclasses.FrozenInstanceError):
        setattr(kind(), dataclasses.fields(kind)[0].name, None)


def test_stable_preset():
    a = Stable()
    assert (a.kl, a.grounding_stop_masked, a.grounding_cap_nat, a.drop_degenerate) == ("exact", True, 1.0, True)
    assert (a.tactile_use, a.gamma, a.beta) == (TactileUse.RECOMMENDED, 0.01, 0.1)
    assert a.advantage is Advantage.BATCH


def test_published_variants():
    assert (Dapo().clip_low, Dapo().clip_high, Dapo().average) == (0.2, 0.28, Average.TOKEN)
    assert (DrGrpo().advantage, DrGrpo().average) == (Advantage.NONE, Average.LENGTH)
    assert (Rloo().advantage, Rloo().average) == (Advantage.LEAVE_ONE_OUT, Average.LENGTH)
    assert (ReinforcePlusPlus().advantage, ReinforcePlusPlus().average) == (Advantage.GLOBAL, Average.TOKEN)
    assert (Gspo().surrogate, Gspo().clip_low, Gspo().clip_high) == (Surrogate.SEQUENCE, 3e-4, 4e-4)
    assert (Cispo().surrogate, Cispo().clip_low, Cispo().clip_high) == (Surrogate.CISPO, 1.0, 4.0)
    assert Cispo().average is Average.TOKEN
    assert {(of().beta, of().gamma) for of in (Dapo, DrGrpo, Rloo, ReinforcePlusPlus, Gspo, Cispo)} == {(0.0, 0.0)}
    assert GRPOConfig(prompts=8, algorithm=Dapo()).drawn == 16


def test_micro_batches_must_divide():
    with pytest.raises(ValueError, match="micro_prompts 3 must divide prompts 8; choose a divisor"):
        GRPOConfig(prompts=8, micro_prompts=3)


def test_a_group_of_one_has_nothing_to_be_compared_with():
    """Its advantage would be 0 in every step; the mean of the batch needs no group."""
    with pytest.raises(ValueError, match="group is 1: must be at least 2"):
        GRPOConfig(group=1)
    with pytest.raises(ValueError, match="group is 1: must be at least 2"):
        GRPOConfig(group=1, algorithm=ReinforcePlusPlus(tactile_use=TactileUse.RECOMMENDED))
    with pytest.raises(ValueError, match=r"best_of is 2: must be .* 1 for advantage PER_REWARD"):
        GRPOConfig(algorithm=Paper(best_of=2, advantage=Advantage.PER_REWARD))
    assert GRPOConfig(group=1, algorithm=ReinforcePlusPlus(tactile_use=TactileUse.LITERAL)).group == 1


@pytest.mark.parametrize("preset", [Paper, DrGrpo, Rloo])
def test_the_best_of_a_whole_group_is_compared_with_that_of_others_alone(preset):
    """Within the group all rollouts share it: a run that asks for pass@8 of groups of 8 would learn nothing."""
    for too_many in (8, 9):
        with pytest.raises(ValueError, match=f"best_of is {too_many}: must be below group 8"):
            GRPOConfig(algorithm=preset(best_of=too_many))
    assert GRPOConfig(algorithm=preset(best_of=7)).algorithm.best_of == 7
    assert GRPOConfig(algorithm=ReinforcePlusPlus(best_of=8)).algorithm.best_of == 8
    with pytest.raises(ValueError, match="best_of is 9"):
        GRPOConfig(algorithm=ReinforcePlusPlus(best_of=9))


@pytest.mark.parametrize(("field", "value"), [("enumerated", Norm.NONE), ("score_centering", 2)])
def test_what_is_summed_over_all_tokens_is_not_drawn_from_a_nucleus(field, value):
    """The sum is over all tokens, while a drawn token has its probability within the nucleus."""
    for cut in ({"top_p": 0.9}, {"min_p": 0.1}):
        with pytest.raises(ValueError, match=rf"top_p is .*, min_p .*: must be 1 and 0 where {field} is set"):
            GRPOConfig(**cut, algorithm=Paper(**{field: value}))


def test_a_conclusion_that_is_not_learned_may_follow_a_moving_reference():
    assert Paper(enumerated=Norm.NONE, learn_conclusion=False, beta=0.0, reference_every=3).reference_every == 3


def test_segments_are_credited_only_where_a_token_has_a_credit_of_its_own():
    """The best of k rewards is none of their sums; one ratio for all tokens gives each the mean of their credits."""
    with pytest.raises(ValueError, match=r"best_of is 2: must be .* 1 for .* segment_credit"):
        GRPOConfig(algorithm=Paper(best_of=2, segment_credit=True))
    with pytest.raises(ValueError, match="segment_credit is True: must be False for surrogate SEQUENCE"):
        Gspo(segment_credit=True)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"updates": 0}, "updates is 0: must be at least 1"),
        ({"reference_every": 0}, "reference_every is 0: must be at least 1"),
        ({"beta": -0.1}, "beta is -0.1: must be ≥ 0"),
        ({"gamma": float("nan")}, "gamma is nan: must be ≥ 0"),
        ({"epsilon": float("inf")}, "epsilon is inf: must be ≥ 0 and finite"),
        ({"tactile_margin": -0.1}, "tactile_margin is -0.1: must be ≥ 0"),
        ({"tactile_margin": float("nan")}, "tactile_margin is nan: must be ≥ 0"),
        ({"grounding_cap_nat": 0.0}, "grounding_cap_nat is 0.0: must be above 0; None leaves it out"),
    ],
)
def test_bad_settings_are_named(change, message):
    with pytest.raises(ValueError, match=message):
        Paper(**change)


def test_the_command_line_chooses_a_preset_and_changes_it():
    default = GRPOConfig(prompts=4)
    assert tyro.cli(GRPOConfig, args=[], default=default) == default
    chosen = tyro.cli(GRPOConfig, args=["--group", "6", "algorithm:stable", "--algorithm.gamma", "0"], default=default)
    assert chosen == dataclasses.replace(default, group=6, algorithm=Stable(gamma=0.0))
    variant = tyro.cli(GRPOConfig, args=["algorithm:dr-grpo", "--algorithm.surrogate", "CISPO"], default=default)
    assert variant.algorithm == DrGrpo(surrogate=Surrogate.CISPO)


def test_the_command_line_reaches_every_option():
    """A flag for each field; those of the README among them."""
    sizes = ["--temperature", "0.8", "--top-p", "0.9", "--min-p", "0.05", "algorithm:paper"]
    flags = {"stale": "2", "minibatches": "2", "importance-cap": "2", "reference-every": "1", "reference-share": "0.1"}
    flags |= {"average": "BATCH"}
    switches = ["importance-sequence", "kl-in-reward", "mask-truncated"]
    named = [word for name, value in flags.items() for word in (f"--algorithm.{name}", value)]
    config = tyro.cli(GRPOConfig, args=[*sizes, *named, *(f"--algorithm.{name}" for name in switches)])
    assert (config.temperature, config.top_p, config.min_p) == (0.8, 0.9, 0.05)
    assert config.algorithm == Paper(
        stale=2,
        minibatches=2,
        importance_cap=2.0,
        importance_sequence=True,
        reference_every=1,
        reference_share=0.1,
        kl_in_reward=True,
        mask_truncated=True,
        average=Average.BATCH,
    )
