"""The whole story on one page: record touch, imitate answers (SFT), reinforce them (GRPO), score on unseen objects.

    python -m experiments.minimal

Objects are generated and pressed by four sensors; a policy of half a million parameters learns from scratch to say how
hard, rough and protruding they are.  Every step of the method is a plain call below.  About two minutes on two cores.
`EXP=ablation_ordinal` is the same with controls, baselines, checkpoints, five seeds and a report.
"""

import sys
import tempfile
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import optax
from touchr1_jax.rl.evaluate import make_answer
from touchr1_jax.rl.objective import GRPOBatch

from sensors_io.generate import generate_records
from sensors_io.pipeline import ClipConfig, clip_batches
from sensors_io.records import RecordStore
from sensors_io.scenes.config import SceneConfig
from sensors_io.schema import CLIP_ARRAYS
from touchr1_jax import masked
from touchr1_jax.bench.statistics import clustered_bootstrap
from touchr1_jax.models.lm import DecoderConfig
from touchr1_jax.models.policy import Policy, PolicyConfig, Slots, init_policy
from touchr1_jax.models.policy_fns import PolicyFns
from touchr1_jax.models.tactile_vit import TactileViTConfig
from touchr1_jax.models.vision import VisionConfig
from touchr1_jax.rewards import make_rewards, uniform_prior
from touchr1_jax.rl.advantages import group_advantage
from touchr1_jax.rl.grpo import sample_group
from touchr1_jax.rl.losses import token_log_probs
from touchr1_jax.rl.rollout import SampleConfig
from touchr1_jax.rl.scoring import make_score
from touchr1_jax.text.language import TOUCH_LANGUAGE as LANGUAGE
from touchr1_jax.text.parser import compile_parser
from touchr1_jax.text.template import answer_text, build_layout, encode_answer, prompt_words
from touchr1_jax.text.tokenizer import word_level
from touchr1_jax.training.sft import SFTBatch, SFTState, make_sft_step
from touchr1_jax.types import Target, TouchBatch

CONTACTS, FRAMES, TOKENS, GROUP = 8, 2, 20, 8  # of a batch, of a clip, of an answer, answers to a question
SFT_STEPS, SFT_RATE, GRPO_STEPS, GRPO_RATE, CLIP, BETA = 400, 2e-3, 100, 2e-5, 0.2, 0.04
REWARD = {"accuracy_debiased": 0.6, "consistency": 0.3, "format": 0.1}
ASKED = np.arange(3)  # hardness, roughness, protrusion: each on three levels
SCENES = SceneConfig(objects=1200, sites=1, frames=FRAMES, min_force_n=2.0, image_px=56, contact_grid=48)

# the answer language, the prompts and the policy; parameters are always an argument
TOKENIZER, ENCODER, VISION = word_level(LANGUAGE, prompt_words()), TactileViTConfig(sensors=4), VisionConfig()
LAYOUT = build_layout(TOKENIZER, LANGUAGE, tactile_tokens=FRAMES * ENCODER.tokens_per_step, view_tokens=VISION.grid**2)
POLICY = Policy(PolicyConfig(tactile=ENCODER, vision=VISION, decoder=DecoderConfig(vocab_size=TOKENIZER.vocab_size)))
SLOTS, END, PAD = Slots(LAYOUT.touch, LAYOUT.view, LAYOUT.stream_text), TOKENIZER.end_ids, TOKENIZER.pad_id
FNS = PolicyFns(module=POLICY, slots=SLOTS, banned=TOKENIZER.banned, end_ids=END, pad_id=PAD)
PARSER = compile_parser(LANGUAGE, TOKENIZER)
LEVELS, ORDINAL = np.array([[len(a.levels), a.ordinal] for a in LANGUAGE.attributes]).T


def touch_batches(store, rows, train=True):
    """Grain batches of clips: training contacts in random order for ever, others once."""
    order = {"batch_size": CONTACTS, "seed": 0, "shuffle": train, "repeat": train}
    for arrays in clip_batches(store, rows, ClipConfig(frames=FRAMES, image_px=56), **order):
        yield TouchBatch(**{name: arrays[name] for name in CLIP_ARRAYS}), arrays["contact"]


def true_answer(label, question):
    """The answer to imitate, as ids and mask; what every sensor perceives is taken to be the label."""
    levels = {"perceive": np.tile(label, (4, 1)), "compare": label, "conclude": label}
    text = answer_text(LANGUAGE, asked=LAYOUT.asked[question], streams=np.ones(4, bool), **levels)
    return encode_answer(TOKENIZER, text, TOKENS)


def sft_batch(touch):
    """Every contact with all questions and the true answers to them."""
    asked, streams = np.tile(ASKED, (len(touch.label), 1)), np.repeat(touch.stream_mask[:, None], len(ASKED), 1)
    rows = [[true_answer(label, q) for q in ASKED] for label in touch.label]
    ids, mask = (np.array([[pair[i] for pair in row] for row in rows]) for i in (0, 1))
    prompts = {"ids": LAYOUT.ids[asked], "mask": LAYOUT.mask[asked], "streams": streams}
    return SFTBatch(touch=touch, **prompts, tokens=ids, token_mask=mask)


