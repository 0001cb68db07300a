"""Evidence of the contacts of a study; SFT in rows and by adapters: the same policy, or a change of low rank."""

import dataclasses
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.study.scores import PUBLISHED
from experiments.study.seed import StudySeed
from experiments.study.stages import ProbeFeatures, StudySFT, answer_feed, gather_evidence, make_arm
from experiments.study.study import make_study_arm
from experiments.study.training import TrainingConfig, preset_name
from sensors_io.schema import LEVELS
from tests.experiments import tiny
from touchr1_jax.models.lora import LoraConfig, by_layer
from touchr1_jax.models.touch_policy import with_lora
from touchr1_jax.rl.config import DrGrpo, GRPOConfig, Stable, TactileUse
from touchr1_jax.training.checkpoint import Checkpoints
from touchr1_jax.training.feeds import AnswerFeed, encoded_clips
from touchr1_jax.training.linear_probe import ProbeConfig
from touchr1_jax.training.loop import Hooks, LoopConfig
from touchr1_jax.training.questions import QuestionFeed
from touchr1_jax.training.train_grpo import train_grpo
from touchr1_jax.training.train_sft import train_sft

PROBE = ProbeConfig(folds=2, iterations=4)
WIDTH = 128


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


@pytest.mark.long
def test_evidence_of_recorded_touch_is_a_distribution_and_of_the_rest_nothing(data, probed, context):
    evidence = gather_evidence(data, probed, PROBE, context)
    train = np.isin(np.arange(len(data.store)), np.concatenate([data.parts["sft"], data.parts["grpo"]]))
    for a, levels in enumerate(LEVELS.values()):
        assert (evidence[:, :, a, levels:] == -np.inf).all()
        for s in (0, 1):
            recorded = train & probed.present[:, s]
            known = evidence[:, s, a, :levels]
            np.testing.assert_allclose(np.exp(known[recorded]).sum(-1), 1, atol=1e-5)
            assert np.ptp(known[recorded], axis=-1).min() > 0
            assert (known[~recorded] == 0).all()
        assert (evidence[:, 3, a, :levels] == 0).all()  # sensor 3 was never there
        assert (evidence[:, 2, a, :levels] == 0).all()  # one object cannot be held out


@pytest.mark.long
def test_an_attribute_that_nobody_annotated_has_no_evidence(data, probed, context):
    label = np.where(np.arange(4) == 0, -1, data.label)
    evidence = gather_evidence(dataclasses.replace(data, label=label), probed, PROBE, context)
    assert (evidence[:, :, 0, :3] == 0).all()
    assert (evidence[data.parts["sft"][1:], 0, 1, :3] != 0).all()


@pytest.fixture
def evidence(data):
    return np.zeros((len(data.store), len(data.clip.sensors), data.label.shape[1], 9), np.float32)


@pytest.mark.long
def test_adapters_on_rows_are_trained_beside_a_decoder_that_stands_still(policy, data, evidence, context):
    adapting = with_lora(policy, LoraConfig(rank=2))
    config = StudySFT(steps=3, batch_size=4, pack=WIDTH)
    seed = StudySeed(config=tiny.STUDY, data=data, policy=adapting, evidence=evidence, context=context, seed=0)
    found = seed.run_sft(config, "sft")
    first = policy.init(0, tiny.one_batch(data))
    assert set(found) == {*first, "adapters"}
    jax.tree.map(np.testing.assert_array_equal, found["decoder"], first["decoder"])
    assert all(bool((adapter.b != 0).any()) for adapter in by_layer(found["adapters"]).values())
    assert (np.asarray(found["tactile_out"]["kernel"]) != np.asarray(first["tactile_out"]["kernel"])).any()


def test_a_curriculum_is_a_share_of_the_steps(policy, data, evidence):
    """Of all of them the first batch has touch of all sensors, which it would not have without."""
    config = StudySFT(steps=3, batch_size=4)
    plain, easy = (
        next(answer_feed(policy, data, evidence, dataclasses.replace(config, curriculum=share), seed=0)).streams
        for share in (0.0, 1.0)
    )
    assert np.asarray(easy).all()
    assert not np.asarray(plain).all()


@pytest.mark.long
def test_the_decoders_phase_trains_the_decoder_alone_and_returns_its_best_point(
    policy, data, params, evidence, tmp_path
):
    """The second of three points is the best; adapters are scored together with the decoder's weights."""
    rows = data.parts["sft"]
    config = dataclasses.replace(tiny.STUDY.decoder, steps=3, save_every=1)
    order, scores, scored = {"batch_size": config.batch_size, "seed": 0}, iter([1.0, 3.0, 2.0]), []
    clips = encoded_clips(tiny.features(len(rows)), rows, data.label[rows], **order)
    feed = AnswerFeed(policy, clips, evidence, questions=config.questions, **order)

    def held_out(found):
        scored.append(jax.tree.map(np.asarray, found))
        return next(scores)

    with Checkpoints(tmp_path, better="higher") as checkpoints:
        hooks = Hooks(checkpoints=checkpoints)
        adapting = with_lora(policy, LoraConfig(rank=2))
        found = train_sft(adapting, params, feed, config, hooks, decoder_only=True, held_out=held_out)
    jax.tree.map(np.testing.assert_array_equal, found, scored[1])
    for name in params:
        jax.tree.map(np.testing.assert_array_equal, found[name], params[name])
    start, second, third = (x["adapters"]["decoder"]["last_layer"]["q_proj"]["b"] for x in scored)
    assert np.any(start != second)
    assert np.any(second != third)


