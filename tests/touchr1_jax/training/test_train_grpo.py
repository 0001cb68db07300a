"""What is checked before GRPO begins."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.touchr1_jax import tiny
from tests.touchr1_jax.distributed.problems import score
from touchr1_jax.models.lora import LoraConfig
from touchr1_jax.models.touch_policy import ModelConfig, TouchPolicy
from touchr1_jax.rl.config import GRPOConfig, Paper
from touchr1_jax.text.parser import compile_parser
from touchr1_jax.training.loop import Hooks, LoopConfig, SingleDevice
from touchr1_jax.training.train_grpo import check_whole_batch, train_grpo

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


@pytest.mark.long
def test_adapters_on_a_base_of_32_bits_learn_in_bfloat16():
    """The base is frozen, but computed with: its keys did not fit into the caches of the sampler."""
    fns = dataclasses.replace(tiny.SHALLOW, lora=LoraConfig(rank=2, targets=("v_proj",)))
    parser = compile_parser(tiny.LANGUAGE, tiny.TOKENIZER)
    words = {"language": tiny.LANGUAGE, "tokenizer": tiny.TOKENIZER, "layout": tiny.LAYOUT, "parser": parser}
    config = dataclasses.replace(CONFIG, group=2, bfloat16=True, algorithm=Paper(gamma=0.0))
    metrics = []
    after = train_grpo(
        TouchPolicy(model=ModelConfig(), fns=fns, **words),
        tiny.shallow_params(0),
        Repeated(WHOLE),
        score,
        config,
        LoopConfig(steps=1),
        Hooks(log=lambda _, found: metrics.append(found)),
        noise=NOISE,
    )
    assert {x.dtype for x in jax.tree.leaves(after)} == {jnp.dtype(jnp.float32)}
    np.testing.assert_array_equal(after["decoder"]["norm"]["scale"], tiny.shallow_params(0)["decoder"]["norm"]["scale"])
    assert metrics[0]["clip_share"] == 0
    assert 0 < metrics[0]["sampler_gap"] < 0.1
