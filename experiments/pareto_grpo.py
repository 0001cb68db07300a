"""Which algorithm and group size reach a set score in the least time?

    make experiment EXP=pareto_grpo [ARGS="--scale smoke"]

Every preset at every group size learns to write low token ids (see `experiments.grpo.job`) from the same decoder and
prompts at one learning rate, with a fixed number of rollouts a step: a larger group has fewer prompts.  A run ends when
the mean reward of a step passes the target.  Time is the median step of that program times the steps taken, so that
neither compilation nor a busy machine counts.

Cost: about fifteen minutes on two cores; `--scale smoke` under one.

Expected: on policy all clipped surrogates have the same gradient, so that presets differ by how they average and weigh:
Dr. GRPO and the token means coincide with GRPO up to scale where all completions have one length; dynamic sampling pays
twice the rollouts for groups that differ anyhow; the controls of `stable` cost time and bring nothing to a task
without touch.
"""

import dataclasses
from collections.abc import Mapping

import jax
import numpy as np

from experiments.grpo.charts import reward_over_time
from experiments.grpo.job import Job, Size
from experiments.reporting.findings import Cell, Column, Findings, Picture, Table
from experiments.running.context import Context
from experiments.running.runner import Experiment
from experiments.running.timing import interleaved
from touchr1_jax.rl.config import AnyAlgorithm, Cispo, Dapo, DrGrpo, GRPOConfig, Gspo, Paper, Stable

ALGORITHMS: Mapping[str, AnyAlgorithm] = {
    "paper": Paper(),
    "stable": Stable(),
    "DAPO": Dapo(),
    "Dr. GRPO": DrGrpo(),
    "GSPO": Gspo(),
    "CISPO": Cispo(),
}


@dataclasses.dataclass(frozen=True, kw_only=True)
class ParetoConfig:
    """Rollouts of a step, how they are grouped, and when a run ends."""

    groups: tuple[int, ...] = (4, 8, 16)
    rollouts: int = 64
    prefix: int = 64
    target: float = 0.9
    """Mean reward of a step that ends a run; chance is .5."""
    most_steps: int = 150
    learning_rate: float = 1e-3
    seeds: int = 3
    size: Size = Size(length=32)

    def __post_init__(self) -> None:
        uneven = [g for g in self.groups if self.rollouts % g]
        if uneven:
            raise ValueError(f"groups holds {uneven}: must divide rollouts = {self.rollouts}; choose divisors of it")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Course:
    """One algorithm and group size: rewards of every seed's steps, and the median seconds of a step."""

    rewards: tuple[tuple[float, ...], ...]
    step_s: float
    target: float

    @property
    def reached(self) -> int:
        """Seeds that passed the target."""
        return sum(r[-1] >= self.target for r in self.rewards)

    @property
    def steps(self) -> float:
        """Median number of steps, those that ran out counted as they stand."""
        return float(np.median([len(r) for r in self.rewards]))


def run(config: ParetoConfig, context: Context) -> Findings:
    """Every algorithm at every group size."""
    courses = {}
    for name, algorithm in ALGORITHMS.items():
        for group in config.groups:
            courses[name, group] = learn(config, algorithm, group)
            c = courses[name, group]
            context.say(f"{name}, groups of {group}: {c.steps:.0f} steps of {c.step_s:.3f} s, {c.reached} seeds there")
    return Findings(
        verdict=verdict(config, courses),
        tables=(table(courses),),
        pictures=(
            Picture(
                name="pareto_grpo",
                title="Reward over time",
                caption="Mean reward over the seeds; a line ends where its first seed passes the target.",
                content=reward_over_time({key: (c.step_s, c.rewards) for key, c in courses.items()}, config.target),
            ),
        ),
        settings={"learning_rate": config.learning_rate, "rollouts a step": config.rollouts, "target": config.target},
    )


def learn(config: ParetoConfig, algorithm: AnyAlgorithm, group: int) -> Course:
    """All seeds of one algorithm and group size; the last one's steps are timed."""
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
        rewards.append(climb(job, config))
    step_s = float(np.median(interleaved({"step": job.step}, 5)["step"]))
    return Course(rewards=tuple(rewards), step_s=step_s, target=config.target)


def climb(job: Job, config: ParetoConfig) -> tuple[float, ...]:
    """Mean reward of each step up to the first that passes the target."""
    rewards: list[float] = []
    while len(rewards) < config.most_steps and (not rewards or rewards[-1] < config.target):
        rewards.append(float(jax.device_get(job.step()["reward"])))
    return tuple(rewards)


def table(courses: Mapping[tuple[str, int], Course]) -> Table:
    """Steps, seconds a step and seconds to the target."""
    rows: list[tuple[Cell, ...]] = [
        (name, group, c.steps, c.step_s, c.steps * c.step_s, f"{c.reached} of {len(c.rewards)}")
        for (name, group), c in courses.items()
    ]
    return Table(
        title="Time to the target",
        columns=(
            Column(name="algorithm"),
            Column(name="group", format="d", meaning="rollouts of a prompt"),
            Column(name="steps", format=".0f", meaning="median over seeds"),
            Column(name="a step", unit="s", meaning="median"),
            Column(name="to the target", unit="s", meaning="steps times seconds a step"),
            Column(name="seeds there", meaning="within the most steps allowed"),
        ),
        rows=tuple(rows),
    )


def verdict(config: ParetoConfig, courses: Mapping[tuple[str, int], Course]) -> tuple[str, ...]:
    """The fastest of those that every seed of which arrived, and who did not arrive."""
    there = {key: c.steps * c.step_s for key, c in courses.items() if c.reached == len(c.rewards)}
    late = [f"{name} in groups of {group}" for (name, group), c in courses.items() if c.reached < len(c.rewards)]
    said = (
        [f"Not every seed passed {config.target} within {config.most_steps} steps with {', '.join(late)}."]
        if late
        else []
    )
    if there:
        name, group = min(there, key=lambda key: there[key])
        said.insert(0, f"{name} in groups of {group} is first at {config.target}, in {there[name, group]:.1f} s.")
    return tuple(said)


DEFAULT = ParetoConfig()
SMOKE = ParetoConfig(
    groups=(2,),
    rollouts=4,
    prefix=16,
    most_steps=2,
    seeds=1,
    size=Size(length=4, vocab_size=32, hidden_size=16, num_layers=1, num_heads=1, num_kv_heads=1, head_dim=16),
)

EXPERIMENT = Experiment(name="pareto_grpo", config=DEFAULT, scales={"smoke": SMOKE}, run=run)
