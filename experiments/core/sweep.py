"""A sweep: every combination of some options of one experiment, a run each, in a folder of runs with one page.

    FOLDER/{sweep.json, report.html, plots/, NAME/STAMP/…}

FOLDER is a folder of runs like any other: `list`, `compare` and `ask` take it.  The work is the list of `SweepUnit`s in
`sweep.json`.  Each is one command, done when FOLDER holds a finished run of its configuration, wherever it ran.
"""

import dataclasses
import functools
import hashlib
import itertools
import json
import os
import shlex
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import jax
import tyro

from experiments.core import runs
from experiments.core.artifacts import DamagedFileError, jsonable, read_json, write_sealed
from experiments.core.commands import PROG, SWEEP, find, print_error, print_lines, unknown_name
from experiments.core.compare import figures
from experiments.core.report import write_report
from experiments.core.results import Cell, Column, Estimate, Picture, Results, Table
from experiments.core.runner import Experiment, load, parse, run_experiment
from experiments.core.sweep_figures import chart, chosen_figures, number_of
from sensors_io.errors import UserError
from sensors_io.remote import at_url
from sensors_io.signals import exit_status
from sensors_io.units import HERE, Launcher, LauncherError, UnitsError, WorkUnit, finish
from touchr1_jax.bench.scoring import REPORTED

LIST = "sweep.json"  # units of a sweep, in its folder

FOLDERS = "sweeps"  # folder of the sweeps in the folder of all runs

DIGITS = 8  # of a hash in a name
NOTE = (
    "Scores are those of test objects.  They say how much a setting matters; a setting that was chosen by them must be "
    "scored on other objects."
)


