"""Can a policy learn from reward alone which touch to make?

    python -m experiments active_touch [--scale smoke]

Every object has labels, but no label gives the best touch.  Each of four sensors touches generated objects with every
motion at two forces.  A policy receives a question about one of five properties, chooses a touch, observes it, and
touches again or concludes.  SFT on random touches comes first; it does not show which touch is good.  GRPO on whole
trajectories then rewards the right answer, minus a price for seconds and for harm (contacts that strain the gel or the
object past its limit).  The report first gives the largest possible gain from choosing, by probes and by the policy's
own beliefs.  Controls: random touches; the best press, the best touch for all questions and the best touch for each
question (looked up on validation objects); a fixed order that stops at a threshold on belief; imitation of a one-step
look-ahead; a policy that chooses without seeing its observations; every touch; the exact optimum over decision trees.

`--physiclear DIR` adds real touch: several videos of an object as contacts, and a policy that learns when to stop.
`--agents` adds PPO of Stable-Baselines3 in the same environment.

For each object, some sensors and motions are missing at random, and policies do not know which: a touch with a missing
one takes its time and returns nothing.

Cost: 24 to 28 minutes on two cores, six to eight of them for the contacts, which are made once; `--scale smoke` two.

Expected: one touch chosen by reward is seven points better than the best touch for all questions and as good as the
best touch for each question, also with missing choices.  A second touch adds little unless the first one returned
nothing.  A policy with a price on harm avoids harm without loss of accuracy.
"""

import dataclasses
import functools
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from experiments.active.agents import AGENT, AgentConfig, agent_played, agents_table, check_installed
from experiments.active.arms import (
    EQUAL,
    EVERY_TOUCH,
    MISSING,
    RULES,
    Arm,
    LearnerConfig,
    SeedPolicy,
    beliefs_of,
    check_arms,
    controls,
    counted,
    every_touch,
    from_json,
    looked_up,
    make_policy,
    of_equal_seconds,
    one_step_look_ahead,
    played_once,
    reinforced,
    warm_params,
    with_dropout,
)
from experiments.active.contacts import PROPERTIES, ContactsConfig
from experiments.active.cost import cost_requirements, cost_table, step_cost
from experiments.active.encoder import ContactEncoderConfig
from experiments.active.findings import findings
from experiments.active.headroom import headroom
from experiments.active.plans import Played
from experiments.active.report import headroom_table
from experiments.active.videos import StoppingConfig, stopping
from experiments.active.world import TouchWorld, WorldConfig, make_world
from experiments.core.concurrency import concurrently
from experiments.core.context import Context
from experiments.core.errors import ConfigurationError
from experiments.core.results import Results, Table
from experiments.core.runner import Experiment
from touchr1_jax.models.active_policy import ActivePolicy
from touchr1_jax.training.train_sft import SFTConfig


