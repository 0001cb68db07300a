"""Which GRPO algorithm and group size reach a given score in the least time, and how long does each step take?

    make experiment EXP=pareto_grpo [ARGS="--scale smoke"]

Every preset at every group size learns to write low token ids (see `experiments.engine.job`) from the same decoder and
prompts, at one learning rate, with the same number of rollouts and steps: a larger group has fewer prompts.  The score
is the mean reward over the last tenth of the steps; a run reaches the target at the first step whose mean reward
exceeds it.  Time is the number of steps times the median time of a step.  Step times are measured in rounds over all
programs, so that compilation and other load on the machine do not count.  If a preset skips groups, the reward is the
mean over all sampled rollouts, so that presets are comparable.

Each option of sampling, advantage, reward, lag and reference is compared with the published objective in the simulated
world of touch, by accuracy and time (see `experiments.engine.grpo_options`).

Cost: 37 minutes in the recorded run on one core, most of it compilation; `--scale smoke` under two.

Expected: on policy, all clipped surrogates have the same gradient, so presets differ only in averages and weights.  Dr.
GRPO and the token means equal GRPO up to scale, because all completions have one length; dynamic sampling draws twice
the rollouts, although few groups have equal rewards here; the controls of `stable` take time and gain nothing in a task
without touch.
"""

import dataclasses
import itertools
from collections.abc import Mapping
from typing import Any

import jax
import numpy as np

from experiments.core.charts import Panel, Rule, Series, draw
from experiments.core.context import Context
from experiments.core.curves import running_mean
from experiments.core.progress import Advance
from experiments.core.results import Cell, Picture, Results, Table, named_table
from experiments.core.runner import Experiment
from experiments.core.timing import interleaved
from experiments.engine.grpo_options import NAMES, measure_options, option_pictures, option_table, option_verdict
from experiments.engine.job import Job, config_of
from experiments.engine.peers import JobSize
from experiments.engine.world_training import TrainingBudget
from touchr1_jax.rl import config as rl
from touchr1_jax.validation import at_least, some_of

ALGORITHMS: Mapping[str, rl.AnyAlgorithm] = {
    "paper": rl.Paper(), "stable": rl.Stable(), "DAPO": rl.Dapo(), "Dr. GRPO": rl.DrGrpo(), "GSPO": rl.Gspo(),
    "CISPO": rl.Cispo(), "RLOO": rl.Rloo(), "REINFORCE++": rl.ReinforcePlusPlus(),
}  # fmt: skip

Key = tuple[str, int]  # algorithm and group size
DEFAULT_KEY: Key = ("paper", rl.GRPOConfig().group)  # setting of the studies, marked in charts and tables


@dataclasses.dataclass(frozen=True, kw_only=True)
class ParetoGrpoConfig:
    """Algorithms, group sizes, rollouts of a step, length of a run, the reward to reach, and the options."""

    algorithms: tuple[str, ...] = tuple(ALGORITHMS)
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
    options: tuple[str, ...] = NAMES
    """Options that are compared with the published objective in the world of touch."""
    option_seeds: int = 10
    effort: TrainingBudget = TrainingBudget()
    """Training of the options."""

    def __post_init__(self) -> None:
        some_of(self, "algorithms", ALGORITHMS)
        if self.options:
            some_of(self, "options", NAMES)
        if self.options and self.option_seeds < 2:
            raise ValueError(f"option_seeds is {self.option_seeds}: must be at least 2 for an interval; raise it")
        at_least(self, 1, "rollouts")
        uneven = [g for g in self.groups if g < 1 or self.rollouts % g]
        if uneven or not self.groups:
            raise ValueError(f"groups holds {uneven}: must divide rollouts = {self.rollouts}; choose divisors of it")


