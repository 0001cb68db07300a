"""Greedy answers: what the trained policy says when it is asked, as evaluation scores it."""

from collections.abc import Callable

import jax
from flax import struct
from jaxtyping import Array, Int

from touchr1_jax.models.agent import Agent
from touchr1_jax.rl.grpo import sample_group
from touchr1_jax.rl.objective import GRPOBatch
from touchr1_jax.rl.rollout import SampleConfig
from touchr1_jax.types import Params, Parsed


@struct.dataclass
class Answers:
    """One answer per prompt and what it says; every field has a leading P."""

    tokens: Int[Array, "P T"]
    parsed: Parsed


def make_answer(
    agent: Agent, parser: Callable[[Int[Array, "T"]], Parsed], length: int
) -> Callable[[Params, GRPOBatch], Answers]:
    """Build the jitted (params, batch) → most likely answers of at most `length` tokens."""
    draw = SampleConfig(group=1, length=length, end_ids=agent.end_ids, pad_id=agent.pad_id, greedy=True)

    @jax.jit
    def answer(params: Params, batch: GRPOBatch) -> Answers:
        tokens = sample_group(agent, params, batch, jax.random.key(0), draw).tokens[:, 0]
        return Answers(tokens=tokens, parsed=jax.vmap(parser)(tokens))

    return answer
