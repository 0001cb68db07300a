"""A policy on released weights: its towers, prompts and parameters, its files, and the memory that its training needs.

A written policy is a folder of the released format with one more file:

    DIR/model.safetensors, config.json, tokenizer.json, …    the released folder with the merged weights
    DIR/touch.npz                                            tactile encoder and the projection of its tokens
"""

import dataclasses
import functools
import io
import shutil
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from flax import traverse_util

from experiments.core.artifacts import write_bytes
from experiments.core.context import Context
from experiments.core.loops import KEPT
from experiments.core.progress import in_megabytes
from experiments.core.results import Table, named_table
from experiments.study.dataset import Dataset
from experiments.study.seed import TrainedPolicy
from experiments.study.stages import encode_rows, untrained
from experiments.study.study import BLIND, CONTINUED, SFT
from experiments.study.training import TrainingConfig
from sensors_io.arrays import load_arrays
from touchr1_jax.distributed.abstract import PromptShape, abstract_grpo
from touchr1_jax.distributed.memory import GRPOShape, counted_peak, grpo_bytes
from touchr1_jax.distributed.mesh import MeshConfig
from touchr1_jax.models.layers import SizeError, check_sizes
from touchr1_jax.models.load import Checkpoint, WeightsError
from touchr1_jax.models.qwen.config import read_config
from touchr1_jax.models.qwen.policy import QwenViewConfig, init_on_pretrained, qwen_fns, qwen_policy
from touchr1_jax.models.qwen.safetensors import ReportBytes
from touchr1_jax.models.qwen.weights import INDEX, SINGLE, load_params, save_params
from touchr1_jax.models.tactile_vit import TactileViTConfig
from touchr1_jax.models.touch_policy import TouchConfig, TouchPolicy, language_of
from touchr1_jax.text.chat import build_chat_layout
from touchr1_jax.text.language import Language
from touchr1_jax.text.parser import compile_parser
from touchr1_jax.text.template import answer_text
from touchr1_jax.text.tokenizer import Tokenizer
from touchr1_jax.training.evaluation import Evaluation
from touchr1_jax.training.optimizer import falling_adamw
from touchr1_jax.types import Params, TouchBatch

TOUCH_FILE = "touch.npz"

COPIED = (".json", ".jinja", ".txt", ".md")
"""Endings of the small files of a released folder, which are copied."""

STEP, WEIGHTS, CONTACTS = "a step of GRPO", "weights as they were read", "encoded contacts, on the host"


@dataclasses.dataclass(frozen=True, kw_only=True)
class ReleasedModel(TouchConfig):
    """Sizes of touch, picture and answer next to released towers, and the type of these towers' weights."""

    tactile: TactileViTConfig = TactileViTConfig(
        sensors=0, width=384, num_layers=8, num_heads=6, mlp_ratio=4, tokens_per_step=4
    )
    frames: int = 8
    image_px: int = 224
    completion_tokens: int = 96
    view_px: int = 224
    """Rows and columns of the object's picture; the released vision tower makes one token of 28² pixels."""
    dtype: Literal["bfloat16", "float32"] = "bfloat16"

    def __post_init__(self) -> None:
        super().__post_init__()
        check_sizes(self, "view_px")


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class ReleasedPolicy(TouchPolicy):
    """A policy whose vision tower and decoder are a checkpoint's."""

    checkpoint: Checkpoint

    @property
    def frozen(self) -> tuple[str, ...]:
        """The released towers."""
        return ("vision", "decoder")

    def init(self, seed: int, batch: TouchBatch) -> Params:
        """The released towers as they are, and a fresh tactile encoder."""
        prompt = self.layout.ids[0], self.layout.mask[0], self.fns.slots
        return init_on_pretrained(self.fns.module, jax.random.key(seed), batch, *prompt, self.checkpoint.params)

    def check(self, batch: TouchBatch) -> None:
        """Build the parameters of a batch's shapes abstractly, so that contradicting sizes show before data are made.

        Raises:
          SizeError: sizes contradict each other.
        """
        try:
            jax.eval_shape(functools.partial(self.init, 0), batch)
        except (ValueError, TypeError) as error:
            raise SizeError(f"no policy can be built of these sizes: {error}") from error


