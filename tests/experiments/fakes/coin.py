"""Does a coin that is paid for heads come up heads?

    python -m experiments coin

Costs nothing.  Expected: both arms at 50 %.
"""

import dataclasses
import os
import time
from typing import Literal

import numpy as np

from experiments.core.artifacts import read_json, write_json
from experiments.core.context import Context
from experiments.core.results import Results, RolloutExample
from experiments.core.runner import Experiment
from experiments.study.estimates import compare_over_objects, compare_over_seeds, estimate
from touchr1_jax.bench.metrics import Answers, Scores, evaluate

ATTRIBUTES = ("hardness", "roughness", "protrusion")
LEVELS = (3, 3, 3)
TRACE = "<perceive> xense soft </perceive> <compare> soft </compare> <conclude> soft </conclude>"


@dataclasses.dataclass(frozen=True, kw_only=True)
class Toss:
    bias: float = 0.5
    """Chance of heads."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Config:
    steps: int = 20
    """Steps of every run."""
    seeds: int = 3
    toss: Toss = Toss()
    coin: Literal["gold", "silver"] = "gold"
    step_s: float = 0.0
    crash_at: int = -1


def run(config: Config, context: Context) -> Results:
    arms = {arm: [train(config, context, arm, seed) for seed in range(config.seeds)] for arm in ("paid", "unpaid")}
    objects = np.repeat(np.arange(10), 3)
    table = {arm: {m: estimate([s[m] for s in runs], objects) for m in runs[0]} for arm, runs in arms.items()}
    blind = {m: estimate([score(99, 0.3)[m]], objects) for m in ("acc", "omae", "middle_rate")}
    over_seeds = compare_over_seeds("acc", *arms, *(table[arm]["acc"].per_seed for arm in arms))
    pair = [[s["acc"] for s in arms[arm]] for arm in ("paid", "unpaid")]
    return Results(
        arms=table,
        baselines={"blind": blind},
        settings={"preset": "paper", "lr_scale": 100.0},
        comparisons=(over_seeds, compare_over_objects("acc", "paid", "unpaid", *pair, objects)),
        verdict=("It is a coin.",),
        data={"tosses": 30, "coin": config.coin},
        examples=(example(),),
    )


def train(config: Config, context: Context, arm: str, seed: int) -> dict[str, Scores]:
    """A loop with a checkpoint every five steps, as real ones are."""
    stage = f"train/{arm}/{seed}"
    checkpoint = context.checkpoint_dir(stage) / "state.json"
    state = read_json(checkpoint) if checkpoint.exists() else {"step": 0, "value": 0.0}
    if not context.done(stage):
        with context.timed(stage), context.progress(stage, config.steps, completed=state["step"]) as advance:
            for step in range(state["step"], config.steps):
                if step == config.crash_at and os.environ.get("COIN_CRASHES"):
                    raise RuntimeError("the coin rolled away")
                time.sleep(config.step_s)
                state = {"step": step + 1, "value": 0.9 * state["value"] + seed + config.toss.bias}
                context.log(stage, step, value=state["value"], reward=np.float32(step / config.steps))
                if state["step"] % 5 == 0:
                    write_json(checkpoint, state)
                advance(1, f"value {state['value']:.2f}")
        context.save_stage(stage, {"seed": seed, "skill": 0.4 + 0.3 * (arm == "paid")})
    saved = context.load_stage(stage)
    return score(saved["seed"], saved["skill"])


def score(seed: int, skill: float) -> dict[str, Scores]:
    """Thirty questions about ten objects, answered rightly with a chance of `skill` and otherwise by the middle."""
    label = np.tile(np.arange(3), (30, 1))
    right = np.random.default_rng(seed).random((30, 3)) < skill
    conclude = np.where(right, label, 1)
    perceive = np.stack([conclude, np.ones_like(conclude)], axis=1)
    answers = Answers(
        conclude=conclude,
        label=label,
        formatted=np.ones(30, bool),
        reward=right.mean(axis=1),
        streams=np.ones((30, 2), bool),
        perceive=perceive,
        alone=perceive,
    )
    return evaluate(answers, ATTRIBUTES, LEVELS)


def example() -> RolloutExample:
    """One answer about a small grey blob."""
    return RolloutExample(
        arm="paid",
        object_id="object_0007",
        question="How hard is it?",
        label="hardness soft",
        trace=TRACE,
        slots=((11, 21, "perceive"), (44, 48, "compare"), (70, 74, "conclude")),
        reward={"accuracy": 1.0, "consistency": -0.1, "format": 1.0},
        total=0.67,
        frames={"xense": np.full((4, 8, 8, 3), 120, np.uint8)},
        force_n={"xense": np.linspace(0, -20, 12).reshape(4, 3)},
        view=np.zeros((8, 8, 3), np.uint8),
    )


EXPERIMENT = Experiment(name="coin", config=Config(), scales={"smoke": Config(steps=3, seeds=2)}, run=run)
