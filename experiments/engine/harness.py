"""What a peer's GRPO engine is asked to do and what it answers.

A peer lives in an environment of its own, whose interpreter runs `python -m experiments.engine.harness_NAME JOB` in
this checkout.  So nothing but Python's own library is imported here.  The engine gets the job as JSON and prints
one line.

The job is the one of `experiments.engine.job`: the same decoder shape, prompts of random token ids, no end token within
reach, one on-policy update a step by AdamW with a KL to a reference policy; the reward of a completion is its share
of ids in the lower half of the vocabulary.
"""

import dataclasses
import itertools
import json
import random
import resource
from collections.abc import Mapping, Sequence

from experiments.engine.size import BETA, LEARNING_RATE, JobSize

ANSWER = "measured: "
"""Opens the line that the harness prints; whatever else the peer prints is left aside."""

PAD_ID = 0
CLIP = 0.2
"""Clip range of the ratio, the same for all."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class PeerJob:
    """One measurement; the iterations before the timed ones load, compile and fill caches."""

    prefix: int
    rounds: int
    warmup: int = 1
    beta: float = BETA
    learning_rate: float = LEARNING_RATE
    size: JobSize = JobSize()

    @property
    def iterations(self) -> int:
        """Steps to take: the warm-up, the timed ones, and one more, for a step ends where the next one begins."""
        return self.warmup + self.rounds + 1

    @property
    def end_id(self) -> int:
        """An id beyond the vocabulary of the model, so that no completion ends early."""
        return self.size.vocab_size

    def prompts(self) -> list[list[list[int]]]:
        """Token ids of every iteration's prompts, [iteration, prompt, prefix]; no padding among them."""
        draw = random.Random(0)
        token = lambda: draw.randrange(PAD_ID + 1, self.size.vocab_size)
        return [
            [[token() for _ in range(self.prefix)] for _ in range(self.size.prompts)] for _ in range(self.iterations)
        ]

    def reward(self, completion: Sequence[int]) -> float:
        """Share of low ids.

        Raises:
          ValueError: a completion of another length, so that the peer did other work.
        """
        if len(completion) != self.size.length:
            raise ValueError(f"completion has {len(completion)} tokens: must be {self.size.length}; nothing may end it")
        return sum(token < self.size.vocab_size // 2 for token in completion) / len(completion)

    def to_json(self) -> str:
        """For the peer's command line."""
        return json.dumps(dataclasses.asdict(self))

    @staticmethod
    def from_json(text: str) -> "PeerJob":
        """The job of a command line."""
        fields = json.loads(text)
        return PeerJob(**fields | {"size": JobSize(**fields["size"])})


@dataclasses.dataclass(frozen=True, kw_only=True)
class PeerTimes:
    """What a peer's process measured of itself; `first_s` is its first iteration."""

    seconds: tuple[float, ...]
    first_s: float
    peak_gb: float
    versions: Mapping[str, str]


def answer(job: PeerJob, starts: Sequence[float], versions: Mapping[str, str]) -> str:
    """The line to print.

    Args:
      job: what was asked.
      starts: clock at the start of every iteration, s; the last one's end is not needed.
      versions: of the packages that count.

    Raises:
      ValueError: fewer or more iterations than asked.
    """
    if len(starts) != job.iterations:
        raise ValueError(f"peer took {len(starts)} steps: must be {job.iterations}; ask it for as many")
    seconds = [end - begin for begin, end in itertools.pairwise(starts)]
    peak_gb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20  # Linux counts in KiB
    times = PeerTimes(seconds=tuple(seconds[job.warmup :]), first_s=seconds[0], peak_gb=peak_gb, versions=versions)
    return ANSWER + json.dumps(dataclasses.asdict(times))


def read_answer(output: str) -> PeerTimes:
    """What the peer measured, from everything that it printed.

    Raises:
      ValueError: no answer among it.
    """
    lines = [line for line in output.splitlines() if line.startswith(ANSWER)]
    if not lines:
        raise ValueError(f"output holds no line that begins with {ANSWER!r}: the harness must print one")
    fields = json.loads(lines[-1].removeprefix(ANSWER))
    return PeerTimes(**fields | {"seconds": tuple(fields["seconds"])})
