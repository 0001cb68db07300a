"""Tables and charts of `physiclear`, over several partitions of the same objects."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from experiments.core.charts import Panel, Series, draw, estimates
from experiments.core.pictures import heatmaps
from experiments.core.results import Picture, Table, named_table
from experiments.core.text import bounds
from experiments.recordings.cross_validation import (
    CrossValidation,
    confidence,
    intervals,
    joint_log_prob,
    marginals,
    scores,
)
from experiments.recordings.descriptions import DescribedVideos
from experiments.recordings.level_probes import READINGS, SCENES, sense
from experiments.study.levels import confusion_map
from sensors_io.touches import families
from touchr1_jax.bench.statistics import Interval, clustered_bootstrap
from touchr1_jax.models.description_policy import LANGUAGE, LEVELS, choose

NAMES = ("hardness", "roughness", "bumps")
"""PhysiCLeAR's names of the attributes, in the order of the answers: it calls protrusion bumps."""

REAL = (0, 5, 15, 30, 60)  # real objects that the curves learn from
SHARES = tuple(np.arange(1, 11) / 10)  # of the videos, the surest first
BINS = (0.0, 0.2, 0.35, 0.5, 0.65, 0.8, 1.001)  # of stated probabilities


@dataclasses.dataclass(frozen=True, kw_only=True)
class JudgedAnswers:
    """Log-probabilities of the answers to the same n videos on P partitions, of the evidence read, and the truth."""

    log_prob: Float[np.ndarray, "P n 27"]
    evidence: Float[np.ndarray, "P n 27"]
    label: Int[np.ndarray, "n A"]
    objects: np.ndarray

    @property
    def levels(self) -> Int[np.ndarray, "m A"]:
        """Answers, partition after partition."""
        return np.concatenate([choose(rows) for rows in self.log_prob])

    @property
    def truth(self) -> Int[np.ndarray, "m A"]:
        """Labels, repeated for every partition."""
        return np.tile(self.label, (len(self.log_prob), 1))

    @property
    def owner(self) -> np.ndarray:
        """Objects, repeated for every partition."""
        return np.tile(self.objects, len(self.log_prob))

    def surest(self, share: float) -> np.ndarray:
        """Mask [m] of the share of videos of every partition that it is surest of."""
        count = max(1, round(share * len(self.label)))
        sure = [confidence(choose(p), read) for p, read in zip(self.log_prob, self.evidence, strict=True)]
        order = np.argsort(-np.array(sure), 1, kind="stable")
        mask = np.zeros(order.shape, bool)
        np.put_along_axis(mask, order[:, :count], True, 1)
        return mask.ravel()

    def of_surest(self, share: float) -> dict[str, Interval]:
        """Scores of the surest videos."""
        mask = self.surest(share)
        return intervals(self.levels[mask], self.truth[mask], self.owner[mask])


def gains(ours: JudgedAnswers, others: JudgedAnswers) -> dict[str, Interval]:
    """Differences of the scores, paired by video, intervals over objects."""
    first, second = scores(ours.levels, ours.truth), scores(others.levels, others.truth)
    return {
        name: clustered_bootstrap(
            first[name].values - second[name].values, ours.owner[first[name].items], strata=first[name].strata
        )
        for name in first
    }


def partition_table(answers: JudgedAnswers, pooled: JudgedAnswers, seeds: Sequence[int]) -> Table:
    """Scores of every partition, one video and all videos of the object."""
    rows = []
    for seed, *both in zip(seeds, answers.log_prob, pooled.log_prob, strict=True):
        row: dict[str, Any] = {"partition": str(seed)}
        for name, log_prob in zip(("", ", all videos"), both, strict=True):
            found = scores(choose(log_prob), answers.label)
            row |= {key + name: found[key].mean() for key in ("all right", "mean", "OMAE")}
        rows.append(row)
    formats = {key: ".3f" if key.startswith("OMAE") else ".1f" for key in rows[0] if key != "partition"}
    units = {key: "" if key.startswith("OMAE") else "%" for key in formats}
    return named_table("Every partition", rows, formats=formats, units=units)


def people_table(found: Mapping[int, np.ndarray], videos: DescribedVideos) -> Table:
    """Share of the videos whose object people rated, cut into levels, as it is labelled."""
    rows = list[dict[str, Any]]()
    for a, level in found.items():
        right = clustered_bootstrap(100.0 * (level == videos.label[:, a]), videos.objects)
        rows.append({"attribute": NAMES[a], "right": right.mean, "95 %": bounds(right.low, right.high, ".1f")})
    if found:
        both = np.all([level == videos.label[:, a] for a, level in found.items()], 0)
        right = clustered_bootstrap(100.0 * both, videos.objects)
        rows.append({"attribute": "all rated", "right": right.mean, "95 %": bounds(right.low, right.high, ".1f")})
    note = "Ratings of 0 to 10, cut at two thresholds that fit all other objects best; bumps were not rated."
    none = [{"attribute": "none rated", "right": None, "95 %": None}]
    return named_table("People", rows or none, formats={"right": ".1f"}, units={"right": "%", "95 %": "%"}, note=note)


def object_table(videos: DescribedVideos, answers: JudgedAnswers, pooled: JudgedAnswers) -> Table:
    """Every object: its label, the answer to all its videos together, the share of levels right."""
    text = lambda levels: "".join(map(str, levels))
    first, together = choose(answers.log_prob[0]), choose(pooled.log_prob[0])
    right, rows = answers.levels == answers.truth, []
    for name in np.unique(videos.objects):
        mine = videos.objects == name
        row: dict[str, Any] = {
            "object": str(name),
            "label": text(videos.label[mine][0]),
            "answers": " ".join(map(text, first[mine])),
        }
        row |= {"all videos": text(together[mine][0]), "levels right": 100 * float(right[answers.owner == name].mean())}
        rows.append(row)
    meanings = {"label": "hardness, roughness, bumps", "answers": "one to each video, first partition"}
    return named_table(
        "Every object", rows, formats={"levels right": ".0f"}, units={"levels right": "%"}, meanings=meanings
    )


