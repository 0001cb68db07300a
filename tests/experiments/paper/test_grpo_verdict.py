"""The verdict on reinforcement: its arms, when a difference counts, and shrunken runs of it and of few labels."""

import dataclasses
import json

import numpy as np
import pytest

from experiments.core.results import Comparison
from experiments.paper import few_labels, grpo_verdict
from experiments.paper.grpo_verdict import GrpoVerdictConfig, algorithm_of, sure
from experiments.paper.label_curves import METHODS, compared_pairs
from experiments.paper.label_curves import verdict as curves_verdict
from experiments.study.study import StudyConfig
from tests.experiments import tiny
from tests.experiments.shrunk import run_shrunk
from touchr1_jax.rl.config import Norm


def difference(low: float, high: float, over: str, *, arm: str = "a", against: str = "b", metric: str = "acc"):
    middle = (low + high) / 2
    return Comparison(
        metric=metric,
        arm=arm,
        against=against,
        difference=middle,
        ci95=(low, high),
        over=over,
        n=5,  # type: ignore[arg-type]
    )


@pytest.mark.parametrize(
    ("objects", "seeds", "metric", "expected"),
    [
        ((1, 2), (0.5, 3), "acc", 1),
        ((1, 2), (-0.5, 3), "acc", 0),  # beyond chance over objects alone
        ((-2, -1), (-3, -0.5), "acc", -1),
        ((-2, -1), (-3, -0.5), "omae", 1),  # a lower error is better
        ((1, 2), (0.5, 3), "omae", -1),
    ],
)
def test_a_difference_counts_beyond_both_intervals(objects, seeds, metric, expected):
    found = [difference(*objects, "objects", metric=metric), difference(*seeds, "seeds", metric=metric)]
    assert sure(found, "a", metric) == expected
    assert sure(found, "other", metric) == 0


def test_an_enumerated_preset_keeps_its_norm_and_draws_no_prompt_twice():
    assert algorithm_of("dapo", exact=False).candidates == 2
    exact = algorithm_of("dapo", exact=True)
    assert (exact.enumerated, exact.candidates, exact.clip_high) == (Norm.STD, 1, 0.28)
    assert algorithm_of("rloo", exact=True).enumerated is Norm.NONE
    assert algorithm_of("rloo", exact=False).enumerated is None


@pytest.mark.parametrize("change", [{"steps": (1,)}, {"lr_scales": ()}, {"presets": ()}])
def test_bad_settings_of_the_verdict_are_refused(change):
    with pytest.raises(ValueError, match=next(iter(change))):
        GrpoVerdictConfig(**change)


@pytest.mark.parametrize("change", [{"labelled": (30, 10)}, {"labelled": (2, 10)}, {"unlabelled": 0}])
def test_bad_settings_of_few_labels_are_refused(change):
    with pytest.raises(ValueError, match=next(iter(change))):
        few_labels.FewLabelsConfig(**change)


def test_the_verdict_of_few_labels_names_where_a_step_pays_and_where_it_costs():
    pays = difference(2, 4, "objects", arm="grpo-10-random", against="two_phases-10-random")
    costs = difference(-4, -2, "objects", arm="two_phases-30-pretrained", against="two_phases-30-random")
    sentences = curves_verdict([pays, costs], [10, 30])
    assert any("GRPO" in s and "10 labels (random encoder) +3.0" in s for s in sentences)
    assert any(s.startswith("Stage 1") and "lowers it at 30 labels -3.0" in s for s in sentences)


def test_every_method_is_compared_with_the_one_that_it_starts_from():
    pairs = compared_pairs(10)
    assert ("physics-10-random", "two_phases-10-random") in pairs
    assert ("two_phases-10-pretrained", "two_phases-10-random") in pairs
    assert len(pairs) == 2 * (len(METHODS) - 1) + 2


SHARED = {field.name: getattr(tiny.STUDY, field.name) for field in dataclasses.fields(StudyConfig)}


@pytest.mark.slow
def test_a_shrunken_verdict_scores_every_arm_on_objects_of_another_seed(tmp_path, cache_dir):
    changes = SHARED | {"grpo": grpo_verdict.SMOKE.grpo, "fresh": dataclasses.replace(tiny.STUDY.scenes, seed=9)}
    small = dataclasses.replace(grpo_verdict.SMOKE, **changes)
    run = run_shrunk(grpo_verdict, small, tmp_path, "--cache-dir", str(cache_dir))
    results = json.loads((run / "results.json").read_text())
    arms = {f"{kind}-rloo-{prompts}" for kind in ("sampled", "enumerated") for prompts in (2, 4)}
    assert set(results["arms"]) == {"sft", "sft_continued", *arms}
    assert {c["against"] for c in results["comparisons"]} == {"sft_continued"}


@pytest.mark.slow
def test_shrunken_learning_curves_hold_every_method_and_encoder(tmp_path, cache_dir):
    kept = few_labels.SMOKE
    small = dataclasses.replace(
        kept,
        **(SHARED | {"grpo": kept.grpo, "grpo_steps": 1}),
        labelled=(4, 6),
        unlabelled=3,
        pretrain=dataclasses.replace(
            kept.pretrain,
            encoder=dataclasses.replace(tiny.STUDY.model.tactile, causal=True),
            frames=tiny.STUDY.model.frames,
            image_px=tiny.STUDY.model.image_px,
        ),
    )
    run = run_shrunk(few_labels, small, tmp_path, "--cache-dir", str(cache_dir))
    results = json.loads((run / "results.json").read_text())
    expected = {f"{m}-{n}-{e}" for m in METHODS for n in (4, 6) for e in ("random", "pretrained")}
    assert set(results["arms"]) == expected
    assert all(np.isfinite(row["acc"]["mean"]) for row in results["arms"].values())