class SweepError(UserError, ValueError):
    """Options that make no sweep; the message names the option, its value and the fix."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class SweepUnit:
    """One run of a sweep."""

    digest: str  # hash of scale and configuration, by which the run is found
    settings: Mapping[str, str]  # varied option → value
    command: tuple[str, ...]  # words of the command line after the name of the experiment
    home: Path  # folder of the runs that it becomes one of
    config: Any  # in JSON's types

    @property
    def directory(self) -> Path | None:
        """Directory of its newest finished run, else of its newest one, else `None`."""
        return runs.newest(self.home, self.config, finished=True) or runs.newest(self.home, self.config, finished=False)

    def finished(self) -> bool:
        """True if it has a finished run."""
        return runs.newest(self.home, self.config, finished=True) is not None

    @property
    def run(self) -> runs.PastRun | None:
        """Its run, if it has begun."""
        return None if self.directory is None else runs.read_run(self.directory)


@dataclasses.dataclass(frozen=True, kw_only=True)
class SweepCommand:
    """Run an experiment once for every combination of values, in a folder of runs with one page.

    All further options are those of the experiment.  The same command continues a sweep that was stopped; a finished
    run is not run again.
    """

    name: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="NAME")]  # an experiment
    vary: tyro.conf.UseAppendAction[tuple[str, ...]]
    """An option and its values, as in `--vary grpo.lr-scale=50,100,200`; once for each option that varies."""
    into: Path | None = None
    """Folder of the sweep; by default in RUNS_DIR/sweeps, named after the values.  With more values it grows."""
    figures: tuple[str, ...] = ()
    """Words in the names of the figures to show, as `compare` names them; by default the main ones."""
    runs_dir: Path = Path("runs")  # folder of all runs
    launcher: Annotated[Launcher, tyro.conf.arg(name="")] = HERE

    def run(self, rest: Sequence[str], package: str = "experiments") -> int:
        """Run the sweep and return the exit status; `rest` are options of the experiment."""
        entries = find(package)
        if self.name not in entries:
            print_error(unknown_name(self.name, entries))
            return 2
        experiment, about = load(self.name, package)
        try:
            folder, units = plan(experiment, about, self.vary, rest, self.runs_dir, self.into)
        except ValueError as error:  # also a configuration that refuses its own values
            print_error(f"{type(error).__name__}: {error}")
            return 2
        run = run_sweep if self.launcher.here else functools.partial(launch_sweep, self.launcher, package)
        try:
            folder.mkdir(parents=True, exist_ok=True)
            with runs.locked(folder, "give another folder by --into"):
                require_growth(folder, self.name, units)
                return run(experiment, about, folder, units, self.figures)
        except (SweepError, DamagedFileError, runs.RunInUse, OSError) as error:
            print_error(f"{type(error).__name__}: {error}")
            return 1


def main(arguments: Sequence[str], package: str = "experiments") -> int:
    """The command line after `sweep`, for the experiments of a package; returns the exit status."""
    prog = f"{PROG} {SWEEP}"
    try:
        command, rest = tyro.cli(SweepCommand, args=arguments, prog=prog, return_unknown_args=True)
    except LauncherError as error:
        print_error(f"{type(error).__name__}: {error}")
        return 2
    return command.run(rest, package)


def options_of(vary: Sequence[str]) -> dict[str, tuple[str, ...]]:
    """Option → its values, from words such as `grpo.lr_scale=50,100`; dashes and underscores are the same.

    `SweepError` for a word without an option and values, or an option named twice.
    """
    found: dict[str, tuple[str, ...]] = {}
    for word in vary:
        name, _, values = word.partition("=")
        name, listed = name.removeprefix("--").replace("_", "-"), tuple(v.strip() for v in values.split(","))
        if not name or not all(listed):
            raise SweepError(f"--vary is {word!r}: must be OPTION=VALUE,VALUE, as in grpo.lr-scale=50,100; correct it")
        if name in found:
            raise SweepError(f"--vary names {name} twice: give all of its values in one, with commas between them")
        found[name] = listed
    if not found:
        raise SweepError("no option varies: give at least one, as in --vary grpo.lr-scale=50,100")
    return found


def plan(
    experiment: Experiment[Any], about: str, vary: Sequence[str], rest: Sequence[str], runs_dir: Path, into: Path | None
) -> tuple[Path, tuple[SweepUnit, ...]]:
    """The folder of a sweep and its units, in the order of the values, the last option fastest.

    Args:
      vary: options and their values, as `options_of` takes them.
      rest: words of the command line for all runs.
      into: the folder; by default named after the units, so that the same sweep goes on in it.

    Raises:
      SweepError: as `options_of`; an option that a sweep gives itself, two units of one configuration, or no folder.
      SystemExit: code 2 after the correction of an option or a value that the experiment does not know.
    """
    varied, planned = options_of(vary), dict[str, tuple[dict[str, str], tuple[str, ...], Any]]()
    words = (*rest, *(f"--{option}" for option in varied))
    own = [word for word in words if word.partition("=")[0] in ("--fresh", "--runs-dir", "--runs_dir")]
    if own:
        raise SweepError(f"{own[0]} belongs to single runs: leave it out; --into names the folder of a sweep")
    for values in itertools.product(*varied.values()):
        settings = dict(zip(varied, values, strict=True))
        words = (*rest, *itertools.chain(*(_words(*one) for one in settings.items())))
        command = parse(experiment, words, about)
        config = jsonable(command.config, where="config")
        digest = hashlib.sha256(json.dumps([command.scale, config], sort_keys=True).encode()).hexdigest()[:DIGITS]
        if digest in planned:
            raise SweepError(f"{planned[digest][0]} and {settings} are one configuration: drop one")
        planned[digest] = settings, words, config
    name = f"{experiment.name}-{hashlib.sha256(''.join(sorted(planned)).encode()).hexdigest()[:DIGITS]}"
    folder = into or runs_dir / FOLDERS / name
    if at_url(folder) or (folder.exists() and not folder.is_dir()):
        raise SweepError(f"into is {folder}: must be a folder of this machine; name another by --into")
    return folder, tuple(
        SweepUnit(
            digest=digest,
            settings=settings,
            command=(*words, "--runs-dir", str(folder)),
            home=folder / experiment.name,
            config=config,
        )
        for digest, (settings, words, config) in planned.items()
    )


def _words(option: str, value: str) -> tuple[str, ...]:
    """An option and its value as words of a command line; true and false are flags."""
    if value.lower() not in ("true", "false"):
        return (f"--{option}", *value.split())
    group, dot, last = option.rpartition(".")
    return (f"--{option}" if value.lower() == "true" else f"--{group}{dot}no-{last}",)


def run_sweep(
    experiment: Experiment[Any], about: str, folder: Path, units: Sequence[SweepUnit], wanted: Sequence[str]
) -> int:
    """Run what is not finished, write the page after each run, and return the exit status: 1 if a run failed.

    A signal stops the sweep with the status of its run.  `wanted` are parts of the names of the figures to show.
    """
    scale, failed = _list_units(experiment, about, folder, units), 0
    for i, unit in enumerate(units):
        past, title = unit.run, _title_of(unit)
        if past is not None and past.state == "finished":
            print_lines(f"{i + 1} of {len(units)}, {title}: finished before, {past.directory}{_other_code(past)}")
            continue
        print_lines(f"{i + 1} of {len(units)}, {title}")
        try:
            status = run_experiment(experiment, unit.command, about)
            jax.clear_caches()  # programs of one configuration; those of all would fill the memory
            write_page(experiment.name, about, scale, folder, units, wanted)
        except KeyboardInterrupt as error:  # between two runs; a run handles the signal itself
            status = exit_status(error)
        if status > 1:
            print_lines("To continue the sweep, run the same command again.")
            return status
        failed += status
    print_lines(f"sweep: {write_page(experiment.name, about, scale, folder, units, wanted)}")
    return int(failed > 0)


def launch_sweep(
    launcher: Launcher,
    package: str,
    experiment: Experiment[Any],
    about: str,
    folder: Path,
    units: Sequence[SweepUnit],
    wanted: Sequence[str],
) -> int:
    """As `run_sweep`, by workers of an engine."""
    scale = _list_units(experiment, about, folder, units)
    run = functools.partial(_run_unit, experiment.name, package)
    named = lambda unit: f"{unit.digest} ({_title_of(unit)})"
    work = [WorkUnit(name=named(unit), run=functools.partial(run, unit), done=unit.finished) for unit in units]
    try:
        for ended, one in enumerate(finish(work, launcher, print_lines), 1):
            print_lines(f"{ended} of {len(units)} finished: {one.name}")
            write_page(experiment.name, about, scale, folder, units, wanted)
    except (LauncherError, UnitsError) as error:
        print_error(f"{type(error).__name__}: {error}")
        return 1
    except KeyboardInterrupt as error:
        print_lines("To continue the sweep, run the same command again.")
        return exit_status(error)
    print_lines(f"sweep: {write_page(experiment.name, about, scale, folder, units, wanted)}")
    return 0


def _run_unit(name: str, package: str, unit: SweepUnit) -> None:
    """Run or continue the run of a unit, in a worker."""
    experiment, about = load(name, package)
    until = time.monotonic() + 60  # the worker of a driver that was killed lives a moment longer
    while (run := unit.run) is not None and run.in_use and time.monotonic() < until:
        time.sleep(1)
    jax.clear_caches()  # of the unit before
    status = run_experiment(experiment, unit.command, about)
    if status > 128:  # a signal; what was done is saved, and the engine runs the unit again
        os._exit(status)
    if status:
        raise SweepError(f"{shlex.join(unit.command)} ended with status {status}: read its report in {unit.home}")


def _list_units(experiment: Experiment[Any], about: str, folder: Path, units: Sequence[SweepUnit]) -> str:
    """Write `sweep.json`; the scale of the runs."""
    scale: str = parse(experiment, units[0].command, about).scale
    listed = [{"hash": u.digest, "settings": u.settings, "command": u.command, "config": u.config} for u in units]
    write_sealed(folder / LIST, {"experiment": experiment.name, "scale": scale, "units": listed})
    return scale


def require_growth(folder: Path, name: str, units: Sequence[SweepUnit]) -> None:
    """Refuse a folder of another sweep, whose list and page this one would overwrite; it may only grow.

    Raises:
      SweepError: the folder lists units that this sweep lacks.
      DamagedFileError: its list is damaged.
    """
    path = folder / LIST
    if not path.is_file():
        return
    found = read_json(path)
    try:
        listed = {one["hash"]: (found["experiment"], _settings(one["settings"])) for one in found["units"]}
    except (LookupError, TypeError, AttributeError) as error:
        raise DamagedFileError(f"{path} is not that of a sweep ({error!r}): move it away to write it anew") from error
    lacking = [unit for digest, unit in listed.items() if digest not in {one.digest for one in units}]
    if lacking:
        raise SweepError(
            f"into is {folder}: its sweep of {lacking[0][0]} has {len(lacking)} runs that this one leaves out, the "
            f"first of {lacking[0][1]}; give all of its values, or another folder by --into"
        )


def _other_code(run: runs.PastRun) -> str:
    """Words about a finished run that other source files made; none where they are the same."""
    same = run.description.get("source", runs.code_digest()) == runs.code_digest()
    return "" if same else f"; other source files made it (code {run.code}): move it away to run it again"


def _title_of(unit: SweepUnit) -> str:
    return _settings(unit.settings)


def _settings(settings: Mapping[str, str]) -> str:
    return ", ".join(f"{name} {value}" for name, value in settings.items())


def write_page(
    name: str, about: str, scale: str, folder: Path, units: Sequence[SweepUnit], wanted: Sequence[str] = ()
) -> Path:
    """Write the page of a sweep: one table, a row for each run, and one chart; the path of the page."""
    every = [(unit, unit.run) for unit in units]
    finished = [(unit, run, figures(run.results)) for unit, run in every if run is not None and run.results is not None]
    chosen = chosen_figures([run.results or {} for _, run, _ in finished], wanted)
    pictures: tuple[Picture, ...] = ()
    if chosen and len(finished) > 1:
        content = chart([(unit.settings, of) for unit, _, of in finished], chosen)
        title = f"Figures over {next(iter(units[0].settings))}"
        pictures = (Picture(name="sweep", title=title, caption="Bars: 95 % intervals.", content=content),)
    results = Results(
        verdict=(f"{len(finished)} of {len(units)} runs are finished.",),
        tables=(_table(folder, every, chosen),),
        pictures=pictures,
    )
    varied = {option: list(dict.fromkeys(u.settings[option] for u in units)) for option in units[0].settings}
    description = {"experiment": f"{name}, a sweep", "scale": scale, "git": dataclasses.asdict(runs.revision())}
    return write_report(folder, results, about=about, description=description | {"varied": varied})


def _table(folder: Path, every: Sequence[tuple[SweepUnit, runs.PastRun | None]], chosen: Sequence[str]) -> Table:
    columns = [Column(name=option) for option in every[0][0].settings]
    for figure in chosen:
        arm, _, metric = figure.rpartition(" ")
        known = REPORTED.get(metric)
        named = {"name": figure, "format": ".4g"}
        if known is not None:
            named = {"name": f"{arm}: {known.title}", "unit": known.unit, "format": known.format}
        columns.append(Column(**named))
    columns += [Column(name="state"), Column(name="time", unit="s", format=",.0f")]
    columns += [Column(name="run", link="report.html")]
    rows: list[tuple[Cell, ...]] = []
    for unit, run in every:
        found = {} if run is None or run.results is None else figures(run.results)
        numbers = [number_of(found.get(figure)) for figure in chosen]
        cells = [one.mean if isinstance(one, Estimate) else one for one in numbers]
        state: tuple[Cell, ...] = ("not begun", None, None)
        if run is not None:
            state = (run.state, run.seconds, str(run.directory.relative_to(folder)))
        rows.append((*unit.settings.values(), *cells, *state))
    return Table(title="Runs", columns=tuple(columns), rows=tuple(rows), note=NOTE)
