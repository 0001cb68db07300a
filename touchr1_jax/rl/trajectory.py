"""Trajectories of a policy that explores: its turns and observations, in one program.

Each of B + 1 turns is decoded token by token until it is complete; an action is then taken in the environment, and its
observation is appended to the keys and values of the trajectory.  The last turn must conclude.  A turn that is
malformed ends its trajectory without an answer.  All rollouts write to the same rows, so that shapes are static and the
turns are one `scan`; rows that a rollout leaves empty are never attended to and advance no position.
"""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from touchr1_jax.models.active_policy import ActiveFns
from touchr1_jax.models.lm import PrefixCache
from touchr1_jax.models.token_cache import CompletionCaches
from touchr1_jax.rl.environment import Environment
from touchr1_jax.rl.rollout import GRPOBatch, SampleConfig, any_alive, draw_token, drawn_log_probs, tempered
from touchr1_jax.text.turns import ANY_TURN, LAST_TURN
from touchr1_jax.types import Params, Parsed, Rollout


@struct.dataclass
class ActiveBatch(GRPOBatch):
    """P questions, and the environment's own data of each."""

    case: Any = None


@struct.dataclass
class Trajectories:
    """G trajectories of each of P prompts, of at most B actions; T are the tokens of B + 1 turns.

    `action` is −1 where none was taken.  `seconds` and `harm` are totals.  In `parsed`, `conclude` is the answer,
    `formatted` means that there is an answer, and `truncated` that there is none.
    """

    rollout: Rollout
    touch: Float[Array, "P G B N W"]
    exists: Bool[Array, "P G B N"]
    action: Int[Array, "P G B"]
    seconds: Float[Array, "P G"]
    harm: Float[Array, "P G"]
    parsed: Parsed


class _Walk(NamedTuple):
    """Where all trajectories are before a turn; `hidden` predicts their next token, `made` are the actions so far."""

    state: Any
    made: Int[Array, "P G B"]
    alive: Bool[Array, "P G"]
    hidden: Float[Array, "P G D"]
    caches: CompletionCaches
    seen: Bool[Array, "P G R"]


class _Turn(NamedTuple):
    """A turn that is being written."""

    t: Int[Array, ""]
    place: Int[Array, "P G"]
    walk: _Walk
    tokens: Int[Array, "t P G"]
    log_prob: Float[Array, "t P G"]
    mask: Bool[Array, "t P G"]


class _Done(NamedTuple):
    """Record of one turn and its observation."""

    tokens: Int[Array, "t P G"]
    log_prob: Float[Array, "t P G"]
    mask: Bool[Array, "t P G"]
    touch: Float[Array, "P G N W"]
    exists: Bool[Array, "P G N"]
    action: Int[Array, "P G"]
    levels: Int[Array, "P G A"]
    seconds: Float[Array, "P G"]
    harm: Float[Array, "P G"]


def sample_trajectories(
    fns: ActiveFns,
    params: Params,
    environment: Environment,
    batch: ActiveBatch,
    key: Array,
    draw: SampleConfig,
    budget: int,
) -> Trajectories:
    """Draw a group of trajectories of each prompt, all of which start in the same state of the environment.

    Args:
      fns, params: the policy.
      environment: the environment of the actions.
      batch: prompts.
      key: randomness; token t of turn i uses `fold_in(fold_in(key, i), t)`.
      draw: size of a group, and how tokens are drawn; its length and constraint are those of `fns`.
      budget: B, most actions.
    """
    p, g = batch.ids.shape[0], draw.group
    spread = lambda x: jnp.broadcast_to(x[:, None], (p, g, *x.shape[1:]))
    first, prefix = jax.vmap(lambda f, i, m: fns.prompt_state(params, f, i, m))(batch.features, batch.ids, batch.mask)
    state = jax.tree.map(spread, jax.vmap(environment.reset)(batch.case))
    sampler = _Sampler(fns, params, environment, prefix, draw, budget, _observed_tokens(environment, state))
    rows = (budget + 1) * (fns.turns.length + sampler.observed)
    start = _Walk(
        state=state,
        made=jnp.full((p, g, budget), -1, jnp.int32),
        alive=jnp.ones((p, g), bool),
        hidden=spread(first),
        caches=jax.tree.map(lambda c: jnp.broadcast_to(c, (p, g, *c.shape)), fns.empty_cache(rows)),
        seen=jnp.zeros((p, g, rows), bool),
    )
    keys = jax.vmap(lambda i: jax.random.fold_in(key, i))(jnp.arange(budget + 1))
    _, done = jax.lax.scan(sampler.turn_and_observation, start, (jnp.arange(budget + 1), keys))
    return _trajectories(done, budget)


def _observed_tokens(environment: Environment, state: Any) -> int:
    """N of an environment."""
    one = jax.tree.map(lambda x: x[0, 0], state)
    return jax.eval_shape(lambda s: environment.step(s, jnp.zeros((), jnp.int32))[1].exists, one).shape[0]


def _trajectories(done: _Done, budget: int) -> Trajectories:
    """Trajectories from the records of their turns, [B + 1, …]."""
    by_rollout = lambda x: jnp.moveaxis(x, (2, 3), (0, 1)).reshape(*x.shape[2:4], -1)
    of_actions = lambda x: jnp.moveaxis(x[:budget], 0, 2)
    mask, levels = by_rollout(done.mask), jnp.max(done.levels, 0)
    concluded = jnp.any(levels >= 0, -1)
    nothing = jnp.full_like(levels, -1)
    return Trajectories(
        rollout=Rollout(tokens=by_rollout(done.tokens), log_prob=by_rollout(done.log_prob), mask=mask),
        touch=of_actions(done.touch),
        exists=of_actions(done.exists),
        action=of_actions(done.action),
        seconds=jnp.sum(done.seconds, 0),
        harm=jnp.sum(done.harm, 0),
        parsed=Parsed(
            perceive=nothing[..., None, :],
            compare=nothing,
            conclude=levels,
            formatted=concluded,
            truncated=~concluded,
            length=jnp.sum(mask, -1, dtype=jnp.int32),
        ),
    )


