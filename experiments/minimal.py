"""The whole story on one page: record touch, imitate answers (SFT), reinforce them (GRPO), score on unseen objects.

    python -m experiments.minimal

Objects are generated and pressed by four sensors; a policy of half a million parameters learns from scratch to say how
hard, rough and protruding they are, in about two minutes on two cores.  Every step of the method is a plain call below;
`EXP=ablation_ordinal` adds controls, baselines, checkpoints, five seeds and a report.
"""

import itertools
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
from sensors_io.schema import CLIP_ARRAYS
from touchr1_jax.bench.statistics import clustered_bootstrap
from touchr1_jax.models.lm import DecoderConfig
from touchr1_jax.models.policy import Policy, PolicyConfig, Slots, init_policy
from touchr1_jax.models.policy_fns import PolicyFns
from touchr1_jax.models.tactile_vit import TactileViTConfig
from touchr1_jax.models.vision import VisionConfig
from touchr1_jax.rewards import make_rewards, uniform_prior
from touchr1_jax.rl.advantages import group_advantage
from touchr1_jax.rl.config import GRPOConfig
from touchr1_jax.rl.counterfactual import drop_touch
from touchr1_jax.rl.losses import grpo_loss, token_terms
from touchr1_jax.rl.rollout import GRPOBatch, SampleConfig, make_answer, sample_group
from touchr1_jax.rl.scoring import make_score
from touchr1_jax.text.language import TOUCH_LANGUAGE as LANGUAGE
from touchr1_jax.text.parser import compile_parser
from touchr1_jax.text.template import answer_text, build_layout, encode_answer, prompt_words
from touchr1_jax.text.tokenizer import word_level
from touchr1_jax.training.sft import SFTBatch, SFTState, make_sft_step
from touchr1_jax.types import Target, TouchBatch

CONTACTS, FRAMES, TOKENS, SFT_STEPS, GRPO_STEPS = 8, 2, 20, 400, 100  # contacts of a batch, tokens of an answer
GRPO = GRPOConfig(prompts=CONTACTS, length=TOKENS)
SCENES = SceneConfig(objects=1200, sites=1, frames=FRAMES, min_force_n=2.0, image_px=56, contact_grid=48)
ASKED = np.arange(3)  # hardness, roughness, protrusion: each on three levels

# the answer language, the prompts and the policy; parameters are always an argument
TOKENIZER, ENCODER, VISION = word_level(LANGUAGE, prompt_words()), TactileViTConfig(sensors=4), VisionConfig()
LAYOUT = build_layout(TOKENIZER, LANGUAGE, tactile_tokens=FRAMES * ENCODER.tokens_per_step, view_tokens=VISION.grid**2)
POLICY = Policy(PolicyConfig(tactile=ENCODER, vision=VISION, decoder=DecoderConfig(vocab_size=TOKENIZER.vocab_size)))
SLOTS, END, PAD = Slots(LAYOUT.touch, LAYOUT.view, LAYOUT.stream_text), TOKENIZER.end_ids, TOKENIZER.pad_id
FNS = PolicyFns(module=POLICY, slots=SLOTS, banned=TOKENIZER.banned, end_ids=END, pad_id=PAD)
LEVELS, ORDINAL = np.array([[len(a.levels), a.ordinal] for a in LANGUAGE.attributes]).T
PARSER, GRPO_OPTIMIZER = compile_parser(LANGUAGE, TOKENIZER), optax.adam(2e-5)
WEIGHTS = {"accuracy_debiased": 0.6, "consistency": 0.3, "format": 0.1}
SCORE = make_score(PARSER, make_rewards(uniform_prior(LEVELS.tolist())), WEIGHTS)


def touch_batches(store, rows, train=True):
    """Grain batches of clips: training contacts in random order for ever, others once."""
    clip = ClipConfig(frames=FRAMES, image_px=56)
    for arrays in clip_batches(store, rows, clip, batch_size=CONTACTS, seed=0, shuffle=train, repeat=train):
        yield TouchBatch(**{name: arrays[name] for name in CLIP_ARRAYS}), arrays["contact"]


