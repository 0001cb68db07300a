"""`python -m touchr1_jax.rewards`: list the rewards, explain the score of one answer, search for answers that cheat.

python -m touchr1_jax.rewards list
python -m touchr1_jax.rewards explain --text "<perceive> xense soft </perceive> <compare> soft </compare> …"
python -m touchr1_jax.rewards explain --text "…" --label hardness firm --weights accuracy 0.6 format 0.1
python -m touchr1_jax.rewards adversary --prior 0.5 0.3 0.2
"""

import dataclasses
import itertools
import signal
import sys
from collections.abc import Iterator, Mapping, Sequence
from typing import Annotated

if __name__ == "__main__" and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
    # nothing is written, and an exception within JAX's callback of the garbage collector would be lost
    signal.signal(signal.SIGINT, signal.SIG_DFL)

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from jaxtyping import Array
from rich.console import Console
from rich.table import Table

from touchr1_jax.rewards import (
    AnyReward,
    check_weights,
    make_rewards,
    stable_weights,
    total_reward,
    uniform_prior,
)
from touchr1_jax.rewards.adversary import ACCURACY, AnswerProgram, earnings, programs, with_prior
from touchr1_jax.rewards.base import GROUP, reward_value
from touchr1_jax.rewards.proof import prove_rewards
from touchr1_jax.text.language import TOUCH_LANGUAGE, Language
from touchr1_jax.text.lexer import tags_of
from touchr1_jax.text.oracle import Reading, read
from touchr1_jax.types import Parsed, Target
from touchr1_jax.validation import at_least, by_name, within

PUBLISHED: Mapping[str, float] = {"accuracy": 0.6, "consistency": 0.3, "format": 0.1}
"""Weights of Touch-R1 (arXiv 2605.27154)."""

UNREAD = "⊥"
"""Value of a slot that names no level, or several."""

NOT_DEFINED = "does not apply"
"""Value of a reward that is not defined for the question; its weight goes to the other terms."""

MOST_TRUTHS = 100
"""Largest number of label combinations in a table."""

MOST_TOKENS = 100_000
"""Longest completion; those of released models have some thousands."""

WIDTH = 110
"""Columns of the output where it is no terminal."""


