"""GRPO as a stage of experiments: an arm reinforces the decoder of a policy on encoded touch.

Like the stages before it, what it leaves behind lies in the run's directory, so that a stopped run goes on from its
last checkpoint.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
import optax
from jaxtyping import Array, Float, Int

from experiments.core.context import Context
from experiments.core.loops import run_loop
from experiments.study.assembly import Assembly, Weights
from experiments.study.feeds import QuestionFeed
from experiments.study.stages import fresh_adapters, merge_noted
from experiments.study.watching import watched_log
from touchr1_jax.models.lora import LoraConfig, adapt
from touchr1_jax.models.policy import Features
from touchr1_jax.models.policy_fns import PolicyFns
from touchr1_jax.rl.config import GRPOConfig
from touchr1_jax.rl.grpo import LEAN, FrozenInputs, GRPOState, make_grpo_step, start_state
from touchr1_jax.rl.rollout import GRPOBatch
from touchr1_jax.rl.scoring import ScoreFn
from touchr1_jax.rl.stream_check import check_streams, stream_influence
from touchr1_jax.text.constraint import Constraint
from touchr1_jax.training.loop import LoopConfig
from touchr1_jax.training.optimizer import falling_adamw
from touchr1_jax.types import Params


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Arm:
    """One way to reinforce: what a completion earns, by which algorithm, for how long.

    Attributes:
      weights: of each reward.
      prior: share of each level among the training labels [A, K].
      score: total reward that both make; the same object for all seeds, so that it is compiled once.
      config: of GRPO.
      loop: its steps and when it saves.
      lora: adapters that are trained in the place of the decoder's weights; `None` trains those.
    """

    weights: Weights
    prior: Float[np.ndarray, "A K"]
    score: ScoreFn
    config: GRPOConfig
    loop: LoopConfig
    lora: LoraConfig | None = None


def make_arm(
    assembly: Assembly,
    weights: Weights,
    prior: Float[np.ndarray, "A K"],
    config: GRPOConfig,
    loop: LoopConfig,
    lora: LoraConfig | None = None,
) -> Arm:
    """An arm whose total reward is made of its weights and the prior."""
    score = assembly.score(weights, prior)
    return Arm(weights=weights, prior=prior, score=score, config=config, loop=loop, lora=lora)


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Asked:
    """Contacts that GRPO asks about, as one encoder feels them.

    Attributes:
      features: their encoded touch.
      label: their levels [n, A]; -1 where nothing may be asked.
      noise: the encoder's noise bank.
    """

    features: Features
    label: Int[np.ndarray, "n A"]
    noise: Float[Array, "K S N D"]


def run_grpo(
    assembly: Assembly, arm: Arm, asked: Asked, params: Params, context: Context, *, seed: int, stage: str
) -> Params:
    """Reinforce the decoder of an SFT policy; both encoders stay as they are.

    Adapters begin at nothing, so that the policy without them is the reference; they are merged in the end.

    Raises:
      ValueError: a stream whose touch does not reach the policy.
    """
    config, lora = arm.config, arm.lora
    new_feed = functools.partial(
        QuestionFeed, assembly, asked.features, asked.label, batch_size=config.drawn, seed=seed
    )
    constraint = assembly.constraint if config.algorithm.constrained else None
    optimizer, step = grpo_program(
        assembly.fns, arm.score, config, arm.loop.steps, constraint, lora, context.devices.gather_params
    )
    decoder = {"decoder": params["decoder"]}
    influence = influence_program(assembly.fns, config.length)
    check_streams(*jax.device_get(influence(decoder, next(new_feed()), asked.noise, jax.random.key(seed))))
    feed = new_feed(own=context.devices.local_rows(config.drawn))
    trained = decoder if lora is None else fresh_adapters(decoder, {}, lora, seed)
    state = start_state(trained, optimizer, jax.random.key(seed), config)
    shared = (FrozenInputs(reference=trained, noise=asked.noise), *(() if lora is None else (decoder,)))
    step, state, batches = context.devices.shard(step, state, feed, config.drawn, *shared)
    end = run_loop(step, state, batches, arm.loop, context, stage, make_log=watched_log)
    found = context.devices.gather(end.params)
    return {**params, **(found if lora is None else merge_noted(decoder, found.adapters, lora, context, stage))}


@functools.cache
def grpo_program(
    fns: PolicyFns,
    score: ScoreFn,
    config: GRPOConfig,
    steps: int,
    constraint: Constraint | None,
    lora: LoraConfig | None = None,
    gather: Callable[[Params], Params] = lambda params: params,
) -> tuple[optax.GradientTransformation, Any]:
    """Optimizer and compiled step, made once for all seeds of an arm; with adapters the frozen decoder comes last."""
    learning_rate = config.learning_rate * config.lr_scale
    updates = steps * config.algorithm.updates
    optimizer = falling_adamw(learning_rate, config.final_share, updates, config.max_grad_norm)
    plain = make_grpo_step(fns, score, optimizer, config, constraint, gather=gather)
    if lora is None:
        return optimizer, plain
    # a jitted step inside another takes no options of the compiler: the outer one gets them
    inner = dataclasses.replace(config, lean_compilation=False)

    def step(
        state: GRPOState, batch: GRPOBatch, frozen: FrozenInputs, base: Params
    ) -> tuple[GRPOState, dict[str, Array]]:
        adapted = adapt(fns, base, lora)
        return make_grpo_step(adapted, score, optimizer, inner, constraint, gather=gather)(state, batch, frozen)

    return optimizer, jax.jit(step, donate_argnums=0, compiler_options=LEAN if config.lean_compilation else None)


@functools.cache
def influence_program(fns: PolicyFns, length: int) -> Any:
    """Compiled `stream_influence`, made once for all arms and seeds."""
    return jax.jit(lambda p, batch, noise, key: stream_influence(fns, p, batch, noise, key, length))
