"""Bounds: what lies on them, what lies outside, and what is no number."""

import dataclasses
import math
from typing import Annotated

import pytest
import tyro

from touchr1_jax.validation import above, at_least, by_name, some_of, within


@dataclasses.dataclass(frozen=True)
class Bounded:
    share: float


@pytest.mark.parametrize(
    ("check", "kept", "refused", "said"),
    [
        (lambda c: at_least(c, 1, "share"), (1, 2), (0.5, math.nan), "must be at least 1; raise it"),
        (lambda c: above(c, 0, "share"), (1e-9,), (0, -1, math.nan), "must be above 0; raise it"),
        (lambda c: within(c, 0, 1, "share"), (0, 1), (-1, 1.1, math.nan), "must lie in 0 … 1; change it"),
    ],
)
def test_bounds(check, kept, refused, said):
    for value in kept:
        check(Bounded(value))
    for value in refused:
        with pytest.raises(ValueError, match=f"share is {value}: {said}"):
            check(Bounded(value))


@pytest.mark.parametrize("names", [(), ("a", "a"), ("a", "c")])
def test_names_are_some_of_those_that_are_known(names):
    some_of(Bounded(("b", "a")), "share", "ab")
    with pytest.raises(ValueError, match=r"share is .*: must hold some of a, b, each once; correct it"):
        some_of(Bounded(names), "share", "ab")


def test_a_size_is_finite():
    """An infinite weight makes every loss NaN, an infinite ε every advantage 0."""
    with pytest.raises(ValueError, match="share is inf: must be finite; lower it"):
        at_least(Bounded(math.inf), 1, "share")


@dataclasses.dataclass(frozen=True)
class Named:
    shares: Annotated[dict[str, float], by_name(float)]


@pytest.mark.parametrize(("words", "said"), [("a 1 b 2 a 3", "a is given twice"), ("a 1 b", "b has no value")])
def test_a_mapping_of_a_command_line_names_each_once(capsys, words, said):
    assert tyro.cli(Named, args=["--shares", "a", "1", "b", "2"]) == Named({"a": 1.0, "b": 2.0})
    with pytest.raises(SystemExit):
        tyro.cli(Named, args=["--shares", *words.split()])
    assert said in capsys.readouterr().err
