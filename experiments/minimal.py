"""The whole story on one page: record touch, imitate answers (SFT), reinforce them (GRPO), score on unseen objects.

    python -m experiments.minimal

Objects are generated and pressed by four sensors; a policy of half a million parameters learns from scratch how hard,
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

CONTACTS, FRAMES, IMAGE_PX, SFT_STEPS, GRPO_STEPS = 8, 2, 56, 800, 100  # contacts of a batch, frames of a clip
SCENES = SceneConfig(objects=1200, sites=1, frames=FRAMES, min_force_n=2.0, image_px=IMAGE_PX, contact_grid=48)
REWARD = {"accuracy_debiased": 0.6, "consistency": 0.3, "format": 0.1}

# language, tokenizer, prompts and forward passes; parameters are always an argument
POLICY = build_policy(ModelConfig(frames=FRAMES, image_px=IMAGE_PX), SENSORS)
FNS, GRPO = POLICY.fns, GRPOConfig(prompts=CONTACTS, length=POLICY.model.completion_tokens)
SCORE = make_score(POLICY.parser, make_rewards(uniform_prior(POLICY.levels)), REWARD)
GRPO_OPTIMIZER = optax.adam(1e-5)


def read_clips(store, rows, train=True):
    """Grain batches of clips: training contacts in random order for ever, others once."""
    clip = ClipConfig(frames=FRAMES, image_px=IMAGE_PX)
    return clip_batches(store, rows, clip, batch_size=CONTACTS, seed=0, shuffle=train, repeat=train)


def encode(store, params, rows):
    """Contacts as the decoder reads them, and their labels: GRPO and evaluation encode each contact once."""
    features = encode_contacts(FNS, params, map(touch_batch, read_clips(store, rows, train=False)))
    return features, np.stack([store.objects[store.contacts[i].object_id].label_row() for i in rows])


@jax.jit
def grpo_step(params, opt_state, reference, batch, key):
    """One GRPO step as one program: rollouts, rewards, advantages, loss, update."""
    draw = SampleConfig(group=GRPO.group, length=GRPO.length, end_ids=FNS.end_ids, pad_id=FNS.pad_id)
    rollout = sample_group(FNS, params, batch, key, draw)
    reward, _, _ = jax.vmap(jax.vmap(SCORE, (0, None)))(rollout.tokens, batch.target)
    advantage = group_advantage(reward)  # (R − mean R) / σ_R over the answers to one question
    logits = jax.vmap(FNS.group_logits, (None, 0, 0, 0, 0))

    def loss(params):
        log_probs = lambda p, touch: jax.nn.log_softmax(logits(p, touch, batch.ids, batch.mask, rollout.tokens))
        policy, old = log_probs(params, batch.features), log_probs(reference, batch.features)
        untouched = log_probs(params, drop_touch(batch.features).features)  # the counterfactual
        terms = token_terms(GRPO.algorithm, rollout.tokens, policy, old, untouched)
        sampler, weight = rollout.log_prob, jnp.full(CONTACTS, 1 / CONTACTS)
        return grpo_loss(terms, sampler, sampler, rollout.mask, advantage, weight, GRPO)[0]

    updates, opt_state = GRPO_OPTIMIZER.update(jax.grad(loss)(params), opt_state, params)
    return optax.apply_updates(params, updates), opt_state, jnp.mean(reward)


def score_unseen(store, params):
    """Share of the levels of unseen objects that are right, and its lead over the best constant, objects resampled."""
    rows, answer = store.contacts_of_split("test"), make_answer(FNS, POLICY.parser, GRPO.length)
    (features, label), everyone, right, constant = encode(store, params, rows), np.arange(len(rows)), [], []
    for question in range(3):  # hardness, roughness, protrusion: each low, middle or high
        attribute = np.full(len(rows), question)
        batch = question_batch(POLICY, features, label, everyone, attribute, features.stream_mask)
        right.append(answer(params, batch).parsed.conclude[:, question] == label[:, question])
        constant.append(label[:, question] == np.bincount(label[:, question]).argmax())
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
    imitated, reinforced = np.split(store.contacts_of_split("train"), [640])
    log(f"{len(imitated)} contacts to imitate, {len(reinforced)} to reinforce, one object in five to test")

    # SFT: imitate answers in which every sensor perceives the true level (in studies, what probes predict)
    truth = np.stack([store.objects[contact.object_id].label_row() for contact in store.contacts])
    perceived = np.log(np.eye(max(POLICY.levels))[truth] + 1e-9)[:, None].repeat(len(SENSORS), 1)
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

    # GRPO: sample answers about other objects and raise the probability of those that earn more than their group
    questions = QuestionFeed(POLICY, *encode(store, state.params, reinforced), batch_size=CONTACTS, seed=0)
    params, opt_state = state.params, GRPO_OPTIMIZER.init(state.params)
    for i in range(GRPO_STEPS):
        step_key = jax.random.fold_in(key, i)
        params, opt_state, reward = grpo_step(params, opt_state, state.params, next(questions), step_key)
        if i % 20 == 19:
            log(f"GRPO step {i + 1}: mean reward {reward:.3f}")
    log(f"after GRPO: {score_unseen(store, params)}")


if __name__ == "__main__":
    main(print)
