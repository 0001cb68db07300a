"""Find an experiment, resolve its configuration, run or continue it, write its report.

    python -m experiments NAME [--scale smoke|default] [--fresh] [--tensorboard] [--wandb] [--distributed] [overrides]
    python -m experiments list | new | compare | sweep | show

An experiment is a module of this package.  It opens with a docstring, whose first line is the question, followed by the
command, the cost and the expected result, and it defines `EXPERIMENT`.
"""

import contextlib
import dataclasses
import errno
import functools
import importlib
import io
import itertools
import re
import shlex
import sys
import textwrap
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Generic, Literal, TypeVar

import tyro
from rich.console import Console

from experiments.core import numerics, runs, watchers
from experiments.core.artifacts import DamagedFileError, jsonable, make_folder, require_link, write_sealed
from experiments.core.commands import PROG, find, print_error, print_lines, run_command
from experiments.core.context import Context
from experiments.core.loops import alarm_tables, left_out_tables
from experiments.core.memory import require_memory
from experiments.core.metric_log import read_metrics
from experiments.core.remote_runs import run_at
from experiments.core.report import write_report
from experiments.core.results import Results
from experiments.core.sizes import require_sizes
from experiments.core.stopping import Stopped, Stopping
from experiments.core.text import MEANINGLESS, SMOKE, aligned
from sensors_io.errors import UserError
from sensors_io.remote import StoreError, at_url
from sensors_io.scenes.backend import require_backend
from sensors_io.units import HERE, Launcher, LauncherError
from touchr1_jax.distributed.companions import DifferentProcessesError, watched
from touchr1_jax.distributed.processes import (
    Accelerators,
    Launch,
    MachineError,
    ProcessesNotFoundError,
    ProcessGroup,
    join_processes,
    require_accelerators,
    require_common_folders,
    select_devices,
)
from touchr1_jax.models.layers import SizeError
from touchr1_jax.models.load import WeightsError
from touchr1_jax.rewards import RewardError
from touchr1_jax.rl.served import RolloutError
from touchr1_jax.rl.stream_check import StreamError
from touchr1_jax.training.checkpoint import CheckpointError
from touchr1_jax.training.compilation import compilations_kept, compiled_quickly
from touchr1_jax.training.loop import NonFiniteGradientError
from touchr1_jax.training.questions import NoLabelsError

EVENTS = "events"  # folder of a run that holds its TensorBoard events

HELP_ALL = "--help-all"

FIRST = ("scale", "fresh", "seeds", "data", "data-dir", "scenes.objects", "recipe", "grpo-steps", "grpo.lr-scale")
"""Options that help shows first, where an experiment has them; then come the experiment's own."""

OF_RUNNER = (
    "tensorboard",
    "wandb",
    "runs-dir",
    "cache-dir",
    "distributed",
    "coordinator",
    "processes",
    "process",
    "launcher",
)
"""Options of every experiment."""

MOST_OPTIONS, MOST_LETTERS = 10, 70  # of short help: options, and letters about a group

COMPILED = "compiled"  # folder of the cache for compiled programs, which later runs of the same shapes reuse

KNOWN_ERRORS = (
    runs.RunInUse,
    UserError,
    CheckpointError,
    NonFiniteGradientError,
    NoLabelsError,
    DamagedFileError,
    ProcessesNotFoundError,
    DifferentProcessesError,
    MachineError,
    RewardError,
    RolloutError,
    SizeError,
    StreamError,
    WeightsError,
    OSError,
)
"""Errors whose message is all that a user needs; others come with their traceback."""

C = TypeVar("C")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Experiment(Generic[C]):
    """A question, and the code that answers it."""

    name: str  # the name of its module
    config: C  # the default configuration, a frozen keyword-only dataclass
    run: Callable[[C, Context], Results]
    """Computes the results; it skips stages for which `Context.done` is true and continues from checkpoints."""
    scales: Mapping[str, C] = dataclasses.field(default_factory=dict)
    """Further configurations by name, `smoke` for one that takes under two minutes."""
    curves: Mapping[str, tuple[str, ...]] = dataclasses.field(default_factory=dict)
    """Phase → scalars to draw; of a phase that is not named all, the first few while it runs."""
    needs: Mapping[str, Accelerators] = dataclasses.field(default_factory=dict)
    """Scale → accelerators that it needs; a scale that is not named runs on any machine."""
    quick: tuple[str, ...] = ()  # scales whose programs run so few times that they are compiled quickly
    spreads: bool = False  # whether its training runs on the devices of all processes; others use one device

    def __post_init__(self) -> None:
        if "default" in self.scales:
            raise ValueError(f"scales of {self.name} holds 'default': that name means `config`; rename the scale")
        for scale, config in self.configs().items():
            if not dataclasses.is_dataclass(config) or type(config) is not type(self.config):
                raise ValueError(
                    f"scale {scale!r} of {self.name} is {config!r}: every scale must be an instance of one dataclass; "
                    "make it with dataclasses.replace from the default"
                )

        for field, named in (("needs", self.needs), ("quick", self.quick)):
            unknown = sorted(set(named) - set(self.configs()))
            if unknown:
                raise ValueError(f"{field} of {self.name} names {unknown}: must be scales; rename or drop them")

    def configs(self) -> dict[str, C]:
        """Every scale's configuration."""
        return {"default": self.config, **self.scales}


