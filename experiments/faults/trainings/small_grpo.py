"""Does reinforcement that is killed end as if it had not been?

    main(["small_grpo"], package="experiments.faults.trainings")

The GRPO stage of every study, shortened: its questions in Grain's order, the published objective with its reference and
counterfactual pass, its log with alarms, and a checkpoint every few steps; the newest and the best on validation
questions are kept.  The policy is small and the encoded contacts are random, so that a session starts in seconds and
can be killed hundreds of times.
"""

import dataclasses
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import traverse_util

from experiments.core.artifacts import write_arrays
from experiments.core.context import Context
from experiments.core.loops import run_loop
from experiments.core.results import Results
from experiments.core.runner import Experiment
from experiments.faults.trainings.small_study import ARM, MODEL
from experiments.study.alarm_log import alarm_log
from experiments.study.scores import PUBLISHED
from sensors_io.arrays import load_arrays
from sensors_io.schema import SENSORS
from touchr1_jax.models.policy import Features
from touchr1_jax.models.touch_policy import TouchPolicy, build_policy, touch_shapes
from touchr1_jax.rewards import make_rewards, uniform_prior
from touchr1_jax.rl.config import GRPOConfig
from touchr1_jax.rl.grpo import FrozenInputs, start_state
from touchr1_jax.rl.rollout import GRPOBatch
from touchr1_jax.rl.scoring import make_score
from touchr1_jax.training.loop import LoopConfig
from touchr1_jax.training.questions import QuestionFeed
from touchr1_jax.training.train_grpo import grpo_program
from touchr1_jax.types import Params

STAGE = f"grpo/{ARM}/0"

CONTACTS, HELD_OUT = 48, 8  # contacts to learn from, and others that score a checkpoint
NOISE = 16  # draws in the bank of encoded noise


@dataclasses.dataclass(frozen=True, kw_only=True)
class ReinforcingConfig:
    """Steps, and every how many a checkpoint is saved and scored."""

    steps: int = 2000
    save_every: int = 5
    grpo: GRPOConfig = GRPOConfig(prompts=2, group=3, length=MODEL.completion_tokens, micro_prompts=2)

    def __post_init__(self) -> None:
        self.loop()  # refuses its own values

    def loop(self) -> LoopConfig:
        """Settings of the loop."""
        return LoopConfig(steps=self.steps, save_every=self.save_every)


def run(config: ReinforcingConfig, context: Context) -> Results:
    """Reinforce to the end."""
    policy = build_policy(MODEL, SENSORS)
    prior = uniform_prior(list(policy.levels))
    score, fns = make_score(policy.parser, make_rewards(prior), PUBLISHED), policy.fns
    optimizer, step = grpo_program(fns, score, config.grpo, config.steps, None)
    decoder = {"decoder": fresh_decoder(policy, context.directory / "start.npz")}
    rng = np.random.default_rng(1)
    noise = drawn_features(rng, NOISE).touch
    frozen = FrozenInputs(reference=decoder, noise=jnp.asarray(noise))
    feed = drawn_questions(policy, rng, CONTACTS, config.grpo.drawn)
    batch = next(drawn_questions(policy, rng, HELD_OUT, HELD_OUT))
    begin = jax.jit(lambda params, key: start_state(params, optimizer, key, config.grpo))  # one program, not forty
    state = begin(decoder, jax.random.key(0))
    judge = jax.jit(lambda params: certainty(policy, params, batch))
    run_loop(
        lambda s, batch: step(s, batch, frozen, fns.base),
        state,
        feed,
        config.loop(),
        context,
        STAGE,
        make_log=alarm_log,
        held_out=lambda s: float(judge(s.params)),
    )
    return Results(verdict=("It came to its end.",))


def certainty(policy: TouchPolicy, params: Params, batch: GRPOBatch) -> jax.Array:
    """Mean largest log-probability of the first word about held-out contacts: cheap, and any score will do."""
    first = jax.vmap(lambda f, i, m: policy.fns.prefill(params, f, i, m)[0])(batch.features, batch.ids, batch.mask)
    return jnp.mean(jnp.max(jax.nn.log_softmax(first), -1))


def drawn_questions(policy: TouchPolicy, rng: np.random.Generator, contacts: int, batch_size: int) -> QuestionFeed:
    """Questions about contacts whose features and labels are drawn."""
    label = np.stack([rng.integers(0, levels, contacts) for levels in policy.levels], 1).astype(np.int32)
    return QuestionFeed(policy, drawn_features(rng, contacts), label, batch_size=batch_size, seed=0)


def drawn_features(rng: np.random.Generator, contacts: int) -> Features:
    """Encoded contacts, all there, drawn from N(0, 1); on the host, as stages keep them."""
    width, times = MODEL.decoder.hidden_size, MODEL.frames // MODEL.tactile.frames_per_step
    time = np.repeat(np.arange(times, dtype=np.int32), MODEL.tactile.tokens_per_step)
    normal = lambda *shape: rng.normal(size=(contacts, *shape, width)).astype(np.float32)
    on_host: dict[str, Any] = {
        "touch": normal(len(SENSORS), len(time)),
        "touch_time": np.tile(time, (contacts, len(SENSORS), 1)),
        "stream_mask": np.ones((contacts, len(SENSORS)), bool),
        "view": normal(MODEL.vision.grid**2),
        "view_mask": np.ones(contacts, bool),
    }
    return Features(**on_host)


def fresh_decoder(policy: TouchPolicy, path: Path) -> Params:
    """A fresh policy's, drawn by the first session and found by the others, as GRPO finds what SFT left."""
    if not path.exists():
        shapes = touch_shapes(MODEL, MODEL.vision.image_px, SENSORS)
        params = policy.init(0, jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes))
        write_arrays(path, traverse_util.flatten_dict(params["decoder"], sep="/"))
    return jax.tree.map(jnp.asarray, traverse_util.unflatten_dict(load_arrays(path), sep="/"))


EXPERIMENT = Experiment(name="small_grpo", config=ReinforcingConfig(), run=run)
