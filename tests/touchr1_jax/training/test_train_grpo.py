"""What is checked before GRPO begins."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from tests.touchr1_jax import tiny
from touchr1_jax.rl.config import GRPOConfig
from touchr1_jax.training.loop import Hooks, SingleDevice
from touchr1_jax.training.train_grpo import check_whole_batch

P = 3
CONFIG = GRPOConfig(prompts=P, micro_prompts=P, length=3)
WHOLE = tiny.question_batch(0, P)
BLIND = WHOLE.replace(features=WHOLE.features.replace(stream_mask=jnp.zeros((P, tiny.S), bool)))
NOISE = jnp.asarray(np.random.default_rng(1).normal(size=(2, *WHOLE.features.touch.shape[1:])), jnp.float32)


@dataclasses.dataclass
class Repeated:
    """The same batch again and again, and how many were made."""

    batch: object
    count: int = 0

    def __iter__(self):
        return self

    def __next__(self):
        self.count += 1
        return self.batch

    def get_state(self):
        return self.count

    def set_state(self, state):
        self.count = state


class ManyProcesses(SingleDevice):
    """Devices of several processes, whose rows together are `whole`, whatever this one reads."""

    def __init__(self, whole) -> None:
        self.whole = Repeated(whole)

    def shard(self, step, state, batches, batch_size, *constants):
        return lambda s, b: step(s, b, *constants), state, self.whole


def check(own, devices: SingleDevice) -> None:
    check_whole_batch(tiny.SHALLOW, tiny.shallow_params(0), own, CONFIG, Hooks(devices=devices), NOISE, 0)


@pytest.mark.long
def test_streams_are_checked_in_the_batch_of_all_processes_and_no_batch_is_used_up():
    """A process whose own rows have no touch would stop alone, and the others would wait for it for ever."""
    own, devices = Repeated(BLIND), ManyProcesses(WHOLE)
    check(own, devices)
    assert own.count == devices.whole.count == 0
    with pytest.raises(ValueError, match="no prompt of the first batch has touch"):
        check(Repeated(WHOLE), ManyProcesses(BLIND))
    with pytest.raises(ValueError, match="no prompt of the first batch has touch"):
        check(own, SingleDevice())


def test_lean_compilation_is_refused_on_a_mesh_which_would_ignore_it():
    devices = SingleDevice()
    devices.shape = (2, 1, 1)
    config = dataclasses.replace(CONFIG, lean_compilation=True)
    with pytest.raises(ValueError, match=r"lean_compilation is True: must be False on a mesh of \(2, 1, 1\)"):
        check_whole_batch(tiny.SHALLOW, {}, Repeated(WHOLE), config, Hooks(devices=devices), NOISE, 0)
