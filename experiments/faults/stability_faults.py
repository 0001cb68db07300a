"""Does training that is killed, starved or fed nonsense end in the same bits, or say what is wrong?

    make experiment EXP=stability_faults [ARGS="--scale smoke"]

Four parts. Kills: training is ended by `kill -9` at random moments, a quarter of them while it starts and the others
spread over the whole run, and goes on until it is done; logs, answers and the final state of every stage are held bit
by bit to those of a run that nobody killed. Two victims, with networks so small that the loop
around a step is most of it: one run of a study's GRPO, whose session starts in seconds, killed 200 times, and a whole
study, supervised fine-tuning, GRPO and a baseline without touch, a few times. Damage: every file of a run that is about
to go on, in four ways. Bad input: some forty kinds through the public command lines. Waiting: the share of a step that
waits for data, at the sizes of the studies, on a CPU.

Cost: about 25 minutes on one core, most of it the 200 kills; `--scale smoke` about a minute and a half.

Expected: no difference in any bit; no end that is wrong; every bad input answered by name, place and way out; waits
below 2 % of a step.
"""

import dataclasses
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path

from experiments.core.context import Context
from experiments.core.progress import Advance
from experiments.core.results import Cell, Column, Picture, Requirement, Results, Table
from experiments.core.runner import Experiment
from experiments.faults.bad_input import provoke
from experiments.faults.bad_inputs import cases
from experiments.faults.damaged_files import OUTCOMES, WRONG, strike
from experiments.faults.data_waits import WaitingConfig, Waits, waits
from experiments.faults.digests import differences, digests
from experiments.faults.fixtures import unfinished_run
from experiments.faults.kill_charts import where_kills_struck
from experiments.faults.killable_session import PHASES, START, Kill, KillableTraining
from experiments.faults.kills import ALONE, Campaign, KillConfig, UndisturbedRun
from experiments.faults.trainings.small_grpo import EXPERIMENT as REINFORCING
from experiments.faults.trainings.small_study import EXPERIMENT as STUDY

MOST_WAITING = 0.02
"""Share of a step that may wait for data."""

KILLS = 200
"""Kills that training must survive."""

GRPO = "GRPO run"
"""Name of the victim that must survive them."""

CELL = 110
"""Characters of a message that a cell of a table shows."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class FaultsConfig:
    """Kills of both victims and their moments, steps of the GRPO run, files to damage, steps to time."""

    grpo: KillConfig = KillConfig(kills=KILLS)
    grpo_steps: int = 2000
    study: KillConfig = KillConfig(kills=10, startup_share=0.2)
    study_scale: str = "default"
    damaged_files: int | None = None
    """Most files to damage; all by default."""
    bad_inputs: int | None = None
    """Most bad inputs to try; all by default."""
    waiting: WaitingConfig = WaitingConfig()


@dataclasses.dataclass(frozen=True, kw_only=True)
class KilledRuns:
    """What became of one victim: its kills, the runs that they were spread over, and what differed at their ends."""

    kills: tuple[Kill, ...]
    runs: int
    differs: tuple[str, ...]


def run(config: FaultsConfig, context: Context) -> Results:
    """Kill, damage, feed nonsense, time."""
    victims = {GRPO: (_grpo(config.grpo_steps), config.grpo), "study": (_study(config.study_scale), config.study)}
    killed = {name: _killed(name, *each, context) for name, each in victims.items()}
    with tempfile.TemporaryDirectory(prefix="touchr1-faults-") as scratch:
        damage, outcomes = _damage(config, context, Path(scratch)), _bad_inputs(config, context, Path(scratch))
    waited = waits(config.waiting, context)
    return Results(
        verdict=_verdict(killed, damage, outcomes, waited),
        requirements=_requirements(killed, damage, outcomes, waited),
        tables=(_kill_table(killed), _damage_table(damage), _input_table(outcomes), _waiting_table(waited)),
        pictures=(
            Picture(
                name="stability_faults",
                title="Where the kills struck",
                caption="Left: the phase that the session was in, told by what it left on the disk.  Right: how much "
                "of the run had been logged by then.",
                content=where_kills_struck({name: each.kills for name, each in killed.items()}),
            ),
        ),
        settings={"kills": sum(len(k.kills) for k in killed.values()), "bad inputs": len(outcomes)},
    )


def _grpo(steps: int) -> KillableTraining:
    return KillableTraining(name=REINFORCING.name, options=("--steps", str(steps)), steps={"grpo": steps})


def _study(scale: str) -> KillableTraining:
    study = STUDY.configs()[scale]
    steps = {"sft": study.sft.steps, "grpo": study.grpo_steps, "blind": study.blind.steps}
    return KillableTraining(name=STUDY.name, options=("--scale", scale), steps=steps)


def _killed(name: str, victim: KillableTraining, config: KillConfig, context: Context) -> KilledRuns:
    """Runs of a victim until all kills have struck; a stopped session of this experiment goes on behind the last."""
    stage = f"kill/{victim.name}"
    campaign = Campaign(context.directory / "victims" / victim.name, context.cache_dir / "programs", victim, config)
    kills: list[Kill] = []
    differs: list[str] = []
    number = 0
    with context.progress(f"killing the {name}", config.kills, _struck_before(stage, context)) as advance:
        if not context.done(f"{stage}/{ALONE}"):
            context.save_stage(f"{stage}/{ALONE}", campaign.left_alone()._asdict())
        alone = UndisturbedRun(**context.load_stage(f"{stage}/{ALONE}"))
        while len(kills) < config.kills:
            here = f"{stage}/{number}"
            if not context.done(here):
                struck = _one_run(campaign, here, number, config.kills - len(kills), alone, context, advance)
                found = differences(alone.digests, digests(campaign.directory(str(number))))
                context.save_stage(here, {"kills": struck, "differs": found})
            kept = context.load_stage(here)
            kills += [Kill(**kill) for kill in kept["kills"]]
            differs += [f"run {number}: {what}" for what in kept["differs"]]
            number += 1
    return KilledRuns(kills=tuple(kills), runs=number, differs=tuple(differs))


def _struck_before(stage: str, context: Context) -> int:
    """Kills that struck a victim's runs in earlier sessions of this experiment."""
    number, before = 0, 0
    while context.done(here := f"{stage}/{number}"):
        before, number = before + len(context.load_stage(here)["kills"]), number + 1
    return before + (len(context.load_stage(f"{here}-struck")) if context.done(f"{here}-struck") else 0)


