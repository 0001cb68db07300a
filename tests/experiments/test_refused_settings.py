"""Settings that cannot be measured or trained are refused by name, before anything is made."""

import dataclasses
import importlib
from pathlib import Path

import pytest

from experiments.core.runner import main
from experiments.paper import presets, touch_r1
from sensors_io.scenes.config import SceneConfig
from touchr1_jax.models.lm import DecoderConfig
from touchr1_jax.models.lora import LoraConfig
from touchr1_jax.models.tactile_vit import TactileViTConfig
from touchr1_jax.models.touch_policy import ModelConfig
from touchr1_jax.training.rollout_server import RolloutsConfig

ACTIVE = "active.active_touch"
PRESSES_BY_ONE_SENSOR = {"motions": ("press",), "forces_n": (2.0,), "sensors": ("tac3d",)}


@pytest.mark.parametrize(
    ("where", "changes", "message"),
    [
        *((f"{ACTIVE}.ActiveTouchConfig", {field: 0}, "full_seeds") for field in ("seeds", "full_seeds", "contacts")),
        *(
            (f"{ACTIVE}.ActiveTouchConfig", {field: price}, field)
            for bad in (float("nan"), float("inf"), -0.1)
            for field, price in (("second_price", bad), ("harm_price", bad), ("second_prices", (0.01, bad)))
        ),
        ("active.contacts.ContactsConfig", {"motions": ("push",)}, "motions"),
        ("active.contacts.ContactsConfig", {"sensors": ()}, "sensors"),
        ("active.contacts.ContactsConfig", {"forces_n": (2.0, 2.0)}, "forces_n"),
        ("active.contacts.ContactsConfig", {"forces_n": (0.0,)}, "forces_n"),
        ("active.contacts.ContactsConfig", {"picture_px": 25}, "picture_px"),
        ("active.contacts.ContactsConfig", PRESSES_BY_ONE_SENSOR, "nothing to choose"),
        *(("active.videos.StoppingConfig", {field: 1}, field) for field in ("videos", "folds", "warm_share")),
        ("bench.dataset_card.DatasetCardConfig", {"drop_odd": True}, "drop_odd is True"),
        ("bench.paper_audit.PaperAuditConfig", {"vtv_items": 0}, "vtv_items is 0"),
        ("encoder.stage_one.StageOneConfig", {"labelled": (30, 10)}, "labelled"),
        ("encoder.stage_one.StageOneConfig", {"labelled": ()}, "labelled"),
        ("encoder.stage_one.StageOneConfig", {"tune_steps": (0, 5)}, "tune_steps"),
        ("encoder.stage_one.StageOneConfig", {"seeds": 0}, "seeds"),
        ("encoder.stage_one.StageOneConfig", {"objectives": ()}, "objectives is .*: must hold some of "),
        ("engine.throughput_feed.FeedScale", {"study": presets.GPU, "devices": 3, "contacts": 8}, "devices is 3: .*64"),
        ("engine.gpu_workloads.GpuConfig", {"vision_px": 450}, "must be a multiple of 28"),
        ("engine.gpu_workloads.GpuConfig", {"frames": 7}, "frames of a patch"),
        ("engine.gpu_workloads.GpuConfig", {"rounds": 0}, "rounds"),
        ("engine.load_weights.LoadWeightsConfig", {"sizes": ("70B",)}, "must be of tiny, "),
        ("engine.load_weights.LoadWeightsConfig", {"sizes": ("3B",), "compare": ("7B",)}, "compare of sizes"),
        ("engine.pareto_grpo.ParetoGrpoConfig", {"groups": (4, 5)}, r"groups holds \[5\]: must divide rollouts = 32"),
        ("engine.pareto_grpo.ParetoGrpoConfig", {"groups": (0, 4)}, r"groups holds \[0\]: must divide rollouts = 32"),
        ("engine.pareto_grpo.ParetoGrpoConfig", {"rollouts": 0}, "rollouts is 0: must be at least 1"),
        ("engine.pareto_grpo.ParetoGrpoConfig", {"options": ("top-k",)}, "options is .*: must hold some of "),
        ("engine.pareto_grpo.ParetoGrpoConfig", {"algorithms": ()}, "algorithms is .*: must hold some of "),
        ("engine.stability_grpo.StabilityGrpoConfig", {"codes": ("F99",)}, "codes is .*: must hold some of F1, "),
        ("engine.scale_paper.ScaleConfig", {"compiled": 6}, "compiled is 6: must be 0 … 5"),
        ("engine.scale_paper.ScaleConfig", {"size": "8B"}, "size is '8B': must be one of 3B, "),
        ("engine.speed_grpo.SpeedConfig", {"steps": 4}, "steps is 4: must be at least 100"),
        ("engine.throughput_feed.FeedingConfig", {"cores": 0}, "cores is 0"),
        ("engine.throughput_feed.FeedingConfig", {"batches": 0}, "batches is 0"),
        ("engine.throughput_feed.FeedingConfig", {"steps": 1}, "steps is 1: must be at least 2"),
        ("faults.kills.KillConfig", {"kills": 0}, "needs kills"),
        ("faults.kills.KillConfig", {"startup_share": 1.0}, "needs kills"),
        ("fields.stability_fields.FieldStabilityConfig", {"methods": ("mean shift",)}, "must hold"),
        ("mechanics.identifiability.DEFAULT", {"noise": (0.0, 2.0)}, "noise is"),
        (
            "mechanics.identifiability.DEFAULT",
            {"presses": SceneConfig(objects=1, sequences=4)},
            r"presses\.sequences is 4",
        ),
        ("mechanics.identifiability.DEFAULT", {"motions": SceneConfig()}, r"motions\.sequences is None"),
        ("mechanics.identifiability.DEFAULT", {"exact_grid": 64}, "exact_grid is 64"),
        (
            "mechanics.pareto_tangential.TangentialConfig",
            {"motions": ("free",)},
            "motions is .*: must hold some of",
        ),
        (
            "mechanics.pareto_tangential.TangentialConfig",
            {"sensors": ()},
            "sensors is .*: must hold some of",
        ),
        (
            "scenes.throughput_scenes.ThroughputConfig",
            {"stage_sensors": ("x",)},
            "stage_sensors is .*: must hold some of ",
        ),
        ("scenes.scale_records.AssumedMachine", {"bandwidth_gb_s": 0}, "bandwidth_gb_s is 0: must be above 0"),
        ("paper.few_labels.FewLabelsConfig", {"labelled": (30, 10)}, "labelled"),
        ("paper.few_labels.FewLabelsConfig", {"labelled": (2, 10)}, "labelled"),
        ("paper.few_labels.FewLabelsConfig", {"unlabelled": 0}, "unlabelled"),
        ("paper.grpo_verdict.GrpoVerdictConfig", {"steps": (1,)}, "steps"),
        ("paper.grpo_verdict.GrpoVerdictConfig", {"lr_scales": ()}, "lr_scales"),
        ("paper.grpo_verdict.GrpoVerdictConfig", {"presets": ()}, "presets"),
        ("paper.pareto_sft.ParetoSFTConfig", {"end_to_end": (0,)}, "end_to_end is .0,.: must hold"),
        ("paper.pareto_sft.ParetoSFTConfig", {"decoder": ()}, "decoder is ..: must hold"),
        (
            "paper.touch_r1.DEFAULT",
            {
                "rollouts": RolloutsConfig(url="http://localhost:8000"),
                "grpo": dataclasses.replace(touch_r1.DEFAULT.grpo, temperature=0.7),
            },
            r"temperature is 0\.7: must be 1\.0 where a server draws rollouts",
        ),
        (
            "paper.touch_r1.DEFAULT",
            {
                "rollouts": RolloutsConfig(url="http://localhost:8000"),
                "model": dataclasses.replace(touch_r1.DEFAULT.model, four_bits=True),
            },
            r"model\.four_bits is True: must be False where a server draws rollouts",
        ),
        ("paper.touch_r1.DEFAULT", {"lora": LoraConfig(rank=0)}, r"lora\.rank is 0: must be at least 1, released"),
        (
            "paper.touch_r1.DEFAULT",
            {"model": dataclasses.replace(touch_r1.DEFAULT.model, dtype="float32")},
            r"grpo\.bfloat16 is True: must be False for weights in float32; set both alike",
        ),
        (
            "paper.touch_r1.DEFAULT",
            {"model": dataclasses.replace(touch_r1.DEFAULT.model, completion_tokens=20)},
            r"grpo\.length is 96: must be model\.completion_tokens = 20",
        ),
        ("paper.touch_r1.DEFAULT", {"read_threads": 0}, "read_threads is 0: must be at least 1"),
        ("study.sources.SourceConfig", {"data_dir": Path("x")}, "data_dir is x: data 'generated' takes no data_dir"),
        ("study.sources.SourceConfig", {"data": "physiclear"}, "data_dir is None: data 'physiclear' needs data_dir"),
        ("study.sources.SourceConfig", {"data": "records"}, "data_dir is None: data 'records' needs data_dir"),
        ("study.stages.StudySFT", {"pack": -1}, "pack is -1: must be at least 0"),
        ("study.stages.StudySFT", {"curriculum": 1.5}, r"curriculum is 1\.5: must lie in 0 … 1"),
        (
            "study.study.StudyConfig",
            {"model": ModelConfig(decoder=DecoderConfig(vocab_size=50))},
            r"model\.decoder\.vocab_size is 50: must be 0",
        ),
        (
            "study.study.StudyConfig",
            {"model": ModelConfig(tactile=TactileViTConfig(sensors=2))},
            r"model\.tactile\.sensors is 2: must be 0",
        ),
    ],
)
def test_a_setting_is_refused(where, changes, message):
    module, _, name = f"experiments.{where}".rpartition(".")
    made = getattr(importlib.import_module(module), name)
    with pytest.raises(ValueError, match=message):
        made(**changes) if isinstance(made, type) else dataclasses.replace(made, **changes)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("seeds", "0"),
        ("grpo-steps", "-1"),
        ("grpo.final-share", "nan"),
        ("sft.optimizer.b2", "1"),
        ("model.decoder.rope-theta", "0"),
        ("scenes.ramp-s", "0"),
        ("data-dir", "somewhere"),
    ],
)
def test_an_option_out_of_range_ends_the_command(field, value, tmp_path, capsys):
    where = ["--runs-dir", str(tmp_path / "runs"), "--cache-dir", str(tmp_path / "cache")]
    try:
        status = main(["ablation_ordinal", f"--{field}={value}", *where])
    except SystemExit as end:
        status = end.code
    error = capsys.readouterr().err
    assert status == 2
    assert f"{field.rpartition('.')[2].replace('-', '_')} is {value}" in error
    assert "Traceback" not in error
    assert not list(tmp_path.iterdir())


def test_a_reward_that_is_weighted_twice_ends_the_command(tmp_path, capsys):
    with pytest.raises(SystemExit):
        main(["ablation_ordinal", "--more-rewards", "overlong", "1", "overlong", "2", "--runs-dir", str(tmp_path)])
    assert "overlong is given twice" in capsys.readouterr().err
