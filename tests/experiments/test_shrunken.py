"""Every experiment runs shrunken, from its command to its report: here, or where its run serves other tests too."""

import dataclasses
import importlib
from collections.abc import Callable
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np
import pytest

from experiments.core.artifacts import read_json
from experiments.core.commands import find
from experiments.encoder.pretrain import StageOneDataConfig
from experiments.paper.components import COMPONENTS
from experiments.study.stages import StudySFT
from experiments.study.study import StudyConfig
from sensors_io.scenes.config import SceneConfig
from tests.experiments import tiny
from tests.experiments.shrunk import run_shrunk
from touchr1_jax.bench.questions.draw import Quota
from touchr1_jax.models.frame_decoder import FrameDecoderConfig
from touchr1_jax.models.predictor import PredictorConfig
from touchr1_jax.training.linear_probe import ProbeConfig
from touchr1_jax.training.pretraining import PretrainConfig

small = dataclasses.replace
CAUSAL = small(tiny.MODEL.tactile, causal=True)
IMAGES = {"frames": tiny.MODEL.frames, "image_px": tiny.MODEL.image_px}
PROBE = ProbeConfig(folds=2, iterations=2)
STUDY = small(tiny.STUDY, grpo_steps=1, share=False, sft=StudySFT(steps=0))  # the phases of the default
FEW = Quota(identify=8, scale=0, compose=3, compare=2, order=0, one_sensor=8, conflict=0)
SHARED = {field.name: getattr(tiny.STUDY, field.name) for field in dataclasses.fields(StudyConfig)}
CONTROLS = ["sft", "sft_continued"]
ADDED, OMITTED = [c.added.name for c in COMPONENTS], [c.omitted.name for c in COMPONENTS]


def rows(results: dict, table: int = 0) -> list[list]:
    return results["tables"][table]["rows"]


def met(m: ModuleType, results: dict) -> bool:
    return all(r["met"] for r in results["requirements"])


class Shrunk(NamedTuple):
    """A configuration, what must hold of the results, the pictures that the report has at least, and what it takes."""

    config: Callable[[ModuleType], Any]
    holds: Callable[[ModuleType, dict], Any] = lambda m, r: True
    plots: str = ""
    seconds: float = 60.0


def tangential_holds(m: ModuleType, results: dict) -> bool:
    """Errors fall with the tolerance and with the iterations, and the default setting keeps 15 % on 24²."""
    by_task = [{row[0]: row[1:] for row in rows(results, i)} for i in range(len(m.METHODS))]
    tight = all(t[f"{m.SOLVER} 0.0003"][3] < t[f"{m.SOLVER} 0.02"][3] and t[m.MAIN][3] < 15 for t in by_task)
    return tight and all(t[f"{m.PLAIN} 80"][1] < t[f"{m.PLAIN} 5"][1] < t["full slip"][1] for t in by_task[1:])


def contact_holds(m: ModuleType, results: dict) -> bool:
    """A bonded gel sticks less than a half-space."""
    return met(m, results) and all(0.7 * flagged < matters <= flagged for _, flagged, matters, _ in rows(results, 1))


def scaling_holds(m: ModuleType, results: dict) -> bool:
    counts = [row[1] for row in rows(results)]
    return counts[0] == counts[1] < counts[2] and all(value > 0 for row in rows(results) for value in row[3:])


ABLATION = Shrunk(lambda m: STUDY, lambda m, r: list(r["arms"]) == [*CONTROLS, *m.ABLATION.arms])

