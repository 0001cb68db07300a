"""`python -m experiments ask | export | demo`: commands on trained policies."""

import contextlib
import dataclasses
import json
import sys
import tempfile
import threading
import webbrowser
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated, Literal

import jax.numpy as jnp
import numpy as np
import tyro

from experiments.active.saved import read_explorer
from experiments.ask.answers import answer_json, as_json, ask_policy, count_right, text_lines
from experiments.ask.demo import demo_server
from experiments.ask.exploring import explored, explorer_folder
from experiments.ask.inputs import read_contacts, read_touch
from experiments.ask.page import write_page
from experiments.core.artifacts import DamagedFileError, make_folder
from experiments.core.commands import PROG, print_error, print_lines
from experiments.core.errors import DataError
from experiments.core.memory import require_memory
from experiments.core.runner import COMPILED
from experiments.study.policies import FILE, POLICIES, find_policy, is_policy, measured_figures
from sensors_io.commands.values import require_possible
from sensors_io.errors import UserError
from sensors_io.records import RecordStore
from sensors_io.remote import Mirror, at_url
from sensors_io.scenes.backend import require_backend
from touchr1_jax.asking import HUB, AskablePolicy, push
from touchr1_jax.distributed.processes import MachineError
from touchr1_jax.models.adapted_folder import export_merged
from touchr1_jax.models.load import WeightsError
from touchr1_jax.models.qwen.config import CONFIG_FILE
from touchr1_jax.models.released_policy import ReleasedPolicy
from touchr1_jax.models.saved_policy import Precision, SavedPolicy, save_policy
from touchr1_jax.text.plain_questions import QuestionError
from touchr1_jax.training.compilation import compilations_kept
from touchr1_jax.training.questions import NoLabelsError

