"""Other GRPO engines on the timed job of `experiments.engine.job`: its size, the processes that run it, their results.

A peer engine may need its own environment, whose interpreter runs `python -m experiments.engine.harness_NAME JOB` in
this checkout, so this module imports only Python's standard library.  A harness gets the job as JSON and prints one
line.
"""

import dataclasses
import importlib.util
import itertools
import json
import os
import random
import resource
import statistics
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

ANSWER = "measured: "  # beginning of the line that a harness prints; all other output of a peer is ignored

PAD_ID = 0
WARMUP = 1  # iterations before the timed ones: they load, compile and fill caches

BETA, CLIP, LEARNING_RATE = 0.04, 0.2, 1e-4
"""Weight of the KL to the reference policy, clip range of the ratio and AdamW's rate, the same for all engines."""

CHECKOUT = Path(__file__).resolve().parents[2]

OFFLINE_ON_CPU = {
    "JAX_PLATFORMS": "cpu",
    "CUDA_VISIBLE_DEVICES": "",
    "HF_HUB_OFFLINE": "1",
    "HF_DATASETS_OFFLINE": "1",
    "TOKENIZERS_PARALLELISM": "false",
}
"""Environment of a peer."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class JobSize:
    """Prompts, rollouts of each, new tokens, and the decoder."""

    prompts: int = 8
    group: int = 8
    length: int = 64
    vocab_size: int = 512
    hidden_size: int = 128
    num_layers: int = 4
    num_heads: int = 4
    num_kv_heads: int = 2
    head_dim: int = 32
    intermediate_size: int = 512

    def gflop(self, prefix: int) -> float:
        """Multiplications and additions of the matrix products that one iteration needs, in 10⁹.

        Each prompt's prefix counts once in every pass: sampling, the reference, forward and backward (three forwards).
        """
        c = self
        weights = c.num_layers * (
            2 * c.hidden_size * c.num_heads * c.head_dim
            + 2 * c.hidden_size * c.num_kv_heads * c.head_dim
            + 3 * c.hidden_size * c.intermediate_size
        )
        pair = 2 * c.num_layers * c.num_heads * c.head_dim  # q·k and weights·v of one query and key
        prompt = prefix * weights + pair * prefix * (prefix + 1) / 2
        keys = self.length * prefix + self.length * (self.length + 1) / 2
        completion = self.length * (weights + c.hidden_size * c.vocab_size) + pair * keys
        return 2 * 5 * self.prompts * (prompt + self.group * completion) / 1e9


@dataclasses.dataclass(frozen=True, kw_only=True)
class PeerJob:
    """One measurement of a peer: prompt tokens, timed iterations, size."""

    prefix: int
    rounds: int
    size: JobSize = JobSize()

    @property
    def iterations(self) -> int:
        """Steps to take: the warm-up, the timed ones, and one more, since a step ends where the next one begins."""
        return WARMUP + self.rounds + 1

    @property
    def end_id(self) -> int:
        """An id beyond the vocabulary of the model, so that no completion ends early."""
        return self.size.vocab_size

    def prompts(self) -> list[list[list[int]]]:
        """Random token ids, [iteration, prompt, prefix], without padding."""
        draw = random.Random(0)
        prompt = lambda: [draw.randrange(PAD_ID + 1, self.size.vocab_size) for _ in range(self.prefix)]
        return [[prompt() for _ in range(self.size.prompts)] for _ in range(self.iterations)]

    def reward(self, completion: Sequence[int]) -> float:
        """Share of ids in the lower half of the vocabulary.

        Raises:
          ValueError: a completion of another length, for which the peer did less work.
        """
        if len(completion) != self.size.length:
            raise ValueError(f"completion has {len(completion)} tokens: must be {self.size.length}; nothing may end it")
        return sum(token < self.size.vocab_size // 2 for token in completion) / len(completion)

    def to_json(self) -> str:
        """The job as an argument of the peer's command line."""
        return json.dumps(dataclasses.asdict(self))

    @staticmethod
    def from_json(text: str) -> "PeerJob":
        """The job that `to_json` wrote."""
        fields = json.loads(text)
        return PeerJob(**fields | {"size": JobSize(**fields["size"])})


