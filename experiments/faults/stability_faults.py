"""Does training that is killed or reads damaged input end with bit-identical results or with a clear error?

    make experiment EXP=stability_faults [ARGS="--scale smoke"]

Kills: `kill -9` ends training at random moments, a quarter of them during start-up, and the run is continued until it
is finished; it is compared bit by bit with an undisturbed one.  The GRPO of a study is killed 200 times, a complete
study a few times, and at nine moments one of two studies that begin together on an empty cache; their networks are so
small that the loop takes most of the time of a step.  Damage: every file of an unfinished run, in four ways, and single
bits in all files of a study and its cache.  Bad input: about forty kinds through the public command lines.  Waiting:
the share of a step that waits for data, on a CPU.

Cost: 91 minutes in the recorded run on one core of a busy machine, most of it the 200 kills, with three pairs of
studies, two to four minutes each; `--scale smoke` eight minutes of one core where nothing is compiled yet.

Expected: no difference in any bit; no wrong result; for every bad input an error that names the place and the fix;
waits below 2 % of a step.
"""

import dataclasses
import tempfile
import textwrap
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np

from experiments.core.charts import Panel, Series, draw
from experiments.core.context import Context
from experiments.core.loops import STEPPING, WAITING
from experiments.core.results import Picture, Results, Table, at_least, at_most, named_table
from experiments.core.runner import Experiment
from experiments.encoder.pretrain import pretrain
from experiments.faults.bad_inputs import cases, provoke
from experiments.faults.damaged_files import OUTCOMES, WRONG, Damage, damage_each
from experiments.faults.digests import STATE, differences, digests
from experiments.faults.fixtures import unfinished_run
from experiments.faults.flipped_bits import RAW, READINGS, Flip, flip_bits, go_on_flipped
from experiments.faults.flipped_bits import WRONG as WRONG_READING
from experiments.faults.kills import (
    PHASES,
    START,
    UNDISTURBED,
    Campaign,
    Kill,
    KillableTraining,
    KillConfig,
    UndisturbedRun,
)
from experiments.faults.trainings.small_grpo import EXPERIMENT as SMALL_GRPO
from experiments.faults.trainings.small_study import EXPERIMENT as SMALL_STUDY
from experiments.study.scores import PUBLISHED
from experiments.study.seed import StudySeed
from experiments.study.stages import gather_evidence, make_arm, probe_features
from experiments.study.study import StudyConfig, open_study_data
from sensors_io.scenes.config import SceneConfig
from touchr1_jax.models.touch_policy import build_policy, with_lora
from touchr1_jax.training.loop import LoopConfig
from touchr1_jax.training.pretraining import PretrainConfig

MOST_WAITING = 0.02  # share of a step that may wait for data
KILLS = 200  # kills that training must survive
GRPO = "GRPO run"  # name of the training that must survive them
UNFINISHED = 0.7  # share of its log that a study has when bits of its files are flipped
CELL = 110  # characters of a message in a table
BLIND = 4  # steps without touch for each with it: they take a quarter of the time
InputRow = Mapping[str, Any]  # row of a bad input: input, kind, exit code, answer, faults (empty if there are none)
Waits = Mapping[str, tuple[float, float]]  # stage → seconds in steps, and those of them that waited for data


@dataclasses.dataclass(frozen=True, kw_only=True)
class WaitingConfig:
    """Steps of each stage, of which the first is not timed, and the objects that they are about."""

    steps: int = 16
    study: StudyConfig = StudyConfig(scenes=SceneConfig(objects=60, sites=1))
    dynamics: PretrainConfig = PretrainConfig()