@dataclasses.dataclass(frozen=True, kw_only=True)
class ActiveTouchConfig:
    """TouchWorld, learner, arms.

    Args:
      world: contacts, encoder, parts of the objects.
      learner: training of the policies.
      contacts: most contacts of a trajectory of several.
      second_price: price of a second for policies of several contacts, in right answers.
      second_prices: further prices of a second.
      harm_price: price of a contact past the strain limit for the arm that pays it.
      seeds: of the policies.
      full_seeds: seeds that also train with a price of harm, at further prices, and by imitation.
      physiclear: folder of real videos as `physiclear` reads it; `None` leaves real touch out.
      videos: folds and policies of real touch.
      agents: train agents of other libraries too, which must be installed.
      agent: their training.
    """

    world: WorldConfig = WorldConfig()
    learner: LearnerConfig = LearnerConfig()
    contacts: int = 3
    second_price: float = 0.004
    second_prices: tuple[float, ...] = (0.015,)
    harm_price: float = 0.5
    seeds: int = 5
    full_seeds: int = 1
    physiclear: Path | None = None
    videos: StoppingConfig = StoppingConfig()
    agents: bool = False
    agent: AgentConfig = AgentConfig()

    def __post_init__(self) -> None:
        given = self.seeds, self.full_seeds, self.contacts
        if min(given[:2]) < 1 or self.contacts < 2:
            raise ConfigurationError(
                f"seeds, full_seeds, contacts are {given}: must be at least 1, 1 and 2; raise them"
            )
        for name in ("second_price", "second_prices", "harm_price"):
            if not (np.isfinite(getattr(self, name)) & (np.asarray(getattr(self, name)) >= 0)).all():
                raise ConfigurationError(f"{name} is {getattr(self, name)}: must be finite and at least 0; correct it")

    def arms(self, seed: int) -> dict[str, Arm]:
        """The reinforced policies of a seed."""
        several = counted("chosen", self.contacts)
        usual = Arm(budget=self.contacts, second=self.second_price)
        found = {"chosen": Arm(budget=1), several: usual}
        if seed < self.full_seeds:
            found["chosen_harm"] = dataclasses.replace(usual, harm=self.harm_price)
            found |= {f"{several}_at_{p:g}": dataclasses.replace(usual, second=p) for p in self.second_prices}
        return found


def run(config: ActiveTouchConfig, context: Context) -> Results:
    """Make the world, report the headroom, train and score every seed."""
    if config.agents:
        check_installed()
    real = None if config.physiclear is None else stopping(config.videos, config.physiclear, context)
    world = make_world(config.world, context)
    policy = make_policy(world, config.learner)
    check_arms(world, policy, config.arms(0))
    tables = [_headroom(world, config, context)]
    train = lambda seed: _seed(world, policy, config, seed, context)
    (first, warm, of_warm), *others = concurrently(context, "seeds", range(config.seeds), train)
    cost = context.once("cost", lambda: step_cost(world, warm, config.learner, config.contacts, context))
    agents, of_agents = _agents(world, policy, config, context)
    seeds = [{**first, **agents}, *(found for found, _, _ in others)]
    tables += [*of_warm, of_agents]
    results = findings(world, config.learner, config.contacts, seeds, tables, config.arms(0))
    return dataclasses.replace(
        results,
        requirements=(*results.requirements, *cost_requirements(cost)),
        tables=(*results.tables, cost_table(cost), *(() if real is None else real[:1])),
        pictures=(*results.pictures, *(() if real is None else real[1:])),
    )


def _headroom(world: TouchWorld, config: ActiveTouchConfig, context: Context) -> Table:
    """Headroom by the probes' beliefs, printed before anything is trained to choose."""
    val, test = (world.probes.of(world.parts[part]) for part in ("val", "test"))
    table = headroom_table(headroom(val, test, config.contacts, config.learner.kept), "probes")
    _print(table, context)
    return table


def _seed(
    world: TouchWorld, policy: ActivePolicy, config: ActiveTouchConfig, seed: int, context: Context
) -> tuple[dict[str, Played], SeedPolicy, list[Table]]:
    """Actions of all plans and policies of a seed about test objects, its warm start, and of the first the headroom."""
    learner = config.learner
    params = warm_params(world, policy, learner, config.contacts, seed, context)
    warm = looked_up(world, policy, params, learner, config.contacts)
    tables = []
    found = controls(world, warm, learner, config.contacts, seed)
    if seed == 0:
        test = beliefs_of(world, warm.answer, "test")
        tables.append(headroom_table(headroom(warm.val, test, config.contacts, learner.kept), "the warm start"))
        _print(tables[0], context)
        found[EVERY_TOUCH] = every_touch(world, test)
    arms = config.arms(seed)
    for name, arm in arms.items():
        compute = functools.partial(reinforced, world, warm, learner, name, arm, seed, context)
        found |= from_json(played_once(name, seed, compute, context))
        context.print(_line(name, found[name]))
    if seed < config.full_seeds:
        compute = functools.partial(one_step_look_ahead, world, warm, learner, seed, context)
        found |= from_json(context.once(f"played/imitation/{seed}", compute))
    found |= of_equal_seconds(found, found[counted("chosen", config.contacts)], config.contacts)
    missing, headroom_missing = _missing(world, warm, found, config, seed)
    return {**found, **missing}, warm, tables + headroom_missing


