"""Bytes on each device: counted by hand against closed forms, and against what the compiler reserves."""

import json
import os
import subprocess
import sys

import optax
import pytest

from tests.touchr1_jax.distributed.sixteen import DECODER, GRPO, PROMPT, tiny_step
from touchr1_jax.distributed.abstract import PromptShape, abstract_grpo
from touchr1_jax.distributed.memory import Compiled, GRPOShape, cache_bytes, counted_peak, grpo_bytes, saved_bytes
from touchr1_jax.distributed.mesh import MeshConfig
from touchr1_jax.models.layers import MOST_SCORES
from touchr1_jax.models.lora import LoraConfig
from touchr1_jax.models.qwen.config import released
from touchr1_jax.rl.config import GRPOConfig, Paper


def test_arguments_by_hand():
    """One layer of width 64 in float32 on one device: parameters, two moments and a counter, reference."""
    shape, step = tiny_step(1, MeshConfig())
    lines = grpo_bytes(shape, step.state, step.batch, step.frozen)
    attention = 64 * 64 + 64 + 2 * (64 * 32 + 32) + 64 * 64
    numbers = 2 * 512 * 64 + attention + 3 * 64 * 256 + 3 * 64
    assert lines["parameters"] == lines["reference"] == 4 * numbers
    assert lines["optimizer"] == 2 * 4 * numbers + 4
    assert lines["noise bank"] == 64 * 2 * 4 * 64 * 4
    assert lines["weights while sampling"] == 0


def test_sampling_holds_all_weights_of_its_share_of_the_heads():
    """Split in halves along tensor, whole along fsdp, but for what both leave whole: norms and outer biases."""
    alone, step = tiny_step(1, MeshConfig())
    lines = grpo_bytes(tiny_step(1, MeshConfig(fsdp=8, tensor=2))[0], step.state, step.batch, step.frozen)
    whole = grpo_bytes(alone, step.state, step.batch, step.frozen)["parameters"]
    norms = 3 * 64
    assert lines["weights while sampling"] == whole / 2 + 4 * norms / 2


def test_caches_and_saved_products_by_hand():
    """Per token and layer: two key heads of 16, keys and values; and q, k, v, o, gate, up, down."""
    shape, _ = tiny_step(2, MeshConfig(fsdp=8, tensor=2))
    tokens = PROMPT.tokens + 8 * 16
    assert cache_bytes(shape) == 2 * tokens * 2 * (2 * 1 * 16) * 4
    products = (64 + 32 + 32 + 2 * 256) // 2 + 2 * 64
    assert saved_bytes(shape) == 2 * 2 * tokens * 2 * products * 4


def test_phases_do_not_add_up():
    """Of sampling, 3 + 4 + 0, and learning, 1 + 2 + 5 + 6, the larger counts."""
    lines = {
        "weights while sampling": 0,
        "caches while sampling": 3,
        "logits while sampling": 4,
        "gradients": 1,
        "saved for the gradient": 2,
        "attention while learning": 5,
        "logits while learning": 6,
        "parameters": 100,
    }
    assert counted_peak(lines) == 114


def test_a_peak_counts_results_on_buffers_of_their_own():
    assert Compiled(10, 5, 4, 100).peak == 111


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"mesh": MeshConfig(fsdp=3)}, "drawn is 16: must be a multiple of data · fsdp = 3"),
        ({"mesh": MeshConfig(tensor=4)}, "num_kv_heads is 2: must be a multiple of mesh tensor = 4"),
    ],
)
def test_shapes_that_do_not_divide_are_errors(changes, message):
    with pytest.raises(ValueError, match=message):
        GRPOShape(**{"decoder": DECODER, "grpo": GRPO, "mesh": MeshConfig(), "prompt_tokens": 9, **changes})


def test_the_7b_at_the_papers_shapes_on_sixteen_devices_by_count():
    """8 frames of 448² in 4 streams as Qwen2.5-VL cuts them: 4 steps of 256 tokens each; groups of 8, 512 tokens."""
    config, optimizer = released("7B"), optax.adamw(1e-6)
    grpo = GRPOConfig(prompts=16, micro_prompts=8, group=8, length=512, remat=True, bfloat16=True, algorithm=Paper())
    prompt = PromptShape(stream_tokens=1024)
    shape = GRPOShape(decoder=config.decoder, grpo=grpo, mesh=MeshConfig(fsdp=8, tensor=2), prompt_tokens=prompt.tokens)
    step = abstract_grpo(config, prompt, shape, optimizer)
    lines = grpo_bytes(shape, step.state, step.batch, step.frozen)
    assert lines["parameters"] == pytest.approx(4 * 7.616e9 / 16, rel=1e-3)
    assert lines["reference"] == lines["parameters"] / 2 == lines["parameters in bfloat16"]
    assert lines["attention while learning"] == 3 * MOST_SCORES // 2 * 4
    assert counted_peak(lines) < 43e9


def test_adapters_on_a_frozen_base_by_hand():
    """Of one layer of width 64: the base in bfloat16, and factors of rank 2 with two moments and a reference."""
    shape, plain = tiny_step(1, MeshConfig())
    step = tiny_step(1, MeshConfig(), LoraConfig(rank=2))[1]
    lines = grpo_bytes(shape, step.state, step.batch, step.frozen, step.base)
    whole = grpo_bytes(shape, plain.state, plain.batch, plain.frozen)
    factors = 2 * (2 * (64 + 64) + 2 * (64 + 32) + 3 * (64 + 256))
    assert lines["frozen base"] == whole["parameters"] / 2
    assert lines["parameters"] == lines["reference"] == 4 * factors
    assert lines["optimizer"] == 2 * 4 * factors + 4
    assert whole["frozen base"] == 0


@pytest.mark.slow
def test_compiled_arguments_are_those_counted():
    """On sixteen simulated devices, in a process of its own; a key of 8 bytes and a step of 4 are not counted."""
    flags = {"XLA_FLAGS": "--xla_force_host_platform_device_count=16", "JAX_PLATFORMS": "cpu"}
    command = [sys.executable, "-m", "tests.touchr1_jax.distributed.sixteen"]
    done = subprocess.run(command, env=os.environ | flags, capture_output=True, text=True, timeout=280, check=False)
    assert done.returncode == 0, done.stderr[-4000:]
    found = json.loads(done.stdout.splitlines()[-1])
    compiled = {layers: Compiled(*entry["compiled"]) for layers, entry in found.items()}
    for layers, entry in found.items():
        assert compiled[layers].arguments == entry["counted"] + 12
        assert compiled[layers].aliased > compiled[layers].results - 2000  # metrics have no argument to take over
