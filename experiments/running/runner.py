"""Find an experiment, resolve its configuration, run or continue it, write its report.

    python -m experiments NAME [--scale smoke|default] [--fresh] [overrides]
    python -m experiments list | new | compare

An experiment is a module of this package.  It opens with a docstring, whose first line is the question, followed by the
command, the cost and the expected result, and it defines `EXPERIMENT`.
"""

import contextlib
import dataclasses
import importlib
import itertools
import shlex
import signal
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from types import FrameType
from typing import Annotated, Any, Generic, Literal, TypeVar

import tyro
from rich.console import Console

from experiments.reporting.findings import Findings
from experiments.reporting.report import write_report
from experiments.reporting.report_findings import write_findings
from experiments.reporting.results import Results
from experiments.running import runs
from experiments.running.artifacts import jsonable, read_json, write_json
from experiments.running.catalogue import find, listing
from experiments.running.commands import COMMANDS, PROG, complain, run_command, say, unknown
from experiments.running.context import Context
from touchr1_jax.training.compilation import compilations_kept

USAGE = f"""usage: {PROG} NAME [--scale smoke|default] [--fresh] [overrides]
       {PROG} list [NAME]            what ran, its cost, its result
       {PROG} new NAME [--reward]    a template that runs
       {PROG} compare RUN_A RUN_B    two runs, figure by figure
"""

COMPILED = "compiled"
"""Folder of the cache that holds compiled programs, so that a run like an earlier one compiles next to nothing."""

C = TypeVar("C")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Experiment(Generic[C]):
    """A question, and the code that answers it.

    Args:
      name: the name of its module.
      config: the default configuration, a frozen keyword-only dataclass.
      run: computes results (trained arms) or findings (measurements); it must skip the stages that `Context.done` names
        and continue from checkpoints.
      scales: further configurations by name, `smoke` for one that takes under two minutes.
    """

    name: str
    config: C
    run: Callable[[C, Context], Results | Findings]
    scales: Mapping[str, C] = dataclasses.field(default_factory=dict)

    def __post_init__(self) -> None:
        if "default" in self.scales:
            raise ValueError(f"scales of {self.name} holds 'default': that name means `config`; rename the scale")
        for scale, config in self.configs().items():
            if not dataclasses.is_dataclass(config) or type(config) is not type(self.config):
                raise ValueError(
                    f"scale {scale!r} of {self.name} is {config!r}: every scale must be an instance of one dataclass; "
                    "make it with dataclasses.replace from the default"
                )

    def configs(self) -> dict[str, C]:
        """Every scale's configuration."""
        return {"default": self.config, **self.scales}


class Stopped(BaseException):
    """A signal asked the run to stop; no `except Exception` may swallow it."""

    def __init__(self, number: int) -> None:
        super().__init__(signal.Signals(number).name)
        self.number = number


def main(arguments: Sequence[str] | None = None, package: str = "experiments") -> int:
    """The command line; returns the exit code.

    Args:
      arguments: those after the program's name, by default the process's.
      package: the package to find experiments in.
    """
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    if arguments and arguments[0] in COMMANDS:
        return run_command(arguments, package)
    questions = find(package)
    if not arguments or arguments[0] in ("-h", "--help"):
        say(USAGE, listing(questions))
        return 0 if arguments else 2
    name, *rest = arguments
    if name not in questions:
        complain(f"{unknown(name, questions)}\n{listing(questions)}")
        return 2
    module = importlib.import_module(f"{package}.{name}")
    if module.EXPERIMENT.name != name:
        raise ValueError(
            f"{package}.{name} names its experiment {module.EXPERIMENT.name!r}: must be {name!r}; rename it"
        )
    command = parse(module.EXPERIMENT, rest, module.__doc__ or name)
    return execute(module.EXPERIMENT, command, module.__doc__ or name, shlex.join([*PROG.split(), *arguments]))