def main(arguments: Sequence[str] | None = None, package: str = "experiments") -> int:
    """The command line, by default the process's, for the experiments of a package; returns the exit code."""
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    status = run_command(arguments, package)
    return run(arguments, package) if status is None else status


def run(arguments: Sequence[str], package: str = "experiments") -> int:
    """Run or continue the experiment that the first argument names; returns the exit code."""
    name, *rest = arguments
    experiment, about = load(name, package)
    return run_experiment(experiment, rest, about)


def load(name: str, package: str = "experiments") -> tuple[Experiment[Any], str]:
    """An experiment of a package and its docstring."""
    module = importlib.import_module(find(package)[name].module)
    if module.EXPERIMENT.name != name:
        raise ValueError(
            f"{module.__name__} names its experiment {module.EXPERIMENT.name!r}: must be {name!r}; rename it"
        )
    return module.EXPERIMENT, module.__doc__ or name


def run_experiment(experiment: Experiment[Any], arguments: Sequence[str], about: str) -> int:
    """Run or continue an experiment, whose docstring is `about`; returns the exit code, 128 + n after signal n."""
    try:
        command = parse(experiment, arguments, about)
        jsonable(command.config, where="config")
    except (ValueError, LauncherError) as error:  # a configuration refuses its own values, or one is not finite
        print_error(f"{type(error).__name__}: {error}")
        return 2
    if why := _refusal(experiment, command):
        print_error(why)
        return 2
    typed = shlex.join([*PROG.split(), experiment.name, *arguments])
    execute = lambda folder: _execute(experiment, dataclasses.replace(command, runs_dir=folder), about, typed)
    with compiled_quickly() if command.scale in experiment.quick else contextlib.nullcontext():
        if not at_url(command.runs_dir):
            return execute(command.runs_dir)
        try:
            return run_at(str(command.runs_dir), experiment.name, execute)
        except StoreError as error:
            print_error(f"StoreError: {error}")
            return 1


def _refusal(experiment: Experiment[Any], command: Any) -> str:
    """The reason why a command cannot run, and the fix; empty if it can."""
    if at_url(command.runs_dir) and command.launch.distributed:
        return f"runs-dir is {command.runs_dir}: must be a folder that all processes share with --distributed; name one"
    if not experiment.spreads and (command.launch != Launch() or command.launcher != HERE):
        return f"{experiment.name} runs in one process on one device; leave --distributed, --mesh, --launcher out"
    if command.launch.distributed and command.launcher != HERE:
        return "--distributed and --launcher both spread the run: leave one out"
    return next(filter(None, (watchers.missing(flag) for flag in watchers.PACKAGES if getattr(command, flag))), "")


