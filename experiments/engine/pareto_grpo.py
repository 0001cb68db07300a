"""Which algorithm and group size reach a set score in the least time, and what does a step of each cost?

    make experiment EXP=pareto_grpo [ARGS="--scale smoke"]

Every preset at every group size learns to write low token ids (see `experiments.engine.job`) from the same decoder and
prompts at one learning rate, with a fixed number of rollouts and of steps: a larger group has fewer prompts.  The
score is the mean reward over the last tenth of the steps; the target is reached where the mean reward of a step first
passes it.  Time is the median step of that program, measured in rounds with all other programs, times the steps taken,
so that neither compilation nor a busy machine counts.

Cost: about ten minutes on one core, most of it compiling for the first time; `--scale smoke` under one.

Expected: on policy all clipped surrogates have the same gradient, so that presets differ by how they average and weigh:
Dr. GRPO and the token means coincide with GRPO up to scale where all completions have one length; dynamic sampling pays
twice the rollouts for groups that differ anyhow; the controls of `stable` cost time and bring nothing to a task
without touch.
"""

import dataclasses
import itertools
from collections.abc import Mapping

import jax
import numpy as np

from experiments.core.context import Context
from experiments.core.progress import Advance
from experiments.core.results import Cell, Column, Picture, Results, Table
from experiments.core.runner import Experiment
from experiments.core.timing import interleaved
from experiments.engine.job import Job
from experiments.engine.pareto_charts import Key, LearningCurves, cost_and_gain, reward_over_time
from experiments.engine.size import JobSize
from touchr1_jax.rl.config import AnyAlgorithm, Cispo, Dapo, DrGrpo, GRPOConfig, Gspo, Paper, Stable

ALGORITHMS: Mapping[str, AnyAlgorithm] = {
    "paper": Paper(),
    "stable": Stable(),
    "DAPO": Dapo(),
    "Dr. GRPO": DrGrpo(),
    "GSPO": Gspo(),
    "CISPO": Cispo(),
}

DEFAULT_KEY: Key = ("paper", GRPOConfig().group)
"""What the studies use, marked in charts and tables."""


FEW = 4  # names that a sentence can hold


@dataclasses.dataclass(frozen=True, kw_only=True)
class ParetoGrpoConfig:
    """Rollouts of a step, how they are grouped, how long a run is, and what it should come to."""

    groups: tuple[int, ...] = (4, 8, 16)
    rollouts: int = 32
    prefix: int = 64
    target: float = 0.9
    """Mean reward of a step that a run should pass; chance is .5."""
    steps: int = 60
    timed: int = 5
    """Rounds in which the step of every program is timed."""
    learning_rate: float = 1e-3
    seeds: int = 3
    size: JobSize = JobSize(length=16, num_layers=2)

    def __post_init__(self) -> None:
        uneven = [g for g in self.groups if self.rollouts % g]
        if uneven:
            raise ValueError(f"groups holds {uneven}: must divide rollouts = {self.rollouts}; choose divisors of it")


def run(config: ParetoGrpoConfig, context: Context) -> Results:
    """Every algorithm at every group size."""
    rewards, last = {}, {}
    keys = tuple(itertools.product(ALGORITHMS, config.groups))
    with context.progress("seeds", len(keys) * config.seeds) as advance:
        for name, group in keys:
            key = name, group
            rewards[key], last[key] = learn(config, ALGORITHMS[name], group, advance)
            context.print(f"{name}, groups of {group}: {rewards[key][:, -1].mean():.3f} after {config.steps} steps")
    calls = {f"{name} {group}": job.step for (name, group), job in last.items()}
    seconds = interleaved(calls, context.rounds("timing steps", config.timed))
    courses = {
        (name, group): LearningCurves(rewards=rewards[name, group], step_s=float(np.median(seconds[f"{name} {group}"])))
        for name, group in rewards
    }
    return Results(
        verdict=verdict(config, courses),
        tables=(table(config, courses),),
        pictures=pictures(config, courses),
        settings={
            "learning_rate": config.learning_rate,
            "rollouts a step": config.rollouts,
            "steps": config.steps,
            "target": config.target,
        },
    )


