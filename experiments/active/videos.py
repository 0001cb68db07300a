"""Real touch: several videos of an object as contacts, and a policy that learns from reward when to stop.

All videos show one motion, so the policy chooses only how many to see.  For each fold of the objects, readers, warm
start and reinforced policy learn from the other folds.  A reader's beliefs about a training object come from a reader
that learned from other objects.
"""

import dataclasses
import functools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from experiments.active.arms import TOUCHES, as_json, check_warm_start, from_json
from experiments.active.encoder import belief_scale, belief_tokens
from experiments.active.plans import Answer, Played, play, same_for_all, until_sure
from experiments.active.policies import answerer, explore, part_of, reinforce, warm_up
from experiments.core.charts import Panel, draw, estimates
from experiments.core.context import Context
from experiments.core.errors import ConfigurationError
from experiments.core.results import Picture, Table, named_table
from experiments.recordings.cross_validation import deal_folds
from experiments.recordings.descriptions import DescribedVideos, describe_source
from experiments.recordings.scene_presses import SENSOR
from experiments.study.estimates import RESAMPLES, points
from sensors_io.touches import families
from touchr1_jax.bench.statistics import Interval, clustered_bootstrap
from touchr1_jax.models.active_policy import build_active_policy
from touchr1_jax.models.description_policy import LANGUAGE, LEVELS
from touchr1_jax.models.lm import DecoderConfig
from touchr1_jax.rl.config import GRPOConfig
from touchr1_jax.rl.environment import TouchBank, TouchChoice
from touchr1_jax.rl.touch_reward import Prices
from touchr1_jax.training.exploration import NO_CHOICE
from touchr1_jax.training.kernel_probe import KernelProbeConfig, cross_probe, object_weights
from touchr1_jax.training.optimizer import OptimizerConfig
from touchr1_jax.training.train_sft import SFTConfig

CHOSEN = "chosen"

READERS = KernelProbeConfig(families=tuple(dict.fromkeys(families())))


@dataclasses.dataclass(frozen=True, kw_only=True)
class StoppingConfig:
    """Folds and training of the policies that stop.

    Args:
      videos: of each object, in an order drawn by the seed; objects with fewer are left out.
      frames: in contact that are described of each video.
      folds: parts of the objects.
      warm_share: share of the training objects that the warm start learns from; reinforcement has the others.
      prices: of a video, in right answers; one policy each.
      thresholds: probabilities of the likeliest level at which the control by threshold stops.
      decoder, warm, grpo, steps: of the policies.
      seed: of order, folds and policies.
    """

    videos: int = 5
    frames: int = 8
    folds: int = 5
    warm_share: float = 0.6
    prices: tuple[float, ...] = (0.005, 0.02, 0.05)
    thresholds: tuple[float, ...] = (0.4, 0.5, 0.6, 0.7, 0.8)
    decoder: DecoderConfig = DecoderConfig(
        vocab_size=0,
        hidden_size=64,
        num_layers=2,
        num_heads=4,
        num_kv_heads=2,
        head_dim=16,
        intermediate_size=128,
        mrope_section=(2, 3, 3),
    )
    warm: SFTConfig = SFTConfig(
        steps=300,
        batch_size=64,
        questions=1,
        micro_contacts=64,
        optimizer=OptimizerConfig(learning_rate=1e-5, lr_scale=200.0, weight_decay=0.05),
    )
    grpo: GRPOConfig = GRPOConfig(
        prompts=24,
        group=12,
        micro_prompts=24,
        lr_scale=1000.0,
        algorithm=TOUCHES,
    )
    steps: int = 80
    seed: int = 0

    def __post_init__(self) -> None:
        check_warm_start(self.warm)
        if self.videos < 2 or self.folds < 2 or not 0 < self.warm_share < 1:
            raise ConfigurationError(
                f"videos, folds, warm_share are {self.videos}, {self.folds}, {self.warm_share}: must be at least 2, "
                "at least 2, and between 0 and 1; correct them"
            )


@dataclasses.dataclass(frozen=True)
class VideoWorld:
    """V described videos of each of O objects, and the levels of its A attributes."""

    x: Float[np.ndarray, "n V D"]
    label: Int[np.ndarray, "n A"]
    fold: Int[np.ndarray, "n"]