def parse(experiment: Experiment[Any], arguments: Sequence[str], about: str) -> Any:
    """Resolve the command line: the runner's options and the overridden `.config`.

    The scale is picked out first, since it chooses the defaults that everything else overrides, and choices such as
    `grpo.algorithm:dapo` are, since their options may stand anywhere; tyro refuses unknown ones.

    Raises:
      SystemExit: code 2 after the correction of a typo, 0 after help.
      ValueError: a number that no scale has; what a class refuses itself.
    """
    arguments = sorted(arguments, key=lambda word: not _chooses(word, experiment.config))
    configs, scale = experiment.configs(), "default"
    for flag, value in itertools.pairwise([*arguments, ""]):
        named = value if flag == "--scale" else flag.removeprefix("--scale=")
        if flag.startswith("--scale") and named in configs:
            scale = named
    events = f"Also write TensorBoard events: `tensorboard --logdir runs/NAME/latest/{EVENTS}`."
    command = dataclasses.make_dataclass(
        "Command",
        [
            ("scale", Annotated[Literal[*configs], tyro.conf.arg(help="Set of defaults.")], scale),
            ("fresh", Annotated[bool, tyro.conf.arg(help="Start a new run though an unfinished one exists.")], False),
            ("tensorboard", Annotated[bool, tyro.conf.arg(help=events)], False),
            ("wandb", Annotated[bool, tyro.conf.arg(help="Also send every figure to Weights & Biases.")], False),
            (
                "runs_dir",
                Annotated[Path, tyro.conf.arg(help="Folder of all runs, or a URL such as s3://bucket/runs.")],
                Path("runs"),
            ),
            ("cache_dir", Annotated[Path, tyro.conf.arg(help="Folder of data and compiled programs.")], Path("data")),
            ("launch", Annotated[Launch, tyro.conf.arg(name="")], Launch()),
            ("launcher", Annotated[Launcher, tyro.conf.arg(name="")], HERE),
            ("config", Annotated[type(experiment.config), tyro.conf.arg(name="")], configs[scale]),
        ],
        kw_only=True,
        frozen=True,
    )
    options: dict[str, Any] = {"default": command(), "prog": f"{PROG} {experiment.name}", "description": about}
    options["config"] = (tyro.conf.CascadeSubcommandArgs,)
    if not {"-h", "--help", HELP_ALL} & set(arguments):
        found = tyro.cli(command, args=arguments, **options)
        require_sizes(found.config, configs.values())
        return found
    asked = ["--help" if word == HELP_ALL else word for word in arguments]
    written = io.TextIOWrapper(io.BytesIO(), "utf-8")  # where tyro draws the boxes that `short_help` reads
    with contextlib.redirect_stdout(written), contextlib.suppress(SystemExit):
        tyro.cli(command, args=asked, **options)
    written.seek(0)
    text = written.read()
    print_lines(text if HELP_ALL in arguments else short_help(text))
    raise SystemExit(0)


def _chooses(word: str, config: Any) -> bool:
    """True of a word that chooses the kind of a part of the configuration, such as `grpo.algorithm:dapo`."""
    path, colon, _ = word.partition(":")
    part = functools.reduce(lambda tree, name: getattr(tree, name.replace("-", "_"), None), path.split("."), config)
    return bool(colon) and dataclasses.is_dataclass(part)


def short_help(text: str) -> str:
    """Tyro's help with `MOST_OPTIONS` options, those of `FIRST`, then the experiment's own; the others are counted."""
    before, *rest = re.split(r"^╭─ (.+?)(?: options)? ─*╮\n", text, flags=re.MULTILINE)
    entries, groups = dict[str, str](), dict[str, tuple[str, str]]()
    for title, panel in zip(rest[::2], rest[1::2], strict=True):
        lines = [line[2:-1].rstrip() for line in panel.splitlines() if line.startswith("│")]
        rule = next((i for i, line in enumerate(lines) if set(line) == {"─"}), -1)
        found = re.findall(r"^--([\w.-]+)((?:.|\n(?!-))*)", "\n".join(lines[rule + 1 :]), flags=re.MULTILINE)
        entries |= {name: f"--{name}{more.rstrip()}" for name, more in found}
        if found and title != "options":
            sentence = " ".join(lines[: max(rule, 0)]).partition(". ")[0].rstrip(".")
            groups[f"--{title}.…"] = str(len(found)), textwrap.shorten(sentence, MOST_LETTERS, placeholder=" …")
    own = [name for name in entries if "." not in name and name not in OF_RUNNER]
    chosen = [name for name in dict.fromkeys((*FIRST, *own)) if name in entries][:MOST_OPTIONS]
    left = ", ".join(f"--{name}" for name in entries if "." not in name and name not in chosen)
    further = aligned([("others", str(left.count("--")), left), *((title, *of) for title, of in groups.items())])
    head = "Options that matter first:"
    return "\n".join((before.rstrip(), "", head, *(entries[n] for n in chosen), "", f"More, with {HELP_ALL}:", further))


def _execute(experiment: Experiment[Any], command: Any, about: str, typed: str) -> int:
    stopping, directory = Stopping(), None

    def fate() -> str:
        if directory is not None and runs.is_finished(directory):
            return f"The run is finished: {directory}"
        return f"Everything so far is in {directory}. To continue: {runs.continuing(typed)}"

    try:
        numerics.require_supported()
        require_memory({})
        make_folder(command.cache_dir / COMPILED, "cache-dir", command.cache_dir)
        processes = join_processes(command.launch, command.cache_dir / COMPILED)
        common = {"experiment": experiment.name, "config": jsonable(command.config), "code": runs.code_digest()}
        common |= {"processes": processes.count, "versions": runs.versions(), "fresh": command.fresh}
        common |= {"settings": numerics.settings(), "mesh": jsonable(command.launch.mesh)}
        with watched(processes.count, processes.index, common, fate):
            require_backend()
            require_accelerators(command.scale, experiment.needs.get(command.scale))
            processes = processes.numbered_by_devices()
            chosen, resumed = processes.broadcast(lambda: _directory(experiment, command, typed))
            directory = Path(chosen)
            require_common_folders(command.launch, processes, directory, command.cache_dir / COMPILED)
            lock = runs.locked(directory) if processes.writes else contextlib.nullcontext()
            with stopping.listening(), lock, compilations_kept(command.cache_dir / COMPILED):
                if processes.writes:
                    _announce(directory, resumed)
                _compute(experiment, command, directory, about, stopping, processes)
    except KNOWN_ERRORS as error:
        message = f"{type(error).__name__}: {error}"
        if isinstance(error, OSError) and error.errno == errno.ENOSPC:  # libraries do not say of which disk
            message += f": free some space on the disks of {command.runs_dir} and {command.cache_dir}, then continue"
        print_error(message if directory is None else f"{message}\n{fate()}")  # standard output may be on the full disk
        return 1
    except Stopped as stopped:
        print_lines(f"\nStopped by {stopped}. {fate()}")
        return 128 + stopped.number
    return 0


