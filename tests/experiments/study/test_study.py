"""Answers on disk, answers that need no policy, and settings, rewards and sizes that are refused before any data."""

import dataclasses
import shutil
from types import SimpleNamespace

import jax
import numpy as np
import pytest

from experiments.core.artifacts import write_arrays, write_json
from experiments.core.runner import main
from experiments.core.runs import FIELDS
from experiments.study.answers import answers_path, load_answers, save_answers
from experiments.study.policies import policy_folder, publish_policy, require_published
from experiments.study.scores import (
    PUBLISHED,
    baselines,
    constant_answers,
    joint_mode,
    level_answers,
    score,
    score_study,
    study_settings,
)
from experiments.study.seed import SeedTraining
from experiments.study.stages import ProbeFeatures
from experiments.study.study import CONTINUED, SFT, Study, StudyConfig, check_arms, run_study
from sensors_io.arrays import ArraysError
from sensors_io.schema import ATTRIBUTES, SENSORS
from tests.experiments import tiny
from tests.sensors_io.checks import refused
from touchr1_jax.models.layers import SizeError
from touchr1_jax.models.touch_policy import ModelConfig, check_model
from touchr1_jax.rewards import Reward, RewardError
from touchr1_jax.rl.config import GRPOConfig, Paper, Stable
from touchr1_jax.training.evaluation import Evaluation
from touchr1_jax.training.linear_probe import ProbeConfig
from touchr1_jax.types import Parsed

TEST = np.array([[0, 1, 2, 8], [2, 1, 0, 0], [1, -1, 1, 4], [1, 0, 0, 8], [1, 2, 2, 0]], np.int32)
"""Labels of the five test contacts; nobody annotated the roughness of the third."""


def answers_about(label: np.ndarray, alone: bool = True) -> Evaluation:
    """Random answers to every labelled question, with touch of all four sensors, for the last contact of two."""
    rng = np.random.default_rng(0)
    contact, attribute = np.nonzero(label >= 0)
    n, asked = len(contact), np.arange(4) == attribute[:, None]
    streams = np.ones((len(label), 4), bool)
    streams[-1, 2:] = False
    return Evaluation(
        contact=contact,
        attribute=attribute,
        streams=streams[contact],
        tokens=rng.integers(0, 40, (n, 20)).astype(np.int32),
        parsed=Parsed(
            perceive=rng.integers(-1, 3, (n, 4, 4)).astype(np.int32),
            compare=rng.integers(-1, 3, (n, 4)).astype(np.int32),
            conclude=rng.integers(-1, 3, (n, 4)).astype(np.int32),
            formatted=rng.random(n) < 0.5,
            truncated=rng.random(n) < 0.5,
            length=rng.integers(0, 20, n).astype(np.int32),
        ),
        label=np.where(asked, label[contact], -1),
        alone=rng.integers(-1, 3, (n, 4, 4)).astype(np.int32) if alone else None,
    )


@pytest.fixture(scope="module")
def study(data, policy):
    """A study whose policies were asked about `TEST`, whose measured force is the label of hardness."""
    label = data.label.copy()
    label[data.parts["test"]] = TEST
    data = dataclasses.replace(data, label=label)
    force = np.repeat(label[:, :1].astype(np.float32), 3, 1) ** [1, 2, 3]
    streams = np.zeros((len(label), 4, 1), np.float32)
    return Study(
        config=dataclasses.replace(tiny.STUDY, probe=ProbeConfig(iterations=30)),
        data=data,
        policy=policy,
        probed=ProbeFeatures(streams=streams, present=np.ones((len(label), 4), bool), force=force.astype(np.float32)),
        prior=data.prior(),
        arms={},
        answers={name: [answers_about(TEST)] for name in (SFT, CONTINUED)},
    )


def table(study: Study, answers: Evaluation) -> dict[str, float]:
    return {name: value.mean() for name, value in score(study, answers).items()}


@pytest.mark.parametrize("alone", [True, False])
def test_answers_survive_the_disk(tmp_path, alone):
    said = answers_about(TEST, alone)
    path = tmp_path / "answers" / "sft-0.npz"
    save_answers(path, said)
    loaded = load_answers(path)
    assert (loaded.alone is None) == (not alone)
    assert jax.tree.structure(vars(loaded)) == jax.tree.structure(vars(said))
    for a, b in zip(jax.tree.leaves(vars(said)), jax.tree.leaves(vars(loaded)), strict=True):
        assert a.dtype == b.dtype
        assert np.array_equal(a, b)
    assert [p.name for p in path.parent.iterdir()] == ["sft-0.npz"]


