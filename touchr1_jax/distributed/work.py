"""Work of a GRPO step on each device, by phase: floating-point operations, memory read, bytes exchanged.

Counted from shapes; `seconds` predicts the time on a machine from it.
"""

import dataclasses
from typing import NamedTuple

from touchr1_jax.distributed.memory import FLOAT, HALF, GRPOShape, head_weights, layer_weights
from touchr1_jax.distributed.mesh import MeshConfig
from touchr1_jax.rl.config import left_out, needs_reference
from touchr1_jax.validation import above

FORWARD, BACKWARD = 2, 4
"""Operations of a weight and token: a product and a sum; the gradients of the input and of the weight take two such."""


class Work(NamedTuple):
    """Work of one phase on each device."""

    flops: float
    read_bytes: float
    """From the device's own memory, at least."""
    gathered_bytes: float
    """Weights and their gradients, from and to the devices that share them along fsdp."""
    summed_bytes: float
    """Partial sums along tensor, all reductions of a layer's result."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Machine:
    """Peak rates of a device, and the shares of them that programs reach; by default an H200 in machines of eight.

    989 TFLOP/s in dense bfloat16, 141 GB at 4.8 TB/s, 900 GB/s of NVLink in both directions together (data sheet), and
    one 400 Gb/s adapter a device between machines.  The shares are assumptions: matrix products of large models reach
    40 to 55 % of the peak in training (PaLM, arXiv 2204.02311, appendix B; Llama 3, arXiv 2407.21783, table 4).

    Raises:
      ValueError: a number that is not above 0.
    """

    flops: float = 989e12
    memory_bytes: float = 141e9
    read_bytes: float = 4.8e12
    near_bytes: float = 450e9
    """Bytes a second from a device of the same machine."""
    far_bytes: float = 50e9
    """Bytes a second from another machine."""
    devices: int = 8
    """Of one machine."""
    flops_share: float = 0.4
    read_share: float = 0.7
    link_share: float = 0.7

    def __post_init__(self) -> None:
        above(self, 0, *(field.name for field in dataclasses.fields(self)))


def grpo_work(shape: GRPOShape) -> dict[str, Work]:
    """Work of a step on each device; the optimizer's is too little to count.

    Sampling uses the weights that were gathered for the prompts.
    """
    return {
        "prompts": _prompts(shape),
        "sampling": _sampling(shape),
        "learning": _learning(shape),
    }


def seconds(shape: GRPOShape, machine: Machine) -> dict[str, float]:
    """Predicted time of each phase of a step."""
    return {name: phase_seconds(work, machine, shape.mesh) for name, work in grpo_work(shape).items()}


def phase_seconds(work: Work, machine: Machine, mesh: MeshConfig) -> float:
    """Time of a phase: the longest of computing, reading and gathering, which may overlap, plus that of the sums.

    Neighbours on the mesh are neighbours in a machine: an axis that fits into one, behind the axes after it, exchanges
    over its links, any other over those between machines.
    """
    gather_rate = machine.near_bytes if mesh.tensor * mesh.fsdp <= machine.devices else machine.far_bytes
    sum_rate = machine.near_bytes if mesh.tensor <= machine.devices else machine.far_bytes
    computing = work.flops / (machine.flops * machine.flops_share)
    reading = work.read_bytes / (machine.read_bytes * machine.read_share)
    gathering = work.gathered_bytes / (gather_rate * machine.link_share)
    return max(computing, reading, gathering) + work.summed_bytes / (sum_rate * machine.link_share)


def model_flops(shape: GRPOShape) -> float:
    """Operations of a step on all devices that any program of it must do: without recomputation."""
    work = grpo_work(shape)
    return sum(w.flops for w in work.values()) * shape.mesh.devices


def _prompts(shape: GRPOShape) -> Work:
    """Every prompt through the decoder once, its last token through the head."""
    tokens = shape.rows * shape.prompt_tokens
    flops = FORWARD * tokens * _weights(shape) + _attention(shape, shape.rows, shape.prompt_tokens, 0)
    flops += FORWARD * shape.rows * head_weights(shape.decoder)
    return Work(flops / shape.mesh.tensor, _local(shape), _gathered(shape, 1), _summed(shape, tokens))


def _sampling(shape: GRPOShape) -> Work:
    """Token by token: all weights are read for each, and the keys of a prompt once for its whole group."""
    c, g = shape.decoder, shape.grpo
    rollouts = shape.rows * g.group
    flops: float = FORWARD * rollouts * g.length * (_weights(shape) + head_weights(c))
    flops += rollouts * _attention(shape, 1, g.length, shape.prompt_tokens)
    keys = shape.rows * (shape.prompt_tokens + g.group * g.length / 2) * c.num_layers * 2 * c.num_kv_heads * c.head_dim
    read = g.length * (_local(shape) + keys * shape.number / shape.mesh.tensor)
    return Work(flops / shape.mesh.tensor, read, 0.0, _summed(shape, rollouts * g.length))


def _learning(shape: GRPOShape) -> Work:
    """Forward passes of all policies that are compared, backward passes of those that learn, for all micro-batches.

    The perturbed policy encodes anew what follows the first tactile token, here counted as the whole prompt.
    """
    g = shape.grpo
    learners, judges = _branches(shape)
    answers = shape.rows * g.group * g.length
    tokens = shape.rows * shape.prompt_tokens + answers
    once = tokens * _weights(shape) + answers * head_weights(shape.decoder)
    attention = _attention(shape, shape.rows, shape.prompt_tokens, 0)
    attention += shape.rows * g.group * _attention(shape, 1, g.length, shape.prompt_tokens)
    passes = FORWARD * (learners + judges) + BACKWARD * learners
    flops = once * passes + attention * passes / FORWARD
    micro = g.prompts // g.micro_prompts
    gathered = micro * _gathered(shape, 2 * learners + judges) + micro * learners * _scattered(shape)
    summed = _summed(shape, tokens) * (2 * learners + judges)
    return Work(flops / shape.mesh.tensor, micro * _local(shape) * (3 * learners + judges), gathered, summed)


def _branches(shape: GRPOShape) -> tuple[int, int]:
    """Policies with a backward pass, and without one."""
    algorithm = shape.grpo.algorithm
    perturbed, reference = not left_out(algorithm.gamma), needs_reference(algorithm)
    learns = perturbed and not algorithm.grounding_stop_masked
    return 1 + learns, reference + perturbed - learns


def _weights(shape: GRPOShape) -> int:
    return shape.decoder.num_layers * layer_weights(shape.decoder)


def _attention(shape: GRPOShape, rows: int, tokens: int, before: int) -> float:
    """Operations of scores and mixtures of causal attention after `before` tokens that all see."""
    c = shape.decoder
    pairs = rows * tokens * (before + (tokens + 1) / 2)
    return 2 * FORWARD * pairs * c.num_heads * c.head_dim * c.num_layers


def _local(shape: GRPOShape) -> float:
    """Bytes of all weights as one device multiplies with them."""
    return (_weights(shape) + head_weights(shape.decoder)) * shape.number / shape.mesh.tensor


def _gathered(shape: GRPOShape, times: int) -> float:
    """Bytes that arrive when all weights are gathered so many times."""
    return times * _local(shape) * (1 - 1 / shape.mesh.fsdp)


def _scattered(shape: GRPOShape) -> float:
    """Bytes that leave when float32 gradients of all weights are summed along fsdp and data."""
    rows = shape.mesh.fsdp * shape.mesh.data
    return _local(shape) / shape.number * FLOAT * (1 - 1 / rows)


def _summed(shape: GRPOShape, tokens: float) -> float:
    """Bytes of a layer's two sums along tensor, by rings: each device sends and receives twice all but its part."""
    c, tensor = shape.decoder, shape.mesh.tensor
    return 2 * c.num_layers * tokens * c.hidden_size * HALF * 2 * (1 - 1 / tensor)
