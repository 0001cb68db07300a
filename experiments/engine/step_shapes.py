"""Training steps of a policy on Qwen-VL: compiled from shapes only, and run on random weights."""

import dataclasses
import functools
import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from experiments.engine.scale_compiling import score_of
from sensors_io.schema import SENSORS
from touchr1_jax.distributed.abstract import PromptShape, abstract_grpo
from touchr1_jax.distributed.memory import GRPOShape
from touchr1_jax.distributed.mesh import MeshConfig
from touchr1_jax.models.load import peak_memory
from touchr1_jax.models.lora import LoraConfig, init_adapters
from touchr1_jax.models.nf4 import quantised
from touchr1_jax.models.policy import init_policy
from touchr1_jax.models.policy_fns import PolicyFns
from touchr1_jax.models.qwen.config import QwenConfig
from touchr1_jax.models.qwen.pictures import RELEASED_BUDGETS
from touchr1_jax.models.qwen.policy import QwenViewConfig, qwen_policy
from touchr1_jax.models.released_policy import ReleasedModel
from touchr1_jax.models.stacked import ADAPTERS, layer_by_layer
from touchr1_jax.models.touch_policy import touch_shapes
from touchr1_jax.rl.config import GRPOConfig
from touchr1_jax.rl.grpo import make_grpo_step
from touchr1_jax.training.optimizer import OptimizerConfig, falling_adamw, make_optimizer
from touchr1_jax.training.sft import SFTBatch, SFTState, make_sft_step
from touchr1_jax.types import Params

GB = 1e9


@dataclasses.dataclass(frozen=True, kw_only=True)
class StepShape:
    """One prompt, or contact, and the tokens that are written about it."""

    rollouts: int = 2
    tokens: int = 16
    text_tokens: int = 128
    lora: LoraConfig = LoraConfig()
    model: ReleasedModel = ReleasedModel()


def compiled_step(config: QwenConfig, shape: StepShape, stage: str) -> tuple[jax.stages.Compiled, float]:
    """A compiled step, and the processor time at which it was traced."""
    step, arguments = abstract_step(config, shape, stage)
    lowered = jax.jit(step, donate_argnums=0).lower(*arguments)
    traced = time.process_time()
    return lowered.compile(compiler_options=layer_by_layer(jnp.bfloat16)), traced


def run_step(config: QwenConfig, shape: StepShape, stage: str) -> dict[str, float]:
    """Two steps on drawn weights: seconds of each, bytes of the weights and of the process at most, GB.

    Raises:
      FloatingPointError: a loss or a gradient that is not finite.
    """
    compiled, _ = compiled_step(config, shape, stage)
    state, *rest = drawn(abstract_step(config, shape, stage)[1])
    seconds = []
    for _ in range(2):
        began = time.perf_counter()
        state, metrics = jax.block_until_ready(compiled(state, *rest))
        seconds.append(time.perf_counter() - began)
    odd = [name for name, x in metrics.items() if not np.isfinite(x).all()]
    if odd:
        raise FloatingPointError(f"{stage}: {', '.join(odd)} are not finite; the weights were drawn too large")
    weights = sum(x.nbytes for x in jax.tree.leaves(rest[-1]))
    return {"first": seconds[0], "second": seconds[1], "weights": weights / GB, "peak": peak_memory() / GB}


def abstract_step(config: QwenConfig, shape: StepShape, stage: str) -> tuple[Any, tuple[Any, ...]]:
    """The function (state, batch, …, frozen weights) → (state, metrics), and its arguments in shapes."""
    return (sft_step if stage == "SFT" else grpo_step)(config, shape)


def grpo_step(config: QwenConfig, shape: StepShape) -> tuple[Any, tuple[Any, ...]]:
    """GRPO of one prompt, with the reference and the counterfactual policy."""
    sizes: dict[str, Any] = {"prompts": 1, "group": shape.rollouts, "length": shape.tokens, "micro_prompts": 1}
    grpo = GRPOConfig(**sizes, remat=True, bfloat16=True)
    prompt = prompt_of(config, shape)
    of = GRPOShape(decoder=config.decoder, grpo=grpo, mesh=MeshConfig(), prompt_tokens=prompt.tokens)
    optimizer = falling_adamw(1e-5, 0.1, 10, 1.0)
    abstract = abstract_grpo(config, prompt, of, optimizer, lora=shape.lora, four_bits=shape.model.four_bits)

    def step(state: Any, batch: Any, frozen: Any, base: Params) -> Any:
        fns = dataclasses.replace(abstract.fns, base=base)
        return make_grpo_step(fns, score_of(len(SENSORS)), optimizer, grpo)(state, batch, frozen)

    return step, (abstract.state, abstract.batch, abstract.frozen, abstract.base)