def sft_batch(touch):
    """Every contact with all questions and the true answers to them; every sensor is taken to perceive the label."""
    asked, answers = np.tile(ASKED, (CONTACTS, 1)), []
    for label, q in itertools.product(touch.label, ASKED):
        levels = {"perceive": np.tile(label, (4, 1)), "compare": label, "conclude": label}
        text = answer_text(LANGUAGE, asked=LAYOUT.asked[q], streams=np.ones(4, bool), **levels)
        answers.append(encode_answer(TOKENIZER, text, TOKENS))
    tokens, mask = (jnp.reshape(np.array(x), (*asked.shape, TOKENS)) for x in zip(*answers, strict=True))
    ids, exists, streams = map(jnp.asarray, (LAYOUT.ids[asked], LAYOUT.mask[asked], np.ones((*asked.shape, 4), bool)))
    return SFTBatch(touch, ids, exists, streams, tokens, mask)


@jax.jit
def ask(params, touch, question):
    """Encoded contacts with one question each, and what the rewards compare the answers with."""
    asked, ids, mask = (jnp.asarray(x)[question] for x in (LAYOUT.asked, LAYOUT.ids, LAYOUT.mask))
    levels, ordinal = jnp.broadcast_to(LEVELS, asked.shape), jnp.broadcast_to(ORDINAL > 0, asked.shape)
    target = Target(asked, jnp.where(asked, touch.label, -1), levels, ordinal, touch.stream_mask)
    return GRPOBatch(features=FNS.encode(params, touch), ids=ids, mask=mask, target=target)


@jax.jit
def grpo_step(params, opt_state, reference, batch, key):
    """One GRPO step as one program: rollouts, rewards, advantages, loss, update."""
    draw = SampleConfig(group=GRPO.group, length=TOKENS, end_ids=END, pad_id=PAD)
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
    answer, rows, found, true = make_answer(FNS, PARSER, TOKENS), store.contacts_of_split("test"), [], []
    for touch, contact in touch_batches(store, rows, train=False):
        questions = [ask(params, touch, np.full(len(contact), q)) for q in ASKED]
        found.append(np.stack([answer(params, x).parsed.conclude[:, q] for q, x in enumerate(questions)], -1))
        true.append(touch.label[:, ASKED])
    label = np.concatenate(true)
    right, constant = np.concatenate(found) == label, label == [np.bincount(x).argmax() for x in label.T]
    objects = np.array([store.contacts[i].object_id for i in rows])
    lead = clustered_bootstrap(100.0 * (right.astype(float) - constant).mean(1), objects)
    return f"{right.mean():.1%} right, {lead.mean:+.1f} [{lead.low:.1f}, {lead.high:.1f}] points over a constant"


def main(log):
    """Generate records, train by SFT and GRPO, score after each."""
    folder, key, rng = tempfile.TemporaryDirectory(), jax.random.key(0), np.random.default_rng(0)
    generate_records(SCENES, Path(folder.name))
    store = RecordStore(folder.name)
    imitated, reinforced = np.split(store.contacts_of_split("train"), [640])
    batches = touch_batches(store, imitated)
    params = init_policy(POLICY, key, next(batches)[0], LAYOUT.ids[0], LAYOUT.mask[0], SLOTS)
    optimizer = optax.adam(optax.cosine_decay_schedule(2e-3, SFT_STEPS))
    sft_step = make_sft_step(FNS, optimizer, micro_contacts=2)
    state = SFTState(params=params, opt_state=optimizer.init(params), step=jnp.zeros((), jnp.int32))
    for i in range(SFT_STEPS):
        state, metrics = sft_step(state, sft_batch(next(batches)[0]))
        if i % 100 == 99:
            log(f"SFT step {i + 1}: loss {metrics['loss']:.3f}")
    log(f"after SFT: {score_unseen(store, state.params)}")

    batches, params, opt_state = touch_batches(store, reinforced), state.params, GRPO_OPTIMIZER.init(state.params)
    for i in range(GRPO_STEPS):
        batch = ask(params, next(batches)[0], rng.choice(ASKED, CONTACTS))
        params, opt_state, reward = grpo_step(params, opt_state, state.params, batch, jax.random.fold_in(key, i))
        if i % 20 == 19:
            log(f"GRPO step {i + 1}: mean reward {reward:.3f}")
    log(f"after GRPO: {score_unseen(store, params)}")


if __name__ == "__main__":
    main(print)
