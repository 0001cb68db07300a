"""One run in several processes and on many devices: who they are, how they meet, who writes.

    python -m experiments NAME --distributed --mesh.fsdp 8                                  Slurm, MPI, Kubernetes
    python -m experiments NAME --distributed --mesh.fsdp 8 --coordinator HOST:PORT --processes N --process I

Every process runs the same program.  Process 0 alone writes; where something that it writes decides what comes next,
the others wait for it.  All must see the same run and cache directories, as over a network file system.
"""

import dataclasses
import json
from collections.abc import Callable
from typing import Any, Self

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import Mesh

from touchr1_jax.distributed.mesh import MeshConfig
from touchr1_jax.distributed.placement import Step, local_rows, place_batch, place_state, shard_step
from touchr1_jax.training.loop import Batches

MESSAGE_BYTES = 8192
"""Longest value that processes can agree on: twice Linux's longest path."""


class NoTeam(RuntimeError):
    """The other processes of a distributed run cannot be found."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Launch:
    """Where a run computes.  No part of its configuration, so that it can go on in other processes, on other devices.

    Raises:
      ValueError: an incomplete address, an address of a run that is not distributed, a process beyond the last.
    """

    distributed: bool = False
    """Be one of several processes; Slurm, Open MPI and Kubernetes are asked for the others."""
    coordinator: str | None = None
    """HOST:PORT at which process 0 can be reached, where nobody can be asked."""
    processes: int | None = None
    """How many there are, where nobody can be asked."""
    process: int | None = None
    """Which of them this is, from 0, where nobody can be asked."""
    mesh: MeshConfig = MeshConfig()
    """How the devices of all processes share the training."""

    def __post_init__(self) -> None:
        address = {"coordinator": self.coordinator, "processes": self.processes, "process": self.process}
        missing = [name for name, value in address.items() if value is None]
        if missing and len(missing) < len(address):
            raise ValueError(f"{', '.join(missing)} is not given: must be, beside {address}; give all three or none")
        if not missing and not self.distributed:
            raise ValueError(f"coordinator is {self.coordinator}, but the run is not distributed; add --distributed")
        if self.processes is not None and not 0 <= (self.process or 0) < self.processes:
            raise ValueError(f"process is {self.process}: must be 0 … {self.processes - 1}, one of the processes")


@dataclasses.dataclass(frozen=True)
class Team:
    """The processes of a run; a team of one never asks JAX for anything."""

    processes: int = 1
    process: int = 0

    @property
    def leads(self) -> bool:
        """Whether this is the process that writes."""
        return self.process == 0

    def once(self, do: Callable[[], object]) -> None:
        """Let process 0 do what leaves files behind; nobody is before or after it meanwhile.

        All must call this alike.  Whoever looks at those files before this call finds what was there before, whoever
        looks after it finds the new, so that all processes decide alike.
        """
        self._meet()
        if self.leads:
            do()
        self._meet()

    def agreed(self, choose: Callable[[], Any]) -> Any:
        """What process 0 chooses, a small JSON value, in all processes."""
        if self.processes == 1:
            return choose()
        letters = np.zeros(MESSAGE_BYTES, np.uint8)
        if self.leads:
            chosen = json.dumps(choose()).encode()
            letters[: len(chosen)] = np.frombuffer(chosen, np.uint8)
        return json.loads(bytes(multihost_utils.broadcast_one_to_all(letters)).rstrip(b"\0"))

    def any(self, here: bool) -> bool:
        """Whether it is so in any process; in several it waits for what they are computing."""
        return here if self.processes == 1 else bool(np.any(multihost_utils.process_allgather(np.array(here))))

    def shared_out(self, rows: np.ndarray, make: Callable[[np.ndarray], Any]) -> Any:
        """make(rows), of which each process makes its part.

        Args:
          rows: what there is to do; the parts are neighbours, of one size, the last padded with the last row.
          make: from some rows to a tree of host arrays with one entry a row.
        """
        if self.processes == 1:
            return make(rows)
        size = -(-len(rows) // self.processes)
        mine = np.minimum(np.arange(size) + self.process * size, len(rows) - 1)
        made = multihost_utils.process_allgather(make(rows[mine]), tiled=True)
        return jax.tree.map(lambda x: x[: len(rows)], made)

    def _meet(self) -> None:
        if self.processes > 1:
            multihost_utils.sync_global_devices("experiments")


ALONE = Team()


def joined(launch: Launch) -> Team:
    """The team of this process; must come before anything is computed.

    Raises:
      NoTeam: a distributed run without an address, outside everything that JAX could ask for one.
    """
    if not launch.distributed:
        return ALONE
    try:
        jax.distributed.initialize(launch.coordinator, launch.processes, launch.process)
    except ValueError as error:
        raise NoTeam(
            f"--distributed finds no other processes ({error}): start them with srun, mpirun or as an indexed "
            "Kubernetes job, or say --coordinator HOST:PORT --processes N --process I in each"
        ) from error
    return Team(jax.process_count(), jax.process_index())


class Devices:
    """Where training steps run: on the one device that there is, as they are."""

    shape: tuple[int, ...] = (1, 1, 1)
    """Devices along the axes of the mesh."""

    def rows(self, batch_size: int) -> np.ndarray:
        """Rows of a batch that this process must read, ascending."""
        return np.arange(batch_size)

    def spread(
        self, step: Step, state: Any, batches: Batches, batch_size: int, *shared: Any
    ) -> tuple[Callable[[Any, Any], tuple[Any, dict[str, jax.Array]]], Any, Batches]:
        """A step (state, batch) → (state, metrics), its first state and its batches, where the run computes.

        Args:
          step: (state, batch, *shared) → (state, metrics), jitted.
          state: the first one.
          batches: of the rows that this process reads.
          batch_size: rows of a whole batch.
          shared: what the run never changes.
        """
        del batch_size
        return lambda s, b: step(s, b, *shared), state, batches

    def whole(self, tree: Any) -> Any:
        """Arrays of which every process has all."""
        return tree


class Spread(Devices):
    """The devices of a mesh, those of other processes too."""

    def __init__(self, mesh: Mesh) -> None:
        self._mesh = mesh
        self.shape = mesh.devices.shape
        self._compiled: dict[Step, Step] = {}

    def rows(self, batch_size: int) -> np.ndarray:
        """Those whose devices are this process's."""
        return local_rows(self._mesh, batch_size)

    def spread(
        self, step: Step, state: Any, batches: Batches, batch_size: int, *shared: Any
    ) -> tuple[Callable[[Any, Any], tuple[Any, dict[str, jax.Array]]], Any, Batches]:
        """The same step split by the sharding rules; a program that comes again is compiled once."""
        placed = Placed(batches, self._mesh, batch_size)
        if step not in self._compiled:
            self._compiled[step] = shard_step(step, self._mesh, state, placed.shapes(), *shared)
        on_mesh, there = self._compiled[step], [place_state(self._mesh, x) for x in shared]
        return lambda s, b: on_mesh(s, b, *there), place_state(self._mesh, state), placed

    def whole(self, tree: Any) -> Any:
        """Gathered from all devices of all processes."""
        return jax.tree.map(jnp.asarray, multihost_utils.process_allgather(tree, tiled=True))


class Placed:
    """Batches that lie on a mesh, made from the rows that each process reads."""

    def __init__(self, batches: Batches, mesh: Mesh, batch_size: int) -> None:
        self._batches, self._mesh, self._size = batches, mesh, batch_size

    def __iter__(self) -> Self:
        return self

    def __next__(self) -> Any:
        return place_batch(self._mesh, next(self._batches), self._size)

    def get_state(self) -> Any:
        """Where the batches are; the same in all processes, whatever their number."""
        return self._batches.get_state()

    def set_state(self, state: Any) -> None:
        """Go back there."""
        self._batches.set_state(state)

    def shapes(self) -> Any:
        """Shapes and dtypes of a whole batch, from the first one, which is read again."""
        before = self.get_state()
        first = next(self._batches)
        self.set_state(before)
        return jax.tree.map(lambda x: jax.ShapeDtypeStruct((self._size, *x.shape[1:]), x.dtype), first)


def devices_of(launch: Launch) -> Devices:
    """Where a run computes.

    Raises:
      ValueError: a mesh of another number of devices than the processes have.
    """
    if launch.mesh.devices == 1 and not launch.distributed:
        return Devices()
    return Spread(launch.mesh.build())
