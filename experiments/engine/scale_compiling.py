"""Shapes of the published training and its layouts over devices, compiled without the devices.

Touch-R1 (arXiv 2605.27154) trains Qwen2.5-VL 7B on 16 H200 with 8 frames of 448² pixels from four sensors and groups of
eight.  A frame of 448² has 16 · 16 tokens of Qwen2.5-VL, which reads two frames at a time: 4 · 256 tokens per sensor,
and 256 for the view.  Lengths of question and answer are not published; here they are 128 and 512.

With `cpu`, XLA simulates the devices; it computes products of bfloat16 in float32, so its temporary memory is an upper
bound.  With `h200`, XLA's GPU compiler gets a description of the machine and states the memory that a step needs there;
this needs NVIDIA's compiler and JAX's CUDA plugin but no GPU.
"""

import contextlib
import dataclasses
import importlib.util
import os
from collections.abc import Iterator, Mapping
from typing import Any, Literal

import jax
import jax.numpy as jnp
import optax
from jax.experimental import topologies

from experiments.engine.processes import in_own_process
from touchr1_jax.distributed.abstract import AbstractStep, PromptShape, abstract_grpo, compile_grpo
from touchr1_jax.distributed.memory import Compiled, GRPOShape, grpo_bytes
from touchr1_jax.distributed.mesh import MeshConfig
from touchr1_jax.models.lora import LoraConfig
from touchr1_jax.models.qwen.config import QwenConfig
from touchr1_jax.rl.config import GRPOConfig, Paper
from touchr1_jax.types import Parsed, Target

Compiler = Literal["cpu", "h200"]

PAPER_PROMPT = PromptShape(streams=4, stream_tokens=1024, view_tokens=256, text_tokens=128)
TINY_PROMPT = PromptShape(streams=2, stream_tokens=4, view_tokens=4, text_tokens=8)

OPTIMIZER = optax.adamw(1e-6)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Setup:
    """A layout of the training: a mesh, and adapters on a frozen base if any."""

    mesh: MeshConfig
    lora: LoraConfig | None = None

    @property
    def name(self) -> str:
        """Such as `fsdp 8 × tensor 2`."""
        axes = {"data": self.mesh.data, "fsdp": self.mesh.fsdp, "tensor": self.mesh.tensor}
        mesh = " × ".join(f"{axis} {size}" for axis, size in axes.items() if size > 1)
        return f"{mesh or 'one device'}{'' if self.lora is None else f', LoRA {self.lora.rank}'}"


@dataclasses.dataclass(frozen=True, kw_only=True)
class Training:
    """A model, its prompts, and the sizes of a step."""

    model: QwenConfig
    prompt: PromptShape
    group: int
    length: int
    prompts: int

    def shape(self, setup: Setup) -> GRPOShape:
        """The sizes that the memory of a step depends on."""
        micro_prompts = min(self.prompts, setup.mesh.data * setup.mesh.fsdp)  # one prompt a device
        sizes: dict[str, Any] = {"prompts": self.prompts, "group": self.group, "length": self.length}
        grpo = GRPOConfig(**sizes, micro_prompts=micro_prompts, remat=True, bfloat16=True, algorithm=Paper())
        return GRPOShape(decoder=self.model.decoder, grpo=grpo, mesh=setup.mesh, prompt_tokens=self.prompt.tokens)

    def step(self, setup: Setup) -> AbstractStep:
        """The arguments of the step as shapes."""
        return abstract_grpo(self.model, self.prompt, self.shape(setup), OPTIMIZER, lora=setup.lora)

    def counted(self, setup: Setup) -> dict[str, int]:
        """Bytes on each device, line by line."""
        step = self.step(setup)
        return grpo_bytes(self.shape(setup), step.state, step.batch, step.frozen, step.base)


