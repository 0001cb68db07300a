"""A policy on Qwen2.5-VL: it is that model where nothing is touched, and both stages train it."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from tests.touchr1_jax import tiny
from tests.touchr1_jax.models.qwen import small_policy
from tests.touchr1_jax.models.qwen.small_policy import CONFIG, FNS, LAYOUT, POLICY, SLOTS, TOKENIZER, VIEW_TOKENS
from tests.touchr1_jax.models.qwen.tiny import Block, position_ids
from touchr1_jax.models.lora import LoraConfig, by_layer, init_adapters
from touchr1_jax.models.policy import init_policy, prompt_mask, prompt_positions
from touchr1_jax.models.policy_fns import over_base
from touchr1_jax.models.qwen.geometry import Grid
from touchr1_jax.models.qwen.model import Inputs, QwenVL
from touchr1_jax.models.qwen.pictures import PixelBudget, patchify, resize
from touchr1_jax.models.qwen.policy import QwenViewConfig, init_on_pretrained, qwen_fns
from touchr1_jax.rl.config import Algorithm, GRPOConfig
from touchr1_jax.rl.grpo import FrozenInputs, make_grpo_step, start_state
from touchr1_jax.rl.rollout import GRPOBatch
from touchr1_jax.training.sft import SFTBatch, SFTState, make_sft_step
from touchr1_jax.types import Parsed, Target

pytestmark = pytest.mark.long

P, G, T = 2, 2, 3
WRITABLE = np.flatnonzero(~TOKENIZER.banned)
LORA = LoraConfig(rank=4, alpha=8.0)
ADAPTING = dataclasses.replace(FNS, lora=LORA)


@pytest.fixture(scope="module")
def batch() -> GRPOBatch:
    touch = jax.tree.map(jnp.asarray, tiny.touch_batch(0, P))
    return GRPOBatch(
        features=jax.jit(lambda p, b: FNS.encode(p, b))(small_policy.params(), touch),
        ids=jnp.asarray(LAYOUT.ids[:P]),
        mask=jnp.asarray(LAYOUT.mask[:P]),
        target=tiny.target(np.arange(P), np.arange(P)),
    )


group_logits = jax.jit(jax.vmap(FNS.group_logits, in_axes=(None, 0, 0, 0, 0)))


def completions(*shape: int) -> jax.Array:
    return jnp.asarray(np.random.default_rng(0).choice(WRITABLE, shape), jnp.int32)


def test_view_fills_its_tokens(batch):
    assert VIEW_TOKENS == LAYOUT.view.size == 4
    assert batch.features.view.shape == (P, VIEW_TOKENS, CONFIG.decoder.hidden_size)


def test_positions_are_those_of_the_model(batch):
    """Block by block: words, the view, and each stream at its integer frame indices."""
    features = jax.tree.map(lambda x: x[1], batch.features)
    mask = np.asarray(prompt_mask(features, batch.mask[1], SLOTS))
    place = jax.jit(lambda time, mask: prompt_positions(time, mask, SLOTS, POLICY.config.vision.grid))
    ours = place(features.touch_time, jnp.asarray(mask))
    names = [int((LAYOUT.stream_text == s).sum()) - 2 for s in range(tiny.S)]
    before, streams = LAYOUT.view[0], []
    for s, name in enumerate(names):
        steps = np.unique(features.touch_time[s])
        streams += [1 + name + 1, Block(steps, 1, tiny.N // len(steps))]
    question = mask[LAYOUT.touch[-1, -1] + 1 :].sum()
    runs = [int(before), Block([0], 2, 2), *streams, int(question)]
    np.testing.assert_array_equal(ours[:, mask], position_ids(runs))


def test_untouched_policy_is_the_model(batch):
    """Without streams, the logits of a completion are those of `QwenVL` on the same conversation with a picture."""
    params, features = small_policy.params(), batch.features
    blind = features.replace(stream_mask=jnp.zeros_like(features.stream_mask))
    tokens = completions(P, G, T)
    ours = group_logits(params, blind, batch.ids, batch.mask, tokens)[1, 0]
    mask = np.asarray(prompt_mask(jax.tree.map(lambda x: x[1], blind), batch.mask[1], SLOTS))
    ids = np.concatenate([np.asarray(batch.ids[1])[mask], tokens[1, 0]])
    after = len(ids) - LAYOUT.view[-1] - 1
    view = resize(tiny.touch_batch(0, P).view[1], 16, 16)
    inputs = Inputs(
        ids=jnp.asarray(ids),
        positions=jnp.asarray(position_ids([int(LAYOUT.view[0]), Block([0], 2, 2), int(after)])),
        slots=jnp.asarray(LAYOUT.view),
        patches=patchify(view[None], CONFIG.vision),
    )
    model = {"vision": params["vision"]["tower"], "decoder": params["decoder"]}
    whole = jax.jit(lambda p, x: QwenVL(CONFIG).apply({"params": p}, x, (Grid(1, 4, 4),)))(model, inputs)
    theirs = whole[-T - 1 : -1, WRITABLE]
    np.testing.assert_allclose(ours[:, WRITABLE], theirs, rtol=0, atol=1e-5 * float(np.abs(theirs).max()))


@pytest.mark.parametrize("what", ["touch", "view", "time"])
def test_what_is_felt_and_seen_reaches_the_logits(batch, what):
    f = batch.features
    changed = {
        "touch": f.replace(touch=f.touch.at[:, 1].add(1.0)),
        "view": f.replace(view=f.view + 1.0),
        "time": f.replace(touch_time=f.touch_time * 2),
    }[what]
    args = (batch.ids, batch.mask, completions(P, G, T))
    before = group_logits(small_policy.params(), f, *args)
    assert float(jnp.abs(group_logits(small_policy.params(), changed, *args) - before).max()) > 1e-3


def test_absent_view_takes_its_marks_along(batch):
    f = jax.tree.map(lambda x: x[0], batch.features)
    gone = prompt_mask(f.replace(view_mask=jnp.array(False)), batch.mask[0], SLOTS)
    lost = np.flatnonzero(np.asarray(prompt_mask(f, batch.mask[0], SLOTS)) & ~np.asarray(gone))
    np.testing.assert_array_equal(lost, [LAYOUT.view[0] - 1, *LAYOUT.view, LAYOUT.view[-1] + 1])


def score(tokens: jax.Array, target: Target) -> tuple[jax.Array, dict[str, jax.Array], Parsed]:
    """Share of tokens that are the label modulo 3."""
    right = jnp.mean(tokens % 3 == jnp.max(target.label))
    level = jnp.where(target.asked, tokens[0] % 3, -1)
    parsed = Parsed(
        perceive=jnp.tile(level, (tiny.S, 1)),
        compare=level,
        conclude=level,
        formatted=tokens[0] > 20,
        truncated=jnp.all(tokens != TOKENIZER.end_ids[0]),
        length=jnp.sum(tokens > 1),
    )
    return right, {"right": right}, parsed


def test_one_grpo_step(batch):
    """With adapters on a frozen decoder: finite, on policy, at the reference, and every layer moves."""
    base = {"decoder": small_policy.params()["decoder"]}
    start = {"adapters": init_adapters(jax.random.key(0), base, LORA)}
    optimizer = optax.adam(1e-3)
    algorithm = Algorithm(beta=0.1, gamma=0.05)
    config = GRPOConfig(prompts=P, group=G, length=T, micro_prompts=1, algorithm=algorithm)
    noise = jax.random.normal(jax.random.key(1), (3, *batch.features.touch.shape[1:]))
    state = start_state(start, optimizer, jax.random.key(0), config)
    step = over_base(ADAPTING, lambda fns: make_grpo_step(fns, score, optimizer, config))
    after, metrics = step(base, state, batch, FrozenInputs(start, noise))
    assert all(np.isfinite(x) for x in metrics.values())
    assert metrics["clip_share"] == 0
    assert metrics["kl"] == pytest.approx(0, abs=1e-6)
    assert metrics["grounding"] > 0
    layers = by_layer(after.params["adapters"]).values()
    assert len(layers) == len(LORA.targets)
    assert all(bool((layer.b != 0).any()) for layer in layers)


def sft_batch() -> SFTBatch:
    """One question about each of P contacts."""
    return SFTBatch(
        touch=jax.tree.map(jnp.asarray, tiny.touch_batch(0, P)),
        ids=jnp.asarray(LAYOUT.ids[:P, None]),
        mask=jnp.asarray(LAYOUT.mask[:P, None]),
        streams=jnp.ones((P, 1, tiny.S), bool),
        tokens=completions(P, 1, T),
        token_mask=jnp.ones((P, 1, T), bool),
    )


def test_sft_with_adapters_and_a_whole_tactile_encoder():
    """What was pretrained stands still, an argument of the step; adapters and tactile encoder learn the answers."""
    params = small_policy.params()
    frozen = {name: x for name, x in params.items() if name in ("decoder", "vision")}
    towers = {name: x for name, x in params.items() if name not in frozen}
    start = {"adapters": init_adapters(jax.random.key(0), frozen, LORA), **towers}
    optimizer = optax.adam(2e-2)
    state = SFTState(params=tiny.copy(start), opt_state=optimizer.init(start), step=jnp.int32(0))
    step = over_base(ADAPTING, lambda fns: make_sft_step(fns, optimizer))
    kept, batch, losses = tiny.copy(frozen), sft_batch(), []
    for _ in range(12):
        state, metrics = step(frozen, state, batch)
        losses.append(float(metrics["loss"]))
    assert losses[-1] < 0.5 * losses[0]
    assert step._cache_size() == 1
    jax.tree.map(np.testing.assert_array_equal, frozen, kept)
    moved = jax.tree.map(lambda a, b: bool((a != b).any()), state.params, start)
    assert all(jax.tree.leaves(moved))


def test_half_precision_decodes_as_the_learner_scores(batch):
    """Keys and values of a bfloat16 decoder are bfloat16; both agree to its rounding."""
    half = jax.tree.map(lambda x: (0.5 * x).astype(jnp.bfloat16), {"decoder": small_policy.params()["decoder"]})
    fns, tokens = qwen_fns(POLICY, LAYOUT, TOKENIZER), completions(1, 2)
    features = jax.tree.map(lambda x: x[0], batch.features)

    @jax.jit
    def both(params):
        states, prefix = fns.group_states(params, features, batch.ids[0], batch.mask[0], tokens)
        step, caches = fns.decode(params, tokens[0, 0], jnp.int32(0), prefix, fns.empty_cache(T))
        return step, caches, fns.logits(params, states)[0, 1]

    step, caches, scored = both(half)
    assert caches[-1].k.dtype == caches[-1].v.dtype == jnp.bfloat16
    assert step.dtype == jnp.float32
    np.testing.assert_allclose(step[WRITABLE], scored[WRITABLE], atol=0.02 * float(jnp.abs(scored[WRITABLE]).max()))


def test_pretrained_towers_stand_beside_fresh_ones():
    params = small_policy.params()
    model = {"vision": params["vision"]["tower"], "decoder": params["decoder"]}
    of = (POLICY, jax.random.key(0), tiny.touch_batch(), LAYOUT.ids[0], LAYOUT.mask[0], SLOTS)
    joined = init_on_pretrained(*of, model)
    assert jax.tree.map(jnp.shape, joined) == jax.tree.map(jnp.shape, params)
    assert joined["decoder"] is model["decoder"]
    assert joined["vision"]["tower"] is model["vision"]
    fresh = init_policy(*of)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-6), joined["tactile"], fresh["tactile"])
    with pytest.raises(ValueError, match="pretrained has other shapes"):
        init_on_pretrained(*of, {**model, "decoder": {}})


def test_view_sizes_are_checked():
    view = QwenViewConfig(tower_config=CONFIG.vision, height_px=33, width_px=15, budget=PixelBudget(least=64, most=512))
    assert (view.size, view.grid, view.tokens) == ((32, 16), 2, 8)
    with pytest.raises(ValueError, match="out_size 24 must be the decoder's hidden_size, 25"):
        view.tower(25)
    other = dataclasses.replace(tiny.touch_batch(0, P), view=np.zeros((P, 8, 8, 3), np.uint8))
    with pytest.raises(ValueError, match="view is 8×8 px, the config says 16×16"):
        jax.eval_shape(lambda b: FNS.encode(small_policy.params(), b), other)