def _one_run(
    campaign: Campaign, here: str, number: int, kills: int, alone: UndisturbedRun, context: Context, advance: Advance
) -> tuple[Kill, ...]:
    """Kills of one run, each of which is kept at once."""
    stage = f"{here}-struck"
    before = [Kill(**kill) for kill in context.load_stage(stage)] if context.done(stage) else []

    def keep(struck: tuple[Kill, ...]) -> None:
        context.save_stage(stage, struck)
        advance()

    return campaign.killed(number, kills, alone, before=before, keep=keep)


def _damage(config: FaultsConfig, context: Context, scratch: Path) -> list[tuple[str, str, str, str]]:
    """File, way, outcome and message of every damaged file."""
    if not context.done("damage"):
        (scratch / "unfinished").mkdir()
        (scratch / "damaged").mkdir()
        _unfinished(scratch / "unfinished", context)
        found = strike(scratch / "unfinished", scratch / "damaged", context, config.damaged_files)
        struck = [(one.file, one.way, one.outcome, _first_error(one.said)) for one in found]
        context.save_stage("damage", struck)
    return [(file, way, outcome, said) for file, way, outcome, said in context.load_stage("damage")]


def _unfinished(folder: Path, context: Context) -> None:
    with context.progress("making a run to damage", 1, still=True) as advance:  # its output is caught
        unfinished_run(folder)
        advance()


def _bad_inputs(config: FaultsConfig, context: Context, scratch: Path) -> list[tuple[str, str, int, str, str]]:
    """Kind, name, exit code, message and faults of every bad input."""
    if not context.done("inputs"):
        _unfinished(scratch / "inputs", context)
        tried = cases(scratch / "inputs")[: config.bad_inputs]
        rows = []
        with context.progress("trying bad inputs", len(tried), still=True) as advance:
            for i, case in enumerate(tried):
                folder = scratch / f"case-{i}"
                folder.mkdir()
                found = provoke(case, folder)
                line = found.line.replace(str(folder), "…")
                rows.append((case.kind, case.name, found.code, line, ", ".join(found.faults)))
                advance()
        context.save_stage("inputs", rows)
    return [tuple(row) for row in context.load_stage("inputs")]


def _first_error(said: str) -> str:
    return next((line for line in said.splitlines() if "Error" in line or "is kept as damaged" in line), "")


Damages = Sequence[tuple[str, str, str, str]]
Inputs = Sequence[tuple[str, str, int, str, str]]


def _requirements(
    killed: Mapping[str, KilledRuns], damage: Damages, inputs: Inputs, waited: Waits
) -> tuple[Requirement, ...]:
    """Kills survived, ends that are wrong, inputs that are answered, waits."""
    differ = sum(len(k.differs) for k in killed.values())
    at_start = max(sum(k.phase == START for k in each.kills) / len(each.kills) for each in killed.values())
    answered = sum(not faults for *_, faults in inputs)
    wrong = sum(outcome == WRONG for _, _, outcome, _ in damage)
    return (
        Requirement(name="kills of the GRPO run", measured=len(killed[GRPO].kills), bound=KILLS, better="higher"),
        Requirement(name="runs that they were spread over", measured=killed[GRPO].runs, bound=1, better="lower"),
        Requirement(name="files that differ after them", measured=differ, bound=0, better="lower"),
        Requirement(
            name="share of kills at start-up", measured=at_start, bound=0.5, better="lower", note="the larger victim's"
        ),
        Requirement(name="damaged files with a wrong end", measured=wrong, bound=0, better="lower"),
        Requirement(name="kinds of bad input answered", measured=answered, bound=25, better="higher"),
        Requirement(
            name="kinds of bad input not answered", measured=len(inputs) - answered, bound=0, better="lower"
        ),
        *(
            Requirement(
                name=f"{stage}: share of a step that waits for data", measured=wait_s / steps_s, bound=MOST_WAITING,
                better="lower",
            )
            for stage, (steps_s, wait_s) in waited.items()
        ),
    )  # fmt: skip