@pytest.mark.parametrize(
    "name", ["run/answers/sft-1.npz", "run/answers/paper-0.npz", "other/answers/sft-0.npz", "twin/answers/sft-0.npz"]
)
def test_answers_of_another_policy_seed_or_run_are_not_taken(tmp_path, name):
    git = {"commit": "", "dirty": False}
    for run, experiment, steps in (("run", "a", 9), ("other", "a", 8), ("twin", "b", 9)):
        description = {"experiment": experiment, "config": {"steps": steps}, "git": git}
        write_json(tmp_path / run / "config.json", dict.fromkeys(FIELDS, "") | description)
    mine = tmp_path / "run" / "answers" / "sft-0.npz"
    save_answers(mine, answers_about(TEST))
    (tmp_path / name).parent.mkdir(exist_ok=True)
    refused(ArraysError, "put its own copy back", load_answers, mine.rename(tmp_path / name))
    write_arrays(mine, {"contact": np.zeros(3)})
    refused(ArraysError, "lacks attribute", load_answers, mine)


@pytest.mark.parametrize("file", ["model.safetensors", "tokenizer.json", "config.json", ""])
def test_an_unfinished_run_makes_a_damaged_policy_again(policy, params, data, tmp_path, file):
    """Not only damaged answers: before, the run ended with a policy that nothing could read, and did not say so."""
    about = {"experiment": "a", "config": {}, "git": {"commit": "", "dirty": False}}
    write_json(tmp_path / "config.json", dict.fromkeys(FIELDS, "") | about)
    printed = list[str]()
    processes = SimpleNamespace(write_once=lambda write: write())
    context = SimpleNamespace(directory=tmp_path, processes=processes, print=printed.append)
    publish_policy(policy, params, data, SFT, 0, context)
    answers, folder = answers_path(context, SFT, 0), policy_folder(context, SFT, 0)
    save_answers(answers, answers_about(TEST))
    seed = SimpleNamespace(context=context, seed=0, arms={}, _path=lambda name: answers_path(context, name, 0))
    SeedTraining._drop_damaged(seed, [SFT])
    assert not printed
    assert answers.exists()
    save_answers(answers_path(context, SFT, 1), answers_about(TEST))
    shutil.move(answers_path(context, SFT, 1), answers)
    SeedTraining._drop_damaged(seed, [SFT])
    assert printed.pop().count(str(answers)) == 1
    save_answers(answers, answers_about(TEST))
    if file:
        (folder / file).write_bytes((folder / file).read_bytes()[:-9])
    else:
        shutil.rmtree(folder)
    SeedTraining._drop_damaged(seed, [SFT])
    assert "it is made again" in printed[0]
    assert "copy the folder" not in printed[0]
    assert not answers.exists()
    publish_policy(policy, params, data, SFT, 0, context)
    require_published(folder)


def test_a_policy_that_is_damaged_twice_or_has_no_answers_yet_is_made_again(policy, params, data, tmp_path):
    """Before, the second could not be moved away, and one without answers was refused where it was published."""
    about = {"experiment": "a", "config": {}, "git": {"commit": "", "dirty": False}}
    write_json(tmp_path / "config.json", dict.fromkeys(FIELDS, "") | about)
    processes = SimpleNamespace(write_once=lambda write: write())
    context = SimpleNamespace(directory=tmp_path, processes=processes, print=lambda line: None)
    folder = policy_folder(context, SFT, 0)
    seed = SimpleNamespace(context=context, seed=0, arms={}, _path=lambda name: answers_path(context, name, 0))
    for _ in range(2):
        publish_policy(policy, params, data, SFT, 0, context)
        (folder / "config.json").write_text("{")
        SeedTraining._drop_damaged(seed, [SFT])
    publish_policy(policy, params, data, SFT, 0, context)
    require_published(folder)
    assert {path.name for path in folder.parent.iterdir()} == {"0", "damaged-0-1", "damaged-0-2"}