FAILURES = (UserError, WeightsError, QuestionError, NoLabelsError, DamagedFileError, MachineError, OSError)
"""Errors whose message is all that a user needs."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Places:
    """Folders of runs and of compiled programs."""

    runs_dir: Path = Path("runs")
    """Folder of all runs."""
    cache_dir: Path = Path("data")
    """Folder of compiled programs, which the next call reuses."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class AskCommand(Places):
    """Ask a trained policy about a touch: the answer, its trace, the levels' probabilities, the same without touch.

    POLICY is a run, RUN/ARM, RUN/ARM/SEED, a policy's folder, hub:USER/NAME, or the name of one that comes with the
    package, which is taken where none is given.  INPUT is `generated`, `generated:NUMBER`, `generated:soft,wood`,
    RECORDS, RECORDS:CONTACT, a video, or a folder of pictures; two INPUTs are compared.  A policy of `active_touch`
    asks for each touch itself: INPUT is `generated`, `generated:NUMBER`, or left out, and you answer with recordings.
    """

    names: Annotated[tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="[POLICY] INPUT [INPUT]")]
    question: str = ""
    """Such as "How hard is it?" or, of two INPUTs, "Which is softer?"; everything that can be asked by default."""
    sensor: str = ""
    """Sensor of a video or of pictures; the policy's first one by default."""
    every: Literal["", "all", "train", "val", "test", "unlabelled"] = ""
    """Ask about all contacts of RECORDS, or of a split, and count the right answers."""
    json: bool = False
    """Print JSON for programs."""
    html: Path | None = None
    """Also write a page with the frames."""
    weights: Path | None = None
    """Released weights of a policy with adapters, where they are no longer where they were."""

    def run(self) -> int:
        """Ask, print, and return the exit status."""
        given = list(self.names)
        policy = given.pop(0) if given and is_policy(given[0], self.runs_dir) else ""
        folder = explorer_folder(policy, self.runs_dir) if policy else None
        if folder is not None:
            print_lines(self._explored(folder, given))
            return 0
        if not policy and len(given) > 1 and not _is_input(given[0]):
            policy = given.pop(0)  # names neither: the error says what a policy can be
        if len(given) not in (1, 2) or (self.every and len(given) != 1):
            raise DataError(f"names are {self.names}: must be at most one POLICY and one or two INPUTs; correct them")
        if self.every and (self.question or self.sensor or self.html is not None):
            raise DataError(f"every is {self.every!r}: goes without --question, --sensor and --html; leave them out")
        found = find_policy(policy, self.runs_dir, self.weights)
        if self.every:
            print_lines(*self._every(found, Path(given[0])))
            return 0
        touches = [read_touch(name, found.saved, self.sensor) for name in given]
        answered = ask_policy(found, touches, self.question)
        print_lines(json.dumps(as_json(answered), ensure_ascii=False) if self.json else "\n".join(text_lines(answered)))
        if self.html is not None:
            write_page(self.html, answered)
        return 0

    def _explored(self, folder: Path, given: list[str]) -> str:
        """The answer of a policy that chooses its touches, after it asked for each of them."""
        if len(given) > 1 or self.every or self.html is not None or self.json or self.sensor or not self.question:
            raise DataError(
                f"names are {self.names}: a policy that chooses its touches takes --question, at most one INPUT, and "
                "none of --sensor, --every, --json and --html; correct them"
            )
        listen = (lambda: "") if sys.stdin is None else sys.stdin.readline  # it is None where it is closed
        return explored(read_explorer(folder), given[0] if given else "", self.question, print_lines, listen)

    def _every(self, policy: AskablePolicy, path: Path) -> Iterator[str]:
        """The answers about every contact as JSON lines, or the share of right ones by attribute."""
        store = RecordStore(path)
        rows = range(len(store)) if self.every == "all" else store.contacts_of_split(self.every).tolist()
        if not rows:
            raise DataError(f"every is {self.every!r}: {path} has no such contact; choose another split, or all")
        touches = read_contacts(store, rows, policy.saved)
        if not self.json:
            yield from count_right(policy, touches, np.array([store.contacts[i].object_id for i in rows]))
            return
        answers = policy.answers([touch.touch for touch in touches])
        for touch, of_touch in zip(touches, answers, strict=True):
            by_attribute = {name: answer_json(answer) for name, answer in of_touch.items()}
            yield json.dumps(
                {"touch": touch.name, "answers": by_attribute, "truth": dict(touch.truth)}, ensure_ascii=False
            )