def confusions(answers: JudgedAnswers) -> Picture:
    """Frequency of each answered level for each label, one panel per attribute."""
    words = [[level[0] for level in attribute.levels] for attribute in LANGUAGE.attributes]
    levels, truth = answers.levels, answers.truth
    maps = [confusion_map(levels[:, a], truth[:, a], words[a], name) for a, name in enumerate(NAMES)]
    return Picture(
        name="confusions",
        title="Confusion matrices",
        caption="Share and number of videos, all partitions; each row sums to 100 %.",
        content=heatmaps(maps, x_label="answered", y_label="label", size=(9.0, 3.2)),
    )


def abstention(answers: JudgedAnswers) -> Picture:
    """Scores over the share of the videos that is answered, and how often a stated probability comes true."""
    shares = [share for share in SHARES if len(np.unique(answers.owner[answers.surest(share)])) > 1]  # for intervals
    at = [100 * share for share in shares]
    found = [answers.of_surest(share) for share in shares]
    series = [estimates(name, [one[name] for one in found], at=at, band=True) for name in ("all right", "mean")]
    axes: dict[str, Any] = {"x_label": "videos answered, the surest first (%)", "y_label": "right (%)"}
    panels = [Panel(series, title="Abstention", x_limits=(0, 105), y_limits=(0, 100), **axes)]
    levels, p = answers.levels, np.concatenate([marginals(rows) for rows in answers.log_prob])
    stated, right = np.take_along_axis(p, levels[..., None], -1)[..., 0], levels == answers.truth
    curves = []
    for a, name in enumerate(NAMES):
        part = np.digitize(stated[:, a], BINS) - 1
        kept = [b for b in range(len(BINS) - 1) if (part == b).sum() >= len(BINS)]
        x = [100 * float(stated[part == b, a].mean()) for b in kept]
        curves.append(Series(name, x=x, y=[100 * float(right[part == b, a].mean()) for b in kept]))
    curves.append(Series("as stated", x=[0, 100], y=[0, 100], line=":", marker="", colour="black"))
    axes = {"x_label": "stated probability of the answer (%)", "y_label": "right (%)"}
    panels.append(Panel(curves, title="Calibration", x_limits=(0, 105), y_limits=(0, 100), **axes))
    return Picture(
        name="abstention",
        title="Abstention and calibration",
        caption="Bands are 95 % intervals over objects; all partitions.",
        content=draw(panels, size=(9.0, 3.6)),
    )


def sim_to_real(split: CrossValidation) -> tuple[Picture, Table]:
    """Scores of probes that learn from scenes alone, from scenes and k real objects, and from k real objects alone."""
    config, videos, most = split.config, split.videos, len(np.unique(split.videos.objects))
    own = dataclasses.replace(config.evidence, families=tuple(dict.fromkeys(families())), by_attribute=())
    alone = dataclasses.replace(config, evidence=own)
    counts = [k for k in REAL if k < most]
    found: dict[str, dict[int, Interval]] = {}
    rows = []
    for name, chosen in (("scenes and real objects", config), ("real objects alone", alone)):
        found[name] = {}
        for k in counts:
            if k == 0 and chosen is alone:
                continue
            log_prob = split.probes(chosen, objects=k) if k else scenes_alone(split)
            measured = intervals(choose(log_prob), videos.label, videos.objects)
            found[name][k] = measured["mean"]
            rows.append({"learned from": name, "real objects": k} | {key: one.mean for key, one in measured.items()})
    formats = {key: ".3f" if key == "OMAE" else ".1f" for key in rows[0] if key not in ("learned from", "real objects")}
    note = "Probes alone, on the partition that settings were chosen on."
    units = {key: "levels" if key == "OMAE" else "%" for key in formats}
    formats |= {"real objects": "d"}
    table = named_table("From scenes to real objects", rows, formats=formats, units=units, note=note)
    series = [estimates(name, [*at.values()], at=[*at]) for name, at in found.items()]
    axes: dict[str, Any] = {"x_label": "real objects learned from", "y_label": "levels right (%)"}
    panel = Panel(series, x_limits=(-2, None), y_limits=(30, 80), x_ticks={k: str(k) for k in counts}, **axes)
    picture = Picture(
        name="sim_to_real",
        title="Training on scenes and on real objects",
        caption=note + "  Bars are 95 % intervals over objects.",
        content=draw([panel], size=(6.4, 3.6)),
    )
    return picture, table


def scenes_alone(split: CrossValidation) -> Float[np.ndarray, "n 27"]:
    """Log-probabilities from the levels that scene probes predict; of real videos their mean and deviation are used."""
    config, auxiliary, x = split.config.evidence, split.auxiliary, split.videos.x.astype(np.float64)
    chosen = dataclasses.replace(config, families=tuple(name for name in SCENES if name.endswith(", levels")))
    world = np.concatenate([x, auxiliary.unlabelled]).astype(np.float64)
    sensed, _ = sense(auxiliary, world, x, chosen)
    levels = sensed.reshape(len(x), len(READINGS), len(NAMES), LEVELS).mean(1)
    p = np.clip(levels, 0.02, 1)
    return joint_log_prob(p / p.sum(-1, keepdims=True))
