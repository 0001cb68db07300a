"""Ask a trained policy about a touch.

    policy = load_policy("runs/ablation_ordinal/latest/policies/sft/0")
    answer = policy.ask({"gelsight_mini": frames}, "How hard is it?")  # frames: uint8 [F, H, W, 3], RGB
    answer.word, answer.trace, answer.probabilities, answer.untouched.word

The answer is the most likely one, token by token, of those that the grammar allows.  Without touch, for which no policy
is trained, it may name no level of the attribute.  Probabilities are p(level | touch), the mean over sampled traces of
p(level | trace).
"""

import contextlib
import dataclasses
import functools
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from touchr1_jax.models.adapted_folder import read_saved
from touchr1_jax.models.lora import of_decoder
from touchr1_jax.models.policy import Features
from touchr1_jax.models.saved_policy import PolicyError, Precision, SavedPolicy, save_policy, words
from touchr1_jax.models.touch_input import TouchInput as TouchInput
from touchr1_jax.models.touch_input import clip_arrays
from touchr1_jax.rl.rollout import GRPOBatch
from touchr1_jax.text.plain_questions import AskedAttribute, QuestionError, read_question
from touchr1_jax.training.compilation import compiled_quickly
from touchr1_jax.training.encoding import encode_contacts
from touchr1_jax.training.evaluation import answer_program, sample_program
from touchr1_jax.training.feeds import take, touch_batch
from touchr1_jax.training.questions import equal_blocks, question_batch
from touchr1_jax.types import Params

SHIPPED = Path(__file__).resolve().parent / "policies"
"""Folder of the policies that come with the package, each a folder that `load_policy` reads by its name."""

HUB = "hub:"
"""Begins the name of a policy on the Hugging Face Hub, as in `hub:USER/NAME`."""

SAMPLES = 32
"""Traces whose probabilities are averaged: the standard error of a share is at most 9 points, usually below 3."""