def world_of(config: StoppingConfig, videos: DescribedVideos) -> VideoWorld:
    """The objects that have enough videos, and those of each in an order drawn by the seed."""
    names, count = np.unique(videos.objects, return_counts=True)
    names = names[count >= config.videos]
    rng = np.random.default_rng(config.seed)
    rows = np.array([rng.permutation(np.flatnonzero(videos.objects == n))[: config.videos] for n in names], int)
    label = videos.label[rows[:, 0]] if len(rows) else np.zeros((0, 1), np.int32)
    return VideoWorld(videos.x[rows], label, deal_folds(names, label, config.folds, config.seed))


def bank_of(world: VideoWorld, tested: Int[np.ndarray, "n"], seed: int) -> TouchBank:
    """The videos as contacts, each read by probes that learned neither from its object nor from those tested."""
    objects, videos, _ = world.x.shape
    owner = np.repeat(np.arange(objects), videos)
    label = np.repeat(world.label, videos, 0)
    weight = object_weights(owner, ~np.isin(owner, tested))
    flat = world.x.reshape(len(owner), -1).astype(np.float64)
    found = cross_probe(flat, np.eye(LEVELS)[label], weight, owner, np.array(families()), READERS, seed).mean(1)
    belief = np.log(found).reshape(objects, videos, *found.shape[1:]).astype(np.float32)
    shape = (objects, videos)
    return TouchBank(
        tokens=jnp.asarray(belief_tokens(belief, belief_scale(belief))),
        available=jnp.ones(shape, bool),
        seconds=jnp.ones(shape),
        harm=jnp.zeros(shape),
        label=jnp.asarray(world.label),
        choices=tuple(TouchChoice(sensor=SENSOR, motion=f"video {v + 1}", force_n=None) for v in range(videos)),
    )


def stopping(config: StoppingConfig, source: Path, context: Context) -> tuple[Table, Picture]:
    """Accuracy against the number of videos: policies, a random number, so many for all, thresholds on belief."""
    world = world_of(config, describe_source(source, config.frames, context).labelled())
    folds: list[Mapping[str, Played]] = []
    for k in context.each("folds of videos", range(config.folds)):
        compute = functools.partial(_fold, config, world, k, context)
        folds.append(from_json(context.once(f"videos/{k}", compute)))
    played = {name: _joined([fold[name] for fold in folds]) for name in folds[0]}
    return video_table(world, played), video_picture(config, played)


def _fold(config: StoppingConfig, world: VideoWorld, k: int, context: Context) -> dict[str, Any]:
    """Outcomes of policies and controls about the objects of one fold, as JSON."""
    tested, known = np.flatnonzero(world.fold == k), np.flatnonzero(world.fold != k)
    bank = bank_of(world, tested, config.seed)
    policy = build_active_policy(bank.actions, config.decoder, attributes=LANGUAGE.attributes)
    rng = np.random.default_rng([config.seed, k])
    # equal numbers in all folds, so that one program serves them
    most = len(world.fold) - int(np.bincount(world.fold).max())
    known = rng.permutation(known)[:most]
    warm_objects, others = np.split(known, [round(config.warm_share * most)])
    stage = f"videos/warm/{k}"
    warm = warm_up(policy, part_of(bank, warm_objects), config.videos, config.warm, context, stage, config.seed)
    answer = answerer(policy, warm, bank)
    found = controls_of(config, bank, tested, answer, rng)
    for price in config.prices:
        params = reinforce(
            policy,
            warm,
            part_of(bank, others),
            config.grpo,
            config.videos,
            Prices(second=jnp.float32(price), harm=jnp.float32(0.0)),
            0.0,
            config.steps,
            context,
            f"videos/grpo/{price:g}/{k}",
            config.seed,
        )
        touches = explore(policy, params, bank, tested, config.videos).choices
        found[f"{CHOSEN} at {price:g}"] = play(bank, tested, touches, answer)  # by the warm start, as the controls
    return as_json(found)