class ExplainError(ValueError):
    """An argument that does not fit; the message names it, its value, the constraint and the fix."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class ListRewards:
    """List every reward with the first line of its file."""

    def run(self) -> int:
        """Print one line per reward and return the exit status."""
        rewards, console = all_rewards(TOUCH_LANGUAGE), Console(soft_wrap=True, highlight=False, emoji=False)
        for name, reward in rewards.items():
            about = (sys.modules[reward.value.__module__].__doc__ or "").strip().partition("\n")[0]
            console.print(f"{name:<{max(map(len, rewards))}}  {about}", markup=False)
        return 0


@dataclasses.dataclass(frozen=True, kw_only=True)
class ExplainAnswer:
    """Show the slots of an answer, the value of every reward, its share of the total, and the total.

    Without `--label` the answer is scored against every label that it could be about.
    """

    text: str
    """The answer."""
    label: Annotated[dict[str, str], by_name(str)] = dataclasses.field(default_factory=dict)
    """Right levels, as in `hardness soft`."""
    asked: tuple[str, ...] = ()
    """Attributes asked for; by default the labelled ones, else those that the answer concludes about."""
    sensors: tuple[str, ...] = ()
    """Sensors that are present; by default those that the answer reports on."""
    weights: Annotated[dict[str, float], by_name(float)] = dataclasses.field(default_factory=dict)
    """Weight of each reward, as in `accuracy 0.6 format 0.1`; by default the published ones."""
    length: int | None = None
    """Tokens before the end token; by default the words of the text."""
    truncated: bool = False
    """The answer was cut off: it has no end token."""
    longest: int = 20
    """Most tokens of a completion."""

    def run(self) -> int:
        """Print both tables and return the exit status."""
        language, console = TOUCH_LANGUAGE, _console()
        rewards, weights = all_rewards(language), self.weights or PUBLISHED
        try:
            check_weights(rewards, weights)
            within(self, 1, MOST_TOKENS, "longest")
            if self.length is not None:
                within(self, 0, MOST_TOKENS, "length")
            reading = read(language, self.text)
            asked = self._asked(language, reading)
            streams = self._streams(language, reading)
            targets = ((w, _target(language, asked, label, streams)) for w, label in self._labels(language, asked))
            parsed = self._parsed(reading)
            earned = terms_table(rewards, weights, parsed, targets, self.text, self.longest)
        except ValueError as error:
            _console(stderr=True).print(f"{type(error).__name__}: {error}", markup=False, soft_wrap=True)
            return 1
        there = [s.name for s, is_there in zip(language.sensors, streams, strict=True) if is_there]
        console.print(slots_table(language, reading))
        if max(map(max, (*reading.perceive, reading.compare, reading.conclude))) < 0:
            console.print(f"no slot names a level; the words that do: {level_words(language)}", soft_wrap=True)
        console.print(f"formatted: {format_fault(language, self.text, reading)}")
        console.print(f"length: {parsed.length}, truncated: {'yes' if self.truncated else 'no'}")
        console.print(f"sensors that touched: {', '.join(there) or 'none'}")
        console.print(earned)
        return 0

    def _asked(self, language: Language, reading: Reading) -> tuple[str, ...]:
        concluded = [a.name for a, k in zip(language.attributes, reading.conclude, strict=True) if k >= 0]
        asked = self.asked or tuple(self.label) or tuple(concluded)
        if not asked:
            raise ExplainError(
                "asked is empty and `conclude` names no level, or several of one attribute: "
                "say what was asked for, as in --asked hardness"
            )
        for name in (*asked, *self.label):
            language.attribute_index(name)
        return asked

    def _streams(self, language: Language, reading: Reading) -> list[bool]:
        known = [sensor.name for sensor in language.sensors]
        unknown = [name for name in self.sensors if name not in known]
        if unknown:
            raise ExplainError(f"sensors holds {unknown}: must be among {', '.join(known)}; correct the name")
        reported = [max(levels) >= 0 for levels in reading.perceive]
        return [name in self.sensors for name in known] if self.sensors else reported

    def _labels(self, language: Language, asked: Sequence[str]) -> list[tuple[str, list[int]]]:
        """Every label to score against, in words and as levels, int [A]."""
        open_levels: list[Sequence[int]] = []
        for attribute in language.attributes:
            if attribute.name in self.label:
                open_levels.append([_level(language, attribute.name, self.label[attribute.name])])
            else:
                open_levels.append(range(len(attribute.levels)) if attribute.name in asked else [-1])
        count = int(np.prod([len(levels) for levels in open_levels]))
        if count > MOST_TRUTHS:
            missing = [name for name in asked if name not in self.label]
            raise ExplainError(
                f"label lacks {', '.join(missing)}, which leaves {count} combinations: must be at most {MOST_TRUTHS}; "
                "say what is true, as in --label hardness soft"
            )
        return [(_in_words(language, asked, label), list(label)) for label in itertools.product(*open_levels)]

    def _parsed(self, reading: Reading) -> Parsed:
        return Parsed(
            perceive=jnp.array(reading.perceive),
            compare=jnp.array(reading.compare),
            conclude=jnp.array(reading.conclude),
            formatted=jnp.array(reading.formatted),
            truncated=jnp.array(self.truncated),
            length=jnp.array(len(self.text.split()) if self.length is None else self.length),
        )


def all_rewards(language: Language) -> dict[str, AnyReward]:
    """Every reward, debiased for levels that are all as likely."""
    return make_rewards(uniform_prior([len(attribute.levels) for attribute in language.attributes]))


def slots_table(language: Language, reading: Reading) -> Table:
    """Levels of every slot; attributes that the answer never names are left out."""
    slots = dict(zip((f"perceive {s.name}" for s in language.sensors), reading.perceive, strict=True))
    slots |= {"compare": reading.compare, "conclude": reading.conclude}
    named = [a for a in range(len(language.attributes)) if any(levels[a] >= 0 for levels in slots.values())]
    table = Table("slot", *(language.attributes[a].name for a in named), title="What the answer says")
    for slot, levels in slots.items():
        words = (language.attributes[a].levels[levels[a]][0] if levels[a] >= 0 else UNREAD for a in named)
        table.add_row(slot, *words)
    return table


def level_words(language: Language) -> str:
    """A word for every level of every attribute."""
    return "; ".join(f"{a.name} {', '.join(words[0] for words in a.levels)}" for a in language.attributes)


def terms_table(
    rewards: Mapping[str, AnyReward],
    weights: Mapping[str, float],
    parsed: Parsed,
    targets: Iterator[tuple[str, Target]],
    text: str = "",
    longest: int = 20,
) -> Table:
    """Value, weight and share of every term, and the total, for each target; the answer is a group of its own.

    Raises:
      RewardError: as training does: a reward that cannot be traced or can be NaN is named, not shown.
    """
    table = Table("if it is", "reward", "value", "weight", "adds", title="What it earns")
    words = text.split()[:longest]
    tokens = jnp.array([*map(sorted(set(words)).index, words), *[len(words)] * (longest - len(words))], jnp.int32)

    def write(tokens: np.ndarray) -> str:
        del tokens
        return text

    def of_rollout(tokens: Array, parsed: Parsed, target: Target) -> tuple[Array, Mapping[str, Array], Mapping]:
        total, parts = total_reward(rewards, weights, parsed, target, tokens, write)
        values = {n: reward_value(n, rewards[n], parsed, target, tokens, write) for n in weights}
        terms = {n: (values[n], rewards[n].applies(target)) for n in weights}
        return total, parts, terms

    @jax.jit  # one program for all targets: one for each operation would take seconds to compile
    def score(target: Target) -> tuple[Array, Mapping[str, Array], Mapping[str, tuple[Array, Array]]]:
        alone = jax.tree.map(lambda x: x[None], parsed)
        scored = jax.vmap(of_rollout, in_axes=(0, 0, None), axis_name=GROUP)(tokens[None], alone, target)
        return jax.tree.map(lambda x: x[0], scored)

    for slot, target in targets:
        total, parts, terms = score(target)
        levels, ordinal = tuple(target.levels.tolist()), tuple(target.ordinal.tolist())
        prove_rewards(rewards, weights, len(parsed.perceive), levels, longest, ordinal)
        for name, weight in weights.items():
            value, applies = terms[name]
            shown = f"{float(value):.3f}" if applies else NOT_DEFINED
            table.add_row(slot, name, shown, f"{weight:g}", f"{float(parts[name]):+.3f}")
            slot = ""
        table.add_row("", "total", "", "", f"{float(total):+.3f}", style="bold", end_section=True)
    return table


def format_fault(language: Language, text: str, reading: Reading) -> str:
    """\"yes\", or the reason why an answer is not formatted."""
    if reading.formatted:
        return "yes"
    wrong = [f"{tag} occurs {text.count(tag)} times" for tag in tags_of(language) if text.count(tag) != 1]
    return "no, " + (", ".join(wrong) or "tags are out of order, a body is empty, or text follows the last tag")