TOGETHER = 8
"""Touches that are answered at once where there are several."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class TouchAnswer:
    """An answer about one attribute of one touch.

    Attributes:
      question, attribute: as the policy was asked.
      word: the level that the answer concludes; empty where its level is of another attribute.
      trace: the whole answer.
      probabilities: word of each level → p(level | touch).
      untouched: the answer to the same question without the touch; `None` in itself.
    """

    question: str
    attribute: str
    word: str
    trace: str
    probabilities: Mapping[str, float]
    untouched: "TouchAnswer | None" = None

    def __str__(self) -> str:
        shares = ", ".join(f"{word} {p:.0%}" for word, p in self.probabilities.items())
        answer = f"{self.word or 'no readable answer'} ({shares})"
        return answer if self.untouched is None else f"{answer}; without touch {self.untouched}"


@dataclasses.dataclass(frozen=True, kw_only=True)
class ComparedTouches:
    """Which of two touched objects has more of an attribute, by the probabilities of their levels.

    Attributes:
      question, attribute: as asked.
      word: "first" or "second".
      probabilities: "first", "same level" and "second" → probability, for levels that are independent of one another.
      first, second: the answers about each.
      untouched: the comparison without touch; `None` in itself.
    """

    question: str
    attribute: str
    word: str
    probabilities: Mapping[str, float]
    first: TouchAnswer
    second: TouchAnswer
    untouched: "ComparedTouches | None" = None


class AskablePolicy:
    """A trained policy that answers questions about touches; programs are compiled when it is first asked.

    Args:
      saved: the policy.
      name: for messages.
    """

    def __init__(self, saved: SavedPolicy, name: str = "policy") -> None:
        self.saved, self.name = saved, name

    @functools.cached_property
    def attributes(self) -> dict[str, list[str]]:
        """Attribute → the words of its levels."""
        return {a.name: words(self.saved, a.name) for a in self.saved.policy.language.attributes}

    def ask(self, touch: TouchInput | Mapping[str, np.ndarray], question: str) -> TouchAnswer:
        """The answer to a question about one touch, given as `TouchInput` or as its frames alone.

        Raises:
          QuestionError: a question for no attribute or for a difference, or a touch that the policy cannot read.
        """
        asked = read_question(question, self.attributes)
        if asked.compares:
            raise QuestionError(f"question is {question!r}: it compares two objects; give two touches, by `compare`")
        return self.answers([touch])[0][asked.name]

    def probabilities(self, touch: TouchInput | Mapping[str, np.ndarray]) -> dict[str, dict[str, float]]:
        """Attribute → word of each level → p(level | touch).

        Raises:
          QuestionError: a touch that the policy cannot read.
        """
        return {name: dict(answer.probabilities) for name, answer in self.answers([touch])[0].items()}

    def compare(
        self,
        first: TouchInput | Mapping[str, np.ndarray],
        second: TouchInput | Mapping[str, np.ndarray],
        question: str,
    ) -> ComparedTouches:
        """Which of two objects has more, or less, of an attribute: P(first) = Σ_{i > j} p₁(i) p₂(j).

        Raises:
          QuestionError: as `ask`, or an attribute whose levels have no order.
        """
        asked = read_question(question, self.attributes)
        language = self.saved.policy.language
        if not language.attributes[language.attribute_index(asked.name)].ordinal:
            raise QuestionError(f"question is {question!r}: levels of {asked.name} have no order; ask about each touch")
        one, two = (found[asked.name] for found in self.answers([first, second]))
        return compared(question, asked, one, two)

    def answers(self, touches: Sequence[TouchInput | Mapping[str, np.ndarray]]) -> list[dict[str, TouchAnswer]]:
        """For each touch, the answer to the question for every attribute, by its name.

        Raises:
          QuestionError: a touch that the policy cannot read.
        """
        given = [touch if isinstance(touch, TouchInput) else TouchInput(frames=touch) for touch in touches]
        size = 1 if len(given) < TOGETHER else TOGETHER
        found: list[dict[str, TouchAnswer]] = []
        with compiled_quickly() if size == 1 else contextlib.nullcontext():  # programs that run a few times
            for rows, real in equal_blocks(len(given), size):
                found += list(self._answered([given[i] for i in rows]))[:real]
        return found

    def encode(self, touches: Sequence[TouchInput]) -> Features:
        """Features of touches on the host, which every other evaluation of the policy takes.

        Raises:
          QuestionError: a touch that the policy cannot read.
        """
        batches = []
        for rows, _ in equal_blocks(len(touches), min(len(touches), TOGETHER)):
            clips = [clip_arrays(touches[i], self.saved) for i in rows]
            batches.append(touch_batch({name: np.stack([clip[name] for clip in clips]) for name in clips[0]}))
        every = encode_contacts(self.saved.policy.fns, self.saved.params, batches)
        return take(every, np.arange(len(touches)))

    def _answered(self, touches: Sequence[TouchInput]) -> Iterator[dict[str, TouchAnswer]]:
        """Answers about a block of touches: with touch in the first half of the questions, without in the second."""
        policy, params, n, a = self.saved.policy, self.saved.params, len(touches), len(self.attributes)
        features, unknown = self.encode(touches), np.full((n, a), -1, np.int32)
        contact, attribute = (np.tile(x.ravel(), 2) for x in np.mgrid[:n, :a])
        with_touch = np.arange(len(contact))[:, None] < n * a
        streams = np.asarray(features.stream_mask)[contact] & with_touch
        batch = question_batch(policy, features, unknown, contact, attribute, streams)
        tokens, level, share = self._decoded(of_decoder(params), batch)

        def answer(row: int, untouched: TouchAnswer | None = None) -> TouchAnswer:
            name, asked = list(self.attributes.items())[attribute[row]], int(level[row, attribute[row]])
            return TouchAnswer(
                question=f"{self.saved.questions[name[0]]}?",
                attribute=name[0],
                word=name[1][asked] if asked >= 0 else "",
                trace=policy.tokenizer.decode(tokens[row]).strip(),
                probabilities={word: float(p) for word, p in zip(name[1], share[row], strict=False)},
                untouched=untouched,
            )

        for i in range(n):
            rows = range(i * a, (i + 1) * a)
            yield dict(zip(self.attributes, (answer(row, answer(row + n * a)) for row in rows), strict=True))

    def _decoded(self, decoder: Params, batch: GRPOBatch) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Greedy tokens and concluded levels of questions, and the probabilities of the levels that are asked for."""
        policy = self.saved.policy
        greedy = answer_program(policy, constrained=True)(decoder, batch)
        _, marginal = sample_program(policy, SAMPLES, constrained=True)(decoder, batch, jax.random.key(0))
        share = np.asarray(marginal, np.float64)
        share /= np.maximum(share.sum(-1, keepdims=True), np.finfo(np.float64).tiny)
        return np.asarray(greedy.tokens), np.asarray(greedy.parsed.conclude), share