@dataclasses.dataclass(frozen=True, kw_only=True)
class FaultsConfig:
    """Kills of the two trainings and their sizes, files and inputs to try at most (`None`: all), stages to time."""

    grpo: KillConfig = KillConfig(kills=KILLS)
    grpo_steps: int = 2000
    study: KillConfig = KillConfig(kills=10, startup_share=0.2)
    study_scale: Literal["default", "short"] = "default"
    shared: int = 9  # moments at which one of two studies that begin together on an empty cache is killed
    damaged_files: int | None = None
    flips: int = 1000
    """Bits flipped in the files of an unfinished and a finished study and their caches, of which each is read."""
    resumed_flips: int = 40  # of those that are found, the number of those with which the study goes on, each alone
    bad_inputs: int | None = None
    waiting: WaitingConfig = WaitingConfig()


@dataclasses.dataclass(frozen=True, kw_only=True)
class KilledRuns:
    """Kills of one training, the number of runs that they were spread over, and the differences at their ends."""

    kills: tuple[Kill, ...]
    runs: int
    differs: tuple[str, ...]


def run(config: FaultsConfig, context: Context) -> Results:
    """Kill, damage, feed nonsense, time."""
    study = SMALL_STUDY.configs()[config.study_scale]
    steps = {phase: getattr(study, phase).steps for phase in ("encoders", "sft", "decoder", "blind")}
    steps |= {"grpo": study.grpo_steps}
    grpo_options = ("--steps", str(config.grpo_steps))
    grpo = KillableTraining(name=SMALL_GRPO.name, options=grpo_options, steps={"grpo": config.grpo_steps})
    whole = KillableTraining(name=SMALL_STUDY.name, options=("--scale", config.study_scale), steps=steps)
    killed = {
        GRPO: kill_training(GRPO, grpo, config.grpo, context),
        "study": kill_training("study", whole, config.study, context),
        "studies that share a cache": kill_one_of_two(whole, config, context),
    }
    with tempfile.TemporaryDirectory(prefix="touchr1-faults-") as scratch:
        home = Path(scratch)
        damaged = context.once("damage", lambda: damage_files(config.damaged_files, context, home))
        flips, ends = flip_files(config, whole, context, home)
        inputs = context.once("inputs", lambda: try_inputs(config.bad_inputs, context, home))
    damage = [*(Damage(**one) for one in damaged), *ends]
    return report(killed, damage, flips, inputs, waits(config.waiting, context))


def kill_training(name: str, training: KillableTraining, config: KillConfig, context: Context) -> KilledRuns:
    """Runs of a training until all kills have struck; every run and every kill of an earlier session counts."""
    stage = f"kill/{training.name}"
    campaign, undisturbed = start_campaign(training, config, context)
    kills: list[Kill] = []
    differs: list[str] = []
    number = 0
    while len(kills) < config.kills:
        here, left = f"{stage}/{number}", config.kills - len(kills)
        if not context.done(here):
            struck = _strike(f"{here}-struck", f"killing the {name}", campaign, number, left, undisturbed, context)
            found = differences(undisturbed.digests, digests(campaign.directory(str(number))))
            context.save_stage(here, {"kills": struck, "differs": found})
        kept = context.load_stage(here)
        kills += [Kill(**kill) for kill in kept["kills"]]
        differs += [f"run {number}: {what}" for what in kept["differs"]]
        number += 1
    return KilledRuns(kills=tuple(kills), runs=number, differs=tuple(differs))


def start_campaign(training: KillableTraining, config: KillConfig, context: Context) -> tuple[Campaign, UndisturbedRun]:
    """The runs of a training, with the one that nobody kills."""
    home, programs = context.directory / "killed" / training.name, context.cache_dir / "programs"
    campaign = Campaign(home, programs, training, config)
    alone = context.once(f"kill/{training.name}/{UNDISTURBED}", lambda: campaign.run_undisturbed()._asdict())
    return campaign, UndisturbedRun(**alone)