def parse(experiment: Experiment[Any], arguments: Sequence[str], about: str) -> Any:
    """Resolve the command line: `.scale`, `.fresh`, `.runs_dir`, `.cache_dir` and the overridden `.config`.

    The scale is picked out first, since it chooses the defaults that everything else overrides.

    Raises:
      SystemExit: code 2 after an answer to a typo, 0 after help.
    """
    configs = experiment.configs()
    command = dataclasses.make_dataclass(
        "Command",
        [
            ("scale", Annotated[Literal[*configs], tyro.conf.arg(help="Whose defaults to start from.")]),
            ("fresh", Annotated[bool, tyro.conf.arg(help="Start anew beside an unfinished run.")]),
            ("runs_dir", Annotated[Path, tyro.conf.arg(help="Where runs are kept.")]),
            ("cache_dir", Annotated[Path, tyro.conf.arg(help="Where data and compiled programs are kept.")]),
            ("config", Annotated[type(experiment.config), tyro.conf.arg(name="")]),
        ],
        kw_only=True,
        frozen=True,
    )
    scale = _scale(arguments, configs)
    default = command(scale=scale, fresh=False, runs_dir=Path("runs"), cache_dir=Path("data"), config=configs[scale])
    prog = f"{PROG} {experiment.name}"
    return tyro.cli(command, args=arguments, default=default, prog=prog, description=about)


def execute(experiment: Experiment[Any], command: Any, about: str, typed: str) -> int:
    """Run or continue an experiment; returns the exit code, 128 + n after signal n."""
    console = Console()
    config = jsonable(command.config, where="config")
    home = command.runs_dir / experiment.name
    directory = None if command.fresh else runs.newest_unfinished(home, config)
    resumed = directory is not None
    if directory is None:
        directory = runs.create(home, runs.describe(experiment.name, command.scale, config, typed))
    try:
        with _signals(), runs.locked(directory), compilations_kept(command.cache_dir / COMPILED):
            runs.point_latest(directory)
            _announce(console, directory, resumed)
            _run(experiment, command.config, Context(directory, command.cache_dir, console), about)
    except runs.RunInUse as error:
        complain(str(error))
        return 1
    except Stopped as stopped:
        say(f"\nStopped by {stopped}. Everything so far is in {directory}. To go on: {runs.go_on(typed)}")
        return 128 + stopped.number
    return 0


def _run(experiment: Experiment[Any], config: Any, context: Context, about: str) -> None:
    """Compute, then publish the report and, last, `results.json`, which marks the run as finished."""
    with contextlib.closing(context), context.timed("total"):
        results = experiment.run(config, context)
    description = read_json(context.directory / "config.json")
    results = dataclasses.replace(results, timing={**context.timing(), **results.timing})
    if isinstance(results, Findings):
        report = write_findings(context.directory, results, about=about, description=description)
    else:
        report = write_report(context.directory, results, about=about, description=description)
    write_json(context.directory / "results.json", results.to_json(description))
    context.say(f"report: {report}")
    for sentence in results.verdict:
        context.say(sentence)


def _announce(console: Console, directory: Path, resumed: bool) -> None:
    """Say which of the two happens, and whether the code changed meanwhile."""
    say(f"continuing {directory} (--fresh starts anew)" if resumed else f"new run {directory}")
    began, now = read_json(directory / "config.json")["git"], dataclasses.asdict(runs.revision())
    if resumed and began != now:
        say(f"note: this run began at {runs.Revision(**began)}, the code is now at {runs.Revision(**now)}")


@contextlib.contextmanager
def _signals() -> Iterator[None]:
    """Turn the first SIGINT or SIGTERM into `Stopped`; a second one acts as if nobody listened."""
    numbers = (signal.SIGINT, signal.SIGTERM)

    def stop(number: int, frame: FrameType | None) -> None:
        for n in numbers:
            signal.signal(n, signal.SIG_DFL)
        raise Stopped(number)

    before = {n: signal.signal(n, stop) for n in numbers}
    try:
        yield
    finally:
        for n, handler in before.items():
            signal.signal(n, handler)


def _scale(arguments: Sequence[str], configs: Mapping[str, Any]) -> str:
    """The scale that the arguments name; `default` where they name none or an unknown one, which tyro then answers."""
    named = "default"
    for flag, value in itertools.pairwise([*arguments, ""]):
        if flag == "--scale":
            named = value
        elif flag.startswith("--scale="):
            named = flag.removeprefix("--scale=")
    return named if named in configs else "default"