def _missing(
    world: TouchWorld, warm: SeedPolicy, found: Mapping[str, Played], config: ActiveTouchConfig, seed: int
) -> tuple[dict[str, Played], list[Table]]:
    """Plans by rule where choices drop out, looked up in beliefs where they drop out, and of the first the headroom."""
    learner, contacts = config.learner, config.contacts
    world = with_dropout(world, learner.dropout, seed)
    warm = looked_up(world, warm.policy, warm.params, learner, contacts)
    rules = controls(world, warm, learner, contacts, seed)
    rules |= of_equal_seconds(rules, found[f"{counted('chosen', contacts)}_{MISSING}"], contacts)
    tables = []
    if seed == 0:
        test = beliefs_of(world, warm.answer, "test")
        left = headroom(warm.val, test, contacts, learner.kept)
        tables.append(headroom_table(left, "the warm start, where choices drop out"))
    compared = (*RULES, *(f"{rule}_{EQUAL}" for rule in RULES))
    return {f"{rule}_{MISSING}": rules[rule] for rule in compared}, tables


def _agents(
    world: TouchWorld, policy: ActivePolicy, config: ActiveTouchConfig, context: Context
) -> tuple[dict[str, Played], Table]:
    """Agents of another library at the prices of the arms, and a table of them."""
    found: dict[str, Played] = {}
    settings: dict[str, Any] = {}
    arms = config.arms(0)
    for contacts in (1, config.contacts) if config.agents else ():
        arm = arms[counted("chosen", contacts)]
        name = counted(AGENT, contacts)
        compute = functools.partial(agent_played, world, policy, arm, config.agent, name, 0, context)
        saved = context.once(f"played/{name}", compute)
        found |= from_json(saved["played"])
        settings[name] = saved["settings"]
        context.print(_line(name, found[name]))
    return found, agents_table(settings, config.agent.steps)


def _line(name: str, played: Played) -> str:
    by = ", ".join(f"{p} {100 * x:.0f}" for p, x in zip(PROPERTIES, played.right.mean(0), strict=True))
    return (
        f"{name}: {100 * played.right.mean():.1f} % right ({by}), {played.seconds.mean():.2f} s, "
        f"{100 * played.harm.mean():.1f} % past the limit"
    )


def _print(table: Table, context: Context) -> None:
    context.print(table.title)
    for row in table.rows:
        context.print("  " + ", ".join("–" if x is None else x if isinstance(x, str) else f"{x:.1f}" for x in row))


SMOKE = ActiveTouchConfig(
    world=WorldConfig(
        contacts=ContactsConfig(
            objects=40, motions=("press", "slide_x", "hold"), forces_n=(2.0,), sensors=("tac3d",), picture_px=24
        ),
        encoder=ContactEncoderConfig(width=24, steps=40, batch_size=32),
    ),
    learner=LearnerConfig(
        warm=SFTConfig(steps=20, batch_size=32, questions=1, micro_contacts=32),
        grpo=dataclasses.replace(LearnerConfig().grpo, prompts=10, group=4, micro_prompts=10),
        steps=4,
        single_steps=4,
        kept=3,
        thresholds=(0.6,),
    ),
    contacts=2,
    second_prices=(),
    seeds=2,
)

EXPERIMENT = Experiment(
    name="active_touch",
    config=ActiveTouchConfig(),
    scales={"smoke": SMOKE},
    run=run,
    curves={"grpo": ("accuracy", "reward", "first_kind_information", "actions", "seconds", "harm"), "warm": ("loss",)},
    quick=("smoke",),
)
