"""Stage 3 from parameters to parameters: GRPO of the decoder on encoded touch."""

import dataclasses
import functools
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float

from touchr1_jax.models.lora import of_decoder, with_adapters
from touchr1_jax.models.policy_fns import PolicyFns
from touchr1_jax.models.released_policy import ReleasedPolicy
from touchr1_jax.models.stacked import ADAPTERS, layer_by_layer
from touchr1_jax.models.touch_policy import TouchPolicy
from touchr1_jax.rewards import AnyReward, check_weights, total_reward
from touchr1_jax.rewards.base import GROUP
from touchr1_jax.rewards.proof import prove_rewards
from touchr1_jax.rl.config import GRPOConfig, at_precision
from touchr1_jax.rl.grpo import LEAN, FrozenInputs, GRPOState, make_grpo_step, start_state
from touchr1_jax.rl.rollout import GRPOBatch
from touchr1_jax.rl.scoring import ScoreFn
from touchr1_jax.rl.stream_check import check_streams, stream_influence
from touchr1_jax.text.constraint import Constraint
from touchr1_jax.text.language import Language
from touchr1_jax.text.template import LevelTokens
from touchr1_jax.training.loop import SILENT, Batches, Hooks, LoopConfig, SingleDevice, fit_best, peek
from touchr1_jax.training.optimizer import falling_adamw
from touchr1_jax.training.rollout_server import RolloutServer
from touchr1_jax.training.train_sft import joined
from touchr1_jax.types import Params, Parsed, Target


def train_grpo(
    policy: TouchPolicy,
    params: Params,
    batches: Batches,
    score: ScoreFn,
    config: GRPOConfig,
    loop: LoopConfig,
    hooks: Hooks = SILENT,
    *,
    noise: Float[Array, "K S N D"],
    seed: int = 0,
    rollouts: RolloutServer | None = None,
    held_out: Callable[[Params], float] | None = None,
) -> Params:
    """Train the decoder of a policy by GRPO; both encoders are frozen, and the reference is the initial policy.

    If the policy has adapters, only these are trained, starting from those of SFT.

    Args:
      policy: its prompts and forward passes.
      params: of the policy after SFT.
      batches: `GRPOBatch`es of `config.drawn` prompts, for example of a `QuestionFeed`.
      score: reward of one rollout (see `rl.scoring.make_score`); each such object compiles its programs once.
      config: sizes of a step and algorithm.
      loop: number of steps.
      hooks: log, checkpoints, devices.
      noise: encoded noise streams of the policy's encoder (`encoding.noise_bank`).
      seed: of rollouts, and of new adapters.
      rollouts: server that draws rollouts of a policy on released weights; by default the step draws them.
      held_out: as in `train_sft`.

    Raises:
      ValueError: `held_out` without checkpoints, lean compilation on several devices; as `RolloutServer.check`.
      StreamError: a first batch without touch, a stream whose touch does not reach the policy.
      RolloutError: as `RolloutServer.rollouts`.
    """
    constraint = policy.constraint if config.algorithm.constrained else None
    levels = None if config.algorithm.enumerated is None else policy.level_tokens
    gather, sampled = hooks.devices.gather_params, hooks.sampled is not None
    optimizer, step = grpo_program(policy.fns, score, config, loop.steps, constraint, gather, levels, sampled)
    whole = with_adapters(params, policy.fns.lora, params, seed)
    start = of_decoder(whole)
    check_whole_batch(policy.fns, start, batches, config, hooks, noise, seed)
    base = {name: tree for name, tree in start.items() if policy.fns.lora.rank and name != ADAPTERS}
    trained = {name: tree for name, tree in start.items() if name not in base}
    # released weights have 16 bits already, or are packed
    base = at_precision(config, base) if policy.fns.cache_dtype == jnp.float32 else base
    state = start_state(trained, optimizer, jax.random.key(seed), config)
    constants = FrozenInputs(reference=at_precision(config, trained), noise=noise), base
    step, state, batches = hooks.devices.shard(step, state, batches, config.drawn, *constants)
    if rollouts is not None:
        assert isinstance(policy, ReleasedPolicy)
        step = rollouts.before(step, policy, start["decoder"]["embedding"]["embedding"], config, hooks.devices)

    def complete(state: GRPOState) -> Params:
        return joined(whole, hooks.devices.gather(state.params))

    judge = None if held_out is None else lambda state: held_out(complete(state))
    return complete(fit_best(step, state, batches, loop, hooks, held_out=judge))


