"""Greedy answers: what the trained policy says when it is asked, as evaluation scores it."""

from collections.abc import Callable

import jax
from flax import struct
from jaxtyping import Array, Float, Int

from touchr1_jax.models.agent import Agent
from touchr1_jax.rl.grpo import ScoreFn, sample_group
from touchr1_jax.rl.objective import GRPOBatch
from touchr1_jax.rl.rollout import SampleConfig
from touchr1_jax.types import Params, Parsed


@struct.dataclass
class Answers:
    """One answer per prompt, parsed and scored; every field has a leading P."""

    tokens: Int[Array, "P T"]
    parsed: Parsed
    reward: Float[Array, "P"]
    terms: dict[str, Float[Array, "P"]]


def make_answer(agent: Agent, score: ScoreFn, length: int) -> Callable[[Params, GRPOBatch], Answers]:
    """Build the jitted (params, batch) → most likely answers of at most `length` tokens."""
    draw = SampleConfig(group=1, length=length, end_ids=agent.end_ids, pad_id=agent.pad_id, greedy=True)

    @jax.jit
    def answer(params: Params, batch: GRPOBatch) -> Answers:
        rollout = sample_group(agent, params, batch, jax.random.key(0), draw)
        tokens = rollout.tokens[:, 0]
        reward, terms, parsed = jax.vmap(score)(tokens, batch.target)
        return Answers(tokens=tokens, parsed=parsed, reward=reward, terms=terms)

    return answer
