"""Settings that the bits of a result depend on besides configuration and code: JAX, XLA, NumPy, OpenCV, device, CPU.

XLA for CPUs adds up large arrays in as many parts as this process has cores, so that the number of cores counts too.
Other threads change no bit: `experiments.__main__` gives NumPy's linear algebra one, for more would add in another
order.  The number of devices does change bits; the cache of policies counts the mesh.
"""

import os
from collections.abc import Mapping
from typing import Any

import jax

from experiments.core.errors import ConfigurationError
from touchr1_jax.training.compilation import FLAGS, processor, xla_flags

SETTINGS = (
    "jax_default_matmul_precision",
    "jax_default_prng_impl",
    "jax_disable_most_optimizations",
    "jax_numpy_dtype_promotion",
    "jax_threefry_partitionable",
)
"""Settings of JAX that change results."""

UNSUPPORTED: Mapping[str, tuple[Any, str]] = {
    "jax_enable_x64": (True, "it makes 64-bit numbers of what this code stores in 32 bits"),
    **{f"jax_error_checking_behavior_{x}": ("raise", "its checks cannot be batched") for x in ("divide", "nan", "oob")},
    "jax_no_execution": (True, "nothing would be computed"),
    "jax_no_tracing": (True, "programs are made by tracing"),
    "jax_disable_jit": (True, "training steps give their buffers away, which only compiled programs can do"),
    "jax_numpy_rank_promotion": ("raise", "rewards and layers broadcast arrays of different rank"),
    "jax_numpy_dtype_promotion": ("strict", "rewards and layers mix integers with floating-point numbers"),
}
"""Settings of JAX, each with the value that no experiment runs with, and the reason."""

DEFAULTS: Mapping[str, Any] = {
    "eager_constant_folding": False,
    "jax_debug_nans": False,
    "jax_high_dynamic_range_gumbel": False,
    "jax_random_seed_offset": 0,
    "jax_softmax_custom_jvp": False,
    "jax_exec_time_optimization_effort": 0.0,
    "jax_optimization_level": "UNKNOWN",
}
"""Settings of JAX that change results or may, each with its default; they count where they differ from it."""

ENVIRONMENT: Mapping[str, str] = {
    **{f"{of}_{x}": "" for of in ("DNNL", "ONEDNN") for x in ("CPU_ISA_HINTS", "DEFAULT_FPMATH_MODE", "MAX_CPU_ISA")},
    "GLIBC_TUNABLES": "",
    "LIBTPU_INIT_ARGS": "",
    "NPY_DISABLE_CPU_FEATURES": "",
    "NPY_ENABLE_CPU_FEATURES": "",
    "NVIDIA_TF32_OVERRIDE": "",
    "OPENBLAS_CORETYPE": "",
    "OPENBLAS_NUM_THREADS": "1",
    "OPENCV_CPU_DISABLE": "",
    "OPENCV_FFMPEG_CAPTURE_OPTIONS": "",
    "OPENCV_FFMPEG_DECODE_ATTEMPTS": "",
    "OPENCV_FFMPEG_READ_ATTEMPTS": "",
    "OPENCV_IPP": "",
}
"""Environment variables that accelerators, XLA's oneDNN, NumPy, OpenCV and the C library read, with defaults; they
count where they differ."""

DECODERS = "OPENCV_VIDEOIO_PRIORITY_"
"""Variables that begin so count too: each gives a decoder of OpenCV's its rank, or lists them."""

HARMLESS = ("--xla_force_host_platform_device_count", "--xla_dump", "--xla_hlo_profile")
"""Flags of XLA that change no result."""


def require_supported() -> None:
    """Refuse settings that no experiment runs with."""
    for name, (value, why) in UNSUPPORTED.items():
        if jax.config.values.get(name) == value:
            raise ConfigurationError(f"{name} is {value}: must keep its default, since {why}; unset {name.upper()}")


def settings() -> dict[str, Any]:
    """The settings of JAX, flags of XLA and variables of the environment that change results."""
    counted = (flag for flag in xla_flags().split() if not flag.startswith(HARMLESS))
    flags = sorted(counted, key=lambda flag: f"{flag.partition('=')[0]}=")  # of one name in their order, as XLA does
    found = {name: jax.config.values[name] for name in SETTINGS} | {FLAGS: flags}
    now = {name: jax.config.values.get(name, default) for name, default in DEFAULTS.items()}
    found |= {name: value for name, value in now.items() if value != DEFAULTS[name]}
    return found | environment()


def environment() -> dict[str, str]:
    """Variables of `ENVIRONMENT` and `DECODERS` not at their defaults; of the C library's, what chooses its kernels."""
    usual = {**ENVIRONMENT, **{name: "" for name in sorted(os.environ) if name.startswith(DECODERS)}}
    found = {name: os.environ[name] for name, value in usual.items() if os.environ.get(name, value) != value}
    return {name: value for name, value in found.items() if name != "GLIBC_TUNABLES" or "glibc.cpu." in value}


def require_same(before: Mapping[str, Any] | None, where: object) -> None:
    """Refuse to continue a run in `where` under other settings than it began with; older runs recorded none."""
    found = () if before is None else changed({**ENVIRONMENT, **before}, {**ENVIRONMENT, **settings()})
    if found:
        raise ConfigurationError(
            f"{where} cannot be resumed with bit-identical results: {'; '.join(found)}; set them as they were, or "
            "start a new run with --fresh"
        )


def machine() -> dict[str, str]:
    """The kinds of device and of processor; where the processor is the device, its cores as XLA counts them."""
    device = jax.default_backend()
    counted = {"cores": os.environ.get("NPROC") or str(cores())} if device == "cpu" else {}
    return {"device": device, "processor": processor()} | counted


def cores() -> int:
    """Number of cores that this process may use; XLA counts them, unless the variable NPROC states a number."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def changed(before: Mapping[str, Any], now: Mapping[str, Any]) -> tuple[str, ...]:
    """Differences between two mappings, each as "NAME was A and is B"."""
    names = sorted(before.keys() | now.keys())
    return tuple(f"{n} was {before.get(n)!r} and is {now.get(n)!r}" for n in names if before.get(n) != now.get(n))
