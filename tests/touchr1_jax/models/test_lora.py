"""Adapters: nothing at first, the merged parameters afterwards, and a base that stands still."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.touchr1_jax import tiny
from touchr1_jax.models.layers import GatedMLP, SizeError
from touchr1_jax.models.lm import Decoder
from touchr1_jax.models.lora import Adapter, LoraConfig, adapted, by_layer, init_adapters, merge, merged_kernel

LORA = LoraConfig(rank=3, alpha=6.0)
MLP = LoraConfig(rank=3, targets=("gate", "up", "down"))
FNS = tiny.SHALLOW
L = 5


@pytest.fixture(scope="module")
def base():
    return {**tiny.params(), **tiny.shallow_params()}


def loud(adapters):
    """Adapters that change much."""
    rng = np.random.default_rng(1)
    draw = lambda x: jnp.asarray(rng.normal(0, 0.3, x.shape), jnp.float32)
    return jax.tree.map(draw, adapters)


def variables(params, adapters):
    return {"params": params, "adapters": adapters}


def states(variables):
    """Hidden states of a prompt of the decoder alone."""
    x = jnp.asarray(np.random.default_rng(0).normal(size=(L, tiny.CONFIG.decoder.hidden_size)), jnp.float32)
    decoder = Decoder(FNS.module.config.decoder)
    positions = jnp.tile(jnp.arange(L), (3, 1))
    return decoder.apply(variables, x, positions, jnp.ones(L, bool), method=Decoder.states)[0]


def logits(fns, params):
    batch, tokens = tiny.question_batch(1, 1), tiny.completions(0, 1, 2, 4)
    forward = jax.vmap(fns.group_logits, in_axes=(None, 0, 0, 0, 0))
    return jax.jit(forward)(params, batch.features, batch.ids, batch.mask, tokens)


def test_a_dense_layer_by_hand():
    """x W + (α/r) (x A) B with one input, one output, rank 1 and α = 2."""
    base = {"decoder": {"q_proj": {"kernel": jnp.array([[5.0]])}}}
    adapters = {"decoder": {"q_proj": {"a": jnp.array([[3.0]]), "b": jnp.array([[7.0]])}}}
    merged = merge(base, adapters, LoraConfig(rank=1, alpha=2.0))
    assert merged["decoder"]["q_proj"]["kernel"] == 5 + 2 * 3 * 7
    assert base["decoder"]["q_proj"]["kernel"] == 5


@pytest.mark.long
def test_fresh_adapters_change_nothing():
    """Not a bit, operation by operation; a compiler may round otherwise."""
    x = jnp.asarray(np.random.default_rng(0).normal(size=(L, 6)), jnp.float32)
    base = GatedMLP(5).init(jax.random.key(0), x)["params"]
    adapters = init_adapters(jax.random.key(1), {"decoder": base}, MLP)["decoder"]
    before = GatedMLP(5).apply({"params": base}, x)
    with adapted(MLP.scale):
        np.testing.assert_array_equal(GatedMLP(5).apply(variables(base, adapters), x), before)
        assert (GatedMLP(5).apply(variables(base, loud(adapters)), x) != before).all()
    np.testing.assert_array_equal(GatedMLP(5).apply({"params": base}, x), before)


@pytest.mark.long
def test_adapters_have_the_shapes_of_their_layers(base):
    layer = init_adapters(jax.random.key(0), base, LORA)["decoder"]["last_layer"]
    c = FNS.module.config.decoder
    assert set(layer) == {"q_proj", "k_proj", "v_proj", "o_proj", "mlp"}
    assert layer["k_proj"]["a"].shape == (c.hidden_size, 3)
    assert layer["k_proj"]["b"].shape == (3, c.num_kv_heads * c.head_dim)
    bound = 1 / np.sqrt(c.intermediate_size)
    a = layer["mlp"]["down"]["a"]
    assert 0.8 * bound < float(np.abs(a).max()) <= bound


@pytest.mark.long
def test_merged_parameters_compute_the_same(base):
    """Prompt, completion and their gradients by both methods; far from the base."""
    adapters = loud(init_adapters(jax.random.key(0), base, LORA))
    fns = dataclasses.replace(FNS, lora=LORA, base=base)
    ours = logits(fns, {"adapters": adapters})
    theirs = logits(FNS, merge(base, adapters, LORA))
    assert float(jnp.abs(ours - logits(FNS, base)).max()) > 0.5
    np.testing.assert_allclose(ours, theirs, rtol=0, atol=2e-5 * float(jnp.abs(theirs[..., tiny.WRITABLE]).max()))


@pytest.mark.long
def test_gradients_are_those_through_the_merged_parameters(base):
    decoder = {"decoder": base["decoder"]}
    inner = loud(init_adapters(jax.random.key(0), decoder, LORA))["decoder"]

    def ours(adapters):
        with adapted(LORA.scale):
            return jnp.sum(jnp.sin(states(variables(base["decoder"], adapters))))

    theirs = lambda adapters: jnp.sum(jnp.sin(states({"params": merge(base["decoder"], adapters, LORA)})))
    for a, b in zip(*(jax.tree.leaves(jax.jit(jax.grad(f))(inner)) for f in (ours, theirs)), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-4 * float(np.abs(b).max()))


@pytest.mark.long
def test_layers_that_are_computed_twice_are_adapted_both_times(base):
    """Values and gradients of a policy that keeps little for its backward pass."""
    params = {"adapters": loud(init_adapters(jax.random.key(0), base, LORA))}
    fns = dataclasses.replace(FNS, lora=LORA, base=base)
    lean = dataclasses.replace(fns, module=fns.module.clone(remat=True))
    total = lambda a: jax.value_and_grad(lambda p: jnp.sum(jnp.sin(logits(a, p)[..., tiny.WRITABLE])))(params)
    for a, b in zip(jax.tree.leaves(total(lean)), jax.tree.leaves(total(fns)), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-5 * float(np.abs(b).max()))


def test_only_named_layers_of_named_towers_are_adapted(base):
    config = dataclasses.replace(LORA, targets=("v_proj",))
    assert paths(init_adapters(jax.random.key(0), base, config)) == {"decoder/last_layer/v_proj"}
    config = dataclasses.replace(LORA, targets=(), vision_targets=("qkv", "out"))
    assert {path.split("/")[0] for path in paths(init_adapters(jax.random.key(0), base, config))} == {"vision"}


def paths(adapters) -> set[str]:
    return {"/".join(path) for path in by_layer(adapters)}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"targets": ("q_proj", "query")},
            r"targets \['query'\] are no dense layers of decoder; name others, of \['down'",
        ),
        ({"vision_targets": ("nose",)}, r"targets \['nose'\] are no dense layers of vision"),
    ],
)
def test_layers_must_exist(base, change, message):
    with pytest.raises(SizeError, match=message):
        init_adapters(jax.random.key(0), base, dataclasses.replace(LORA, **change))


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"rank": -1}, "rank is -1: must be at least 0"),
        ({"alpha": 0.0}, "alpha is 0"),
        ({"targets": ()}, r"targets are \(\): must name a layer where rank is above 0"),
    ],
)
def test_settings_are_checked(fields, message):
    with pytest.raises(ValueError, match=message):
        LoraConfig(**fields)


def test_the_scale_by_hand():
    assert LoraConfig(rank=0).scale == LoraConfig(rank=0, rank_stabilised=True).scale == 0
    assert LoraConfig(rank=16, alpha=32.0).scale == 2
    assert LoraConfig(rank=16, alpha=32.0, rank_stabilised=True).scale == 8


def test_foreign_adapters_are_not_merged(base):
    foreign = {"decoder": {"layers_9": {"q_proj": {"a": jnp.ones((1, 1)), "b": jnp.ones((1, 1))}}}}
    with pytest.raises(ValueError, match="belong to no layer of the base"):
        merge(base, foreign, LORA)


def test_half_precision_base_stays_so(base):
    half = jax.tree.map(lambda x: x.astype(jnp.bfloat16), {"decoder": base["decoder"]})
    merged = merge(half, init_adapters(jax.random.key(0), half, LORA), LORA)
    jax.tree.map(np.testing.assert_array_equal, merged, half)


@pytest.mark.parametrize(
    ("dtype", "change", "kept"),
    [
        (jnp.float32, 2**-9, 1.0),
        (jnp.bfloat16, 2**-7, 1.0),  # the neighbour of 1 in bfloat16 is 1 + 2⁻⁷
        (jnp.bfloat16, 2**-9, 0.0),  # a quarter of the way there: rounded back
        (jnp.bfloat16, 3 * 2**-9, 4 / 3),  # three quarters: rounded on
        (jnp.bfloat16, 0.0, 1.0),
    ],
)
def test_what_a_coarse_type_keeps_of_a_change_by_hand(dtype, change, kept):
    adapter = Adapter(jnp.array([[change]]), jnp.array([[1.0]]))
    after, (along, whole) = merged_kernel(jnp.ones((1, 1), dtype), adapter, LoraConfig(rank=1, alpha=1.0))
    assert (after.dtype, float(whole)) == (dtype, change**2)
    assert float(along) == pytest.approx(kept * change**2)


def test_a_change_of_context_reaches_the_frozen_base():
    fns = dataclasses.replace(tiny.SHALLOW, base={"decoder": {"scale": jnp.ones(2)}})
    doubled = fns.with_context(lambda params: jax.tree.map(lambda x: 2 * x, params))
    assert doubled.base["decoder"]["scale"].tolist() == [2, 2]
    assert tiny.SHALLOW.with_context(lambda params: None) is tiny.SHALLOW
