"""Least time that a step of training occupies accelerators, counted from shapes."""

import math
from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
from jax.extend.core import ClosedJaxpr, Jaxpr

from experiments.study.stages import StudySFT
from touchr1_jax.distributed.memory import GRPOShape
from touchr1_jax.distributed.mesh import MeshConfig
from touchr1_jax.distributed.work import Machine, seconds
from touchr1_jax.models.touch_policy import TouchPolicy
from touchr1_jax.rl.config import GRPOConfig
from touchr1_jax.training.sft import SFTBatch, SFTState
from touchr1_jax.training.train_sft import sft_program
from touchr1_jax.types import TouchBatch


def count_flops(function: Callable[..., Any], *arguments: Any) -> float:
    """Floating-point operations of the products and convolutions of a call, a loop's as often as it turns.

    Args:
      function: what is traced, not run.
      arguments: arrays, or their shapes and dtypes.

    Raises:
      ValueError: a product within a loop of unknown length.
    """
    return _flops(jax.make_jaxpr(function)(*arguments).jaxpr)


def sft_seconds(policy: TouchPolicy, config: StudySFT, batch: SFTBatch, devices: int, machine: Machine) -> float:
    """Least seconds of a step of SFT, W / (devices · peak · share), where W are the step's operations.

    Exchange between devices is not counted: it could only make the step longer, and so easier to feed.

    Args:
      policy, config: as in `run_sft`.
      batch: one whole batch, or its shapes and dtypes.
      devices: that share it.
      machine: what each can do.
    """
    optimizer, step = sft_program(policy.fns, config, False)

    def start(touch: TouchBatch) -> SFTState:
        params = policy.init(0, touch)
        return SFTState(params=params, opt_state=optimizer.init(params), step=jnp.zeros((), jnp.int32))

    state = jax.eval_shape(start, batch.touch)
    return count_flops(step, state, batch) / (devices * machine.flops * machine.flops_share)


def grpo_seconds(policy: TouchPolicy, config: GRPOConfig, devices: int, machine: Machine) -> float:
    """Seconds of a step of GRPO as `touchr1_jax.distributed.work` predicts them, weights split over all devices.

    Args:
      policy, config: as in `run_grpo`.
      devices: that share a batch.
      machine: what each can do.
    """
    shape = GRPOShape(
        decoder=policy.fns.module.config.decoder,
        grpo=config,
        mesh=MeshConfig(fsdp=devices),
        prompt_tokens=policy.layout.ids.shape[1],
    )
    return math.fsum(seconds(shape, machine).values())


def _flops(jaxpr: Jaxpr) -> float:
    return math.fsum(_equation_flops(equation) for equation in jaxpr.eqns)


def _equation_flops(equation: Any) -> float:
    name, params = equation.primitive.name, equation.params
    if name == "dot_general":
        ((contracted, _), _) = params["dimension_numbers"]
        depth = math.prod(equation.invars[0].aval.shape[i] for i in contracted)
        return 2.0 * math.prod(equation.outvars[0].aval.shape) * depth
    if name == "conv_general_dilated":
        kernel = equation.invars[1].aval.shape
        outputs = kernel[params["dimension_numbers"].rhs_spec[0]]
        return 2.0 * math.prod(equation.outvars[0].aval.shape) * math.prod(kernel) / outputs
    inner = [_flops(jaxpr) for jaxpr in _inner(params)]
    if name == "scan":
        return params["length"] * math.fsum(inner)
    if name == "while" and any(inner):
        raise ValueError("a product stands in a while loop: how often it turns is unknown; count it by hand")
    return max(inner, default=0.0) if name == "cond" else math.fsum(inner)


def _inner(params: dict[str, Any]) -> Iterator[Jaxpr]:
    """Programs within an equation: the turns of a loop, the branches of a choice, a function that is called."""
    for leaf in jax.tree.leaves(list(params.values()), is_leaf=lambda x: isinstance(x, (Jaxpr, ClosedJaxpr))):
        if isinstance(leaf, ClosedJaxpr):
            yield leaf.jaxpr
        elif isinstance(leaf, Jaxpr):
            yield leaf
