"""Results of `active_touch`, computed from the trajectories of all plans and policies."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from experiments.active import report
from experiments.active.agents import AGENT
from experiments.active.arms import EQUAL, EVERY_TOUCH, MISSING, RULES, Arm, LearnerConfig, counted
from experiments.active.contacts import PROPERTIES
from experiments.active.headroom import BY_BELIEF, BY_QUESTION, Beliefs, headroom
from experiments.active.plans import Played
from experiments.active.world import TouchWorld
from experiments.core.results import (
    Comparison,
    Estimate,
    Requirement,
    Results,
    Table,
    at_least,
    at_most,
    named_table,
)
from experiments.core.text import bounds, number
from experiments.study.estimates import compare_over_objects, compare_over_seeds, estimate
from experiments.study.training import preset_name
from touchr1_jax.bench.metrics import Scores
from touchr1_jax.text.language import EXPLORED_ATTRIBUTES
from touchr1_jax.training.exploration import NO_CHOICE

METRIC = "acc"  # mean of the accuracy over the five properties

Seeds = Sequence[Mapping[str, Played]]


def findings(
    world: TouchWorld,
    learner: LearnerConfig,
    contacts: int,
    seeds: Seeds,
    tables: Sequence[Table],
    arms: Mapping[str, Arm],
) -> Results:
    """The report of all seeds."""
    scores = {name: [scores_of(found[name]) for found in seeds if name in found] for name in seeds[0]}
    objects = np.repeat(world.parts["test"], len(PROPERTIES))
    estimates = {name: {METRIC: estimate(of_seeds, objects)} for name, of_seeds in scores.items()}
    comparisons = compared(scores, estimates, objects, contacts)
    several, test = counted("chosen", contacts), world.probes.of(world.parts["test"])
    setup = world.config.contacts
    chosen = [found["chosen"] for found in seeds]
    touched = trajectories(world, seeds[0][several])
    return Results(
        verdict=verdict(estimates, comparisons, seeds, contacts),
        requirements=requirements(world, comparisons, seeds, contacts),
        tables=(
            *tables,
            *plan_tables(seeds, estimates, learner),
            report.procedures_table(setup, chosen, test),
            report.probe_table(setup, test),
            stop_table(seeds, several),
            harm_table(world, learner, contacts, seeds, arms),
            price_table(seeds[0], arms),
        ),
        pictures=(
            report.seconds_picture(curves(seeds, estimates, contacts, learner)),
            report.first_touch_picture(setup, chosen, test),
            *([report.trajectory_picture(touched)] if touched else []),
        ),
        settings={
            "preset": preset_name(learner.grpo),
            "lr_scale": learner.grpo.lr_scale,
            "choices": f"{len(setup.choices)}: {len(setup.sensors)} sensors, {len(setup.motions)} motions, "
            f"{len(setup.forces_n)} forces",
            "objects": ", ".join(f"{name} {len(rows)}" for name, rows in world.parts.items()),
            "a step": f"{learner.grpo.prompts} prompts × {learner.grpo.group} trajectories",
            "steps": f"{learner.single_steps} with one touch, {learner.steps} with several",
        },
        arms={name: row for name, row in estimates.items() if len(scores[name]) == len(seeds)},
        baselines={name: row for name, row in estimates.items() if len(scores[name]) < len(seeds)},
        comparisons=comparisons,
    )


def scores_of(played: Played) -> Scores:
    """Right answers in %, one stratum for each question."""
    n, questions = played.right.shape
    strata = np.tile(np.arange(questions), n)
    return Scores(values=100 * played.right.ravel(), items=np.arange(n * questions), strata=strata)


def compared(
    scores: Mapping[str, Sequence[Scores]],
    estimates: Mapping[str, Mapping[str, Estimate]],
    objects: np.ndarray,
    contacts: int,
) -> tuple[Comparison, ...]:
    """Chosen touches against every rule, over seeds and over objects."""
    several = counted("chosen", contacts)
    pairs = [("chosen", rule) for rule in (*RULES, "chosen_warm_answers")]
    pairs += [("chosen_warm_answers", rule) for rule in RULES]
    pairs += [(several, f"{rule}_{EQUAL}") for rule in RULES]
    pairs += [(f"chosen_{MISSING}", f"{rule}_{MISSING}") for rule in RULES]
    pairs += [(f"{several}_{MISSING}", f"{rule}_{EQUAL}_{MISSING}") for rule in RULES]
    pairs += [(several, f"{several}_unseen"), (several, "chosen"), ("by_question", "no_touch")]
    found = []
    for a, b in pairs:
        if len(scores[a]) > 1:
            found.append(compare_over_seeds(METRIC, a, b, *(estimates[name][METRIC].per_seed for name in (a, b))))
        found.append(compare_over_objects(METRIC, a, b, scores[a], scores[b], objects))
    return tuple(found)


def named(comparisons: Sequence[Comparison], a: str, b: str) -> Comparison:
    """The comparison of two arms over objects."""
    return next(c for c in comparisons if (c.arm, c.against, c.over) == (a, b, "objects"))


def requirements(
    world: TouchWorld, comparisons: Sequence[Comparison], seeds: Seeds, contacts: int
) -> tuple[Requirement, ...]:
    """Bounds that the experiment must reach."""
    several = counted("chosen", contacts)
    fixed, question = named(comparisons, "chosen", "best_fixed"), named(comparisons, "chosen", "by_question")
    later = named(comparisons, several, f"by_question_{EQUAL}")
    dropped = named(comparisons, f"chosen_{MISSING}", f"by_question_{MISSING}")
    later_dropped = named(comparisons, f"{several}_{MISSING}", f"by_question_{EQUAL}_{MISSING}")
    every = seeds[0][EVERY_TOUCH]
    seconds = np.mean([f[several].seconds.mean() for f in seeds])
    note = f"95 % interval over objects {bounds(fixed.low, fixed.high)}"
    probes, setup = world.probes.of(world.parts["test"]), world.config.contacts
    found = [len(report.found_questions(setup, f["chosen"], probes)) for f in seeds]
    accuracy = np.mean([f[several].right.mean() for f in seeds]) - every.right.mean()
    return (
        at_least("chosen over best fixed, one contact each", fixed.difference, 6.0, "points", note),
        at_least("lower end of its interval", fixed.low, 0.0, "points"),
        at_least("upper end of chosen over best by question", question.high, 0.0, "points"),
        at_least(f"the same with up to {contacts} contacts, equal seconds", later.high, 0.0, "points"),
        at_least("upper end, one contact, where choices drop out", dropped.high, 0.0, "points"),
        at_least(f"upper end, up to {contacts}, where choices drop out", later_dropped.high, 0.0, "points"),
        at_least(f"up to {contacts} contacts over every contact", 100 * accuracy, 0.0, "points"),
        at_most("seconds of touch, share of every contact's", 100 * seconds / every.seconds.mean(), 15.0, "%"),
        at_least(
            "seeds whose first motion is the probes' for 4 of 5 questions",
            100 * float(np.mean([n >= 4 for n in found])),
            80.0,
            "%",
            f"{found} questions of 5 in the seeds",
        ),
    )


def verdict(
    estimates: Mapping[str, Mapping[str, Estimate]], comparisons: Sequence[Comparison], seeds: Seeds, contacts: int
) -> tuple[str, ...]:
    """One sentence for one contact, one for several; none of them where the warm start cannot read a touch."""
    several = counted("chosen", contacts)
    mean = lambda name: f"{estimates[name][METRIC].mean:.1f} %"
    against = lambda a, b: (
        (c := named(comparisons, a, b)) and f"{number(c.difference, '+.1f')} {bounds(c.low, c.high, '+.1f')}"
    )
    if named(comparisons, "by_question", "no_touch").low <= 0:
        return (
            f"The warm start answers {mean('by_question')} right after the best touch for each question, "
            f"{against('by_question', 'no_touch')} points compared with no touch: it does not use touches, so that "
            "this run does not show how to choose them.",
        )
    touches = np.mean([f[several].contacts.mean() for f in seeds])
    return (
        f"With one touch, the policy that learned from reward answers {mean('chosen')} right. Difference in points: "
        f"{against('chosen', 'random')} from a random touch, {against('chosen', 'best_fixed')} from the best touch for "
        f"all questions, {against('chosen', 'by_question')} from the best touch for each question.",
        f"If the warm start answers after the same touches: {against('chosen_warm_answers', 'best_fixed')} from the "
        f"best touch for all questions, {against('chosen_warm_answers', 'by_question')} from the best for each.",
        f"With up to {contacts} touches that have a price: {mean(several)} right with {touches:.2f} touches on "
        f"average; {against(several, f'best_fixed_{EQUAL}')} from the best touches for all questions in the same time, "
        f"{against(several, f'by_question_{EQUAL}')} from the best for each. With all touches: {mean(EVERY_TOUCH)}.",
    )


def plan_tables(
    seeds: Seeds, estimates: Mapping[str, Mapping[str, Estimate]], learner: LearnerConfig
) -> tuple[Table, Table]:
    """All outcomes, and those where choices drop out."""
    note = (
        "Plans by rule are answered by the warm start; `_warm_answers` are the touches of a reinforced policy, "
        "answered by the warm start; of `_unseen` the touches were chosen without seeing any observation."
    )
    note_missing = (
        f"Each sensor and each motion drops out of an object with probability {learner.dropout:g}, unknown to plan and "
        "policy: a contact without them takes its time and returns nothing. Plans by rule were looked up where choices "
        f"drop out; those of `_{EQUAL}` take the time of the policy of several contacts."
    )
    usual = [name for name in estimates if not name.endswith((EQUAL, MISSING))]
    missing = [name for name in estimates if name.endswith(MISSING)]
    return (
        plan_table("Plans and policies", usual, note, seeds, estimates),
        plan_table("Where choices drop out", missing, note_missing, seeds, estimates),
    )


def plan_table(
    title: str, names: Sequence[str], note: str, seeds: Seeds, estimates: Mapping[str, Mapping[str, Estimate]]
) -> Table:
    """Accuracy, seconds and harm of these outcomes."""
    rows: list[dict[str, Any]] = []
    for name in names:
        one = estimates[name]
        mean = lambda field, name=name: float(np.mean([getattr(f[name], field).mean() for f in seeds if name in f]))
        by = np.mean([f[name].right.mean(0) for f in seeds if name in f], 0)
        mixed = EQUAL in name  # of plans with fewer and more contacts: only answers and time are known
        rows.append(
            {
                "plan": name.removesuffix(f"_{MISSING}"),
                "right": one[METRIC].mean,
                "from": one[METRIC].low,
                "to": one[METRIC].high,
                "contacts": None if mixed else mean("contacts"),
                "seconds": mean("seconds"),
                "past the limit": None if mixed else mean("harm"),
            }
            | {p: 100 * float(x) for p, x in zip(PROPERTIES, by, strict=True)}
        )
    percent = ("right", "from", "to", *PROPERTIES)
    return named_table(
        title,
        rows,
        formats=dict.fromkeys(percent, ".1f") | {"contacts": ".2f", "seconds": ".1f", "past the limit": ".3f"},
        units=dict.fromkeys(percent, "%") | {"seconds": "s"},
        meanings={"past the limit": "contacts of a question that strain gel or object past the limit"},
        note=f"Test objects, mean over seeds, intervals over objects. {note}",
    )


def stop_table(seeds: Seeds, name: str) -> Table:
    """When the policy stops, by question."""
    rows: list[dict[str, Any]] = []
    for a, question in enumerate(PROPERTIES):
        number = np.concatenate([f[name].contacts[:, a] for f in seeds])
        most = seeds[0][name].choices.shape[-1]
        rows.append(
            {"question": question}
            | {f"{k} contact{'' if k == 1 else 's'}": 100 * float((number == k).mean()) for k in range(most + 1)}
            | {"right": 100 * float(np.mean([f[name].right[:, a].mean() for f in seeds]))}
        )
    figures = [column for column in rows[0] if column != "question"]
    return named_table(
        "When the policy stops",
        rows,
        formats=dict.fromkeys(figures, ".0f"),
        units=dict.fromkeys(figures, "%"),
        note=f"Share of the test objects, {name}.",
    )


def harm_table(
    world: TouchWorld, learner: LearnerConfig, contacts: int, seeds: Seeds, arms: Mapping[str, Arm]
) -> Table:
    """Worth of policies and look-ups where harm has a price, and what the optimum over trees leaves."""
    arm = arms["chosen_harm"]
    cost = arm.second * np.asarray(world.bank.seconds) + arm.harm * np.asarray(world.bank.harm)
    priced = Beliefs(world.probes.log_probs, world.probes.label, cost)
    val, test = (priced.of(world.parts[part]) for part in ("val", "test"))
    found = headroom(val, test, contacts, learner.kept)
    rows: list[dict[str, Any]] = []
    for name in ("random", "best_fixed", "by_question", counted("chosen", contacts), "chosen_harm"):
        mean = lambda field, name=name: float(np.mean([getattr(f[name], field).mean() for f in seeds if name in f]))
        worth = mean("right") - arm.second * mean("seconds") - arm.harm * mean("harm")
        rows.append({"plan": name, "worth": 100 * worth, "right": 100 * mean("right"), "past the limit": mean("harm")})
    rows += [
        {"plan": f"probes, {plan}, {k}", "worth": 100 * float(found[plan, k].mean())}
        for plan in (BY_QUESTION, BY_BELIEF)
        for k in range(1, contacts + 1)
    ]
    light = [light_first(world, f["chosen_harm"]) for f in seeds if "chosen_harm" in f]
    return named_table(
        "Policies when harm has a price",
        rows,
        formats={"worth": ".1f", "right": ".1f", "past the limit": ".3f"},
        units={"worth": "points", "right": "%"},
        meanings={"worth": "right answers less prices, in points"},
        note=f"Price of a second {arm.second:g}, of a contact past the limit {arm.harm:g}. The policy that pays begins "
        f"with the lightest force in {100 * np.mean(light):.0f} % of its trajectories.",
    )


def light_first(world: TouchWorld, played: Played) -> float:
    """Share of trajectories that begin with the lightest force, among those that touch."""
    force = np.array([f for _, _, f in world.config.contacts.choices])
    first = played.choices[..., 0]
    made = first != NO_CHOICE
    return float((force[first[made]] == force.min()).mean()) if made.any() else 0.0


def price_table(found: Mapping[str, Played], arms: Mapping[str, Arm]) -> Table:
    """Policies of the first seed over the price of a second."""
    rows: list[dict[str, Any]] = [
        {
            "policy": name,
            "price of a second": arm.second,
            "price of harm": arm.harm,
            "right": 100 * float(found[name].right.mean()),
            "contacts": float(found[name].contacts.mean()),
            "past the limit": float(found[name].harm.mean()),
        }
        for name, arm in arms.items()
    ]
    return named_table(
        "Prices", rows, formats={"right": ".1f", "contacts": ".2f"}, units={"right": "%"}, note="The first seed."
    )


def curves(
    seeds: Seeds, estimates: Mapping[str, Mapping[str, Estimate]], contacts: int, learner: LearnerConfig
) -> dict[str, list[tuple[float, Estimate]]]:
    """Accuracy over seconds of every plan."""

    def point(name: str) -> tuple[float, Estimate]:
        return float(np.mean([f[name].seconds.mean() for f in seeds if name in f])), estimates[name][METRIC]

    several = counted("chosen", contacts)
    found = {"chosen by the policy": [point("chosen"), point(several)]}
    found |= {rule.replace("_", " "): [point(counted(rule, k)) for k in range(1, contacts + 1)] for rule in RULES}
    found["by question until sure"] = [point(f"until_{100 * t:.0f}") for t in learner.thresholds]
    found["imitation of a look-ahead"] = [point("imitation")]
    if AGENT in seeds[0]:
        found["PPO of Stable-Baselines3"] = [point(AGENT), point(counted(AGENT, contacts))]
    found["every contact"] = [point(EVERY_TOUCH)]
    return found


def trajectories(world: TouchWorld, played: Played, most: int = 7) -> dict[str, np.ndarray]:
    """Frames of the contacts of a few trajectories, by what was asked, chosen and concluded."""
    rows: dict[str, np.ndarray] = {}
    objects, choices = world.parts["test"], world.bank.choices
    for i in range(len(objects)):
        question = i % len(PROPERTIES)
        for k, choice in enumerate(played.choices[i, question]):
            if choice == NO_CHOICE or len(rows) >= most:
                break
            level = int(np.asarray(world.bank.label)[objects[i], question])
            label = EXPLORED_ATTRIBUTES[question].levels[level][0]
            outcome = "right" if played.right[i, question] else "wrong"
            words = choices[choice].words.replace(" ", "\n", 1)
            title = f"{PROPERTIES[question]}?\n{words}\n{label}: {outcome}\nobject {i}, touch {k + 1}"
            rows[title] = world.contacts.frames[objects[i], choice]
    return rows
