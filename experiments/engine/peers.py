"""Other GRPO engines, each measured in a process and, where need be, an environment of its own."""

import dataclasses
import importlib.util
import os
import subprocess
import sys
from pathlib import Path

from experiments.core.runs import ROOT
from experiments.engine.harness import PeerJob, PeerTimes, read_answer

QUIETLY = {
    "JAX_PLATFORMS": "cpu",
    "CUDA_VISIBLE_DEVICES": "",
    "HF_HUB_OFFLINE": "1",
    "HF_DATASETS_OFFLINE": "1",
    "TOKENIZERS_PARALLELISM": "false",
}
"""Environment of a peer: the CPU, nothing from the network."""

LAST_LINES = 15  # of a failed peer's complaints


class PeerFailed(RuntimeError):
    """A peer's process ended without an answer, with an exit code; −9: the system killed it, as for want of memory."""

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
          PeerFailed: the process failed, or printed no answer.
        """
        command = [str(self.python), "-m", self.harness, job.to_json()]
        done = subprocess.run(
            command, cwd=ROOT, env=os.environ | QUIETLY, capture_output=True, text=True, check=False, errors="replace"
        )
        if done.returncode:
            said = "\n".join(done.stderr.splitlines()[-LAST_LINES:])
            raise PeerFailed(
                f"{self.name} ended with {done.returncode} at prefix {job.prefix}: {self.python} must be able to run "
                f"{self.harness}; its recipe stands there.  It said:\n{said}",
                done.returncode,
            )
        return read_answer(done.stdout)


def installed_peers(trl_python: Path | None, tunix_python: Path | None) -> tuple[Peer, ...]:
    """The engines that can be measured: by the interpreters given, else by this one where it can import them.

    Raises:
      FileNotFoundError: an interpreter that is not there.
    """
    found = []
    for name, package, python in (("TRL", "trl", trl_python), ("Tunix", "tunix", tunix_python)):
        if python is not None and not python.exists():
            raise FileNotFoundError(
                f"{package}-python is {python}: there is no such interpreter; make it as experiments/grpo/"
                f"harness_{package}.py says, or leave the option out"
            )
        own = Path(sys.executable) if importlib.util.find_spec(package) is not None else None
        chosen = python.absolute() if python is not None else own
        if chosen is not None:
            found.append(Peer(name=name, harness=f"experiments.engine.harness_{package}", python=chosen))
    return tuple(found)
