"""Greedy answers: what the trained policy says when it is asked, as evaluation scores it."""

from collections.abc import Callable

import jax
from flax import struct
from jaxtyping import Array, Int

from touchr1_jax.models.policy_fns import PolicyFns
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
    fns: PolicyFns, parser: Callable[[Int[Array, "T"]], Parsed], length: int
) -> Callable[[Params, GRPOBatch], Answers]:
    """Build the jitted (params, batch) → most likely answers of at most `length` tokens."""
    draw = SampleConfig(group=1, length=length, end_ids=fns.end_ids, pad_id=fns.pad_id, greedy=True)

    @jax.jit
    def answer(params: Params, batch: GRPOBatch) -> Answers:
        tokens = sample_group(fns, params, batch, jax.random.key(0), draw).tokens[:, 0]
        return Answers(tokens=tokens, parsed=jax.vmap(parser)(tokens))

    return answer