RUNS = {
    "paper_audit": Shrunk(lambda m: m.DEFAULT, met, "distance average", seconds=0.5),
    "vtv150k": Shrunk(
        lambda m: small(m.EXPERIMENT.scales["smoke"], probe=ProbeConfig(folds=3, iterations=4), questions=24),
        lambda m, r: {row[0]: row[10] for row in rows(r)}["guessing"] == pytest.approx(31.6, abs=0.05),
    ),
    "pareto_encoder": Shrunk(
        lambda m: m.ParetoEncoderConfig(
            touch=StageOneDataConfig(scenes=small(tiny.SCENES, frames=8), probe=PROBE),
            pretrain=PretrainConfig(
                encoder=small(PretrainConfig().encoder, width=12, num_layers=1),
                predictor=PredictorConfig(width=12, num_layers=1),
                frames=8, steps=1, batch_size=2, probe_every=1,
            ),
            rounds=1,
        ),
        lambda m, r: len(rows(r)) == len(m.variants(PretrainConfig(frames=8))),
        "pareto_encoder",
    ),
    "stability_encoder": Shrunk(
        lambda m: small(
            m.SMOKE,
            touch=StageOneDataConfig(scenes=small(tiny.SCENES, split_shares=(0.6, 0.2, 0.2))),
            encoder=small(m.EXPERIMENT.config.encoder, width=8, num_layers=0, stem_px=4, stem_width=2),
            batch_size=3, probe=PROBE,
        ),
        lambda m, r: len(rows(r)) == len(m.ARMS),
        "stability_encoder",
    ),
    "stage_one": Shrunk(
        lambda m: small(
            m.SMOKE,
            touch=small(m.SMOKE.touch, scenes=tiny.SCENES),
            pretrain=small(m.SMOKE.pretrain, encoder=CAUSAL, **IMAGES, steps=1, probe_every=1),
            labelled=(3, 5),
        ),
    ),
    "video_prediction": Shrunk(
        lambda m: m.VideoPredictionConfig(
            touch=StageOneDataConfig(scenes=tiny.SCENES),
            frames=4, image_px=28, skips=(1, 2), tactile=CAUSAL, scored=3, mean_of=4,
            decoder=FrameDecoderConfig(width=4, num_layers=1),
            film=m.VideoTrainingConfig(steps=2, batch_size=2),
        ),
        lambda m, r: len(rows(r)) == 2 * len((m.TOUCH, m.VISION, m.COPY, m.MEAN)),
        "film_strip",
    ),
    "pareto_grpo": Shrunk(
        lambda m: m.SMOKE,
        lambda m, r: [row[0] for row in rows(r)] == list(m.SMOKE.algorithms),
        "pareto_grpo courses options option_courses",
    ),
    "scale_paper": Shrunk(lambda m: m.SMOKE, lambda m, r: met(m, r) and len(r["requirements"]) == 3 + 2 * 2, "memory"),
    "speed_gpu": Shrunk(lambda m: m.SMOKE, lambda m, r: met(m, r) and all(row[1] > 0 for row in rows(r))),
    "speed_grpo": Shrunk(
        lambda m: small(m.SMOKE, prefixes=(16,), words=256),
        lambda m, r: {q["name"]: q["measured"] for q in r["requirements"]}["programs for all lengths"] == 1,
        "prefixes steps",
    ),
    "stability_grpo": Shrunk(lambda m: m.SMOKE, plots="stability_grpo"),
    "pareto_fields": Shrunk(
        lambda m: small(m.EXPERIMENT.scales["smoke"], rounds=2),
        lambda m, r: r["requirements"][0]["met"],
        seconds=8.0,
    ),
    "stability_fields": Shrunk(lambda m: m.SMOKE, met, "stability_tracking stability_shear stability_depth"),
    "identifiability": Shrunk(
        lambda m: small(
            m.SMOKE,
            presses=SceneConfig(
                objects=8, sites=1, frames=3, min_force_n=0.3, max_force_n=3.0, image_px=24, contact_grid=24
            ),
            exact_grid=32, noise=(0.0, 1.0), probe=ProbeConfig(folds=2, iterations=3), batch=3,
        ),
        lambda m, r: all(np.all(np.abs(row[1:]) <= 100) for i in range(4) for row in rows(r, i)),
        "identifiability label_transfer",
    ),
    "pareto_chooser": Shrunk(
        lambda m: small(m.SMOKE, batch=5, grids=(24,), asked=(0.9,), sequences=2),
        lambda m, r: sum(row[1] for row in rows(r, 1)) == 5,
        "chooser",
    ),
    "pareto_contact": Shrunk(
        lambda m: m.ParetoContactConfig(
            scenes=3, grid=32, ladder=(24, 32), ladder_scenes=2, rounds=2, oracle_scenes=1
        ),
        lambda m, r: all(q["met"] for q in r["requirements"] if "time" not in q["name"])
        and [row[3] for row in rows(r) if row[0] in ("Winkler", "PK-25")] == [0, 51],  # convolutions
        seconds=9.0,
    ),
    "pareto_tangential": Shrunk(
        lambda m: small(m.SMOKE, contacts=1, sensors=("xense",), grid=24, frames=20, rounds=1, closed_grid=32),
        tangential_holds,
        "pareto_tangential promise",
    ),
    "stability_contact": Shrunk(
        lambda m: small(m.SMOKE, scenes=12, forces_n=(0.01, 1.0), roughness=(2.0,)),
        contact_holds,
        "stability_roughness stability_thickness",
    ),
    **{f"ablation_{name}": ABLATION for name in ("consistency", "format", "grounding", "tactile_use")},
    "ablation_cumulative": Shrunk(
        lambda m: STUDY,
        lambda m, r: list(r["arms"]) == [*CONTROLS, *ADDED[1:]] and len(rows(r, 1)) == 3 * len(ADDED),
        "changes",
    ),
    "ablation_leave_one_out": Shrunk(lambda m: STUDY, lambda m, r: set(r["arms"]) == {*CONTROLS, "full", *OMITTED}),
    "conflict": Shrunk(lambda m: STUDY, lambda m, r: {c["against"] for c in r["comparisons"]} == {"sft_continued"}),
    "few_labels": Shrunk(
        lambda m: small(
            m.SMOKE,
            **SHARED | {"grpo": m.SMOKE.grpo, "grpo_steps": 1},
            labelled=(4, 6), unlabelled=3,
            pretrain=small(m.SMOKE.pretrain, encoder=CAUSAL, **IMAGES),
        ),
        lambda m, r: len(r["arms"]) == 2 * 2 * len(m.METHODS),
    ),
    "grpo_verdict": Shrunk(
        lambda m: small(m.SMOKE, **SHARED | {"grpo": m.SMOKE.grpo, "fresh": small(tiny.SCENES, seed=9)}),
        lambda m, r: len(r["arms"]) == 2 + 4 and {c["against"] for c in r["comparisons"]} == {"sft_continued"},
    ),
    "main_table": Shrunk(
        lambda m: m.MainConfig(study=STUDY, quota=FEW),
        lambda m, r: r["requirements"][0]["met"] and [row[2] for row in rows(r, 4)] == [8, 3, 2, 8],
    ),
    "pareto_sft": Shrunk(
        lambda m: m.ParetoSFTConfig(study=tiny.STUDY, encoders=(1,), end_to_end=(2,), decoder=(1, 2)),
        lambda m, r: [row[:3] for row in rows(r)] == [[m.HEAD, 1, 1], [m.HEAD, 1, 2], [m.WHOLE, 2, 1], [m.WHOLE, 2, 2]],
    ),
    "qualitative": Shrunk(
        lambda m: m.QualitativeConfig(study=small(STUDY, seeds=1), quota=FEW),
        lambda m, r: len(rows(r)) == 10 and all(row[1] <= row[2] for row in rows(r)),
    ),
    "scaling": Shrunk(
        lambda m: m.ScalingConfig(
            study=small(STUDY, grpo_steps=2),  # the first step of a stage is not timed
            small=tiny.MODEL,
            large=small(tiny.MODEL, tactile=small(tiny.MODEL.tactile, width=32)),
            quota=FEW, rounds=1,
        ),
        scaling_holds,
    ),
    "scale_records": Shrunk(
        lambda m: small(
            m.SMOKE,
            scenes=small(tiny.SCENES, objects=4, split_shares=(0.5, 0.25, 0.25)),
            indexed=(100, 2000),
            publications=2,
        ),
        lambda m, r: [row[0] for row in rows(r, 3)] == [1, 10, 100, 1000] and rows(r)[0][3:5] == [2, 2],
    ),
    "scene_gallery": Shrunk(
        lambda m: small(
            m.SMOKE,
            views=3, columns=2, image_px=28,
            protocol=SceneConfig(objects=2, sequences=4 * 14, frames=20, contact_grid=24, solver_tolerance=1e-2),
        ),
        plots="views press-0 motions varied properties",
    ),
}  # fmt: skip

