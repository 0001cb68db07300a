"""Compiled programs are written below the folder, found again, and only inside the block."""

import os
import resource
import types
import zlib
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax._src import compilation_cache as jax_cache
from jax.experimental.compilation_cache import compilation_cache

from touchr1_jax.training.compilation import (
    FLAGS,
    OLDER_LOOPS,
    committed,
    compilations_kept,
    compiled_quickly,
    drop_programs,
    processor,
    remove_half_written,
    return_memory,
)
from touchr1_jax.training.loop import SingleDevice


@pytest.fixture
def keeping():
    """No cache of the session's own."""
    session = jax.config.values["jax_compilation_cache_dir"]
    jax.config.update("jax_compilation_cache_dir", None)
    compilation_cache.reset_cache()
    yield
    jax.config.update("jax_compilation_cache_dir", session)
    compilation_cache.reset_cache()


def resident_mb():
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize() / 2**20


def entries(folder):
    return sorted(p.relative_to(folder) for p in folder.rglob("*-cache"))


def compiled(x: float) -> float:
    """A program that is compiled anew each time it is asked for."""
    return float(jax.jit(lambda y: jnp.sin(y) * 3.25 + 1)(x))


@pytest.mark.long
def test_a_program_is_kept_and_found_again(keeping, tmp_path):
    """Not in the folder of earlier versions, where zstandard may have compressed an entry of the same key."""
    with compilations_kept(tmp_path, least_s=0.0):
        first = compiled(0.5)
        kept = entries(tmp_path)
        jax.clear_caches()
        assert compiled(0.5) == first
    assert kept
    assert {path.parts[0] for path in kept} == {f"{processor()}-zlib"}
    assert entries(tmp_path) == kept


def test_kept_programs_have_a_checksum_where_zstandard_is_installed(keeping, tmp_path, monkeypatch):
    other = types.SimpleNamespace(ZstdCompressor=lambda: pytest.fail("its frames have no checksum"))
    monkeypatch.setattr(jax_cache, "zstandard", other)
    with compilations_kept(tmp_path):
        assert zlib.decompress(jax_cache.compress_executable(b"program")) == b"program"
    assert jax_cache.zstandard is other


def test_nothing_is_kept_outside_the_block(keeping, tmp_path):
    with compilations_kept(tmp_path, least_s=0.0):
        pass
    compiled(0.7)
    assert jax.config.values["jax_compilation_cache_dir"] is None
    assert not entries(tmp_path)


def test_a_half_written_entry_does_not_stop_the_keeping(keeping, tmp_path):
    """A killed process left the program without the time of its use: JAX would warn and never write again."""
    with compilations_kept(tmp_path, least_s=0.0):
        compiled(0.5)
    (folder,) = tmp_path.iterdir()
    (whole,) = folder.glob("*-cache")
    young, old = folder / "jit_young-cache", folder / "jit_old-cache"
    for path in (young, old):
        path.write_bytes(b"half")
    os.utime(old, (0, 0))
    assert remove_half_written(folder) == 1
    assert entries(tmp_path) == sorted(p.relative_to(tmp_path) for p in (whole, young))


def test_freed_memory_goes_back_to_the_system():
    """A hundred thousand small pieces that stand before one that stays."""
    pieces = [bytearray(2000) for _ in range(100_000)]
    last = bytearray(2000)
    full = resident_mb()
    del pieces
    return_memory()
    assert resident_mb() < full - 100
    assert len(last) == 2000


def test_a_cache_of_the_users_own_stays(keeping, tmp_path):
    mine, other = tmp_path / "mine", tmp_path / "other"
    with compilations_kept(mine, least_s=0.0), compilations_kept(other, least_s=0.0):
        compiled(0.9)
    assert entries(mine)
    assert not other.exists()


SETTING = "jax_disable_most_optimizations"


@pytest.fixture
def well(monkeypatch):
    """A process that compiles well, as one outside of the tests does."""
    monkeypatch.delenv(FLAGS, raising=False)
    before = jax.config.values[SETTING]
    jax.config.update(SETTING, False)
    yield
    jax.config.update(SETTING, before)


def test_quick_compilation_ends_with_its_block_even_by_an_error(well):
    seen = {}

    def fail():
        seen.update(setting=jax.config.values[SETTING], flags=os.environ.get(FLAGS, ""))
        raise KeyError

    with pytest.raises(KeyError), compiled_quickly():
        fail()
    assert seen == {"setting": True, "flags": OLDER_LOOPS}
    assert not jax.config.values[SETTING]
    assert FLAGS not in os.environ


def test_flags_of_the_user_stay(well, monkeypatch):
    monkeypatch.setenv(FLAGS, "--xla_force_host_platform_device_count=2")
    with compiled_quickly(), compiled_quickly():
        assert os.environ[FLAGS].split() == ["--xla_force_host_platform_device_count=2", *OLDER_LOOPS.split()]
    assert os.environ[FLAGS] == "--xla_force_host_platform_device_count=2"


def test_flags_of_a_file_are_given_with_the_older_loops(well, monkeypatch, tmp_path):
    """XLA takes a variable without a dash as the name of a file, and ends the process where there is none."""
    (tmp_path / "flags of ours").write_text("--xla_dump_hlo_as_text=false\n--xla_force_host_platform_device_count=2\n")
    monkeypatch.setenv(FLAGS, str(tmp_path / "flags of ours"))
    with compiled_quickly(), compiled_quickly():
        assert os.environ[FLAGS].split()[:2] == [
            "--xla_dump_hlo_as_text=false",
            "--xla_force_host_platform_device_count=2",
        ]
        assert os.environ[FLAGS].split()[2:] == OLDER_LOOPS.split()
    assert os.environ[FLAGS] == str(tmp_path / "flags of ours")


def test_a_step_compiles_once_whatever_part_of_its_state_came_from_a_checkpoint():
    """Arrays of a checkpoint are committed to their device, fresh ones are not; results of a mixture are."""
    of_checkpoint = jax.device_put(jnp.ones(3), jax.devices()[0])
    state = {"params": of_checkpoint, "step": jnp.zeros(()), "key": jax.random.key(0)}
    assert [x.committed for x in state.values()] == [True, False, False]

    def compiled(start) -> int:
        step = jax.jit(lambda s, b: ({**s, "step": s["step"] + b}, s["step"]))
        for _ in range(3):
            start, _ = step(start, np.float32(1))
        return step._cache_size()

    assert compiled(state) == 2
    assert compiled(committed(state)) == 1
    assert compiled(SingleDevice().shard(None, state, None, 1)[1]) == 1
    assert committed(state)["params"] is of_checkpoint


@pytest.mark.long
@pytest.mark.skipif(not Path("/proc/self/maps").exists(), reason="only Linux counts mappings")
def test_programs_are_dropped_and_compiled_again():
    mappings = lambda: len(Path("/proc/self/maps").read_text().splitlines())
    programs = [jax.jit(lambda x, k=k: jnp.tanh(x @ x + k) @ x) for k in range(8)]
    of_all = lambda: [float(program(jnp.eye(3)).sum()) for program in programs]
    before, filled = of_all(), mappings()
    assert not drop_programs(share=1.0)
    assert drop_programs(share=0.0)
    assert mappings() < filled - len(programs)
    assert of_all() == before
