"""A run on released weights: a check that they stay the same, the memory of training, further evaluations."""

from collections.abc import Mapping
from pathlib import Path

import jax

from experiments.core.context import Context
from experiments.core.results import Table, named_table
from experiments.study.dataset import Dataset
from experiments.study.seed import TrainedPolicy
from experiments.study.stages import encode_rows, untrained
from experiments.study.training import TrainingConfig
from touchr1_jax.distributed.abstract import PromptShape, abstract_grpo
from touchr1_jax.distributed.memory import GRPOShape, counted_peak, grpo_bytes
from touchr1_jax.distributed.mesh import MeshConfig
from touchr1_jax.models.adapted_folder import file_marks, read_adapted
from touchr1_jax.models.layers import SizeError
from touchr1_jax.models.load import WeightsError
from touchr1_jax.models.released_policy import ReleasedPolicy
from touchr1_jax.training.evaluation import Evaluation
from touchr1_jax.training.optimizer import falling_adamw
from touchr1_jax.training.rollout_server import RolloutsConfig, RolloutServer

STEP, WEIGHTS, CONTACTS = "a step of GRPO", "weights as they were read", "encoded contacts, on the host"


def memory_bytes(
    config: TrainingConfig, policy: ReleasedPolicy, data: Dataset, mesh: tuple[int, ...]
) -> dict[str, int]:
    """Bytes of training, counted from shapes: the first two on each device, or on the first one of each process.

    The step reads the released decoder, of which there is one tree: all policies are adapters on it.  SFT needs less
    than GRPO, since it samples nothing.  Contacts are encoded once for GRPO, once for the test.

    Raises:
      SizeError: as `grpo_shape`.
    """
    released, layout, streams = policy.checkpoint.config, policy.layout, len(policy.language.sensors)
    touch, view = layout.touch.size // streams, len(layout.view)
    shape = grpo_shape(config, policy, mesh)
    text = layout.ids.shape[1] - streams * touch - view
    prompt = PromptShape(streams=streams, stream_tokens=touch, view_tokens=view, text_tokens=text)
    step = abstract_grpo(
        released, prompt, shape, falling_adamw(1.0, 1.0, 1, 1.0), lora=config.lora, four_bits=policy.model.four_bits
    )
    lines = grpo_bytes(shape, step.state, step.batch, step.frozen, step.base)
    contacts = len(data.parts["grpo"]) + len(data.parts["test"])
    of_contact = released.decoder.hidden_size * (
        4 * streams * touch + shape.number * (1 + released.vision.levels) * view
    )
    weights = sum(x.nbytes for x in jax.tree.leaves(policy.checkpoint.params))
    return {STEP: counted_peak(lines), WEIGHTS: weights, CONTACTS: contacts * of_contact}


def grpo_shape(config: TrainingConfig, policy: ReleasedPolicy, mesh: tuple[int, ...]) -> GRPOShape:
    """The sizes that the memory of a GRPO step depends on; needs no data.

    Raises:
      SizeError: prompts or heads that the mesh cannot share.
    """
    data, fsdp, tensor = mesh
    try:
        return GRPOShape(
            decoder=policy.checkpoint.config.decoder,
            grpo=config.grpo,
            mesh=MeshConfig(data=data, fsdp=fsdp, tensor=tensor),
            prompt_tokens=policy.layout.ids.shape[1],
        )
    except ValueError as error:
        raise SizeError(f"GRPO cannot be shared by the devices of the mesh: {error}") from error


def rollout_server(config: RolloutsConfig, context: Context) -> RolloutServer | None:
    """The server that draws rollouts, where one is configured; it finds adapters in the run."""
    return None if config.url is None else RolloutServer(config, context.directory / "adapters")


def memory_table(lines: Mapping[str, int]) -> Table:
    """The bytes of `memory_bytes`."""
    return named_table(
        "Memory, counted from shapes",
        [{"part": name, "memory": size / 1e9} for name, size in lines.items()],
        units={"memory": "GB"},
        note="On each device, except the encoded contacts; the compiler's own buffers and the pictures of a batch are "
        "not counted. `scale_paper` compares the count with XLA's figures; no run of this size has.",
    )


def require_same(source: Path, context: Context) -> None:
    """Refuse to continue a run with other weights than it began with, by the fingerprints of their files.

    Raises:
      WeightsError: a file changed, came or went.
    """
    marks = file_marks(source)
    began = context.once("weights", lambda: marks)
    changed = sorted(name for name in {*began, *marks} if began.get(name) != marks.get(name))
    if changed:
        raise WeightsError(
            f"{source} is not what this run began with: {', '.join(changed)} changed; put it back, or pass --fresh"
        )


def zero_shot(trained: TrainedPolicy) -> Evaluation:
    """The released model before any training: it sees the object's picture and no touch, which it never learned to
    read; the system prompt describes the form of an answer."""
    policy, data = trained.policy, trained.data
    params = untrained(policy, data, trained.seed)
    return trained.ask(params, encode_rows(policy, params, data, data.parts["test"], trained.context, blind=True))


def written(trained: TrainedPolicy) -> Evaluation:
    """The policy read from its folder in the run, and evaluated again with all streams."""
    policy, data, context = trained.policy, trained.data, trained.context
    assert isinstance(policy, ReleasedPolicy)
    params = read_adapted(trained.folder, found=policy.checkpoint).params
    return trained.ask(params, encode_rows(policy, params, data, data.parts["test"], context), alone=False)
