"""The rules name every parameter that there is, split what is large, and refuse the rest by name."""

import math
from typing import get_args, get_type_hints

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from jax.sharding import PartitionSpec as P

from tests.touchr1_jax import tiny
from tests.touchr1_jax.distributed.problems import PROBLEMS
from touchr1_jax.distributed.mesh import MeshConfig
from touchr1_jax.distributed.rules import activation_axes, batch_shardings, gathered_shardings, rule, state_shardings
from touchr1_jax.models.frame_decoder import FrameDecoder, FrameDecoderConfig
from touchr1_jax.models.layers import SizeError
from touchr1_jax.models.lora import LoraConfig, init_adapters
from touchr1_jax.models.qwen.config import released
from touchr1_jax.models.qwen.model import abstract_params
from touchr1_jax.models.vision import VisionConfig

MESH = MeshConfig(data=2, fsdp=4, tensor=2).abstract()


def specs(tree) -> dict[str, P]:
    """Partition of each leaf, by its path."""
    found = jax.tree_util.tree_leaves_with_path(state_shardings(MESH, tree))
    return {jax.tree_util.keystr(path, simple=True, separator="/"): s.spec for path, s in found}


@pytest.fixture(scope="module")
def seven():
    """Parameters of Qwen2.5-VL 7B, in shapes."""
    return abstract_params(released("7B"))


def test_kernels_of_the_decoder_by_hand(seven):
    found = specs({"decoder": seven["decoder"]})
    layer = "decoder/last_layer"
    assert found[f"{layer}/q_proj/kernel"] == P("fsdp", "tensor")
    assert found[f"{layer}/q_proj/bias"] == P("tensor")
    assert found[f"{layer}/o_proj/kernel"] == P("tensor", "fsdp")
    assert found[f"{layer}/mlp/down/kernel"] == P("tensor", "fsdp")
    assert found[f"{layer}/norm_mlp/scale"] == P(None)
    assert found["decoder/layers/q_proj/kernel"] == P(None, "fsdp", "tensor")
    assert found["decoder/embedding/embedding"] == P("tensor", "fsdp")
    assert found["decoder/head/kernel"] == P("fsdp", "tensor")


@pytest.mark.parametrize("size", [2, 8, 16])
def test_a_device_holds_its_share_of_the_published_model(seven, size):
    """To two thousandths, norms and biases; the vision tower's heads are not split along tensor."""
    mesh = MeshConfig(fsdp=size).abstract()
    held = jax.tree.map(lambda x, s: math.prod(s.shard_shape(x.shape)), seven, state_shardings(mesh, seven))
    total = sum(x.size for x in jax.tree.leaves(seven))
    assert total / size <= sum(jax.tree.leaves(held)) < 1.002 * total / size


@pytest.mark.long
@pytest.mark.parametrize("name", ["sft", "grpo", "dynamics"])
def test_states_of_all_stages_are_named_and_moments_lie_as_their_parameters(name):
    state = PROBLEMS[name]().state
    found = specs(state)
    moments = {path.partition("/mu/")[2]: spec for path, spec in found.items() if "/mu/" in path}
    assert moments
    assert {f"params/{path}": spec for path, spec in moments.items()}.items() <= found.items()
    assert found["step"] == P()


def test_adapters_lie_as_the_layers_that_they_change(seven):
    base = {"decoder": {name: seven["decoder"][name] for name in ("layers", "last_layer")}}
    adapters = jax.eval_shape(lambda: init_adapters(jax.random.key(0), base, LoraConfig(rank=3)))
    found = specs(adapters)
    assert found["decoder/last_layer/q_proj/a"] == P("fsdp", None)
    assert found["decoder/last_layer/q_proj/b"] == P(None, "tensor")
    assert found["decoder/layers/mlp/down/a"] == P(None, "tensor", None)