def instruction(language: Language) -> str:
    """The system prompt: the form of an answer and the words for every level, such as

    Answer about the touch as <perceive> SENSOR LEVEL … </perceive> <compare> LEVEL </compare> …
    """
    perceive, compare, conclude = language.tags
    levels = "; ".join(f"{a.name}: {', '.join(level[0] for level in a.levels)}" for a in language.attributes)
    return (
        f"Answer about the touch as <{perceive}> SENSOR LEVEL ... </{perceive}> <{compare}> LEVEL </{compare}> "
        f"<{conclude}> LEVEL </{conclude}>. Levels are {levels}."
    )


def build_released_policy(model: ReleasedModel, found: Checkpoint, sensors: tuple[str, ...]) -> ReleasedPolicy:
    """Combine a checkpoint, prompts in its chat template and a tactile encoder for a set of sensors.

    Raises:
      SizeError: completions that are too short for an answer.
      ValueError: a sensor that the language does not know.
    """
    language = language_of(sensors)
    need = longest_answer(language, found.tokenizer)
    if model.completion_tokens < need:
        raise SizeError(
            f"model.completion_tokens is {model.completion_tokens}: the longest answer takes {need} tokens of this "
            "tokenizer; raise it, and grpo.length with it"
        )
    tactile = dataclasses.replace(model.tactile, sensors=len(sensors))
    policy = qwen_policy(found.config, tactile, (model.view_px, model.view_px), found.budget)
    view = policy.config.vision
    assert isinstance(view, QwenViewConfig)
    layout = build_chat_layout(
        found.tokenizer,
        language,
        tactile_tokens=model.stream_tokens,
        view_tokens=view.tokens,
        system=instruction(language),
    )
    return ReleasedPolicy(
        model=model,
        language=language,
        tokenizer=found.tokenizer,
        layout=layout,
        fns=qwen_fns(policy, layout, found.tokenizer, jnp.dtype(model.dtype)),
        parser=compile_parser(language, found.tokenizer),
        checkpoint=found,
    )


def longest_answer(language: Language, tokenizer: Tokenizer) -> int:
    """Tokens of the longest answer to a question for one attribute, the end token included."""
    return max(len(tokenizer.encode(text)) + 1 for text in plain_answers(language))


def plain_answers(language: Language) -> Iterator[str]:
    """For each level of each attribute the answer that gives it in every slot, with all sensors."""
    sensors, attributes = len(language.sensors), len(language.attributes)
    for a, attribute in enumerate(language.attributes):
        for level in range(len(attribute.levels)):
            yield answer_text(
                language,
                asked=np.arange(attributes) == a,
                streams=np.ones(sensors, bool),
                perceive=np.full((sensors, attributes), level),
                compare=np.full(attributes, level),
                conclude=np.full(attributes, level),
            )


def memory_bytes(
    config: TrainingConfig, policy: ReleasedPolicy, data: Dataset, mesh: tuple[int, ...]
) -> dict[str, int]:
    """Bytes of training, counted from shapes: the first two on each device, or on the first one of each process.

    The step holds the decoder that SFT left; the released towers, from which other seeds and the baseline without touch
    start, are kept in addition.  SFT needs less than GRPO, since it samples nothing.  Contacts are encoded once for
    GRPO, once for the test.

    Raises:
      SizeError: as `grpo_shape`.
    """
    released, layout, streams = policy.checkpoint.config, policy.layout, len(policy.language.sensors)
    touch, view = layout.touch.size // streams, len(layout.view)
    shape = grpo_shape(config, policy, mesh)
    text = layout.ids.shape[1] - streams * touch - view
    prompt = PromptShape(streams=streams, stream_tokens=touch, view_tokens=view, text_tokens=text)
    step = abstract_grpo(released, prompt, shape, falling_adamw(1.0, 1.0, 1, 1.0), lora=config.grpo_lora)
    lines = grpo_bytes(shape, step.state, step.batch, step.frozen, step.base)
    contacts = len(data.parts["grpo"]) + len(data.parts["test"])
    of_contact = released.decoder.hidden_size * (4 * streams * touch + shape.number * view)
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
    marks = {path.name: file_fingerprint(path) for path in sorted(source.iterdir()) if path.is_file()}
    if not context.done("weights"):
        context.save_stage("weights", marks)
    began = context.load_stage("weights")
    changed = sorted(name for name in {*began, *marks} if began.get(name) != marks.get(name))
    if changed:
        raise WeightsError(
            f"{source} is not what this run began with: {', '.join(changed)} changed; put it back, or pass --fresh"
        )