def kill_one_of_two(training: KillableTraining, config: FaultsConfig, context: Context) -> KilledRuns:
    """Pairs of runs on one cache, of which one is killed; both count."""
    campaign, undisturbed = start_campaign(training, config.study, context)
    kills: list[Kill] = []
    differs: list[str] = []
    for i in context.each("killing one of two studies", range(config.shared), still=True):
        stage = f"kill/{training.name}/shared-{i}"
        if not context.done(stage):
            *directories, kill = campaign.run_two(f"shared-{i}", undisturbed, (i + 0.5) / config.shared)
            found = shared_differences([differences(undisturbed.digests, digests(each)) for each in directories])
            context.save_stage(stage, {"kills": [] if kill is None else [kill], "differs": found})
        kept = context.load_stage(stage)
        kills += [Kill(**kill) for kill in kept["kills"]]
        differs += [f"pair {i}: {what}" for what in kept["differs"]]
    return KilledRuns(kills=tuple(kills), runs=2 * config.shared, differs=tuple(differs))


def shared_differences(found: Sequence[Sequence[str]]) -> list[str]:
    """Differences of runs on one cache: all of logs, answers and results, and of states those that all runs have.

    A policy that one run trained is read from the cache by the others, which then lack its states.
    """
    in_all = set.intersection(*map(set, found))
    return [what for names in found for what in names if what in in_all or not what.startswith(STATE)]


def _strike(
    stage: str, title: str, campaign: Campaign, number: int, kills: int, undisturbed: UndisturbedRun, context: Context
) -> tuple[Kill, ...]:
    """Kills of one run, each of which is saved at once."""
    before = [Kill(**kill) for kill in context.load_stage(stage)] if context.done(stage) else []
    with context.progress(title, kills, len(before)) as advance:

        def keep(struck: tuple[Kill, ...]) -> None:
            context.save_stage(stage, struck)
            advance()

        return campaign.run_killed(number, kills, undisturbed, before=before, keep=keep)