ELSEWHERE = {
    "ablation_ordinal", "active_touch", "dataset_card", "load_weights", "pareto", "pareto_storage", "physiclear",
    "pretrain_encoder", "real_sensors", "scene_realism", "sim_to_real", "stability_devices", "stability_faults",
    "stability_touch", "step_weights", "throughput_feed", "throughput_scenes", "touch_r1",
}  # fmt: skip

EXPERIMENTS = find("experiments")  # reads every source


def test_every_experiment_runs_shrunken_here_or_elsewhere():
    assert RUNS.keys() | ELSEWHERE == EXPERIMENTS.keys()
    assert not RUNS.keys() & ELSEWHERE


def marks(name: str) -> list[pytest.MarkDecorator]:
    """The flagship's family is in every CI run."""
    seconds, paper = RUNS[name].seconds, EXPERIMENTS[name].module.startswith("experiments.paper.")
    return [] if seconds < 1 else [pytest.mark.long if paper or seconds < 10 else pytest.mark.slow]


@pytest.mark.parametrize("name", [pytest.param(name, marks=marks(name)) for name in RUNS])
def test_the_experiment_runs_shrunken(name, tmp_path, cache_dir):
    run, module = RUNS[name], importlib.import_module(EXPERIMENTS[name].module)
    directory = run_shrunk(module, run.config(module), tmp_path, "--cache-dir", str(cache_dir))
    results = read_json(directory / "results.json")
    assert run.holds(module, results), results
    drawn = {path.stem: path.stat().st_size for path in directory.glob("plots/*")}
    assert drawn.keys() >= set(run.plots.split())
    assert all(size > 200 for size in drawn.values())