def sft_step(config: QwenConfig, shape: StepShape) -> tuple[Any, tuple[Any, ...]]:
    """SFT of one contact and one question, end to end."""
    prompt, touch = prompt_of(config, shape), touch_shapes(shape.model, shape.model.view_px, SENSORS)
    module, length = _module(config, shape), prompt.tokens
    fns = PolicyFns(
        module=module.clone(remat=True),
        slots=prompt.slots,
        banned=np.zeros(config.decoder.vocab_size, bool),
        end_ids=(config.decoder.vocab_size - 1,),
        pad_id=0,
        cache_dtype=jnp.dtype(jnp.bfloat16),
        lora=shape.lora,
    )
    ids, mask = np.zeros(length, np.int32), np.ones(length, bool)
    fresh = lambda batch: init_policy(module, jax.random.key(0), batch, ids, mask, prompt.slots)
    params = dict(jax.eval_shape(fresh, touch))
    half = lambda x: jax.ShapeDtypeStruct(x.shape, jnp.bfloat16)
    base = {name: jax.tree.map(half, params.pop(name)) for name in ("vision", "decoder")}
    params[ADAPTERS] = jax.eval_shape(lambda p: init_adapters(jax.random.key(0), p, shape.lora), base)
    base = jax.eval_shape(quantised, base) if shape.model.four_bits else base
    optimizer = make_optimizer(OptimizerConfig(learning_rate=1e-5), 10)
    of: Any = jax.ShapeDtypeStruct
    state = SFTState(params=params, opt_state=jax.eval_shape(optimizer.init, params), step=of((), jnp.int32))
    batch = SFTBatch(
        touch=touch,
        ids=of((1, 1, length), jnp.int32),
        mask=of((1, 1, length), bool),
        streams=of((1, 1, len(SENSORS)), bool),
        tokens=of((1, 1, shape.tokens), jnp.int32),
        token_mask=of((1, 1, shape.tokens), bool),
    )

    def step(state: SFTState, batch: SFTBatch, base: Params) -> Any:
        return make_sft_step(dataclasses.replace(fns, base=base), optimizer)(state, batch)

    return step, (state, batch, base)


def prompt_of(config: QwenConfig, shape: StepShape) -> PromptShape:
    """Tokens of a prompt of these sizes."""
    view = _module(config, shape).config.vision
    assert isinstance(view, QwenViewConfig)
    tokens = {"stream_tokens": shape.model.stream_tokens, "view_tokens": view.tokens}
    return PromptShape(streams=len(SENSORS), **tokens, text_tokens=shape.text_tokens)


def _module(config: QwenConfig, shape: StepShape) -> Any:
    tactile = dataclasses.replace(shape.model.tactile, sensors=len(SENSORS))
    budget = RELEASED_BUDGETS[config.vision.model_type]
    return qwen_policy(config, tactile, (shape.model.view_px, shape.model.view_px), budget)


def drawn(shapes: Any) -> Any:
    """Arrays of these shapes: weights of about 0.02, small whole numbers, all true; scales of norms are 1."""

    def draw(path: tuple[Any, ...], x: Any) -> jax.Array:
        if jnp.issubdtype(x.dtype, jax.dtypes.prng_key):
            return jax.random.key(0)
        name = jax.tree_util.keystr(path, simple=True, separator="/")
        if name.endswith("kernel/codes"):
            return _wave(x.shape, x.dtype, 128.0, 127.0)
        one = "scale" in name and not name.endswith("kernel/scale")
        return _draw(x.shape, x.dtype, one, "opt_state" in name or x.dtype == jnp.int32)

    return jax.tree_util.tree_map_with_path(draw, shapes)


def _draw(shape: tuple[int, ...], dtype: Any, one: bool, zero: bool) -> jax.Array:
    if one or jnp.issubdtype(dtype, jnp.bool_):
        return jnp.ones(shape, dtype)
    if zero or not jnp.issubdtype(dtype, jnp.floating):
        return jnp.zeros(shape, dtype)
    return _wave(shape, dtype, 0.0, 0.02)


@functools.partial(jax.jit, static_argnums=(0, 1, 2, 3))
def _wave(shape: tuple[int, ...], dtype: Any, middle: float, height: float) -> jax.Array:
    """Fused: no more memory than the array's."""
    index = sum(jax.lax.broadcasted_iota(jnp.float32, shape, i) * (12.9898 + 7.233 * i) for i in range(len(shape)))
    return (middle + height * jnp.sin(index * index)).astype(dtype)