def _target(language: Language, asked: Sequence[str], label: Sequence[int], streams: Sequence[bool]) -> Target:
    return Target(
        asked=jnp.array([a.name in asked for a in language.attributes]),
        label=jnp.array(label),
        levels=jnp.array([len(a.levels) for a in language.attributes]),
        ordinal=jnp.array([a.ordinal for a in language.attributes]),
        streams=jnp.array(streams),
    )


def _level(language: Language, name: str, word: str) -> int:
    levels = language.attributes[language.attribute_index(name)].levels
    for level, words in enumerate(levels):
        if word in words:
            return level
    known = ", ".join(words[0] for words in levels)
    raise ExplainError(f"label of {name} is {word!r}: must be one of {known}; correct the word")


def _in_words(language: Language, asked: Sequence[str], label: Sequence[int]) -> str:
    pairs = zip(language.attributes, label, strict=True)
    return ", ".join(attribute.levels[level][0] for attribute, level in pairs if attribute.name in asked)


def _console(stderr: bool = False) -> Console:
    console = Console(stderr=stderr, highlight=False, emoji=False)
    return console if console.is_terminal else Console(stderr=stderr, highlight=False, emoji=False, width=WIDTH)


@dataclasses.dataclass(frozen=True, kw_only=True)
class SearchAnswers:
    """Search all short answers for those that earn more without touch than an honest answer with touch."""

    weights: Annotated[dict[str, float], by_name(float)] = dataclasses.field(default_factory=dict)
    """Weight of each reward; by default the published ones, and then the stable ones."""
    prior: tuple[float, float, float] = (1 / 3, 1 / 3, 1 / 3)
    """Share of each level among the labels."""
    accuracy: float = ACCURACY
    """Share of right readings of touch."""
    most: int = 8
    """Answers of each table."""

    def run(self) -> int:
        """Print a table for each set of rewards and return the exit status: 0 if the last one has no such answer."""
        sets = {"chosen": self.weights} if self.weights else {"paper": PUBLISHED, "stable": stable_weights(PUBLISHED)}
        better: list[tuple[AnswerProgram, float]] = []
        try:
            within(self, 0, 1, "accuracy")
            at_least(self, 0, "most")
            rewards = make_rewards(with_prior(self.prior))
            earned = {name: earnings(rewards, weights, self.prior) for name, weights in sets.items()}
        except ValueError as error:
            _console(stderr=True).print(f"{type(error).__name__}: {error}", markup=False, soft_wrap=True)
            return 1
        for name, found in earned.items():
            better, honest = found.better(self.accuracy), found.expected(self.accuracy)[-1]
            total = f"{len(better)} of {len(programs())} answers earn more than the honest one, {honest:.3f}"
            table = Table("layout: perceive → compare → conclude", "earns", "more by", title=f"{name}: {total}")
            for program, lead in better[: self.most]:
                table.add_row(str(program), f"{honest + lead:.3f}", f"{lead:.3f}")
            _console().print(table)
        return int(bool(better))


Command = (
    Annotated[ListRewards, tyro.conf.subcommand("list")]
    | Annotated[ExplainAnswer, tyro.conf.subcommand("explain")]
    | Annotated[SearchAnswers, tyro.conf.subcommand("adversary")]
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit status."""
    command = tyro.cli(
        Command, args=arguments, prog="python -m touchr1_jax.rewards", config=(tyro.conf.OmitArgPrefixes,)
    )
    try:
        return command.run()
    except KeyboardInterrupt:
        return 128 + signal.SIGINT  # as shells have it
    except OSError as error:
        sys.stderr.write(f"{type(error).__name__}: {error}: let standard output lead to something that takes text\n")
        return 1


if __name__ == "__main__":
    sys.exit(main())
