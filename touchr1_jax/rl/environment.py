"""Environments that a policy explores before it answers: pure functions of arrays, inside the compiled step.

    state = environment.reset(case)
    state, outcome = environment.step(state, action)

An environment is a pytree, so that it is an argument of the program and not a constant in it.  Both functions treat one
trajectory and are batched by `vmap`.  `TouchBank` is the environment of recorded contacts; any other class with the
members of `Environment` can take its place.
"""

import dataclasses
from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from touchr1_jax.rewards.proof import IMPURE, written


class Outcome(NamedTuple):
    """Result of one action: N observed tokens, which of them exist, the time that it took and the harm that it did.

    The outcome of an unavailable action has no existing token, but takes time.
    """

    tokens: Float[Array, "N W"]
    exists: Bool[Array, "N"]
    seconds: Float[Array, ""]
    harm: Float[Array, ""]


@runtime_checkable
class Environment(Protocol):
    """Interface of an environment; a pytree of arrays with these members.

    `actions` are the words of each action, which the policy writes: "tac3d slide 5n".  `kinds` group the actions for
    the alarm of a policy that starts with one kind whatever the question is: the motion of a contact, for example.
    """

    @property
    def actions(self) -> tuple[str, ...]: ...
    @property
    def kinds(self) -> tuple[str, ...]: ...
    def reset(self, case: Any) -> Any:
        """State before the first action; `case` is the environment's own data of one prompt, any tree of arrays."""

    def step(self, state: Any, action: Int[Array, ""]) -> tuple[Any, Outcome]:
        """State after an action, 0 ≤ action < number of actions, and what it returns."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class TouchChoice:
    """One way to touch an object: a sensor, a motion and a normal force in newtons, where it is known."""

    sensor: str
    motion: str
    force_n: float | None

    @property
    def words(self) -> str:
        """The words that choose it, "tac3d slide 5n"."""
        force = "" if self.force_n is None else f" {self.force_n:g}n"
        return f"{self.sensor} {self.motion}{force}".lower()


class TouchCase(NamedTuple):
    """Data of one prompt for a `TouchBank`: the object, and the choices that have not dropped out, C."""

    object: Int[Array, ""]
    offered: Bool[Array, "C"]


@struct.dataclass
class TouchBank:
    """Encoded contacts of O objects, one for each of C choices: N tokens of width W.

    `seconds` is the duration of a contact, also of an unavailable one; `harm` counts the strain limits, of gel and
    object, that it exceeds; `label` is the level of each attribute, −1 if it is unknown.
    """

    tokens: Float[Array, "O C N W"]
    available: Bool[Array, "O C"]
    seconds: Float[Array, "O C"]
    harm: Float[Array, "O C"]
    label: Int[Array, "O A"]
    choices: tuple[TouchChoice, ...] = struct.field(pytree_node=False)

    @property
    def actions(self) -> tuple[str, ...]:
        """The words of each choice."""
        return tuple(choice.words for choice in self.choices)

    @property
    def kinds(self) -> tuple[str, ...]:
        """The motion of each choice."""
        return tuple(choice.motion for choice in self.choices)

    def reset(self, case: TouchCase) -> TouchCase:
        """The state is the case: a recorded contact changes nothing."""
        return case

    def step(self, state: TouchCase, action: Int[Array, ""]) -> tuple[TouchCase, Outcome]:
        """Gather the contact of a choice; an unavailable or not offered contact returns no token and no harm."""
        at = (state.object, action)
        available = self.available[at] & state.offered[action]
        tokens = jnp.where(available, self.tokens[at], 0.0)
        outcome = Outcome(
            tokens=tokens,
            exists=jnp.broadcast_to(available, tokens.shape[:1]),
            seconds=self.seconds[at].astype(jnp.float32),
            harm=jnp.where(available, self.harm[at].astype(jnp.float32), 0.0),
        )
        return state, outcome


def check_bank(bank: TouchBank) -> None:
    """Refuse a bank with objects or choices that leave nothing to choose.

    Raises:
      EnvironmentCheckError: no object, a choice that no object has, or an object with fewer than two contacts.
    """
    available = np.asarray(bank.available)
    if not available.shape[0]:
        raise EnvironmentCheckError("the bank has no object: must have at least 1; add some")
    missing = [words for i, words in enumerate(bank.actions) if not available[:, i].any()]
    if missing:
        raise EnvironmentCheckError(f"choices {missing} are available for no object; leave them out of the bank")
    few = np.flatnonzero(available.sum(1) < 2)
    if len(few):
        raise EnvironmentCheckError(
            f"{len(few)} objects, the first of them {few[:5].tolist()}, have fewer than 2 contacts: there is "
            "nothing to choose; leave them out of the bank"
        )


class EnvironmentCheckError(ValueError):
    """An environment from which nothing can be learned, or that the step cannot run."""


def check_environment(environment: Environment, cases: Any, *, budget: int) -> Outcome:
    """Try every action of an environment on some cases before training; return the outcomes, [cases, actions, …].

    Args:
      environment: the one to check.
      cases: data of some prompts, each array with a leading axis.
      budget: most actions of a trajectory.

    Raises:
      EnvironmentCheckError: a budget below 1, fewer than two actions, repeated words, a number of kinds other than that
        of the actions, functions that cannot be traced, a state that changes its shape, outcomes of wrong shapes or
        types, a number that is not finite, negative seconds or harm, functions that are not pure.
    """
    actions = environment.actions
    if budget < 1:
        raise EnvironmentCheckError(f"budget is {budget}: must be at least 1 action; raise it")
    if len(actions) < 2:
        raise EnvironmentCheckError(f"actions are {actions}: must be at least 2, or there is no choice; add some")
    if len(set(actions)) < len(actions):
        repeated = sorted({words for words in actions if actions.count(words) > 1})
        raise EnvironmentCheckError(f"actions {repeated} occur twice: the words of each must be its own; rename them")
    if len(environment.kinds) != len(actions):
        raise EnvironmentCheckError(
            f"kinds are {len(environment.kinds)} for {len(actions)} actions: must be as many; name one for each"
        )
    outcome = _all_outcomes(environment, cases)
    _check_outcomes(actions, outcome)
    return outcome


def _all_outcomes(environment: Environment, cases: Any) -> Outcome:
    """Outcome of every action after a reset, [cases, actions, …], after a check of shapes and types."""
    index = jnp.arange(len(environment.actions))

    reset, step = lambda e, case: e.reset(case), lambda e, state, action: e.step(state, action)

    def of_case(environment: Environment, case: Any) -> Any:
        state = environment.reset(case)
        return state, jax.vmap(environment.step, in_axes=(None, 0))(state, index)

    try:
        first = jax.tree.map(lambda x: x[0], cases)
        state = jax.eval_shape(reset, environment, first)
        after, outcome = jax.eval_shape(step, environment, state, index[0])
    except Exception as error:
        raise EnvironmentCheckError(
            f"{type(environment).__name__} cannot be traced ({error}): must be a pytree whose reset and step compute "
            "with jax.numpy; use jnp.where for choices that depend on arrays"
        ) from error
    shape = lambda tree: jax.tree.map(lambda x: (x.shape, x.dtype.name), tree)
    if shape(after) != shape(state):
        raise EnvironmentCheckError(f"step makes a state {shape(after)} of {shape(state)}: must keep shapes and types")
    _check_types(outcome)
    for function, of in ((reset, (first,)), (step, (state, index[0]))):
        if written(function, environment, *of) != written(function, environment, *of):
            name = type(environment).__name__
            raise EnvironmentCheckError(f"{name} {IMPURE}; keep a key in its state, and draw from that")
    return jax.device_get(jax.jit(jax.vmap(of_case, in_axes=(None, 0)))(environment, cases)[1][1])


def _check_types(outcome: Any) -> None:
    if not isinstance(outcome, Outcome):
        raise EnvironmentCheckError(f"step returns {type(outcome).__name__}: must be (state, Outcome); return that")
    expected = {"tokens": (2, "float32"), "exists": (1, "bool"), "seconds": (0, "float32"), "harm": (0, "float32")}
    for field, (axes, dtype) in expected.items():
        found = getattr(outcome, field)
        if len(found.shape) != axes or found.dtype != dtype:
            raise EnvironmentCheckError(
                f"outcome.{field} is {found.dtype}{list(found.shape)}: must be {dtype} with {axes} axes; convert it"
            )
    if outcome.tokens.shape[:1] != outcome.exists.shape or not outcome.exists.shape[0]:
        raise EnvironmentCheckError(
            f"outcome.exists is {outcome.exists.shape} for tokens {outcome.tokens.shape}: must be [N] of [N, W], N ≥ 1"
        )


def _check_outcomes(actions: tuple[str, ...], outcome: Outcome) -> None:
    for field in ("tokens", "seconds", "harm"):
        value = np.asarray(getattr(outcome, field))
        wrong = ~np.isfinite(value) | ((value < 0) & (field != "tokens"))
        if wrong.any():
            case, action = np.argwhere(wrong)[0][:2]
            raise EnvironmentCheckError(
                f"outcome.{field} of {actions[action]!r} in case {case} is {value[wrong][0]}: must be finite"
                f"{'' if field == 'tokens' else ' and ≥ 0'}; correct the data"
            )