def flip_files(
    config: FaultsConfig, training: KillableTraining, context: Context, scratch: Path
) -> tuple[list[Flip], list[Damage]]:
    """Every flipped bit of an unfinished and a finished study and their caches, and the ends of those that go on."""
    campaign, undisturbed = start_campaign(training, config.study, context)
    flips: list[Flip] = []
    ends: list[Damage] = []
    for seed, state in enumerate(("unfinished", "finished")):
        home = campaign.home / (UNDISTURBED if state == "finished" else state)
        if not context.done(f"flips/{state}"):
            if state == "unfinished":
                campaign.run_part(state, undisturbed, UNFINISHED)
            each = list(flip_bits(home, scratch, context, config.flips // 2, seed))
            context.save_stage(f"flips/{state}", each)
        found = [Flip(**one) for one in context.load_stage(f"flips/{state}")]
        if not context.done(f"flips/{state}-ends"):
            order = (undisturbed.digests, training, campaign.programs, scratch, context, config.resumed_flips // 2)
            context.save_stage(f"flips/{state}-ends", list(go_on_flipped(home, found, *order)))
        flips += found
        ends += [Damage(**one) for one in context.load_stage(f"flips/{state}-ends")]
    return flips, ends


def damage_files(most: int | None, context: Context, scratch: Path) -> list[Damage]:
    """Every damaged file and the end of its run."""
    unfinished, damaged = scratch / "unfinished", scratch / "damaged"
    unfinished.mkdir()
    damaged.mkdir()
    unfinished_run(unfinished)
    return list(damage_each(unfinished, damaged, context, most))


def try_inputs(most: int | None, context: Context, scratch: Path) -> list[InputRow]:
    """Every bad input and its answer."""
    unfinished_run(scratch / "inputs")
    rows: list[InputRow] = []
    tried = enumerate(cases(scratch / "inputs")[:most])
    for i, case in context.each("trying bad inputs", tried, still=True):  # the commands' output is captured
        folder = scratch / f"case-{i}"
        folder.mkdir()
        found = provoke(case, folder)
        answer = {"exit code": found.code, "answer": found.line.replace(str(folder), "…")}
        rows.append({"input": case.name, "kind": case.kind, **answer, "faults": ", ".join(found.faults)})
    return rows


def waits(config: WaitingConfig, context: Context) -> Waits:
    """Train each stage for some steps from where it is; a stage that is done is not timed again."""
    study, loop = config.study, LoopConfig(steps=config.steps, save_every=config.steps)
    data = open_study_data(study, context)
    policy = with_lora(build_policy(study.model, data.clip.sensors), study.lora)
    evidence = gather_evidence(data, probe_features(data, context), study.probe, context)
    seed = StudySeed(config=study, data=data, policy=policy, evidence=evidence, context=context, seed=0)
    some = lambda sft, steps: dataclasses.replace(sft, steps=steps, save_every=steps)
    params = seed.run_sft(some(study.sft, config.steps), "sft")
    arm = make_arm(policy, PUBLISHED, data.prior(), study.grpo, loop)
    seed.run_grpo(arm, "grpo/published", seed.contacts(params), params)
    seed.run_sft(some(study.blind, BLIND * config.steps), "blind", blind=True)
    pretraining = dataclasses.replace(config.dynamics, steps=config.steps, probe_every=config.steps)
    pretrain(pretraining, data.store, data.parts["sft"], data.clip, context, stage="dynamics/0", seed=0)
    times = context.timing()
    stages = ("sft/0", "grpo/published/0", "blind/0", "dynamics/0")
    return {stage: (times[f"{STEPPING}/{stage}"], times[f"{WAITING}/{stage}"]) for stage in stages}


def report(
    killed: Mapping[str, KilledRuns],
    damage: Sequence[Damage],
    flips: Sequence[Flip],
    inputs: Sequence[InputRow],
    waited: Waits,
) -> Results:
    """Kills survived, ends with damaged files, readings of flipped bits, inputs that are answered, waits."""
    at_start = max(sum(k.phase == START for k in each.kills) / len(each.kills) for each in killed.values())
    differs, answered = sum(len(k.differs) for k in killed.values()), sum(not row["faults"] for row in inputs)
    ends, readings = Counter(one.outcome for one in damage), Counter(one.reading for one in flips)
    kills = "; ".join(f"the {name}, {len(k.kills)} times, {len(k.differs)} differences" for name, k in killed.items())
    said = lambda counts, names: ", ".join(f"{counts[name]} {name}" for name in names)
    return Results(
        verdict=(
            f"Killed by SIGKILL and resumed: {kills}.",
            f"Of {len(damage)} damaged files: {said(ends, OUTCOMES)}.  Of {len(flips)} flipped bits: "
            f"{said(readings, READINGS)}.",
            f"For {answered} of {len(inputs)} kinds of bad input the error message names the place and a fix.",
        ),
        requirements=(
            at_least("kills of the GRPO run", len(killed[GRPO].kills), KILLS),
            at_most("runs that they were spread over", killed[GRPO].runs, 1),
            at_most("files that differ after them", differs, 0),
            at_most("share of kills at start-up", at_start, 0.5, note="of the training with the larger share"),
            at_most("damaged files with a wrong end", ends[WRONG], 0),
            at_most("flipped bits that read as something else", readings[WRONG_READING], 0),
            at_most("flipped bits that end in a raw error", readings[RAW], 0),
            at_least("kinds of bad input answered", answered, 25),
            at_most("kinds of bad input not answered", len(inputs) - answered, 0),
            *(
                at_most(f"{stage}: share of a step that waits for data", wait_s / steps_s, MOST_WAITING)
                for stage, (steps_s, wait_s) in waited.items()
            ),
        ),
        tables=(
            kill_table(killed),
            damage_table(damage),
            flip_table(flips),
            named_table(
                "Bad inputs",
                [{**row, "answer": shortened(row["answer"]), "faults": row["faults"] or "none"} for row in inputs],
                meanings={"faults": "what the answer lacks, and what was lost or left half-written"},
            ),
            waiting_table(waited),
        ),
        pictures=(kill_picture(killed),),
        settings={"kills": sum(len(k.kills) for k in killed.values()), "bad inputs": len(inputs)},
    )


def shortened(message: str) -> str:
    """A message for a table: whole words, and "…" for those that are left out."""
    return textwrap.shorten(message, CELL, placeholder=" …")


def kill_table(killed: Mapping[str, KilledRuns]) -> Table:
    """Kills by phase."""
    return named_table(
        "Kills by phase",
        [
            {"victim": name, "kills": len(each.kills), "runs": each.runs}
            | {phase: sum(k.phase == phase for k in each.kills) for phase in PHASES}
            | {"torn lines": sum(k.torn for k in each.kills), "differences": len(each.differs)}
            for name, each in killed.items()
        ],
        meanings={"torn lines": "kills that left half a line in the log", "differences": "from the undisturbed run"},
        note="Compared are metrics.jsonl, all answers, results, and step, iterator and every array of every stage.",
    )


def damage_table(damage: Sequence[Damage]) -> Table:
    """Ends by kind of file and damage, with the first message of each kind."""
    ends = Counter((f"{one.file}, {one.damage}", one.outcome) for one in damage)
    message = {f"{one.file}, {one.damage}": shortened(one.message) for one in reversed(damage)}
    return named_table(
        "Damaged files of a resumed run",
        [
            {"damage": kind, **{outcome: ends[kind, outcome] for outcome in OUTCOMES}, "message": message[kind]}
            for kind in dict.fromkeys(kind for kind, _ in ends)
        ],
        note="All files of the newer of two checkpoints, and those of the run that its next session reads.",
    )


def flip_table(flips: Sequence[Flip]) -> Table:
    """Readings by kind of file."""
    readings = Counter((one.file, one.reading) for one in flips)
    return named_table(
        "Flipped bits of an unfinished and a finished study and their caches",
        [
            {"file": file, **{reading: readings[file, reading] for reading in READINGS}}
            for file in sorted({one.file for one in flips})
        ],
        note="One random bit of a random file of a random kind; the file is read as a session reads it.",
    )


def waiting_table(waited: Waits) -> Table:
    """Waits of every stage."""
    return named_table(
        "Waiting for data, on a CPU",
        [
            {"stage": stage, "in steps": steps_s, "waiting": wait_s, "share": 100 * wait_s / steps_s}
            for stage, (steps_s, wait_s) in waited.items()
        ],
        formats={"in steps": ".2f", "waiting": ".4f", "share": ".3f"},
        units={"in steps": "s", "waiting": "s", "share": "%"},
        meanings={"in steps": "after the first, which compiles", "waiting": "device idle, the next batch not ready"},
    )


def kill_picture(killed: Mapping[str, KilledRuns]) -> Picture:
    """Kills by the share of the run's steps that were done."""
    edges = np.linspace(0, 100, 21)
    counts = {name: np.histogram([100 * k.done for k in each.kills], edges)[0] for name, each in killed.items()}
    panel = Panel(
        [Series(name, x=count[::-1], bar=True) for name, count in counts.items()],
        rows=[f"{low:.0f}–{low + 5:.0f}" for low in edges[-2::-1]],
        stacked=True,
        x_label="kills",
        title="steps of the run done, %",
    )
    return Picture(
        name="stability_faults",
        title="Kills over the run",
        caption="The share of the run that had been logged when each kill struck.",
        content=draw([panel]),
    )


DEFAULT = FaultsConfig()
SMOKE = FaultsConfig(
    grpo=KillConfig(kills=3), grpo_steps=20, study=KillConfig(kills=1), study_scale="short", shared=1,
    damaged_files=2, flips=100, resumed_flips=2, bad_inputs=30, waiting=WaitingConfig(steps=3),
)  # fmt: skip

EXPERIMENT = Experiment(name="stability_faults", config=DEFAULT, scales={"smoke": SMOKE}, run=run)