@dataclasses.dataclass(frozen=True, kw_only=True)
class LearningCurves:
    """Runs of one algorithm and group size: mean reward of every step, [seeds, steps], and seconds of a step."""

    rewards: np.ndarray
    step_s: float

    @property
    def score(self) -> float:
        """Mean reward over the last tenth of the steps and over the seeds."""
        return float(self.rewards[:, -max(1, self.rewards.shape[1] // 10) :].mean())

    def steps_to(self, target: float) -> np.ndarray:
        """Steps until each seed's reward first passes the target, [seeds]; ∞ where it never does."""
        passed = self.rewards >= target
        return np.where(passed.any(1), passed.argmax(1) + 1.0, np.inf)

    def seconds_to(self, target: float) -> float:
        """Median time to the target over the seeds that reach it; NaN where none does."""
        steps = self.steps_to(target)
        return float(np.median(steps[np.isfinite(steps)])) * self.step_s if np.isfinite(steps).any() else np.nan

    def all_reach(self, target: float) -> bool:
        """True if every seed reaches the target."""
        return bool(np.isfinite(self.steps_to(target)).all())


Curves = Mapping[Key, LearningCurves]


def run(config: ParetoGrpoConfig, context: Context) -> Results:
    """Train every algorithm at every group size, then time their steps in turn."""
    rewards, last = {}, {}
    with context.progress("seeds", len(config.algorithms) * len(config.groups) * config.seeds) as advance:
        for name, group in itertools.product(config.algorithms, config.groups):
            key = name, group
            rewards[key], last[key] = learn(config, ALGORITHMS[name], group, advance)
            context.print(f"{name}, groups of {group}: {rewards[key][:, -1].mean():.3f} after {config.steps} steps")
    calls = {f"{name} {group}": job.step for (name, group), job in last.items()}
    seconds = interleaved(calls, context.rounds("timing steps", config.timed)).values()
    curves = {
        key: LearningCurves(rewards=rewards[key], step_s=float(np.median(s)))
        for key, s in zip(last, seconds, strict=True)
    }
    del last, calls
    jax.clear_caches()  # the mapped sections of so many programs reach Linux's limit (65,530) with those of the options
    options = {}
    if config.options:
        options = measure_options(config.options, config.effort, config.option_seeds, config.timed, context)
    return Results(
        verdict=(*verdict(config, curves), *(option_verdict(options) if options else ())),
        tables=(cost_table(config.target, curves), *((option_table(options),) if options else ())),
        pictures=(
            Picture(
                name="pareto_grpo",
                title="Step time, score, and time to the target",
                caption="Left: score over the time of a step; right: time until the mean reward of a step passes the "
                "target, median over seeds, hollow where not every seed passed it.  Numbers are group sizes; the ring "
                "marks the setting of the studies.",
                content=cost_and_gain(config.target, curves),
            ),
            Picture(
                name="courses",
                title="Reward over time",
                caption="Mean over the seeds; the dotted line is the target.",
                content=reward_over_time(config.target, curves),
            ),
            *(option_pictures(options) if options else ()),
        ),
        settings={
            "learning_rate": config.learning_rate,
            "rollouts a step": config.rollouts,
            "steps": config.steps,
            "target of the mean reward": config.target,
        },
    )


def learn(config: ParetoGrpoConfig, algorithm: rl.AnyAlgorithm, group: int, advance: Advance) -> tuple[np.ndarray, Job]:
    """Mean reward of all that each step drew, [seeds, steps], and the last seed's job; a seed calls `advance`."""
    prompts = config.rollouts // group
    size = dataclasses.replace(config.size, prompts=prompts, group=group)
    step = config_of(size, algorithm)
    rewards = []
    for seed in range(config.seeds):
        job = Job(size, config.prefix, step, learning_rate=config.learning_rate, seed=seed)
        steps = (job.step() for _ in range(config.steps))
        rewards.append(jax.device_get([metrics.get("drawn_reward", metrics["reward"]) for metrics in steps]))
        advance()
    return np.array(rewards), job


def verdict(config: ParetoGrpoConfig, curves: Curves) -> tuple[str, ...]:
    """Name the fastest setting whose every seed reaches the target, and the settings that fail."""
    seconds = {key: c.seconds_to(config.target) for key, c in curves.items() if c.all_reach(config.target)}
    late = [f"{name} {group}" for name, group in curves if (name, group) not in seconds]
    timed = [
        f"{name} in groups of {group}: {seconds[name, group]:.1f} s"
        for name, group in sorted(seconds, key=seconds.__getitem__)
    ]
    return (
        f"The fastest to a reward of {config.target} is {timed[0]}."
        if timed
        else f"No setting reaches {config.target} with every seed.",
        *(
            [f"Not with every seed in {config.steps} steps (algorithm, group): {', '.join(late)}."]
            * bool(late and timed)
        ),
    )


def cost_table(target: float, curves: Curves) -> Table:
    """Seconds a step, score, steps and seconds to the target."""
    rows: list[dict[str, Cell]] = []
    for (name, group), c in curves.items():
        steps, all_reach = c.steps_to(target), c.all_reach(target)
        rows.append(
            {
                "algorithm": name + (" (default)" if (name, group) == DEFAULT_KEY else ""),
                "group": group,
                "a step": 1e3 * c.step_s,
                "score": c.score,
                "steps to the target": float(np.median(steps)) if all_reach else None,
                "to the target": c.seconds_to(target) if all_reach else None,
                "seeds there": f"{np.isfinite(steps).sum()} of {len(steps)}",
            }
        )
    return named_table(
        "Cost and gain",
        rows,
        formats={"a step": ".1f", "score": ".3f", "steps to the target": ".0f"},
        units={"a step": "ms", "to the target": "s"},
        meanings={
            "group": "answers to each prompt",
            "a step": "median",
            "score": "mean reward over the last tenth of the steps and the seeds",
            "steps to the target": "median over seeds, where every seed passed it",
            "to the target": "steps times seconds a step",
            "seeds there": "seeds that passed the target",
        },
    )


def cost_and_gain(target: float, curves: Curves) -> bytes:
    """Draw score over the time of a step, and time to the target by algorithm."""
    names = list(dict.fromkeys(name for name, _ in curves))
    ring: dict[str, Any] = {"colour": "black", "marker": "o", "line": "", "size": 170.0, "hollow": True}
    left, right = [], []
    for (name, group), c in curves.items():
        look: dict[str, Any] = {"name": name, "line": "", "labels": [str(group)]}
        gain: dict[str, Any] = {"x": [1e3 * c.step_s], "y": [c.score]}
        cost: dict[str, Any] = {"x": [c.seconds_to(target)], "y": [names.index(name)]}
        default = (name, group) == DEFAULT_KEY
        left += [Series(**look, **gain), *([Series(**ring, **gain)] if default else [])]
        right += [Series(**look, **cost, hollow=not c.all_reach(target))]
        right += [Series(**ring, **cost)] if default else []
    label = f"time to a mean reward of {target:g}, s"
    panels = [
        Panel(
            left,
            x_label="a step, ms",
            y_label="score: mean reward at the end",
            rules=[Rule(y=target)],
            better=("lower", "higher"),
        ),
        Panel(right, x_label=label, x_limits=(0, None), rows=names),
    ]
    return draw(panels, size=(9.0, 4.2))


def reward_over_time(target: float, curves: Curves) -> bytes:
    """Draw mean reward over seconds, a panel for each algorithm and a line for each group size."""
    panels = []
    for name in dict.fromkeys(name for name, _ in curves):
        lines = [
            Series(
                f"groups of {group}",
                x=c.step_s * np.arange(1, c.rewards.shape[1] + 1),
                y=running_mean(c.rewards.mean(0)),
                marker="",
            )
            for (algorithm, group), c in curves.items()
            if algorithm == name
        ]
        panels.append(Panel(lines, title=name, x_label="time, s", y_label="mean reward", rules=[Rule(y=target)]))
    return draw(panels, share_x=True, share_y=True)


SMOKE = ParetoGrpoConfig(
    algorithms=("paper", "DAPO"), groups=(2,), rollouts=4, prefix=16, steps=2, timed=1, seeds=1,
    size=JobSize(length=4, vocab_size=32, hidden_size=16, num_layers=1, num_heads=1, num_kv_heads=1, head_dim=16),
    options=("2 minibatches",), option_seeds=2,
    effort=TrainingBudget(pretrain_steps=4, pretrain_batch=8, steps=4, prompts=2, group=4, examined=8, answers=2),
)  # fmt: skip

EXPERIMENT = Experiment(name="pareto_grpo", config=ParetoGrpoConfig(), scales={"smoke": SMOKE}, run=run)