def _verdict(killed: Mapping[str, KilledRuns], damage: Damages, inputs: Inputs, waited: Waits) -> tuple[str, ...]:
    ends = [
        f"the {name} was killed {len(k.kills)} times in {k.runs} run{'s' if k.runs > 1 else ''} and "
        + ("ended in the same bits" if not k.differs else f"differs in {', '.join(k.differs)}")
        for name, k in killed.items()
    ]
    counts = ", ".join(f"{sum(row[2] == o for row in damage)} {o}" for o in OUTCOMES)
    answered = sum(not faults for *_, faults in inputs)
    worst = max(wait_s / steps_s for steps_s, wait_s in waited.values())
    return (
        f"By kill -9 {'; '.join(ends)}.",
        f"Of {len(damage)} damaged files: {counts}.",
        f"Of {len(inputs)} kinds of bad input {answered} are answered by name, place and way out, with nothing lost.",
        f"At most {worst:.2%} of a training step waits for data.",
    )


def _kill_table(killed: Mapping[str, KilledRuns]) -> Table:
    rows: list[tuple[Cell, ...]] = []
    for name, each in killed.items():
        counts = [sum(k.phase == phase for k in each.kills) for phase in PHASES]
        torn = sum(k.torn for k in each.kills)
        rows.append((name, len(each.kills), each.runs, *counts, torn, len(each.differs)))
    return Table(
        title="Kills by what they struck",
        columns=(
            Column(name="victim"),
            Column(name="kills"),
            Column(name="runs", meaning="that they were spread over; each ended on its own after its last kill"),
            *(Column(name=phase) for phase in PHASES),
            Column(name="torn lines", meaning="kills that left half a line in the log"),
            Column(name="differences", meaning="from the run that nobody killed, in any bit"),
        ),
        rows=tuple(rows),
        note="Compared are metrics.jsonl, all answers, results, and step, iterator and every array of every stage.",
    )


def _damage_table(damage: Damages) -> Table:
    kinds = tuple(dict.fromkeys((file, way) for file, way, _, _ in damage))
    rows: list[tuple[Cell, ...]] = []
    for file, way in kinds:
        same = [row for row in damage if row[:2] == (file, way)]
        rows.append((f"{file}, {way}", *(sum(r[2] == o for r in same) for o in OUTCOMES), same[0][3][:CELL]))
    return Table(
        title="Damaged files of a run that goes on",
        columns=(Column(name="damage"), *(Column(name=o) for o in OUTCOMES), Column(name="said")),
        rows=tuple(rows),
        note="Of the newest of two checkpoints all files, and those of the run that its next session reads.",
    )


def _input_table(inputs: Inputs) -> Table:
    return Table(
        title="Bad inputs",
        columns=(
            Column(name="input"),
            Column(name="kind"),
            Column(name="exit code"),
            Column(name="answer"),
            Column(name="faults", meaning="what the answer lacks, and what was lost or left half-written"),
        ),
        rows=tuple((name, kind, code, line[:CELL], faults or "none") for kind, name, code, line, faults in inputs),
    )


def _waiting_table(waited: Waits) -> Table:
    return Table(
        title="Waiting for data, on a CPU",
        columns=(
            Column(name="stage"),
            Column(name="in steps", unit="s", format=".2f", meaning="after the first, which compiles"),
            Column(name="waiting", unit="s", format=".4f", meaning="the device idle, the next batch not there"),
            Column(name="share", unit="%", format=".3f"),
        ),
        rows=tuple((stage, steps_s, wait_s, 100 * wait_s / steps_s) for stage, (steps_s, wait_s) in waited.items()),
        note="In every run the same is kept in timing.json and printed at the end of each stage.",
    )


DEFAULT = FaultsConfig()
SMOKE = FaultsConfig(
    grpo=KillConfig(kills=3),
    grpo_steps=20,
    study=KillConfig(kills=1),
    study_scale="short",
    damaged_files=2,
    bad_inputs=30,
    waiting=WaitingConfig(steps=3),
)

EXPERIMENT = Experiment(name="stability_faults", config=DEFAULT, scales={"smoke": SMOKE}, run=run)
