"""The whole method on one page: generate touch, imitate answers (SFT), reinforce them (GRPO), score on unseen objects.

    python -m experiments.minimal

Objects are generated and pressed by four sensors; a policy of 0.6 million parameters learns from scratch how hard,
rough and protruding they are, in a minute and a half on two cores.  Every step of the method is a plain call below;
`EXP=ablation_ordinal` adds controls, baselines, checkpoints, five seeds and a report.
"""

import tempfile
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import optax

from sensors_io.generate import generate_records
from sensors_io.pipeline import ClipConfig, clip_batches
from sensors_io.records import RecordStore
from sensors_io.scenes.config import SceneConfig
from sensors_io.schema import SENSORS
from touchr1_jax.bench.statistics import clustered_bootstrap
from touchr1_jax.models.touch_policy import ModelConfig, build_policy
from touchr1_jax.rewards import make_rewards, uniform_prior
from touchr1_jax.rl.advantages import group_advantage
from touchr1_jax.rl.config import GRPOConfig
from touchr1_jax.rl.counterfactual import drop_touch
from touchr1_jax.rl.losses import grpo_loss, token_terms
from touchr1_jax.rl.rollout import SampleConfig, make_answer, sample_group
from touchr1_jax.rl.scoring import make_score
from touchr1_jax.training.encoding import encode_contacts
from touchr1_jax.training.feeds import AnswerFeed, touch_batch
from touchr1_jax.training.questions import QuestionFeed, question_batch
from touchr1_jax.training.sft import SFTState, make_sft_step

CONTACTS = 8  # of a batch
FRAMES, IMAGE_PX = 2, 56  # of a clip, from each sensor
SFT_STEPS, GRPO_STEPS = 800, 100
SCENES = SceneConfig(objects=1200, sites=1, frames=FRAMES, min_force_n=2.0, image_px=IMAGE_PX, contact_grid=48)
REWARD = {"accuracy_debiased": 0.6, "consistency": 0.3, "format": 0.1}  # "debiased": no constant answer earns anything

POLICY = build_policy(ModelConfig(frames=FRAMES, image_px=IMAGE_PX), SENSORS)  # language, tokenizer, prompts
FNS = POLICY.fns  # forward passes as pure functions of parameters and inputs
GRPO = GRPOConfig(prompts=CONTACTS, length=POLICY.model.completion_tokens)
# every level is a priori as likely as any other
SCORE = make_score(POLICY.parser, make_rewards(uniform_prior(POLICY.levels)), REWARD)
GRPO_OPTIMIZER = optax.adam(1e-5)


def read_clips(store, rows, train=True):
    """Grain batches of clips: training contacts in random order for ever, others once."""
    clip = ClipConfig(frames=FRAMES, image_px=IMAGE_PX)
    return clip_batches(store, rows, clip, batch_size=CONTACTS, seed=0, shuffle=train, repeat=train)


def encode(store, params, rows):
    """Tokens of the tactile encoder for each contact, and labels; GRPO trains the decoder and keeps the encoder."""
    features = encode_contacts(FNS, params, map(touch_batch, read_clips(store, rows, train=False)))
    return features, np.stack([store.objects[store.contacts[i].object_id].label_row() for i in rows])


@jax.jit
def grpo_step(params, opt_state, reference, batch, key):
    """One GRPO step as one program: rollouts, rewards, advantages, loss, update."""
    draw = SampleConfig(group=GRPO.group, length=GRPO.length, end_ids=FNS.end_ids, pad_id=FNS.pad_id)
    rollout = sample_group(FNS, params, batch, key, draw)
    reward, _terms, _parsed = jax.vmap(jax.vmap(SCORE, (0, None)))(rollout.tokens, batch.target)
    advantage = group_advantage(reward)  # (R − mean R) / σ_R over the answers to one question
    logits = jax.vmap(FNS.group_logits, (None, 0, 0, 0, 0))  # over the questions; parameters are shared

    def loss(params):
        log_probs = lambda p, touch: jax.nn.log_softmax(logits(p, touch, batch.ids, batch.mask, rollout.tokens))
        policy, before = log_probs(params, batch.features), log_probs(reference, batch.features)
        untouched = log_probs(params, drop_touch(batch.features).features)  # G_tg; the paper masks one sensor of four
        terms = token_terms(GRPO.algorithm, rollout.tokens, policy, before, untouched)
        old = rollout.log_prob  # one update for each rollout: the old policy is the one that sampled
        weight = jnp.full(CONTACTS, 1 / CONTACTS)
        value, _metrics = grpo_loss(terms, old, rollout.log_prob, rollout.mask, advantage, weight, GRPO)
        return value

    updates, opt_state = GRPO_OPTIMIZER.update(jax.grad(loss)(params), opt_state, params)
    return optax.apply_updates(params, updates), opt_state, jnp.mean(reward)