def load_policy(path: str | Path | None = None, weights: Path | None = None) -> AskablePolicy:
    """A trained policy, ready to be asked.

    Args:
      path: folder of a saved policy, name of one that comes with the package, or `hub:USER/NAME` on the Hugging Face
        Hub; without one, the policy that comes with the package.
      weights: released weights of a policy with adapters, where they are no longer where they were.

    Raises:
      PolicyError: there is none, or it cannot be read.
    """
    known = shipped()
    if path is None and not known:
        raise PolicyError("policy is None: none comes with this version; give the folder of one, or of a run")
    name = known[0] if path is None else str(path)
    folder = SHIPPED / name if name in known else Path(name)
    try:
        if name.startswith(HUB):
            folder = fetch(name.removeprefix(HUB))
        if name and folder.exists():
            return AskablePolicy(read_saved(folder, weights), name)
    except OSError as error:  # a name that is too long, a file without permission
        raise PolicyError(f"policy is {name!r}: cannot be read ({error}); correct its path or permissions") from error
    names = f"one of {', '.join(known)}, " if known else ""
    raise PolicyError(f"policy is {name!r}: no such folder; must be {names}the folder of a policy or {HUB}USER/NAME")


def shipped() -> list[str]:
    """Names of the policies that come with the package."""
    return sorted(folder.name for folder in SHIPPED.glob("*/"))


def fetch(repository: str) -> Path:
    """The folder of a policy of the Hugging Face Hub, downloaded first where its cache lacks it.

    Raises:
      PolicyError: no such repository, or it cannot be reached.
    """
    with _hub(f"policy is {HUB}{repository}: cannot be fetched", "correct the name") as hub:
        return Path(hub.snapshot_download(repository))


def push(saved: SavedPolicy, repository: str, *, precision: Precision = "float32", card: str = "") -> str:
    """Publish a policy in a repository of the Hugging Face Hub, made where there is none; its address.

    Args:
      saved, precision, card: as in `save_policy`.
      repository: `USER/NAME`; the user must be logged in (`hf auth login`).

    Raises:
      PolicyError: it cannot be reached, or not be written to.
    """
    with tempfile.TemporaryDirectory() as home:
        folder = Path(home) / "policy"
        save_policy(folder, saved, precision=precision, card=card)
        with _hub(f"{HUB}{repository} cannot be written", "correct the name, or log in by `hf auth login`") as hub:
            hub.create_repo(repository, exist_ok=True)
            return str(hub.upload_folder(repo_id=repository, folder_path=folder))


@contextlib.contextmanager
def _hub(what: str, fix: str) -> Iterator[Any]:
    """The client of the hub, which takes a second to import, and whose network's errors are those of other packages.

    Raises:
      PolicyError: it is not installed, or fails.
    """
    try:
        import huggingface_hub

        yield huggingface_hub
    except Exception as error:
        raise PolicyError(f"{what} ({' '.join(str(error).split()) or repr(error)}): {fix}") from error


def compared(question: str, asked: AskedAttribute, one: TouchAnswer, two: TouchAnswer) -> ComparedTouches:
    """The comparison of two answers, each with probabilities of ordered levels; see `AskablePolicy.compare`."""
    joint = np.outer([*one.probabilities.values()], [*two.probabilities.values()])
    more, less = float(np.tril(joint, -1).sum()), float(np.triu(joint, 1).sum())
    if asked.sign < 0:
        more, less = less, more
    both = one.untouched is not None and two.untouched is not None
    return ComparedTouches(
        question=question,
        attribute=asked.name,
        word="first" if more >= less else "second",
        probabilities={"first": more, "same level": float(np.trace(joint)), "second": less},
        first=one,
        second=two,
        untouched=compared(question, asked, one.untouched, two.untouched) if both else None,  # type: ignore[arg-type]
    )