@dataclasses.dataclass(frozen=True, kw_only=True)
class ExportCommand(Places):
    """Write a trained policy as a folder in the layout of model hubs: config, safetensors, tokenizer, model card.

    The folder is a POLICY of `ask`; so is a URL such as s3://bucket/policy, and hub:USER/NAME on the hub.  A policy
    with adapters on released weights is merged into them, in float32, as a folder of the released format.
    """

    policy: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="POLICY")]
    folder: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="FOLDER|URL|hub:USER/NAME")]
    precision: Precision = "float32"
    """Of the parameters: int8 takes a quarter of the bytes."""
    weights: Path | None = None
    """Released weights of a policy with adapters, where they are no longer where they were."""
    card: Path | None = None
    """Model card to enclose; by default a table of what is known of the policy."""

    def run(self) -> int:
        """Write the folder and return the exit status."""
        above = Path(self.folder).resolve().parents
        if len(above) > 2 and above[1].name == POLICIES and (above[2] / CONFIG_FILE).exists():
            raise DataError(f"folder is {self.folder}: is the place of a run's own policy; name another")
        saved = find_policy(self.policy, self.runs_dir, self.weights).saved
        saved = dataclasses.replace(saved, notes={name: x for name, x in saved.notes.items() if name != FILE})
        if isinstance(saved.policy, ReleasedPolicy):
            return self._merged(saved)
        figures = measured_figures(self.policy, self.runs_dir)
        saved = dataclasses.replace(saved, notes={**saved.notes, **figures})
        try:
            card = "" if self.card is None else self.card.read_text(encoding="utf-8")
        except UnicodeDecodeError as error:
            raise DataError(f"card is {self.card}: must be text in UTF-8 ({error}); convert it") from error
        if self.folder.startswith(HUB):
            print_lines(push(saved, self.folder.removeprefix(HUB), precision=self.precision, card=card))
            return 0
        if at_url(self.folder):
            with tempfile.TemporaryDirectory() as folder:
                save_policy(Path(folder), saved, precision=self.precision, card=card)
                names = sorted((path.name for path in Path(folder).iterdir()), key=CONFIG_FILE.__eq__)  # that one last
                print_lines(f"{self.folder}: {Mirror(self.folder).publish(Path(folder), names) / 1e6:.2f} MB were sent")
            return 0
        save_policy(Path(self.folder), saved, precision=self.precision, card=card)
        size = sum(path.stat().st_size for path in Path(self.folder).iterdir())
        print_lines(f"{self.folder}: {size / 1e6:.2f} MB")
        return 0

    def _merged(self, saved: SavedPolicy) -> int:
        """Released weights with the adapters in them."""
        elsewhere = self.folder.startswith(HUB) or at_url(self.folder)
        if elsewhere or self.precision != "float32" or self.card is not None:
            raise DataError(
                f"folder is {self.folder!r}, precision {self.precision}: a policy with adapters is merged into a "
                "folder in float32, without --card; leave the options out, or publish its own folder as it is"
            )
        kept = export_merged(Path(self.folder), saved, jnp.dtype(jnp.float32))
        print_lines(f"{self.folder}: merged in float32, {kept:.1%} of the adapters' change kept")
        return 0


@dataclasses.dataclass(frozen=True, kw_only=True)
class DemoCommand(Places):
    """Open a page in the browser: choose a generated object or drop a video, and see touch, answer and trace.

    POLICY as for `ask`.  The page is served to this machine alone, until Ctrl-C.
    """

    policy: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="POLICY")] = ""
    port: int = 8766
    """Port of the page; 0 takes a free one."""
    open: bool = True
    """Open the browser, if there is one."""

    def run(self) -> int:
        """Serve until Ctrl-C and return the exit status."""
        policy = find_policy(self.policy, self.runs_dir)
        with demo_server(policy, self.port) as address:
            print_lines(f"{address}, Ctrl-C ends", "compiling, up to half a minute the first time")
            if self.open:
                webbrowser.open(address)
            ask_policy(policy, [read_touch("generated:0", policy.saved)])  # later answers of the page come at once
            print_lines("ready")
            with contextlib.suppress(KeyboardInterrupt):
                threading.Event().wait()
        return 0


def _is_input(name: str) -> bool:
    return name.startswith("generated") or Path(name).exists() or Path(name.rpartition(":")[0] or name).exists()


AskingCommand = (
    Annotated[AskCommand, tyro.conf.subcommand("ask")]
    | Annotated[ExportCommand, tyro.conf.subcommand("export")]
    | Annotated[DemoCommand, tyro.conf.subcommand("demo")]
)


def run_asking(arguments: Sequence[str]) -> int:
    """Run one of these commands; the exit status."""
    command = tyro.cli(AskingCommand, args=arguments, prog=PROG, config=(tyro.conf.OmitArgPrefixes,))
    try:
        require_possible(command)
    except ValueError as error:
        print_error(f"{type(error).__name__}: {error}")
        return 2
    compiled, exports = command.cache_dir / COMPILED, arguments[0] == "export"
    try:
        if not exports:
            require_memory({})
            make_folder(compiled, "cache-dir", command.cache_dir)
        with contextlib.nullcontext() if exports else compilations_kept(compiled):
            require_backend()
            return command.run()
    except FAILURES as error:
        print_error(f"{type(error).__name__}: {error}")
        return 1