def check_rewards(rewards: Mapping[str, AnyReward], weights: Mapping[str, float], language: Language) -> None:
    """Try every weighted reward on an empty answer, to report errors before any work.

    Raises:
      RewardError: an unknown reward, a weight that is negative or not finite, a reward that is no floating scalar,
        cannot be traced, or can be NaN or infinite.
    """
    attributes, sensors = len(language.attributes), len(language.sensors)
    level, flag = jnp.zeros(attributes, jnp.int32), jnp.array(False)
    parsed = Parsed(
        perceive=jnp.zeros((sensors, attributes), jnp.int32),
        compare=level,
        conclude=level,
        formatted=flag,
        truncated=flag,
        length=jnp.int32(0),
    )
    target = Target(asked=level > 0, label=level, levels=level, ordinal=level > 0, streams=jnp.zeros(sensors, bool))
    check_weights(rewards, weights)
    of_group = jax.vmap(
        lambda p, t, tokens: total_reward(rewards, weights, p, t, tokens, str), in_axes=(0, None, 0), axis_name=GROUP
    )
    jax.eval_shape(of_group, jax.tree.map(lambda x: x[None], parsed), target, jnp.zeros((1, 1), jnp.int32))
    levels = tuple(len(attribute.levels) for attribute in language.attributes)
    ordinal = tuple(attribute.ordinal for attribute in language.attributes)
    prove_rewards(rewards, weights, sensors, levels, ordinal=ordinal)


@functools.cache
def grpo_program(
    fns: PolicyFns,
    score: ScoreFn,
    config: GRPOConfig,
    steps: int,
    constraint: Constraint | None = None,
    gather: Callable[[Params], Params] = lambda params: params,
    levels: LevelTokens | None = None,
    sampled: bool = False,
) -> tuple[optax.GradientTransformation, Any]:
    """Optimizer and compiled step, made once for all seeds; frozen parameters under adapters are its last argument."""
    learning_rate = config.learning_rate * config.lr_scale
    updates = steps * config.algorithm.updates * config.algorithm.minibatches
    optimizer = falling_adamw(learning_rate, config.final_share, updates, config.max_grad_norm)
    make = functools.partial(make_grpo_step, gather=gather, levels=levels, sampled=sampled)
    # a jitted step inside another takes no options of the compiler: the outer one gets them
    inner = dataclasses.replace(config, lean_compilation=False)

    def step(
        state: GRPOState, batch: GRPOBatch, frozen: FrozenInputs, base: Params
    ) -> tuple[GRPOState, dict[str, Array]]:
        on_base = dataclasses.replace(fns, base=base)
        return make(on_base, score, optimizer, inner, constraint)(state, batch, frozen)

    options = {**layer_by_layer(fns.cache_dtype), **(LEAN if config.lean_compilation else {})}
    return optimizer, jax.jit(step, donate_argnums=0, compiler_options=options)


def check_whole_batch(
    fns: PolicyFns,
    decoder: Params,
    batches: Batches,
    config: GRPOConfig,
    hooks: Hooks,
    noise: Float[Array, "K S N D"],
    seed: int,
) -> None:
    """`check_streams` on all rows of the first batch, so that all processes decide alike.

    Raises:
      StreamError: as `check_streams`.
      ValueError: lean compilation on several devices, which would compile without it.
    """
    if config.lean_compilation and hooks.devices.shape != SingleDevice.shape:
        raise ValueError(f"lean_compilation is True: must be False on a mesh of {hooks.devices.shape}; leave it out")
    program, key = influence_program(fns, config.length), jax.random.key(seed)
    frozen = FrozenInputs(reference=(), noise=noise)
    check, placed, rows = hooks.devices.shard(program, decoder, batches, config.drawn, frozen, key)
    check_streams(*jax.device_get(check(placed, peek(rows))[1]))


@functools.cache
def influence_program(fns: PolicyFns, length: int) -> Any:
    """Compiled `stream_influence`, made once for all rewards and seeds; it returns its parameters unchanged."""
    return jax.jit(lambda p, batch, frozen, key: (p, stream_influence(fns, p, batch, frozen.noise, key, length)))