@jax.jit
def ask(params, touch, question):
    """Encoded contacts with one question each, and what the rewards compare the answers with."""
    asked, ids, mask = (jnp.asarray(x)[question] for x in (LAYOUT.asked, LAYOUT.ids, LAYOUT.mask))
    levels, ordinal = jnp.broadcast_to(LEVELS, asked.shape), jnp.broadcast_to(ORDINAL > 0, asked.shape)
    label = jnp.where(asked, touch.label, -1)
    target = Target(asked=asked, label=label, levels=levels, ordinal=ordinal, streams=touch.stream_mask)
    return GRPOBatch(features=FNS.encode(params, touch), ids=ids, mask=mask, target=target)


def make_grpo_step(optimizer, score, reference):
    """One GRPO step as one program: rollouts, rewards, advantages, loss, update."""
    draw = SampleConfig(group=GROUP, length=TOKENS, end_ids=END, pad_id=PAD)

    @jax.jit
    def step(params, opt_state, batch, key):
        rollout = sample_group(FNS, params, batch, key, draw)
        reward, _, _ = jax.vmap(jax.vmap(score, (0, None)))(rollout.tokens, batch.target)
        advantage = group_advantage(reward)[..., None]  # (R − mean R) / σ_R over the answers to one question
        logits = jax.vmap(FNS.group_logits, (None, 0, 0, 0, 0))
        prompts = batch.features, batch.ids, batch.mask, rollout.tokens
        log_probs = lambda p: token_log_probs(jax.nn.log_softmax(logits(p, *prompts)), rollout.tokens)

        def loss(params):
            log_p, log_ref = log_probs(params), log_probs(reference)
            ratio = jnp.exp(log_p - rollout.log_prob)
            gain = jnp.minimum(ratio * advantage, jnp.clip(ratio, 1 - CLIP, 1 + CLIP) * advantage)
            kl = jnp.expm1(log_ref - log_p) - (log_ref - log_p)
            return -jnp.mean(masked.mean(gain - BETA * kl, rollout.mask, axis=-1))

        updates, opt_state = optimizer.update(jax.grad(loss)(params), opt_state, params)
        return optax.apply_updates(params, updates), opt_state, jnp.mean(reward)

    return step


def score_unseen(store, params):
    """Share of the levels of unseen objects that are right, and its lead over the best constant, objects resampled."""
    answer, right, truth, objects = make_answer(FNS, PARSER, TOKENS), [], [], []
    for touch, contact in touch_batches(store, store.contacts_of_split("test"), train=False):
        given = [answer(params, ask(params, touch, np.full(len(contact), q))).parsed.conclude[:, q] for q in ASKED]
        right, truth = [*right, np.stack(given, -1) == touch.label[:, ASKED]], [*truth, touch.label[:, ASKED]]
        objects += [store.contacts[i].object_id for i in contact]
    right, truth = np.concatenate(right), np.concatenate(truth)
    constant = truth == [np.bincount(levels).argmax() for levels in truth.T]
    lead = clustered_bootstrap(100.0 * (right.astype(float) - constant).mean(1), np.array(objects))
    return f"{right.mean():.1%} right, {lead.mean:+.1f} [{lead.low:.1f}, {lead.high:.1f}] points over a constant"


def main(log):
    """Tell the story."""
    folder, key, rng = tempfile.TemporaryDirectory(), jax.random.key(0), np.random.default_rng(0)
    generate_records(SCENES, Path(folder.name))
    store = RecordStore(folder.name)
    imitated, reinforced = np.split(store.contacts_of_split("train"), [640])
    log(f"{len(imitated)} contacts to imitate, {len(reinforced)} to reinforce")

    batches = touch_batches(store, imitated)
    params = init_policy(POLICY, key, next(batches)[0], LAYOUT.ids[0], LAYOUT.mask[0], SLOTS)
    adam = lambda rate: optax.chain(optax.clip_by_global_norm(1.0), optax.adam(rate))
    optimizer = adam(optax.cosine_decay_schedule(SFT_RATE, SFT_STEPS))
    sft_step = make_sft_step(FNS, optimizer, micro_contacts=2)
    state = SFTState(params=params, opt_state=optimizer.init(params), step=jnp.zeros((), jnp.int32))
    for i in range(SFT_STEPS):
        state, metrics = sft_step(state, sft_batch(next(batches)[0]))
        if i % 100 == 0:
            log(f"SFT step {i}: loss {metrics['loss']:.3f}")
    log(f"after SFT: {score_unseen(store, state.params)}")

    params, optimizer, batches = state.params, adam(GRPO_RATE), touch_batches(store, reinforced)
    score = make_score(PARSER, make_rewards(uniform_prior(LEVELS.tolist())), REWARD)
    step, opt_state, rewards = make_grpo_step(optimizer, score, params), optimizer.init(params), []
    for i in range(GRPO_STEPS):
        batch = ask(params, next(batches)[0], rng.choice(ASKED, CONTACTS))
        params, opt_state, reward = step(params, opt_state, batch, jax.random.fold_in(key, i))
        rewards.append(float(reward))
        if i % 20 == 19:
            log(f"GRPO step {i}: mean reward of 20 steps {np.mean(rewards[-20:]):.3f}")
    log(f"after GRPO: {score_unseen(store, params)}")


if __name__ == "__main__":
    main(lambda line: sys.stdout.write(f"{line}\n"))