def test_gathered_parameters_keep_their_share_of_the_heads(seven):
    layer = {"last_layer": seven["decoder"]["last_layer"]}
    found = gathered_shardings(MESH, layer)["last_layer"]
    assert found["q_proj"]["kernel"].spec == P(None, "tensor")
    assert found["o_proj"]["kernel"].spec == P("tensor", None)
    assert found["q_proj"]["bias"].spec == P("tensor")


def test_the_frame_decoder_is_named():
    frames, patches = jnp.zeros((1, 8, 8, 3)), jnp.zeros((1, 4, 5))
    config = FrameDecoderConfig(width=8, num_layers=1)
    init = lambda: FrameDecoder(config).init(jax.random.key(0), frames, frames, patches, jnp.zeros((1, 2)))
    assert specs(jax.eval_shape(init)["params"])["conv_0/kernel"] == P(None, None, None, "fsdp")


@pytest.mark.parametrize("stem", get_args(get_type_hints(VisionConfig)["stem"]))
def test_the_vision_tower_is_named_with_every_stem(stem):
    """That of studies reads statistics: before, each of them ended in an error on a mesh."""
    tower, view = VisionConfig(stem=stem).tower(8), jnp.zeros((1, 64, 64, 3), jnp.uint8)
    found = specs(jax.eval_shape(lambda: tower.init(jax.random.key(0), view))["params"])
    assert found[f"{'cell' if stem == 'statistics' else 'patch'}/kernel"] == P(None, "fsdp")


def test_a_parameter_without_a_rule_is_named():
    with pytest.raises(ValueError, match="parameter params/tower/novelty/kernel has no sharding rule"):
        specs({"params": {"tower": {"novelty": {"kernel": jnp.zeros((8, 8))}}}})


def test_a_parameter_of_another_rank_is_named():
    with pytest.raises(ValueError, match=r"q_proj/kernel has 3 dimensions, its sharding rule .* has 2"):
        rule("decoder/q_proj/kernel", 3)


def test_a_large_parameter_that_an_axis_does_not_divide_is_named(seven):
    """3420 hidden channels of the published vision tower over eight devices."""
    with pytest.raises(SizeError, match=r"blocks/mlp/\w+/\w+ has shape .*multiple of mesh tensor = 8"):
        state_shardings(MeshConfig(tensor=8).abstract(), {"vision": {"blocks": seven["vision"]["blocks"]}})


def test_a_small_parameter_that_an_axis_does_not_divide_stays_whole_and_a_large_one_is_named():
    kernel = lambda *shape: {"q_proj": {"kernel": jax.ShapeDtypeStruct(shape, jnp.float32)}}
    assert state_shardings(MESH, kernel(6, 6))["q_proj"]["kernel"].spec == P(None, "tensor")
    with pytest.raises(SizeError, match=r"dimension 0 must be a multiple of mesh fsdp = 4; choose a divisor of 514"):
        state_shardings(MESH, kernel(514, 512))  # 1 MiB and some


def test_batches_are_split_by_their_rows():
    found = batch_shardings(MESH, tiny.question_batch(0, 8))
    assert {s.spec for s in jax.tree.leaves(found)} == {P(("data", "fsdp"))}


def test_a_batch_that_does_not_divide_is_an_error():
    with pytest.raises(SizeError, match=r"batch ids has shape \(6, 4\).*multiple of data · fsdp = 8"):
        batch_shardings(MESH, {"ids": np.zeros((6, 4))})


def test_outputs_of_opening_layers_are_split_and_the_stream_is_whole():
    free = P.UNCONSTRAINED
    assert activation_axes("q_proj", 3) == P(free, free, "tensor")
    assert activation_axes("o_proj", 2) == P(free, None)
    assert activation_axes("head", 1) == P("tensor")


def test_scalars_are_whole_whatever_they_are():
    assert set(specs(optax.adam(1.0).init({"scale": jnp.zeros(3)})).values()) == {P(), P(None)}
