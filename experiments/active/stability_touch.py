"""Does every seed find from reward alone which touch each question needs?

    python -m experiments stability_touch [--scale smoke]

The one-touch policy of `active_touch` is trained with ten seeds, on the same contacts and networks that read them.
Each seed trains on random touches by SFT and then learns from reward; no label gives the best touch.  A seed solves a
question if its most frequent first motion on test objects is the best by linear probes, or within its interval.  The
report lists the alarms of exploring policies (A1 to A5) that fired during training.

Cost: five minutes of CPU time per seed, and thirteen once for the contacts; `--scale smoke` one minute.

Expected: at least eight of ten seeds solve four of five questions.  In half of the seeds, A4 fires early, until the
policy distinguishes the questions.
"""

import dataclasses
import functools
from typing import Any

import numpy as np

from experiments.active import active_touch
from experiments.active.arms import Arm, LearnerConfig, as_json, from_json, make_policy, reinforced_params, warm_params
from experiments.active.contacts import PROPERTIES
from experiments.active.plans import Played
from experiments.active.policies import explore
from experiments.active.report import found_questions
from experiments.active.world import TouchWorld, WorldConfig, make_world
from experiments.core.concurrency import concurrently
from experiments.core.context import Context
from experiments.core.errors import ConfigurationError
from experiments.core.loops import fired_alarms
from experiments.core.metric_log import by_stage, read_metrics
from experiments.core.results import Requirement, Results, Table, at_least, named_table
from experiments.core.runner import Experiment
from experiments.study.training import preset_name
from touchr1_jax.models.active_policy import ActivePolicy
from touchr1_jax.training.exploration import NO_CHOICE

ENOUGH = 4  # questions of five whose motion a seed must find
SHARE = 80.0  # per cent of the seeds that must find so many

NAME = "chosen"


@dataclasses.dataclass(frozen=True, kw_only=True)
class StabilityTouchConfig:
    """Contacts, learner and seeds.

    Args:
      world: contacts, encoder, parts of the objects.
      learner: training of the policies.
      contacts: most contacts of a trajectory of the warm start.
      seeds, first_seed: of the policies.
    """

    world: WorldConfig = WorldConfig()
    learner: LearnerConfig = LearnerConfig()
    contacts: int = 3
    seeds: int = 10
    first_seed: int = 0

    def __post_init__(self) -> None:
        if self.seeds < 1 or self.first_seed < 0:
            raise ConfigurationError(
                f"seeds, first_seed are {self.seeds}, {self.first_seed}: must be at least 1 and 0; raise them"
            )


def run(config: StabilityTouchConfig, context: Context) -> Results:
    """Train the policy of every seed, and see where it begins."""
    world = make_world(config.world, context)
    policy = make_policy(world, config.learner)
    probes, seeds = world.probes.of(world.parts["test"]), range(config.first_seed, config.first_seed + config.seeds)

    def train(seed: int) -> tuple[Played, list[str]]:
        compute = functools.partial(_one_seed, world, policy, config, seed, context)
        one = from_json(context.once(f"played/{seed}", compute))[NAME]
        questions = found_questions(config.world.contacts, one, probes)
        context.print(f"seed {seed}: {', '.join(questions)} found")
        return one, questions

    trained = dict(zip(seeds, concurrently(context, "seeds", seeds, train), strict=True))
    played = {seed: one for seed, (one, _) in trained.items()}
    found = {seed: questions for seed, (_, questions) in trained.items()}
    stages = by_stage(read_metrics(context.directory))
    alarms = {seed: list(fired_alarms(stages.get(f"grpo/{NAME}/{seed}", []))) for seed in played}
    return Results(
        verdict=(verdict(found, alarms),),
        requirements=requirements(found),
        tables=(seed_table(world, played, found, alarms),),
        settings={
            "choices": len(world.bank.choices),
            "objects": ", ".join(f"{name} {len(rows)}" for name, rows in world.parts.items()),
            "preset": preset_name(config.learner.grpo),
        },
    )


def _one_seed(
    world: TouchWorld, policy: ActivePolicy, config: StabilityTouchConfig, seed: int, context: Context
) -> dict[str, Any]:
    """Outcomes of the policy of one touch about test objects, as JSON."""
    learner = config.learner
    warm = warm_params(world, policy, learner, config.contacts, seed, context)
    params = reinforced_params(world, policy, warm, learner, NAME, Arm(budget=1), seed, context)
    return as_json({NAME: explore(policy, params, world.bank, world.parts["test"], 1)})


def requirements(found: dict[int, list[str]]) -> tuple[Requirement, ...]:
    """The share of seeds that find enough."""
    enough = 100 * float(np.mean([len(names) >= ENOUGH for names in found.values()]))
    note = f"{[len(names) for names in found.values()]} questions of {len(PROPERTIES)} in the seeds"
    return (at_least(f"seeds whose first motion is the probes' for {ENOUGH} of 5 questions", enough, SHARE, "%", note),)


def verdict(found: dict[int, list[str]], alarms: dict[int, list[str]]) -> str:
    """Seeds that find enough, and alarms."""
    enough = sum(len(names) >= ENOUGH for names in found.values())
    rang = [f"{code} in seed {seed}" for seed, codes in alarms.items() for code in codes]
    return (
        f"{enough} of {len(found)} seeds learn from reward alone the best motion for at least {ENOUGH} of "
        f"{len(PROPERTIES)} questions; alarms: {', '.join(rang) or 'none'}."
    )


def seed_table(
    world: TouchWorld, played: dict[int, Played], found: dict[int, list[str]], alarms: dict[int, list[str]]
) -> Table:
    """First motion by question in every seed, a star where it is not the probes'."""
    motions = [motion for _, motion, _ in world.config.contacts.choices]
    rows: list[dict[str, Any]] = []
    for seed, one in played.items():
        row: dict[str, Any] = {"seed": str(seed)}
        for a, name in enumerate(PROPERTIES):
            touched = [motions[c] for c in one.choices[:, a, 0] if c != NO_CHOICE]
            first = max(sorted(set(touched)), key=touched.count) if touched else "none"
            row[name] = first if name in found[seed] else f"{first} *"
        right, touches = 100 * float(one.right.mean()), float(one.contacts.mean())
        rows.append(row | {"right": right, "touches": touches, "alarms": " ".join(alarms[seed]) or "none"})
    return named_table(
        "First motion in every seed",
        rows,
        formats={"right": ".1f", "touches": ".2f"},
        units={"right": "%"},
        note="The commonest first motion about test objects; a star marks one that is worse than the interval of the "
        "probes' best.",
    )


SMOKE = StabilityTouchConfig(world=active_touch.SMOKE.world, learner=active_touch.SMOKE.learner, contacts=2, seeds=2)

EXPERIMENT = Experiment(
    name="stability_touch",
    config=StabilityTouchConfig(),
    scales={"smoke": SMOKE},
    run=run,
    curves={"grpo": ("accuracy", "reward", "first_kind_information", "actions")},
    quick=("smoke",),
)
