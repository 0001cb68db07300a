"""Compile a step for devices that are not there, in a process that believes in them.

For `cpu` XLA simulates the devices; it computes products of bfloat16 in float32, so that its temporary memory is an
upper figure.  For `h200` XLA's GPU compiler gets a description of the machine, which needs NVIDIA's compiler and JAX's
plugin for CUDA but no GPU: what it reserves is what a step there takes.
"""

import contextlib
import importlib.util
import os
import time
from collections.abc import Iterator, Mapping
from typing import Literal, NamedTuple

import jax
from jax.experimental import topologies

from experiments.engine.paper_shapes import OPTIMIZER, Setup, Training, score_of
from experiments.engine.processes import in_own_process
from touchr1_jax.distributed.abstract import compile_grpo
from touchr1_jax.distributed.memory import Compiled

Compiler = Literal["cpu", "h200"]

OF_A_MACHINE = 8
"""H200s of one machine."""

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
"""What XLA must know of the device, in its own words (`stream_executor.GpuTargetConfigProto`)."""

TOOLKIT = "nvidia.cuda_nvcc"
"""Python package of NVIDIA's compiler."""


class Compilation(NamedTuple):
    """What the compiler reserves, and how long it took, seconds."""

    compiled: Compiled
    seconds: float


def compiled_alone(training: Training, setup: Setup, compiler: Compiler) -> Compilation:
    """Compile in a fresh process.

    Raises:
      ModuleNotFoundError: for `h200`, without JAX's plugin for CUDA.
    """
    flags = {"cpu": f"--xla_force_host_platform_device_count={setup.mesh.devices}"}
    if compiler == "h200":  # Triton's products would be tuned on the device, and XLA's guesses without it can fail
        flags["h200"] = f"--xla_gpu_cuda_data_dir={toolkit()} --xla_gpu_enable_triton_gemm=false"
    environment = {"XLA_FLAGS": flags[compiler], "JAX_PLATFORMS": "cpu"}
    with _environment(environment):
        return in_own_process(compile_here, training, setup, compiler)


def compile_here(training: Training, setup: Setup, compiler: Compiler) -> Compilation:
    """The same in this process, whose environment must be right."""
    began = time.perf_counter()
    score = score_of(training.prompt.streams)
    devices = jax.devices() if compiler == "cpu" else h200s(setup.mesh.devices)
    compiled = compile_grpo(training.step(setup), training.shape(setup), score, OPTIMIZER, devices)
    return Compilation(compiled, time.perf_counter() - began)


def h200s(count: int) -> list[jax.Device]:
    """Devices of as many machines as it takes, to compile for."""
    machines = -(-count // OF_A_MACHINE)
    topology = f"1x{machines}x{count // machines}"
    return list(topologies.get_topology_desc(platform="cuda", target_config=H200, topology=topology).devices)


def toolkit() -> str:
    """Folder of NVIDIA's compiler.

    Raises:
      ModuleNotFoundError: it is not installed.
    """
    try:
        found = importlib.util.find_spec(TOOLKIT)
    except ModuleNotFoundError:
        found = None
    if found is None or not found.submodule_search_locations:
        raise ModuleNotFoundError(
            f"compiler is h200, but there is no {TOOLKIT}: install jax-cuda12-plugin and jax-cuda12-pjrt of jax "
            f"{jax.__version__}, without their dependencies, and nvidia-cuda-nvcc-cu12; or choose --compiler cpu"
        )
    return str(found.submodule_search_locations[0])


@contextlib.contextmanager
def _environment(values: Mapping[str, str]) -> Iterator[None]:
    """These variables for the processes that are started inside."""
    before = {name: os.environ.get(name) for name in values}
    os.environ.update(values)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