def score_of(streams: int):
    """A reward of the right form for a step that is compiled and never run."""

    def score(tokens: jax.Array, target: Target) -> tuple[jax.Array, dict[str, jax.Array], Parsed]:
        level = jnp.where(target.asked, tokens[0] % 3, -1)
        right = jnp.mean(tokens % 3 == jnp.max(target.label))
        parsed = Parsed(
            perceive=jnp.tile(level, (streams, 1)),
            compare=level,
            conclude=level,
            formatted=tokens[0] > 0,
            truncated=tokens[-1] > 0,
            length=jnp.sum(tokens > 0),
        )
        return right, {"right": right}, parsed

    return score


H200 = """
gpu_device_info {
  threads_per_block_limit: 1024
  threads_per_warp: 32
  shared_memory_per_block: 49152
  shared_memory_per_core: 233472
  shared_memory_per_block_optin: 232448
  threads_per_core_limit: 2048
  core_count: 132
  fpus_per_core: 128
  block_dim_limit_x: 2147483647
  block_dim_limit_y: 65535
  block_dim_limit_z: 65535
  memory_bandwidth: 4800000000000
  l2_cache_size: 52428800
  clock_rate_ghz: 1.98
  device_memory_size: 151397597184
  cuda_compute_capability { major: 9 }
  registers_per_core_limit: 65536
  registers_per_block_limit: 65536
}
platform_name: "CUDA"
dnn_version_info { major: 9 minor: 10 patch: 0 }
runtime_version { major: 12 minor: 8 patch: 0 }
device_description_str: "NVIDIA H200 141GB HBM3e"
"""
"""The device's description for XLA (`stream_executor.GpuTargetConfigProto`)."""


def compile_in_process(training: Training, setup: Setup, compiler: Compiler) -> Compiled:
    """Compile in a fresh process.

    Raises:
      ModuleNotFoundError: for `h200`, without JAX's plugin for CUDA.
    """
    flags = f"--xla_force_host_platform_device_count={setup.mesh.devices}"
    if compiler == "h200":  # Triton's products would be tuned on the device, and XLA's guesses without it can fail
        flags = f"--xla_gpu_cuda_data_dir={toolkit()} --xla_gpu_enable_triton_gemm=false"
    environment = {"XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu"}
    with _environment(environment):
        return in_own_process(compile_here, training, setup, compiler)


def compile_here(training: Training, setup: Setup, compiler: Compiler) -> Compiled:
    """Compile in this process, whose environment must fit the compiler."""
    score = score_of(training.prompt.streams)
    devices = jax.devices() if compiler == "cpu" else h200s(setup.mesh.devices)
    return compile_grpo(training.step(setup), training.shape(setup), score, OPTIMIZER, devices)


def h200s(count: int, per_machine: int = 8) -> list[jax.Device]:
    """Devices of as many machines as it takes, to compile for."""
    machines = -(-count // per_machine)
    topology = f"1x{machines}x{count // machines}"
    return list(topologies.get_topology_desc(platform="cuda", target_config=H200, topology=topology).devices)


def toolkit(package: str = "nvidia.cuda_nvcc") -> str:
    """Folder of NVIDIA's compiler.

    Raises:
      ModuleNotFoundError: it is not installed.
    """
    try:
        found = importlib.util.find_spec(package)
    except ModuleNotFoundError:
        found = None
    if found is None or not found.submodule_search_locations:
        raise ModuleNotFoundError(
            f"compiler is h200, but there is no {package}: install jax-cuda12-plugin and jax-cuda12-pjrt of jax "
            f"{jax.__version__}, without their dependencies, and nvidia-cuda-nvcc-cu12; or choose --compiler cpu"
        )
    return str(found.submodule_search_locations[0])


@contextlib.contextmanager
def _environment(values: Mapping[str, str]) -> Iterator[None]:
    """These variables for the processes that are started inside."""
    before = dict(os.environ)
    os.environ.update(values)
    try:
        yield
    finally:
        os.environ.clear()
        os.environ.update(before)
