"""Checkpoints by Orbax: state, data iterator and step together, published atomically, the newest N kept."""

from pathlib import Path
from typing import Any, NamedTuple, Self

import jax
import jax.numpy as jnp
import orbax.checkpoint as ocp


class Restored(NamedTuple):
    """What a checkpoint held."""

    step: int
    state: Any
    data: Any


class Checkpoints:
    """The checkpoints of one stage; a context manager that waits for the last save."""

    def __init__(self, directory: Path, keep: int = 2) -> None:
        self._manager = ocp.CheckpointManager(
            directory.absolute(), options=ocp.CheckpointManagerOptions(max_to_keep=keep, create=True)
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        self._manager.wait_until_finished()
        self._manager.close()

    def save(self, step: int, state: Any, data: Any) -> None:
        """Save a pytree of arrays and a JSON value as checkpoint `step`; writing goes on in the background.

        The arrays are copied first: the writer must not read buffers that the next step takes over by donation.
        """
        state = jax.tree.map(jnp.copy, state)
        args = ocp.args.Composite(state=ocp.args.StandardSave(state), data=ocp.args.JsonSave({"data": data}))
        self._manager.save(step, args=args)

    def latest(self) -> int | None:
        """Step of the newest checkpoint."""
        return self._manager.latest_step()

    def restore(self, like: Any) -> Restored | None:
        """The newest checkpoint in the shapes, dtypes and placement of `like`, or `None` where there is none."""
        step = self._manager.latest_step()
        if step is None:
            return None
        args = ocp.args.Composite(state=ocp.args.StandardRestore(like), data=ocp.args.JsonRestore())
        found = self._manager.restore(step, args=args)
        return Restored(step, found.state, found.data["data"])