def learn(config: ParetoGrpoConfig, algorithm: AnyAlgorithm, group: int, advance: Advance) -> tuple[np.ndarray, Job]:
    """Mean reward of every seed's steps, [seeds, steps], and the last seed's job; `advance` is called after a seed."""
    prompts = config.rollouts // group
    size = dataclasses.replace(config.size, prompts=prompts, group=group)
    step = GRPOConfig(
        prompts=prompts,
        group=group,
        length=size.length,
        micro_prompts=1,
        algorithm=algorithm,
        inverse_draws=True,
    )
    rewards = []
    for seed in range(config.seeds):
        job = Job(size, config.prefix, step, learning_rate=config.learning_rate, seed=seed)
        rewards.append(jax.device_get([job.step()["reward"] for _ in range(config.steps)]))
        advance()
    return np.array(rewards), job


def pictures(config: ParetoGrpoConfig, courses: Mapping[Key, LearningCurves]) -> tuple[Picture, ...]:
    """Cost against gain, and the courses."""
    return (
        Picture(
            name="pareto_grpo",
            title="Step time, score, and time to the target",
            caption="Left: score over the time of a step; right: time until the mean reward of a step passes the "
            "target, median over seeds, hollow where not every seed passed it.  A shape for each group size; the "
            "ring marks what the studies use.",
            content=cost_and_gain(courses, config.target, DEFAULT_KEY),
        ),
        Picture(
            name="courses",
            title="Reward over time",
            caption="Mean over the seeds; the dotted line is the target.",
            content=reward_over_time(courses, config.target),
        ),
    )


def table(config: ParetoGrpoConfig, courses: Mapping[Key, LearningCurves]) -> Table:
    """Seconds a step, score, steps and seconds to the target."""
    rows: list[tuple[Cell, ...]] = []
    for (name, group), c in courses.items():
        reached = c.reached(config.target)
        there = np.isfinite(reached)
        steps = float(np.median(reached)) if there.all() else None
        mark = " (default)" if (name, group) == DEFAULT_KEY else ""
        seconds = None if steps is None else steps * c.step_s
        rows.append((name + mark, group, 1e3 * c.step_s, c.score, steps, seconds, f"{there.sum()} of {len(reached)}"))
    return Table(
        title="Cost and gain",
        columns=(
            Column(name="algorithm"),
            Column(name="group", format="d", meaning="rollouts of a prompt"),
            Column(name="a step", unit="ms", format=".1f", meaning="median, in rounds with all others"),
            Column(name="score", format=".3f", meaning="mean reward over the last tenth of the steps and the seeds"),
            Column(name="steps to the target", format=".0f", meaning="median over seeds, where every seed passed it"),
            Column(name="to the target", unit="s", meaning="steps times seconds a step"),
            Column(name="seeds there"),
        ),
        rows=tuple(rows),
    )


def verdict(config: ParetoGrpoConfig, courses: Mapping[Key, LearningCurves]) -> tuple[str, ...]:
    """The fastest of those that every seed of which arrived, the default beside it, and who did not arrive."""
    steps = {key: float(np.median(c.reached(config.target))) for key, c in courses.items()}
    whole = [key for key, c in courses.items() if np.isfinite(c.reached(config.target)).all()]
    late = [f"{name} in groups of {group}" for name, group in courses if (name, group) not in whole]
    said = []
    if whole:
        name, group = first = min(whole, key=lambda key: steps[key] * courses[key].step_s)
        said.append(
            f"{name} in groups of {group} is first at {config.target}, in {steps[first] * courses[first].step_s:.1f} s."
        )
        if DEFAULT_KEY in whole and first != DEFAULT_KEY:
            took = steps[DEFAULT_KEY] * courses[DEFAULT_KEY].step_s
            said.append(f"The default, {DEFAULT_KEY[0]} in groups of {DEFAULT_KEY[1]}, takes {took:.1f} s.")
    if late:
        which = ", ".join(late) if len(late) <= FEW else f"{len(late)} of {len(courses)} (see the table)"
        said.append(f"Not every seed passed {config.target} within {config.steps} steps with {which}.")
    return tuple(said) or ("Every seed passed the target at once.",)


DEFAULT = ParetoGrpoConfig()
SMOKE = ParetoGrpoConfig(
    groups=(2,),
    rollouts=4,
    prefix=16,
    steps=2,
    timed=1,
    seeds=1,
    size=JobSize(length=4, vocab_size=32, hidden_size=16, num_layers=1, num_heads=1, num_kv_heads=1, head_dim=16),
)

EXPERIMENT = Experiment(name="pareto_grpo", config=DEFAULT, scales={"smoke": SMOKE}, run=run)