@dataclasses.dataclass(frozen=True)
class _Sampler:
    """The parts of one turn of all trajectories."""

    fns: ActiveFns
    params: Params
    environment: Environment
    prefix: PrefixCache
    draw: SampleConfig
    budget: int
    observed: int

    def turn_and_observation(self, walk: _Walk, place: tuple[Array, Array]) -> tuple[_Walk, _Done]:
        """Write turn i, take its action and append the observation."""
        (i, key), turns = place, self.fns.turns
        row = i * (turns.length + self.observed)
        turn = self.write(walk, i == self.budget, row, key)
        action = jnp.where(walk.alive, jnp.asarray(turns.action)[turn.place], -1)
        levels = jnp.where(walk.alive[..., None], jnp.asarray(turns.answer)[turn.place], -1)
        acts = action >= 0
        step = jax.vmap(jax.vmap(self.environment.step))
        state, outcome = step(walk.state, jnp.maximum(action, 0))
        where_acts = lambda new, old: jnp.where(acts.reshape(acts.shape + (1,) * (new.ndim - 2)), new, old)
        exists = outcome.exists & acts[..., None]
        after = self.observe(turn.walk, outcome.tokens, exists, row + turns.length)
        made = jnp.where(jnp.arange(self.budget) == i, action[..., None], walk.made)
        after = after._replace(state=jax.tree.map(where_acts, state, walk.state), made=made, alive=acts)
        none = lambda x: jnp.where(acts, x, 0.0)
        return after, _Done(
            tokens=turn.tokens,
            log_prob=turn.log_prob,
            mask=turn.mask,
            touch=jnp.where(exists[..., None], outcome.tokens, 0.0),
            exists=exists,
            action=action,
            levels=levels,
            seconds=none(outcome.seconds),
            harm=none(outcome.harm),
        )

    def write(self, walk: _Walk, last: Bool[Array, ""], row: Int[Array, ""], key: Array) -> _Turn:
        """Draw the tokens of a turn until every rollout has completed its own."""
        turns, shape = self.fns.turns, (self.fns.turns.length, *walk.alive.shape)

        def talks(turn: _Turn) -> Bool[Array, "P G"]:
            return turn.walk.alive & ~turns.ends(turn.place)

        def add_token(turn: _Turn) -> _Turn:
            here, goes = turn.walk, talks(turn)
            states = self.fns.placed(here.hidden, turn.place, here.made)
            logits = tempered(self.fns.logits(self.params, states), self.draw.temperature)
            token = draw_token(logits, jax.random.fold_in(key, turn.t), self.draw)
            log_prob = drawn_log_probs(jax.nn.log_softmax(logits), token, self.draw.top_p, self.draw.min_p)
            token = jnp.where(goes, token, self.draw.pad_id)
            x = self.fns.embed(self.params, token)[..., None, :]
            return _Turn(
                t=turn.t + 1,
                place=jnp.where(goes, turns.advance(turn.place, token), turn.place),
                walk=self.append(here, x, goes[..., None], row + turn.t),
                tokens=turn.tokens.at[turn.t].set(token),
                log_prob=turn.log_prob.at[turn.t].set(jnp.where(goes, log_prob, 0.0)),
                mask=turn.mask.at[turn.t].set(goes),
            )

        start = _Turn(
            t=jnp.zeros((), jnp.int32),
            place=jnp.broadcast_to(jnp.where(last, LAST_TURN, ANY_TURN), walk.alive.shape),
            walk=walk,
            tokens=jnp.full(shape, self.draw.pad_id, jnp.int32),
            log_prob=jnp.zeros(shape),
            mask=jnp.zeros(shape, bool),
        )
        return jax.lax.while_loop(lambda turn: (turn.t < turns.length) & any_alive(talks(turn)), add_token, start)

    def observe(
        self, walk: _Walk, tokens: Float[Array, "P G N W"], exists: Bool[Array, "P G N"], row: Int[Array, ""]
    ) -> _Walk:
        """Append observations; nothing is computed where no rollout has one."""
        tokens = self.fns.project(self.params, tokens).astype(walk.hidden.dtype)
        return jax.lax.cond(
            any_alive(jnp.any(exists, -1)), lambda: self.append(walk, tokens, exists, row), lambda: walk
        )

    def append(
        self, walk: _Walk, x: Float[Array, "P G n D"], exists: Bool[Array, "P G n"], row: Int[Array, ""]
    ) -> _Walk:
        """Append embedded tokens; `hidden` is then that of the last one that exists."""
        one = lambda *args: self.fns.advance(self.params, *args)
        group = jax.vmap(one, in_axes=(0, 0, None, None, 0, 0))
        every = jax.vmap(group, in_axes=(0, 0, None, 0, 0, 0))
        hidden, caches, seen = every(x, exists, row, self.prefix, walk.caches, walk.seen)
        last = exists.shape[-1] - 1 - jnp.argmax(exists[..., ::-1], -1)
        newest = jnp.take_along_axis(hidden, last[..., None, None], -2)[..., 0, :]
        hidden = jnp.where(jnp.any(exists, -1, keepdims=True), newest, walk.hidden)
        return walk._replace(hidden=hidden, caches=caches, seen=seen)