def score_unseen(store, params):
    """Share of right levels on unseen objects, and its difference from the best constant with a 95 % interval.

    The constant knows the most frequent level of the test objects; the interval comes from resampled objects.
    """
    rows, answer = store.contacts_of_split("test"), make_answer(FNS, POLICY.parser, GRPO.length)
    features, label = encode(store, params, rows)
    right, constant = [], []
    for question in range(3):  # hardness, roughness, protrusion: each low, middle or high
        attribute = np.full(len(rows), question)
        batch = question_batch(POLICY, features, label, np.arange(len(rows)), attribute, features.stream_mask)
        right.append(answer(params, batch).parsed.conclude[:, question] == label[:, question])
        most_frequent = np.bincount(label[:, question]).argmax()
        constant.append(label[:, question] == most_frequent)
    objects = np.array([store.contacts[i].object_id for i in rows])
    lead = clustered_bootstrap(100.0 * (np.mean(right, 0) - np.mean(constant, 0)), objects)
    return f"{np.mean(right):.1%} right, {lead.mean:+.1f} [{lead.low:.1f}, {lead.high:.1f}] points over a constant"


def main(log):
    """Generate records, train by SFT and GRPO, score after each."""
    with tempfile.TemporaryDirectory() as folder:
        generate_records(SCENES, Path(folder))
        train(RecordStore(folder), jax.random.key(0), log)


def train(store, key, log):
    """SFT on some objects, GRPO on others, scores on unseen ones."""
    imitated, reinforced = np.split(store.contacts_of_split("train"), [640])  # two thirds for SFT
    log(f"{len(imitated)} contacts for SFT, {len(reinforced)} for GRPO")

    # SFT: imitate answers in which every sensor perceives the true level
    truth = np.stack([store.objects[contact.object_id].label_row() for contact in store.contacts])
    certain = np.log(np.eye(max(POLICY.levels))[truth] + 1e-9)  # of each level, [contacts, attributes, levels]
    perceived = np.repeat(certain[:, None], len(SENSORS), axis=1)  # the same from every sensor
    answers = AnswerFeed(POLICY, read_clips(store, imitated), perceived, batch_size=CONTACTS, questions=3, seed=0)
    params = POLICY.init(0, next(answers).touch)
    optimizer = optax.adam(optax.cosine_decay_schedule(2e-3, SFT_STEPS))
    sft_step = make_sft_step(FNS, optimizer, micro_contacts=2)
    state = SFTState(params=params, opt_state=optimizer.init(params), step=jnp.zeros((), jnp.int32))
    for i in range(SFT_STEPS):
        state, metrics = sft_step(state, next(answers))
        if i % 100 == 99:
            log(f"SFT step {i + 1}: loss {metrics['loss']:.3f}")
    log(f"after SFT: {score_unseen(store, state.params)}")

    # GRPO: sample answers about other objects and raise the probability of those above the mean reward of their group
    questions = QuestionFeed(POLICY, *encode(store, state.params, reinforced), batch_size=CONTACTS, seed=0)
    reference = params = state.params
    opt_state = GRPO_OPTIMIZER.init(params)
    for i in range(GRPO_STEPS):
        step_key = jax.random.fold_in(key, i)
        params, opt_state, reward = grpo_step(params, opt_state, reference, next(questions), step_key)
        if i % 20 == 19:
            log(f"GRPO step {i + 1}: mean reward {reward:.3f}")
    log(f"after GRPO: {score_unseen(store, params)}")


if __name__ == "__main__":
    main(print)
