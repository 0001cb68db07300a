"""Settings that change bits are recorded, compared when a run continues, or refused."""

import os
import subprocess
import sys

import jax
import pytest

from experiments.core import numerics
from experiments.core.artifacts import read_json
from experiments.core.errors import ConfigurationError
from experiments.core.runner import main
from touchr1_jax.training.compilation import FLAGS

FAKES = "tests.experiments.fakes"


@pytest.mark.parametrize(
    ("flags", "kept"),
    [
        ("--xla_cpu_enable_fast_math=true --xla_cpu_max_isa=SSE4_2", (0, 1)),
        ("--xla_cpu_multi_thread_eigen=false --xla_backend_optimization_level=0", (1, 0)),
        ("--xla_force_host_platform_device_count=8 --xla_dump_to=/tmp/x", ()),
        ("--xla_cpu_enable_fast_math=true --xla_cpu_enable_fast_math=false", (0, 1)),  # the last one counts
        ("--xla_disable_hlo_passes=b --xla_cpu_max_isa=AVX --xla_disable_hlo_passes=a", (1, 0, 2)),  # both count
    ],
)
def test_flags_that_change_results_are_settings(monkeypatch, flags, kept):
    monkeypatch.setenv(FLAGS, "")
    before = numerics.settings()
    monkeypatch.setenv(FLAGS, flags)
    assert numerics.settings()[FLAGS] == [flags.split()[i] for i in kept]
    assert bool(numerics.changed(before, numerics.settings())) == bool(kept)
    numerics.require_same(None, "a run of an earlier version")


def test_flags_in_a_file_and_variables_of_accelerators_are_settings(monkeypatch, tmp_path):
    monkeypatch.setenv(FLAGS, str(tmp_path / "flags"))
    (tmp_path / "flags").write_text("--xla_cpu_enable_fast_math=true\n--xla_dump_to=/tmp/x\n")
    assert numerics.settings()[FLAGS] == ["--xla_cpu_enable_fast_math=true"]
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", "1")
    before = numerics.settings()
    for name, value in (
        ("NVIDIA_TF32_OVERRIDE", "1"),
        ("NPY_DISABLE_CPU_FEATURES", "AVX512_SKX"),
        ("NPY_ENABLE_CPU_FEATURES", "AVX2"),
        ("ONEDNN_MAX_CPU_ISA", "AVX2"),
        ("DNNL_DEFAULT_FPMATH_MODE", "BF16"),
        ("GLIBC_TUNABLES", "glibc.cpu.hwcaps=-AVX2,-FMA"),
        ("OPENCV_CPU_DISABLE", "AVX2"),
        ("OPENCV_IPP", "disabled"),
        ("OPENCV_FFMPEG_CAPTURE_OPTIONS", "skip_frame;nokey"),
        ("OPENCV_FFMPEG_DECODE_ATTEMPTS", "1"),
        ("OPENCV_FFMPEG_READ_ATTEMPTS", "1"),
        ("OPENCV_VIDEOIO_PRIORITY_CV_MJPEG", "9999"),
        ("OPENCV_VIDEOIO_PRIORITY_FFMPEG", "0"),
        ("OPENCV_VIDEOIO_PRIORITY_LIST", "CV_MJPEG,FFMPEG"),
        ("OPENBLAS_CORETYPE", "Haswell"),
        ("OPENBLAS_NUM_THREADS", "2"),
    ):
        with monkeypatch.context() as one:
            one.setenv(name, value)
            assert numerics.settings() == {**before, name: value}
    monkeypatch.setenv("GLIBC_TUNABLES", "glibc.malloc.arena_max=1")
    monkeypatch.setenv("OPENCV_VIDEOIO_PRIORITY_FFMPEG", "")
    assert numerics.settings() == before


