"""Numbers, intervals and times as a reader sees them in reports, tables and logs."""

import re
from collections.abc import Mapping, Sequence
from typing import Protocol

ABSENT = "–"  # stands for a number that was not measured

SMOKE, MEANINGLESS = "smoke", "smoke: the figures mean nothing"
"""The scale that only shows that an experiment runs, and what stands in place of its verdict."""

MINUTE, HOUR = 60, 3600


class WithInterval(Protocol):
    """An estimate and the ends of its interval: `statistics.Interval`, `results.Estimate`."""

    @property
    def mean(self) -> float: ...
    @property
    def low(self) -> float: ...
    @property
    def high(self) -> float: ...


def number(value: float | None, spec: str = ".3g") -> str:
    """A number by its format, with a true minus sign, which is as wide as a digit; a dash for `None`.

    A negative number that rounds to zero is written without its sign.
    """
    if value is None:
        return ABSENT
    text = _with_true_minus(value, spec)
    zero = text.startswith("−") and not any(digit in text for digit in "123456789")
    return text.replace("−", "+" if "+" in spec else "", 1) if zero else text


def interval(found: WithInterval | None, spec: str = ".3g") -> str:
    """An estimate and its interval, such as `48.7 [38.0, 60.1]`; only the mean takes the plus of a spec like `+.1f`."""
    return ABSENT if found is None else f"{number(found.mean, spec)} {bounds(found.low, found.high, spec.lstrip('+'))}"


def bounds(low: float, high: float, spec: str = ".3g") -> str:
    """The ends of an interval, such as `[38.0, 60.1]`; their signs show whether 0 lies inside, also `[−0.0, 1.2]`."""
    return f"[{_with_true_minus(low, spec)}, {_with_true_minus(high, spec)}]"


def _with_true_minus(value: float, spec: str) -> str:
    return format(value, spec).replace("-", "−")


def plain(value: object) -> str:
    """A setting or a count in words."""
    if isinstance(value, float):
        return number(value, ",.4g")
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, int):
        return number(value, ",")
    if isinstance(value, Mapping):
        return ", ".join(f"{key} {plain(item)}" for key, item in value.items())
    if isinstance(value, list | tuple):
        return ", ".join(plain(item) for item in value) or "none"
    return str(value)


PRESET = {
    "prompts": "{} prompts a step",
    "group": "{} answers to each",
    "micro_prompts": "gradients of {} prompts at a time",
    "length": "at most {} tokens",
    "gamma": "grounding γ = {}",
    "beta": "KL β = {}",
}
"""Change of a preset in words, where its name says too little."""


def preset_in_words(preset: str) -> str:
    """A preset's name and changes: `paper with prompts=4` becomes `paper with 4 prompts a step`."""
    name, _, changes = preset.partition(" with ")
    pairs = [one.partition("=") for one in re.split(r", (?=\w+=)", changes) if one]
    switch = {"True": "{}", "False": "no {}", "None": "no {}"}
    words = lambda key, value: switch.get(value, f"{{}} {value}").format(key.replace("_", " "))
    changed = ", ".join(PRESET[key].format(value) if key in PRESET else words(key, value) for key, _, value in pairs)
    return f"{name} with {changed}" if changed else preset


def duration(seconds: float) -> str:
    """A wall time to read: `48 s`, `19 min 30 s`, `2 h 5 min`."""
    whole = round(seconds)
    if whole < MINUTE:
        return f"{whole} s"
    if whole < HOUR:
        return f"{whole // MINUTE} min {whole % MINUTE} s"
    return f"{whole // HOUR} h {whole % HOUR // MINUTE} min"


def aligned(rows: Sequence[Sequence[str]]) -> str:
    """Rows of cells as lines of text, the columns left-aligned."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = ("  ".join(f"{cell:<{width}}" for cell, width in zip(row, widths, strict=True)) for row in rows)
    return "\n".join(line.rstrip() for line in lines)