def test_the_joint_mode_is_that_of_whole_rows():
    rows = [[0, 0, 0, 5]] * 3 + [[1, 1, 1, 2], [1, 2, 1, 2], [1, 1, 2, 2], [2, 1, 1, 2]]
    assert joint_mode(np.array(rows)).tolist() == [0, 0, 0, 5]  # not 1 1 1 2, the mode of each column
    rows = [[2, 1, 0, 7], [2, 1, 0, 3], [2, 1, 0, 3], [0, 0, 0, 7], [0, 0, 0, 7]]
    assert joint_mode(np.array(rows)).tolist() == [2, 1, 0, 3]  # its own most frequent material
    rows = [[1, 1, 1, 4], [0, 0, -1, 2], [0, 0, -1, 2]]
    assert joint_mode(np.array(rows)).tolist() == [1, 1, 1, 4]  # annotated rows alone


def test_a_constant_scores_what_its_label_share_is(study):
    scores = table(study, constant_answers(study, np.tile([1, 1, 1, 8], (5, 1))))
    assert scores["h_acc"] == pytest.approx(100 * 3 / 5)
    assert scores["r_acc"] == pytest.approx(100 * 2 / 4)
    assert scores["p_acc"] == pytest.approx(100 * 1 / 5)
    assert scores["acc"] == pytest.approx((60 + 50 + 20) / 3)
    assert scores["mat_acc"] == pytest.approx(100 * 2 / 5)
    assert scores["h_bacc"] == pytest.approx(100 / 3)
    assert scores["omae"] == pytest.approx((2 + 2 + 4) / 14)
    assert (scores["middle_rate"], scores["parse_rate"], scores["csc_agree"], scores["csc_slot"]) == (100,) * 4


@pytest.mark.long
def test_every_baseline_answers_the_questions_of_the_policies(study):
    rows = baselines(study)
    assert list(rows) == ["constant", "constant_joint", "constant_middle", "force_only"]
    asked = study.answers[SFT][0]
    for said in rows.values():
        assert np.array_equal(said.contact, asked.contact)
        assert np.array_equal(said.label, asked.label)
        assert np.asarray(said.parsed.conclude)[np.arange(19), asked.attribute].min() >= 0
    modes = [int(np.asarray(rows["constant"].parsed.conclude)[asked.attribute == a].max()) for a in range(4)]
    assert modes == study.prior.argmax(1).tolist()
    assert table(study, rows["constant_middle"])["middle_rate"] == 100


@pytest.mark.long
def test_force_that_gives_hardness_away_is_found_out_where_it_is_measured(study):
    assert table(study, baselines(study)["force_only"])["h_acc"] == 100
    silent = dataclasses.replace(study, data=dataclasses.replace(study.data, has_force=False))
    assert "force_only" not in baselines(silent)


@pytest.mark.long
def test_every_policy_and_baseline_is_scored_on_the_same_questions(study):
    scored = score_study(study)
    assert list(scored.arms) == list(scored.rows)[:2] == [SFT, CONTINUED]
    assert list(scored.baselines) == ["constant", "constant_joint", "constant_middle", "force_only"]
    assert list(scored.estimates) == [*scored.arms, *scored.baselines]
    assert len(scored.objects) == 19
    for name, said in baselines(study).items():
        assert scored.baselines[name]["acc"].mean == pytest.approx(table(study, said)["acc"])


@pytest.mark.long
def test_a_metric_about_one_object_alone_is_left_out(study):
    """Before, a run of records with hardness on one test object trained to its end and then had no interval."""
    one = score_study(study).objects == score_study(study).objects[0]
    kept = one[:, None] | (np.arange(4) != ATTRIBUTES.index("hardness"))
    relabelled = lambda said: dataclasses.replace(said, label=np.where(kept, said.label, -1))
    answers = {name: [relabelled(said) for said in seeds] for name, seeds in study.answers.items()}
    scored = score_study(dataclasses.replace(study, answers=answers))
    for row in scored.estimates.values():
        assert "h_acc" not in row
        assert {"acc", "r_acc"} <= set(row)


def test_levels_are_given_contact_by_contact_and_by_single_sensors(study):
    scores = table(study, constant_answers(study, TEST))
    assert (scores["acc"], scores["mat_acc"], scores["omae"], scores["csc"]) == (100, 100, 0, 100)
    assert scores["reward"] == pytest.approx(1)  # the whole published reward
    alone = np.tile([0, 1, 2, 0], (5, 4, 1))
    alone[:, 0] = TEST
    said = level_answers(study.policy, study.answers[SFT][0], TEST, alone)
    scores = table(study, said)
    assert scores["acc"] == 100
    assert np.array_equal(said.alone[:, 0].max(1), said.label.max(1))
    present = np.asarray(said.streams)
    assert (np.asarray(said.parsed.perceive)[~present] == -1).all()