@pytest.mark.long
def test_grpo_returns_its_best_point(policy, data, params, tmp_path):
    """The second of three points is the best; the encoders are those of the start."""
    arm = make_arm(policy, PUBLISHED, data.prior(), tiny.STUDY.grpo, LoopConfig(steps=3, save_every=1))
    rows, scores, scored = data.parts["sft"], iter([1.0, 3.0, 2.0]), []
    label, drawn = data.label[rows], arm.config.drawn
    feed = QuestionFeed(policy, tiny.features(len(rows)), label, batch_size=drawn, seed=0, truth=label)

    def held_out(found):
        scored.append(jax.tree.map(np.asarray, found))
        return next(scores)

    with Checkpoints(tmp_path, better="higher") as checkpoints:
        more = {"noise": jnp.asarray(tiny.features(1, seed=1).touch), "held_out": held_out}
        found = train_grpo(
            policy, params, feed, arm.score, arm.config, arm.loop, Hooks(checkpoints=checkpoints), **more
        )
    jax.tree.map(np.testing.assert_array_equal, found, scored[1])
    jax.tree.map(np.testing.assert_array_equal, found["tactile"], params["tactile"])
    points = [jax.tree.leaves(x["decoder"]) for x in scored]
    assert all(any(np.any(a != b) for a, b in zip(x, y, strict=True)) for x, y in itertools.pairwise(points))


@pytest.mark.long
@pytest.mark.parametrize(("recipe", "anchor"), [("touch", 1.0), ("paper", 0.0)])
def test_one_word_chooses_the_recipe(policy, data, params, context, evidence, recipe, anchor):
    config = dataclasses.replace(tiny.STUDY, recipe=recipe)
    seed = StudySeed(config=config, data=data, policy=policy, evidence=evidence, context=context, seed=0)
    contacts = seed.contacts(params)
    np.testing.assert_array_equal(contacts.truth, data.label[data.parts["grpo"]])
    assert (contacts.label[:, 3] == -1).all() == (recipe == "paper")
    arm = make_study_arm(config, policy, PUBLISHED, data.prior(), config.grpo.algorithm)
    assert arm.config.algorithm.anchor == anchor


def test_devices_share_a_micro_batch():
    config = StudySFT(batch_size=16, micro_contacts=8, pack=WIDTH)
    packing = config.packing(4)
    assert (packing.width, packing.contacts, packing.micro_batches) == (WIDTH, 2, 2)
    assert StudySFT().packing(3) is None
    with pytest.raises(ValueError, match="micro_contacts is 8: must be a multiple of the 3 devices"):
        config.packing(3)


def test_the_control_without_touch_answers_as_many_questions_as_the_policy():
    study = dataclasses.replace(tiny.STUDY, recipe="touch")
    decoder, blind = study.decoder, study.blind  # 3 × 4 × 2 questions end to end, 2 × 2 × 2 in the decoder's phase
    assert blind.steps * blind.batch_size * blind.questions == 24 + 8
    assert (blind.optimizer, blind.conclusion_weight) == (decoder.optimizer, decoder.conclusion_weight)
    assert dataclasses.replace(study, recipe="paper").blind == study.sft


@pytest.mark.parametrize(
    ("phase", "change", "said"),
    [
        ("decoder", {"pack": WIDTH}, "decoder.pack is 128: must be 0, for this stage does not read it"),
        ("decoder", {"curriculum": 0.5}, r"decoder.curriculum is 0\.5: must be 0"),
        ("decoder", {"questions": 5}, "decoder.questions is 5: must be at most 4"),
    ],
)
def test_options_that_a_phase_does_not_read_are_refused(phase, change, said):
    config = TrainingConfig()
    with pytest.raises(ValueError, match=said):
        dataclasses.replace(config, **{phase: dataclasses.replace(getattr(config, phase), **change)})


def test_one_word_chooses_the_stable_engine_and_the_stable_rewards(policy, data):
    """`grpo.algorithm:stable` alone: rewards that touch must earn; `paper` keeps the weights that it is given."""
    loop = LoopConfig(steps=1)
    paper = make_arm(policy, PUBLISHED, data.prior(), GRPOConfig(), loop)
    stable = make_arm(policy, PUBLISHED, data.prior(), GRPOConfig(algorithm=Stable()), loop)
    assert paper.weights == PUBLISHED
    assert stable.weights == {"accuracy_strict": 0.6, "consistency_strict": 0.3, "format_strict": 0.1}


def test_reports_name_the_preset_and_what_differs():
    assert preset_name(GRPOConfig()) == "paper"
    assert preset_name(GRPOConfig(algorithm=Stable())) == "stable"
    changed = GRPOConfig(algorithm=Stable(gamma=0.0, tactile_use=TactileUse.OFF), prompts=4)
    assert preset_name(changed) == "stable with gamma=0.0, tactile_use=off, prompts=4"
    assert preset_name(GRPOConfig(algorithm=DrGrpo())) == "drgrpo"
    # neither algorithm fits the default sizes
    assert preset_name(GRPOConfig(group=16, algorithm=DrGrpo(best_of=8))) == "drgrpo with best_of=8, group=16"
    parts = GRPOConfig(prompts=12, micro_prompts=2, algorithm=DrGrpo(minibatches=3))
    assert preset_name(parts) == "drgrpo with minibatches=3, prompts=12, micro_prompts=2"