@pytest.mark.skipif(len(os.sched_getaffinity(0)) < 2, reason="one core gives one thread")
def test_cores_change_no_bit_of_linear_algebra():
    source = (
        "import os, sys; os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[: int(sys.argv[1])]);"
        "import experiments.__main__, numpy as np; x = np.random.default_rng(0).normal(size=(600, 200));"
        "print(float(np.linalg.solve(x.T @ x + np.eye(200), x.T[:, :3]).sum()).hex())"
    )
    env = {name: value for name, value in os.environ.items() if name != "OPENBLAS_NUM_THREADS"}
    run = lambda cores: subprocess.run([sys.executable, "-c", source, cores], env=env, check=True, capture_output=True)
    assert run("1").stdout == run("2").stdout


@pytest.mark.long
@pytest.mark.parametrize(
    ("name", "value"),
    [("jax_default_prng_impl", "rbg"), ("jax_debug_nans", True), ("eager_constant_folding", True)],
)
def test_a_run_is_not_continued_under_other_settings(tmp_path, capsys, name, value):
    order = ["coin", "--runs-dir", str(tmp_path), "--cache-dir", str(tmp_path / "data"), "--scale", "smoke"]
    assert main(order, package=FAKES) == 0
    (tmp_path / "coin" / "latest" / "results.json").unlink()
    assert read_json(tmp_path / "coin" / "latest" / "config.json")["settings"] == numerics.settings()
    before = jax.config.values[name]
    jax.config.update(name, value)
    try:
        assert main(order, package=FAKES) == 1
    finally:
        jax.config.update(name, before)
    assert f"{name} was" in capsys.readouterr().err
    assert main(order, package=FAKES) == 0


@pytest.mark.parametrize(("name", "value"), [(name, value) for name, (value, _) in numerics.UNSUPPORTED.items()])
def test_settings_that_no_experiment_runs_with_are_refused(tmp_path, capsys, name, value):
    """Arrays of different rank ended a run in a traceback, strict types in an error about sizes."""
    before = jax.config.values[name]
    jax.config.update(name, value)
    try:
        with pytest.raises(ConfigurationError, match=f"unset {name.upper()}"):
            numerics.require_supported()
        assert main(["coin", "--runs-dir", str(tmp_path)], package=FAKES) == 1
    finally:
        jax.config.update(name, before)
    assert f"{name} is {value}: must keep its default" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.long
def test_a_variable_that_jax_cannot_read_is_named():
    order, env = [sys.executable, "-m", "experiments", "ablation_ordinal"], os.environ | {"JAX_ENABLE_X64": "maybe"}
    done = subprocess.run(order, env=env, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert "'maybe' for environment 'JAX_ENABLE_X64': a variable" in done.stderr
    assert "Traceback" not in done.stderr


def test_charts_need_no_window_whatever_the_environment_names():
    """matplotlib refuses to be imported by the name of a window that is gone: a run would end at its first chart."""
    order = [sys.executable, "-c", "import experiments.__main__, matplotlib as mpl; assert mpl.get_backend() == 'svg'"]
    subprocess.run(order, env=os.environ | {"MPLBACKEND": "Qt4Agg"}, check=True)


@pytest.mark.long
@pytest.mark.skipif(
    not hasattr(os, "sched_setaffinity") or numerics.cores() == 1, reason="a process cannot choose one core of two"
)
def test_cores_change_the_bits_of_large_sums_and_are_counted():
    source = (
        "import experiments.__main__, os, sys;"
        "os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[: int(sys.argv[1])]);"
        "import jax, jax.numpy as jnp, numpy as np; from experiments.core import numerics;"
        "x = jnp.asarray(np.random.default_rng(0).normal(size=100_000), jnp.float32);"
        "print(float(jax.jit(jnp.sum)(x)).hex(), numerics.machine()['cores'])"
    )
    env = {name: value for name, value in os.environ.items() if name != "NPROC"}
    run = lambda cores: subprocess.run(
        [sys.executable, "-c", source, cores], env=env, check=True, capture_output=True, text=True
    )
    (one, counted), (two, of_two) = (run(cores).stdout.split() for cores in "12")
    assert (counted, of_two) == ("1", "2")
    assert one != two  # where this fails, XLA has changed: cores need not count any longer