@pytest.mark.long
@pytest.mark.parametrize(
    ("reward", "message"),
    [
        (Reward(lambda p, t: p.conclude * 1.0), r"reward 'mine': value has type float32\[4\]"),
        (Reward(lambda p, t: 1.0 / p.length), r"reward 'mine' is inf .*must be finite everywhere"),
    ],
)
def test_a_reward_that_does_not_fit_is_named_with_its_arm(reward, message):
    check_arms({"published": PUBLISHED})
    with pytest.raises(RewardError, match=rf"{message}.* \(in the weights of arm 'good', {{'mine': 0.5}}\)"):
        check_arms({"good": {"mine": 0.5}}, rewards={"mine": reward})
    with pytest.raises(RewardError, match=r"no reward is called 'brevty'; choose from accuracy.* of arm 'mine'"):
        check_arms({"published": PUBLISHED, "mine": {"brevty": 1.0}})


@pytest.mark.parametrize(("answered", "sealed"), [(False, False), (True, False), (True, True)])
def test_a_policy_without_touch_that_has_answers_but_no_log_is_trained(tmp_path, answered, sealed):
    """A run that was restored in part had answers of the finished run: its log lacked the stage without a word."""
    trained, file = [], tmp_path / "answers.npz"
    if answered:
        file.touch()
    seed = SimpleNamespace(
        seed=0,
        context=SimpleNamespace(has_sealed=lambda stage: sealed and stage == "blind/0"),
        encode=lambda *_, **__: None,
        _path=lambda name: file,
        _train_blind=lambda: trained.append(1),
        _evaluate=lambda *_: None,
    )
    SeedTraining._evaluate_blind(seed)
    assert bool(trained) == (not sealed)


def test_an_algorithm_that_no_arm_trains_by_is_refused():
    with pytest.raises(ValueError, match=r"grpo\.algorithm is stable: .* each has its own; leave it out"):
        run_study(StudyConfig(grpo=GRPOConfig(algorithm=Stable())), {"full": PUBLISHED}, None, {"full": Paper()})


def test_reports_name_the_algorithm_by_which_arms_train():
    """Under recipe `touch`, with the likelihood of verified answers."""
    config = StudyConfig()
    published = dataclasses.replace(config, recipe="paper", sft=dataclasses.replace(config.sft, steps=1))
    assert study_settings(config)["preset"] == "paper with anchor=1.0"
    assert study_settings(published)["preset"] == "paper"


@pytest.mark.long
@pytest.mark.parametrize(
    ("part", "changes", "message"),
    [
        ("decoder", {"head_dim": 34}, r"no model can be built .* must be three that sum to head_dim/2 = 17"),
        ("tactile", {"frames_per_step": 3}, r"no model can be built .*4 per stream must divide into .* steps of 3"),
        ("tactile", {"patches_kept": 99}, r"no model can be built .* patches_kept is 99: must lie in 1\.\.16"),
    ],
)
def test_sizes_that_contradict_each_other_are_named_without_data(part, changes, message):
    model = ModelConfig()
    check_model(dataclasses.replace(model, frames=3), SENSORS)
    with pytest.raises(SizeError, match=message):
        check_model(dataclasses.replace(model, **{part: dataclasses.replace(getattr(model, part), **changes)}), SENSORS)


@pytest.mark.long
@pytest.mark.parametrize("content", [None, b"", b"no archive"])
def test_a_file_that_is_no_encoder_is_named_before_data_are_made(content, tmp_path, capsys):
    path = tmp_path / "encoder.npz"
    if content is not None:
        path.write_bytes(content)
    places = ["--runs-dir", str(tmp_path / "runs"), "--cache-dir", str(tmp_path / "cache")]
    assert main(["ablation_ordinal", "--scale", "smoke", "--encoder", str(path), *places]) == 1
    assert f"EncoderError: encoder is {path}: " in capsys.readouterr().err
    assert not list(tmp_path.glob("cache/scenes-*"))
