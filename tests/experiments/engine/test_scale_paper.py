"""The recipe for sixteen devices, shrunk to four: counted, compiled in processes of their own, predicted."""

import pytest

from experiments.core.artifacts import read_json
from experiments.engine import scale_compiling as compiling
from experiments.engine import scale_paper
from experiments.engine.scale_compiling import Setup
from experiments.engine.scale_paper import DEFAULT, SMOKE, ScaleConfig, parts
from tests.experiments.shrunk import run_shrunk
from touchr1_jax.distributed.memory import counted_peak
from touchr1_jax.distributed.mesh import MeshConfig
from touchr1_jax.models.lora import LoraConfig


def test_the_paper_fits_by_count_and_adapters_need_less():
    first, adapters, *_ = DEFAULT.setups
    whole, lean = (DEFAULT.training.counted(setup) for setup in (first, adapters))
    assert DEFAULT.training.prompt.tokens == 4 * 1024 + 256 + 128
    assert whole["parameters"] == pytest.approx(4 * 7.616e9 / 16, rel=1e-3)
    assert counted_peak(lean) + 2.5 * whole["parameters"] < counted_peak(whole) < DEFAULT.machine.memory_bytes / 2


def test_more_compiled_setups_than_there_are_is_refused():
    with pytest.raises(ValueError, match="compiled is 6: must be 0 … 5"):
        ScaleConfig(compiled=6)


def test_setups_have_names():
    mesh = MeshConfig(fsdp=8, tensor=2)
    assert Setup(mesh=mesh).name == "fsdp 8 × tensor 2"
    assert Setup(mesh=mesh, lora=LoraConfig(rank=4)).name == "fsdp 8 × tensor 2, LoRA 4"


def test_bars_hold_what_is_counted():
    lines = {setup: SMOKE.training.counted(setup) for setup in SMOKE.setups}
    totals = [sum(sizes) for sizes in zip(*parts(lines).values(), strict=True)]
    assert totals == pytest.approx([counted_peak(by) / 1e9 for by in lines.values()])


def test_without_nvidias_compiler_the_error_names_the_packages_to_install():
    with pytest.raises(ModuleNotFoundError, match=r"compiler is h200, but there is no nvidia\.absent: install"):
        compiling.toolkit("nvidia.absent")


@pytest.mark.slow
def test_the_experiment_shrunk(tmp_path):
    """Full training and adapters, compiled for four simulated devices; arguments are exactly those counted."""
    directory = run_shrunk(scale_paper, SMOKE, tmp_path)
    results = read_json(directory / "results.json")
    found = {r["name"]: r for r in results["requirements"]}
    assert len(found) == 3 + 2 * 2
    assert all(r["met"] for r in found.values())
    assert found["fsdp 2 × tensor 2: arguments off the count"]["measured"] < 1e-3
    assert (directory / "plots/memory.svg").exists()