def _directory(experiment: Experiment[Any], command: Any, typed: str) -> tuple[str, bool]:
    """The run's directory, and whether it is that of an unfinished run."""
    config = jsonable(command.config, where="config")
    home = command.runs_dir / experiment.name
    require_link(home / runs.LATEST)  # a copy of a folder of runs may have a folder there
    unfinished = None if command.fresh else runs.newest(home, config, finished=False)
    if unfinished is not None:
        numerics.require_same(runs.read_description(unfinished).get("settings"), unfinished)
        return str(unfinished), True
    here: dict[str, Any] = {"settings": numerics.settings(), "devices": numerics.machine()}
    return str(runs.create(home, runs.describe(experiment.name, command.scale, config, typed, **here))), False


def _announce(directory: Path, resumed: bool) -> None:
    """Print whether the run is new, the path of its page, and a note if the code has changed since it began."""
    print_lines(f"continuing {directory} (--fresh starts a new run)" if resumed else f"new run {directory}")
    print_lines(f"to watch: {directory / 'report.html'}")
    if not resumed:
        return
    description = runs.read_description(directory)
    began, now = runs.Revision(**description["git"]), runs.revision()
    if began != now:
        print_lines(f"note: this run began at {began}, the code is now at {now}")
    elif description.get("source", runs.code_digest()) != runs.code_digest():  # changes that no commit holds
        print_lines(f"note: source files changed since this run began; the commit is still {now}")
    for field, here in (("versions", runs.versions()), ("machine", numerics.machine())):
        before = {name: description.get(field, {}).get(name, value) for name, value in here.items()}
        for change in numerics.changed(before, here):
            print_lines(f"note: since this run began, {change}")


def _compute(
    experiment: Experiment[Any], command: Any, directory: Path, about: str, stopping: Stopping, processes: ProcessGroup
) -> None:
    """Compute and, in the process that writes, publish; an error that ends the run is shown on its page."""
    devices = select_devices(command.launch)
    make_context = functools.partial(
        Context,
        directory,
        command.cache_dir,
        stopping=stopping,
        processes=processes,
        devices=devices,
        launcher=command.launcher,
    )
    if not processes.writes:
        with contextlib.closing(make_context(Console(quiet=True))) as context:
            experiment.run(command.config, context)
        return
    description = runs.read_description(directory)
    usual_s = watchers.usual_seconds(directory.parent, description["config"])
    page = watchers.LivePage(directory, about=about, description=description, curves=experiment.curves, usual_s=usual_s)
    try:
        events: list[watchers.Watcher] = [watchers.Events(directory / EVENTS)] if command.tensorboard else []
        events += [watchers.WeightsAndBiases(directory, description)] if command.wandb else []
        context = make_context(Console(emoji=False), [watchers.Latest(directory), page, *events])
        with contextlib.closing(context), context.timed("total"), page.kept_fresh():
            context.require_log()
            results = experiment.run(command.config, context)
            context.require_in_place()
        logged = [*read_metrics(directory)]
        tables = (*results.tables, *left_out_tables(logged), *alarm_tables(logged))
        timing, drawn = {**context.timing(), **results.timing}, {**experiment.curves, **results.curves}
        results = dataclasses.replace(results, timing=timing, tables=tables, curves=drawn)
        report = write_report(directory, results, about=about, description=description)
        write_sealed(directory / "results.json", results.to_json(description))  # last: it marks the run as finished
        runs.point_latest(directory)  # of a run without a loop or a line
    except BaseException as error:
        with contextlib.suppress(Exception):  # of the page must not hide what ended the run
            if not runs.is_finished(directory):  # else its page is the report
                page.end(error)
        raise
    print_lines(f"report: {report}", *(results.verdict if command.scale != SMOKE else (f"{MEANINGLESS}.",)))
