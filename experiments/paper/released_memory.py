"""What training on released weights will hold, counted from shapes before it begins."""

from collections.abc import Mapping

import jax

from experiments.core.results import Column, Table
from experiments.paper.released_policy import ReleasedAssembly
from experiments.study.dataset import Dataset
from experiments.study.training import TrainingConfig
from touchr1_jax.distributed.abstract import PromptShape, abstract_grpo
from touchr1_jax.distributed.memory import GRPOShape, counted_peak, grpo_bytes
from touchr1_jax.distributed.mesh import MeshConfig
from touchr1_jax.models.layers import SizeError
from touchr1_jax.training.optimizer import falling_adamw

GB = 1e9

STEP, WEIGHTS, CONTACTS = "a step of GRPO", "weights as they were read", "encoded contacts, on the host"


def counted(config: TrainingConfig, assembly: ReleasedAssembly, data: Dataset, mesh: tuple[int, ...]) -> dict[str, int]:
    """Bytes by what they are for; the first two on each device, on the first one of each process at least.

    The step holds the decoder that SFT left; beside it stand the released towers, from which other seeds and the
    baseline without touch begin.  SFT holds less than GRPO, since it samples nothing.

    Args:
      config: of the training.
      assembly: the policy.
      data: its contacts are encoded once for GRPO, once for the test.
      mesh: devices along its axes.

    Raises:
      SizeError: as `shape_of`.
    """
    released, layout, streams = assembly.checkpoint.config, assembly.layout, len(assembly.language.sensors)
    touch, view = layout.touch.size // streams, len(layout.view)
    shape = shape_of(config, assembly, mesh)
    text = layout.ids.shape[1] - streams * touch - view
    prompt = PromptShape(streams=streams, stream_tokens=touch, view_tokens=view, text_tokens=text)
    step = abstract_grpo(released, prompt, shape, falling_adamw(1.0, 1.0, 1, 1.0), lora=config.grpo_lora)
    lines = grpo_bytes(shape, step.state, step.batch, step.frozen, step.base)
    contacts = len(data.parts["grpo"]) + len(data.parts["test"])
    of_contact = released.decoder.hidden_size * (4 * streams * touch + shape.number * view)
    return {STEP: counted_peak(lines), WEIGHTS: _bytes(assembly), CONTACTS: contacts * of_contact}


def shape_of(config: TrainingConfig, assembly: ReleasedAssembly, mesh: tuple[int, ...]) -> GRPOShape:
    """What the memory of a GRPO step depends on; needs no data.

    Raises:
      SizeError: prompts or heads that the mesh cannot share.
    """
    data, fsdp, tensor = mesh
    try:
        return GRPOShape(
            decoder=assembly.checkpoint.config.decoder,
            grpo=config.grpo,
            mesh=MeshConfig(data=data, fsdp=fsdp, tensor=tensor),
            prompt_tokens=assembly.layout.ids.shape[1],
        )
    except ValueError as error:
        raise SizeError(f"GRPO cannot be shared by the devices of the mesh: {error}") from error


def _bytes(assembly: ReleasedAssembly) -> int:
    return sum(x.nbytes for x in jax.tree.leaves(assembly.checkpoint.params))


def memory_table(lines: Mapping[str, int]) -> Table:
    """The count."""
    return Table(
        title="Memory, counted from shapes",
        columns=(Column(name="what"), Column(name="memory", unit="GB", format=".3g")),
        rows=tuple((name, size / GB) for name, size in lines.items()),
        note="On each device, but for the encoded contacts; the compiler's own buffers and the pictures of a batch are "
        "not among it. Held against XLA's figures by `scale_paper`, not by a run of this size.",
    )