def controls_of(
    config: StoppingConfig, bank: TouchBank, tested: Int[np.ndarray, "n"], answer: Answer, rng: np.random.Generator
) -> dict[str, Played]:
    """So many videos for all, a random number of them, and as many as a threshold on belief asks for."""
    n, questions, videos = len(tested), bank.label.shape[1], config.videos
    every = same_for_all(tuple(range(videos)), n, questions)
    made = {"0 videos": np.full((n, questions, 1), NO_CHOICE, np.int32)}
    made |= {f"{k} videos": every[..., :k] for k in range(1, videos + 1)}
    number = rng.integers(0, videos + 1, (n, questions, 1))
    made["a random number"] = np.where(np.arange(videos) < number, every, NO_CHOICE)
    order = [tuple(range(videos))] * questions
    for threshold in config.thresholds:
        made[f"until {threshold:g}"] = until_sure(tested, order, videos, threshold, answer)
    return {name: play(bank, tested, choices, answer) for name, choices in made.items()}


def _joined(parts: Sequence[Played]) -> Played:
    widest = max(part.choices.shape[-1] for part in parts)
    fill = lambda x: np.pad(x, ((0, 0), (0, 0), (0, widest - x.shape[-1])), constant_values=NO_CHOICE)
    joined = {f: np.concatenate([getattr(p, f) for p in parts]) for f in ("right", "seconds", "harm")}
    return Played(**joined, choices=np.concatenate([fill(p.choices) for p in parts]))


def accuracy(played: Played) -> Interval:
    """Right answers in %, mean over the attributes, with an interval over objects."""
    n, questions = played.right.shape
    strata = np.tile(np.arange(questions), n)
    objects = np.repeat(np.arange(n), questions)
    return clustered_bootstrap(100 * played.right.ravel(), objects, strata=strata, resamples=RESAMPLES)


def equal_videos(played: Mapping[str, Played], one: Played, videos: int) -> Interval:
    """Right answers of a plan less those of so many videos for all in the same mean number, points, over objects."""
    number = float(one.contacts.mean())
    below = min(int(number), videos - 1)
    share = number - below
    fixed = (1 - share) * played[f"{below} videos"].right + share * played[f"{below + 1} videos"].right
    return points((one.right - fixed).mean(1), np.arange(len(fixed)))


def video_table(world: VideoWorld, played: Mapping[str, Played]) -> Table:
    """Accuracy against the number of videos."""
    rows: list[dict[str, Any]] = []
    videos = world.x.shape[1]
    for name, one in played.items():
        found, gain = accuracy(one), equal_videos(played, one, videos)
        by = {a.name: 100 * float(x) for a, x in zip(LANGUAGE.attributes, one.right.mean(0), strict=True)}
        number = {"plan": name, "videos": float(one.contacts.mean())}
        rows.append(
            number
            | {"right": found.mean, "from": found.low, "to": found.high}
            | by
            | {"over as many for all": gain.mean, "its low": gain.low, "its high": gain.high}
        )
    percent = ("right", "from", "to", *(a.name for a in LANGUAGE.attributes))
    points = ("over as many for all", "its low", "its high")
    return named_table(
        "Real touch: when to stop",
        rows,
        formats=dict.fromkeys((*percent, *points), ".1f") | {"videos": ".2f"},
        units=dict.fromkeys(percent, "%") | dict.fromkeys(points, "points"),
        note=f"{len(world.label)} real objects, {videos} videos each, no object in two folds, intervals over objects. "
        "All plans are answered by the warm start. A policy at a price stops where it expects no gain; "
        "`until` stops when the likeliest level has that probability.",
    )


def video_picture(config: StoppingConfig, played: Mapping[str, Played]) -> Picture:
    """Accuracy over the mean number of videos."""
    groups = {
        "so many for all": [f"{k} videos" for k in range(config.videos + 1)],
        "until a threshold": [f"until {t:g}" for t in config.thresholds],
        "policy at a price": [f"{CHOSEN} at {p:g}" for p in config.prices],
        "a random number": ["a random number"],
    }
    series = []
    for title, names in groups.items():
        found = [accuracy(played[name]) for name in names]
        at = [float(played[name].contacts.mean()) for name in names]
        series.append(estimates(title, found, at=at, line="-" if len(names) > 1 else ""))
    panel = Panel(series, x_label="videos a question, mean", y_label="right about unseen objects, %")
    return Picture(
        name="real_touch",
        title="Real touch: when to stop",
        caption="Right answers about real objects over the mean number of videos, with 95 % intervals over objects.",
        content=draw([panel], size=(7.0, 4.2)),
    )
