"""Short trainings that any mesh must do alike: one layer, and SFT, GRPO and tactile dynamics of the tiny policy."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import flax.linen as nn
import grain
import jax
import jax.numpy as jnp
import numpy as np
import optax

from tests.touchr1_jax import tiny
from tests.touchr1_jax.drawn import draw_params
from touchr1_jax.distributed.placement import gather_params
from touchr1_jax.models.layers import GatedMLP, RMSNorm
from touchr1_jax.models.lora import LoraConfig, init_adapters
from touchr1_jax.models.policy_fns import PolicyFns
from touchr1_jax.models.predictor import PredictorConfig
from touchr1_jax.rl.config import GRPOConfig, Paper
from touchr1_jax.rl.grpo import FrozenInputs, GRPOState, make_grpo_step, start_state
from touchr1_jax.rl.rollout import GRPOBatch
from touchr1_jax.training.dynamics import DynamicsConfig, make_dynamics_step, start_dynamics
from touchr1_jax.training.optimizer import OptimizerConfig, falling_adamw, make_optimizer
from touchr1_jax.training.packing import Packing, existing_tokens, pack_rows
from touchr1_jax.training.sft import SFTBatch, SFTState, make_sft_step
from touchr1_jax.types import Params, Parsed, Target

ROWS, STEPS, TOKENS = 8, 20, 6
Gather = Callable[[Params], Params]
FNS = tiny.SHALLOW
LORA = LoraConfig(rank=2, alpha=4.0)
GRPO = GRPOConfig(prompts=ROWS, group=4, length=TOKENS, micro_prompts=ROWS, algorithm=Paper(beta=0.1, gamma=0.05))
OPTIMIZER = make_optimizer(OptimizerConfig(learning_rate=1e-5, warmup_steps=2), STEPS)


@dataclasses.dataclass(frozen=True)
class TrainingProblem:
    """A training: its step for a given gather of weights, first state, batches, and inputs that never change."""

    make_step: Callable[[Gather], Callable[..., Any]]
    state: Any
    item: Callable[[int], Any]
    shared: tuple[Any, ...] = ()
    finish: Callable[[Any], Any] = lambda batch: batch
    """Completes a batch of items, or those rows of it that a process reads."""

    @functools.cached_property
    def step(self) -> Callable[..., Any]:
        """The step on one device."""
        return self.make_step(lambda params: params)

    def step_on(self, mesh: jax.sharding.Mesh) -> Callable[..., Any]:
        """The step to be split over a mesh."""
        return self.make_step(functools.partial(gather_params, mesh))


def feed(problem: TrainingProblem, own: np.ndarray | None = None) -> Any:
    """Batches of `ROWS` items in random order, or those rows of them that a process reads."""
    mine = np.arange(ROWS) if own is None else own
    drawn = grain.MapDataset.range(64).seed(3).shuffle().repeat().batch(ROWS)
    stack = lambda items: jax.tree.map(lambda *x: np.stack(x), *items)
    batch = lambda rows: problem.finish(stack([problem.item(int(i)) for i in rows[mine]]))
    return iter(drawn.map(batch).to_iter_dataset())


def contact(i: int) -> Any:
    """Touch of contact i, without leading axis."""
    return jax.tree.map(lambda x: np.asarray(x[0]), tiny.touch_batch(i))


class Words(nn.Module):
    """A residual layer between an embedding and a head, named as the rules name them."""

    @nn.compact
    def __call__(self, token: jax.Array) -> jax.Array:
        x = nn.Embed(16, 8, name="embedding")(token)
        return nn.Dense(16, name="head")(x + GatedMLP(32, name="mlp")(RMSNorm(name="norm")(x)))


def words() -> TrainingProblem:
    """The number after next, modulo 16: quick to compile."""
    model = Words()
    params = draw_params(jax.eval_shape(lambda: model.init(jax.random.key(0), jnp.zeros(1, jnp.int32)))["params"])

    def step(state: SFTState, batch: dict[str, jax.Array]) -> tuple[SFTState, dict[str, jax.Array]]:
        logits = lambda p: jnp.asarray(model.apply({"params": p}, batch["token"]))
        cost = lambda p: optax.softmax_cross_entropy_with_integer_labels(logits(p), batch["label"]).mean()
        value, grads = jax.value_and_grad(cost)(state.params)
        updates, opt_state = OPTIMIZER.update(grads, state.opt_state, state.params)
        params = optax.apply_updates(state.params, updates)
        return SFTState(params=params, opt_state=opt_state, step=state.step + 1), {"loss": value}

    state = SFTState(params=params, opt_state=OPTIMIZER.init(params), step=jnp.int32(0))
    return TrainingProblem(
        lambda gather: jax.jit(step), state, lambda i: {"token": np.int32(i % 16), "label": np.int32((i + 2) % 16)}
    )


def sft() -> TrainingProblem:
    """The whole policy, one question a contact, random answers of several lengths."""

    def item(i: int) -> SFTBatch:
        rng = np.random.default_rng(i)
        return SFTBatch(
            touch=contact(i),
            ids=np.asarray(tiny.LAYOUT.ids[[i % tiny.A]]),
            mask=np.asarray(tiny.LAYOUT.mask[[i % tiny.A]]),
            streams=np.ones((1, tiny.S), bool),
            tokens=rng.choice(tiny.WRITABLE, (1, TOKENS)).astype(np.int32),
            token_mask=np.arange(TOKENS)[None] <= rng.integers(TOKENS),
        )

    params = {**tiny.params(loud=0.2), **tiny.shallow_params(loud=0.2)}
    state = SFTState(params=params, opt_state=OPTIMIZER.init(params), step=jnp.int32(0))
    return TrainingProblem(lambda gather: make_sft_step(FNS, OPTIMIZER), state, item)


def packed() -> TrainingProblem:
    """The same in rows, which the questions of two contacts share; a mesh of eight splits each two between devices."""
    problem = sft()

    def finish(batch: SFTBatch) -> SFTBatch:
        prompt = batch.touch, batch.mask, batch.streams, batch.token_mask
        exists = existing_tokens(FNS.module, FNS.slots, *prompt)
        return batch.replace(rows=pack_rows(exists, batch.token_mask, Packing(width=40, contacts=2)))

    return dataclasses.replace(problem, finish=finish)


def adapters() -> TrainingProblem:
    """SFT whose decoder stands still under adapters of rank 2, with encoders that are trained in full."""
    plain = sft()
    base, towers = _apart(plain.state.params)
    trained = {"adapters": _adapters(base), **towers}
    state = SFTState(params=trained, opt_state=OPTIMIZER.init(trained), step=jnp.int32(0))

    def step(state: SFTState, batch: SFTBatch, base: Params) -> tuple[SFTState, dict[str, jax.Array]]:
        return make_sft_step(_on(base), OPTIMIZER)(state, batch)

    return TrainingProblem(lambda gather: jax.jit(step, donate_argnums=0), state, plain.item, (base,))


def adapters_grpo() -> TrainingProblem:
    """GRPO of adapters; others are the reference."""
    plain = grpo()
    base, _ = _apart(plain.state.params)
    trained = {"adapters": _adapters(base)}
    optimizer = falling_adamw(1e-3, 0.1, STEPS, 1.0)
    state = start_state(trained, optimizer, jax.random.key(0), GRPO)
    frozen = FrozenInputs(reference={"adapters": _adapters(base, 1)}, noise=plain.shared[0].noise)

    def make_step(gather: Gather) -> Callable[..., Any]:
        def step(state: GRPOState, batch: GRPOBatch, frozen: FrozenInputs, base: Params):
            return make_grpo_step(_on(base), score, optimizer, GRPO, gather=gather)(state, batch, frozen)

        return jax.jit(step, donate_argnums=0)

    return TrainingProblem(make_step, state, plain.item, (frozen, base))


def _on(base: Params) -> PolicyFns:
    """The policy with adapters on a frozen base."""
    return dataclasses.replace(FNS, lora=LORA, base=base)


def _apart(params: Params) -> tuple[Params, Params]:
    """The decoder, and the other towers."""
    return {"decoder": params["decoder"]}, {name: x for name, x in params.items() if name != "decoder"}


def _adapters(base: Params, seed: int = 0) -> Any:
    """Drawn and loud: of fresh ones half have no gradient at first."""
    shapes = jax.eval_shape(lambda key: init_adapters(key, base, LORA), jax.random.key(0))
    rng = np.random.default_rng(seed)
    return jax.tree.map(lambda x: jnp.asarray(rng.normal(0, 0.2, x.shape), x.dtype), shapes)


def score(tokens: jax.Array, target: Target) -> tuple[jax.Array, dict[str, jax.Array], Parsed]:
    """Share of tokens that are the label modulo 3."""
    level = jnp.where(target.asked, tokens[0] % 3, -1)
    right = jnp.mean(tokens % 3 == jnp.max(target.label))
    truncated = jnp.all(~jnp.isin(tokens, jnp.asarray(FNS.end_ids)))
    parsed = Parsed(
        perceive=jnp.tile(level, (tiny.S, 1)),
        compare=level,
        conclude=level,
        formatted=tokens[0] > 20,
        truncated=truncated,
        length=jnp.sum(tokens > 1),
    )
    return right, {"right": right}, parsed


def grpo() -> TrainingProblem:
    """The decoder, groups of four; both divergences count."""
    optimizer = falling_adamw(1e-3, 0.1, STEPS, 1.0)
    state = start_state(tiny.shallow_params(0, loud=0.2), optimizer, jax.random.key(0), GRPO)
    noise = np.random.default_rng(5).normal(size=(3, tiny.S, tiny.N, tiny.CONFIG.decoder.hidden_size))
    frozen = FrozenInputs(reference=tiny.shallow_params(1, loud=0.2), noise=jnp.asarray(noise, jnp.float32))
    item = lambda i: jax.tree.map(lambda x: np.asarray(x[i % 16]), questions)
    questions = tiny.question_batch(0, 16)
    make_step = lambda gather: make_grpo_step(FNS, score, optimizer, GRPO, gather=gather)
    return TrainingProblem(make_step, state, item, (frozen,))


def dynamics() -> TrainingProblem:
    """Encoder and predictor of stage 1."""
    config = DynamicsConfig(
        encoder=dataclasses.replace(tiny.CONFIG.tactile, causal=True),
        predictor=PredictorConfig(width=16, num_layers=1, num_heads=2),
    )
    batch = jax.tree.map(jnp.asarray, tiny.touch_batch(0, 1))
    shapes = jax.eval_shape(lambda: start_dynamics(config, OPTIMIZER, jax.random.key(0), batch))
    params = draw_params(shapes.params, loud=0.2)
    state = shapes.replace(
        params=params,
        target=jax.tree.map(jnp.copy, params["encoder"]),
        opt_state=OPTIMIZER.init(params),
        step=jnp.int32(0),
        key=jax.random.key(1),
    )
    return TrainingProblem(lambda gather: make_dynamics_step(config, OPTIMIZER), state, contact)


PROBLEMS: dict[str, Callable[[], TrainingProblem]] = {
    "words": words,
    "sft": sft,
    "packed": packed,
    "adapters": adapters,
    "adapters_grpo": adapters_grpo,
    "grpo": grpo,
    "dynamics": dynamics,
}
