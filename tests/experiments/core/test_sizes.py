"""Numbers of a configuration that no scale has."""

import dataclasses

import pytest

from experiments.core.sizes import require_sizes
from experiments.engine import speed_grpo, step_weights
from experiments.paper import touch_r1
from touchr1_jax.validation import at_least


@dataclasses.dataclass(frozen=True, kw_only=True)
class Training:
    steps: int = 100
    rate: float = 0.1
    forces: tuple[float, ...] = (1.0, 5.0)
    shift: float = 0.0
    grids: tuple[int, ...] = (24, 48)
    first_seed: int = 3
    seeds: tuple[int, ...] = (1, 2)
    shares: tuple[float, ...] = (0.4, 0.3, 0.3)
    size: tuple[int, int] = (24, 32)
    extra: tuple[str, ...] = ("a",)
    kept: bool = True


@dataclasses.dataclass(frozen=True, kw_only=True)
class Checked:
    steps: int = 10
    counts: tuple[int, ...] = (1, 2)
    of_counts: tuple[int, ...] = (5, 6)
    options: tuple[str, ...] = ("a", "b")

    def __post_init__(self) -> None:
        at_least(self, 0, "steps")
        if len(self.counts) != len(self.of_counts) or len({*self.options}) < len(self.options):
            raise ValueError("must be of one length, and options different")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Config:
    training: Training = Training()
    checked: Checked = Checked()
    moments: int = 4
    name: str = "a"
    most: int | None = None


SCALES = (Config(), Config(training=Training(shift=-1.0, extra=()), moments=0))
"""One of them moves backwards, and has no moments and nothing extra."""


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"steps": -1}, "training.steps is -1: must be at least 0; raise it"),
        ({"steps": 0}, "training.steps is 0: must be at least 1; raise it"),
        ({"rate": -0.1}, "training.rate is -0.1: must be at least 0; raise it"),
        ({"forces": (1.0, -5.0)}, r"training.forces is \(1.0, -5.0\): must be at least 0; raise it"),
        ({"steps": 10**21}, "training.steps is 1000000000000000000000: must be at most 2147483647; lower it"),
        ({"rate": 1e300}, r"training.rate is 1e\+300: must be at most 1e\+15; lower it"),
        ({"shift": -1e16}, r"training.shift is -1e\+16: must be at most 1e\+15; lower it"),
        ({"forces": (1.0, 1e-300)}, r"training.forces is .*: must be 0 or at least 1e-30; raise it"),
        ({"grids": (24, 0)}, r"training.grids is \(24, 0\): must be at least 1; raise it"),
        ({"first_seed": -1}, "training.first_seed is -1: must be at least 0; raise it"),
        ({"extra": ("b", "b")}, r"training.extra is \('b', 'b'\): must hold each once; drop what is there twice"),
        ({"grids": ()}, r"training.grids is \(\): must not be empty; name at least one"),
        ({"grids": (24, 48, 24)}, r"training.grids is \(24, 48, 24\): must hold each once; drop what is there twice"),
    ],
)
def test_what_no_scale_has_is_refused(change, said):
    with pytest.raises(ValueError, match=said):
        require_sizes(Config(training=Training(**change)), SCALES)


def test_what_a_scale_has_or_a_class_checks_itself_is_taken():
    training = Training(shift=-3.0, first_seed=0, seeds=(0,), rate=0.0, forces=(0.0,), kept=False)
    require_sizes(Config(training=training, checked=Checked(steps=0), moments=0, most=-1), SCALES)
    lists = Training(shares=(0.5, 0.5), size=(32, 32), extra=())
    require_sizes(Config(training=lists, checked=Checked(counts=(1, 2), of_counts=(5, 5), options=())), SCALES)
    many = Config(moments=10**9)
    require_sizes(dataclasses.replace(many, moments=10**12), (many,))


@pytest.mark.parametrize(
    ("module", "change"),
    [(step_weights, {"shallow": 0}), (speed_grpo, {"words": 0}), (touch_r1, {"teaching_steps": 0})],
)
def test_a_0_that_is_documented_is_taken(module, change):
    of = module.EXPERIMENT
    require_sizes(dataclasses.replace(of.config, **change), (of.config, *of.scales.values()))