def file_fingerprint(path: Path) -> list[int]:
    """Size of a file and the CRC-32 of its first and of its last mebibyte: shards of gigabytes are not read twice."""
    size, ends = path.stat().st_size, []
    with path.open("rb") as file:
        for start in (0, max(0, size - 2**20)):
            file.seek(start)
            ends.append(zlib.crc32(file.read(2**20)))
    return [size, *ends]


def write_policy(
    directory: Path, source: Path, params: Params, progress: ReportBytes = lambda done_bytes, all_bytes: None
) -> None:
    """Publish a policy in one move, so that `directory` is never half written; one that exists is replaced.

    `source` is the released folder that the policy started from; adapters are merged in `params`.
    """
    unfinished = directory.with_name(f"{directory.name}.unfinished")
    for folder in (unfinished, directory):
        shutil.rmtree(folder, ignore_errors=True)
    unfinished.mkdir(parents=True)
    for path in sorted(source.iterdir()):
        if path.is_file() and path.suffix in COPIED and path.name != INDEX:
            shutil.copy(path, unfinished)
    released = {"vision": params["vision"]["tower"], "decoder": params["decoder"]}
    save_params(unfinished / SINGLE, released, read_config(source), progress)
    buffer = io.BytesIO()
    added = {name: x for name, x in params.items() if name not in released}
    np.savez(buffer, allow_pickle=False, **traverse_util.flatten_dict(added, sep="/"))
    write_bytes(unfinished / TOUCH_FILE, buffer.getvalue())
    unfinished.rename(directory)


def read_policy(
    directory: Path, dtype: jnp.dtype | type, progress: ReportBytes = lambda done_bytes, all_bytes: None
) -> Params:
    """The parameters that `write_policy` wrote, those of the released towers as `dtype`.

    Raises:
      FileNotFoundError, ValueError: as `read_config` and `load_params`, or no tactile encoder.
    """
    if not (directory / TOUCH_FILE).is_file():
        raise FileNotFoundError(
            f"{directory} holds no {TOUCH_FILE}: must be a folder that `touch_r1` wrote; correct it"
        )
    released = load_params(directory, read_config(directory), dtype, progress=progress)
    arrays = load_arrays(directory / TOUCH_FILE)
    touch = traverse_util.unflatten_dict({name: jnp.asarray(x) for name, x in arrays.items()}, sep="/")
    return {**touch, "vision": {"tower": released["vision"]}, "decoder": released["decoder"]}


def zero_shot(trained: TrainedPolicy) -> Evaluation:
    """The released model before any training: it sees the object's picture and no touch, which it never learned to
    read; the system prompt describes the form of an answer."""
    policy, data = trained.policy, trained.data
    params = untrained(policy, data, trained.seed)
    return trained.ask(params, encode_rows(policy, params, data, data.parts["test"], trained.context, blind=True))


def written(source: Path, trained: TrainedPolicy) -> Evaluation:
    """The policy written to `weights/SEED` of the run, read from there, and evaluated again with all streams."""
    policy, data, context = trained.policy, trained.data, trained.context
    folder = context.directory / "weights" / str(trained.seed)
    with context.progress_callback("writing weights, MB") as report:
        context.processes.write_once(lambda: write_policy(folder, source, trained.params, in_megabytes(report)))
    with context.progress_callback("reading weights, MB") as report:
        params = read_policy(folder, policy.fns.cache_dtype, in_megabytes(report))
    return trained.ask(params, encode_rows(policy, params, data, data.parts["test"], context), alone=False)


def merged_shares(arm: str, seeds: int, context: Context) -> dict[str, float]:
    """Stage of training → share of its adapters that merging kept, the least of all seeds."""
    stages = {"sft": SFT, f"decoder/{SFT}": f"{SFT}, decoder", f"decoder/{CONTINUED}": CONTINUED}
    stages |= {f"grpo/{arm}": arm, "blind": BLIND}
    shares = lambda stage: [context.load_stage(f"{KEPT}/{stage}/{seed}") for seed in range(seeds)]
    return {name: min(shares(stage)) for stage, name in stages.items() if context.done(f"{KEPT}/{stage}/0")}


def merged_table(kept: Mapping[str, float]) -> Table:
    """The share of each policy."""
    return named_table(
        "Share of the adapters that merging keeps",
        [{"policy": name, "kept": 100 * share} for name, share in kept.items()],
        units={"kept": "%"},
        formats={"kept": ".1f"},
        note="Projection of the change of the weights, rounded to their type, on the adapters' change; the least "
        "of all seeds.",
    )