@dataclasses.dataclass(frozen=True, kw_only=True)
class EngineTimes:
    """Seconds of an engine's timed iterations and of its first, and peak memory of its process."""

    seconds: tuple[float, ...]
    first_s: float
    peak_gb: float

    @property
    def median_s(self) -> float:
        """Median of the timed iterations."""
        return statistics.median(self.seconds)


@dataclasses.dataclass(frozen=True, kw_only=True)
class PeerTimes(EngineTimes):
    """Times of a peer, and the versions of its packages."""

    versions: Mapping[str, str]


def format_answer(job: PeerJob, starts: Sequence[float], versions: Mapping[str, str]) -> str:
    """The line that a harness prints; `starts` are clock times (s) at the start of every iteration.

    Raises:
      ValueError: fewer or more iterations than the job has.
    """
    if len(starts) != job.iterations:
        raise ValueError(f"peer took {len(starts)} steps: must be {job.iterations}; ask it for as many")
    seconds = [end - begin for begin, end in itertools.pairwise(starts)]
    peak_gb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20  # Linux counts in KiB
    times = PeerTimes(seconds=tuple(seconds[WARMUP:]), first_s=seconds[0], peak_gb=peak_gb, versions=versions)
    return ANSWER + json.dumps(dataclasses.asdict(times))


def run_harness(main: Callable[[PeerJob], str]) -> None:
    """Run a harness on the job of the command line, and print its answer."""
    sys.stdout.write(main(PeerJob.from_json(sys.argv[1])) + "\n")


def parse_answer(output: str) -> PeerTimes:
    """Find the harness's line in everything that the peer printed.

    Raises:
      ValueError: there is none.
    """
    lines = [line for line in output.splitlines() if line.startswith(ANSWER)]
    if not lines:
        raise ValueError(f"output holds no line that begins with {ANSWER!r}: the harness must print one")
    fields = json.loads(lines[-1].removeprefix(ANSWER))
    return PeerTimes(**fields | {"seconds": tuple(fields["seconds"])})


class PeerFailed(RuntimeError):
    """A peer's process ended without an answer, with an exit code; −9: the system killed it, as for lack of memory."""

    def __init__(self, message: str, code: int) -> None:
        super().__init__(message)
        self.code = code


@dataclasses.dataclass(frozen=True, kw_only=True)
class Peer:
    """An engine: its name, the harness that drives it, an interpreter that can import it."""

    name: str
    harness: str
    python: Path

    def measure(self, job: PeerJob) -> PeerTimes:
        """Run the job in a process of its own.

        Raises:
          PeerFailed: the process failed.
          ValueError: it printed no answer.
        """
        done = subprocess.run(
            [str(self.python), "-m", self.harness, job.to_json()],
            cwd=CHECKOUT,
            env=os.environ | OFFLINE_ON_CPU,
            capture_output=True,
            text=True,
            check=False,
            errors="replace",
        )
        if done.returncode:
            errors = "\n".join(done.stderr.splitlines()[-15:])
            raise PeerFailed(
                f"{self.name} ended with {done.returncode} at prefix {job.prefix}: {self.python} must be able to run "
                f"{self.harness}, whose first lines explain how to install it.  Its last errors:\n{errors}",
                done.returncode,
            )
        return parse_answer(done.stdout)


def installed_peers(trl_python: Path | None, tunix_python: Path | None) -> tuple[Peer, ...]:
    """The engines that can be measured: by the interpreters given, else by this one where it can import them.

    Raises:
      FileNotFoundError: an interpreter that does not exist.
    """
    found = []
    for name, package, python in (("TRL", "trl", trl_python), ("Tunix", "tunix", tunix_python)):
        if python is not None and not python.exists():
            raise FileNotFoundError(
                f"{package}-python is {python}: there is no such interpreter; make it as experiments/engine/"
                f"harness_{package}.py says, or leave the option out"
            )
        own = Path(sys.executable) if importlib.util.find_spec(package) is not None else None
        chosen = python.absolute() if python is not None else own
        if chosen is not None:
            found.append(Peer(name=name, harness=f"experiments.engine.harness_{package}", python=chosen))
    return tuple(found)
