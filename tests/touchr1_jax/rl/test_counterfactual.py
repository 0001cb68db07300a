"""Perturbed touch: what changes, what does not, and where nothing can be changed."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.touchr1_jax import tiny
from touchr1_jax.rl import counterfactual

drop_touch, noise_touch, shuffle_touch, swap_touch, mask_one_stream = map(
    jax.jit,
    (
        counterfactual.drop_touch,
        counterfactual.noise_touch,
        counterfactual.shuffle_touch,
        counterfactual.swap_touch,
        counterfactual.mask_one_stream,
    ),
)
P = 5
NOISE = jnp.asarray(
    np.random.default_rng(0).normal(size=(7, tiny.S, tiny.N, tiny.CONFIG.decoder.hidden_size)), jnp.float32
)
FEATURES = tiny.features(1, P)
many = lambda: jax.random.split(jax.random.key(0), 200)


def longer(p: int, steps: int, tokens: int = 2):
    """Features whose tokens carry their number: `steps` steps of `tokens` tokens."""
    n = steps * tokens
    touch = jnp.broadcast_to(jnp.arange(n, dtype=jnp.float32)[:, None], (p, tiny.S, n, 1))
    time = jnp.broadcast_to(jnp.repeat(3 * jnp.arange(steps), tokens), (p, tiny.S, n))
    return tiny.features(0, p).replace(touch=touch, touch_time=time)


def test_drop_leaves_no_stream():
    present = FEATURES.stream_mask.at[2].set(False)
    dropped = drop_touch(FEATURES.replace(stream_mask=present))
    assert not dropped.features.stream_mask.any()
    np.testing.assert_array_equal(dropped.applies, [True, True, False, True, True])


def test_noise_is_a_draw_of_the_same_sensor():
    touch = np.asarray(jax.vmap(lambda key: noise_touch(FEATURES, NOISE, key))(many()).features.touch)
    drawn = (touch[:, :, None] == np.asarray(NOISE)).all((-1, -2))  # [key, P, K, S]
    assert (drawn.sum(2) == 1).all()
    n = 200 * P * tiny.S
    assert np.abs(drawn.sum((0, 1, 3)) - n / 7).max() < 5 * (n / 7) ** 0.5
    present = FEATURES.stream_mask.at[2].set(False).at[0, 1].set(False)
    applies = noise_touch(FEATURES.replace(stream_mask=present), NOISE, jax.random.key(1)).applies
    np.testing.assert_array_equal(applies, [True, True, False, True, True])


@pytest.mark.long
@pytest.mark.parametrize("steps", [2, 3, 5])
def test_shuffle_permutes_whole_steps_and_is_never_the_identity(steps):
    features = longer(1, steps)
    shuffled = jax.jit(jax.vmap(lambda k: shuffle_touch(features, k)))(many())
    assert shuffled.applies.all()
    np.testing.assert_array_equal(
        shuffled.features.touch_time, np.broadcast_to(features.touch_time, (200, 1, 2, 2 * steps))
    )
    order = np.asarray(shuffled.features.touch)[:, 0, :, :, 0].reshape(-1, steps, 2)
    assert (order[..., 1] == order[..., 0] + 1).all()  # tokens of a step stay together
    np.testing.assert_array_equal(np.sort(order[..., 0]), np.broadcast_to(2 * np.arange(steps), (400, steps)))
    assert (order[..., 0] != 2 * np.arange(steps)).any(-1).all()
    if steps == 3:
        assert len(np.unique(order[..., 0], axis=0)) == 5  # every order but the identity


def test_shuffle_does_not_apply_where_time_stands_still():
    features = longer(2, 3)
    frozen = features.replace(touch_time=features.touch_time.at[0].set(0))
    shuffled = shuffle_touch(frozen, jax.random.key(0))
    np.testing.assert_array_equal(shuffled.applies, [False, True])
    np.testing.assert_array_equal(shuffled.features.touch[0], frozen.touch[0])


def test_shuffle_leaves_steps_alone_that_do_not_exist():
    features = longer(1, 4)
    gone = features.replace(touch_time=features.touch_time.at[..., 2:4].set(-1))
    shuffled = jax.vmap(lambda k: shuffle_touch(gone, k))(many())
    order = np.asarray(shuffled.features.touch)[:, 0, 0, :, 0]
    np.testing.assert_array_equal(order[:, 2:4], np.tile([2, 3], (200, 1)))
    assert (order[:, [0, 4, 6]] != [0, 4, 6]).any(-1).all()


def test_steps_of_unequal_length_keep_their_order():
    features = longer(1, 3)
    uneven = features.replace(touch_time=jnp.broadcast_to(jnp.array([0, 0, 0, 3, 3, 6]), features.touch_time.shape))
    shuffled = shuffle_touch(uneven, jax.random.key(0))
    assert not shuffled.applies.any()
    np.testing.assert_array_equal(shuffled.features.touch, uneven.touch)


def test_swap_gives_each_prompt_the_touch_of_another():
    for key in many()[:20]:
        swapped = swap_touch(FEATURES, key)
        assert swapped.applies.all()
        owner = [[i for i in range(P) if (swapped.features.touch[p] == FEATURES.touch[i]).all()] for p in range(P)]
        assert all(len(o) == 1 and o[0] != p for p, o in enumerate(owner))
        assert len({o[0] for o in owner}) == P


def test_swap_exchanges_only_streams_that_both_have():
    alone = FEATURES.replace(stream_mask=FEATURES.stream_mask.at[:, 1].set(jnp.arange(P) == 0))
    swapped = swap_touch(alone, jax.random.key(0)).features
    np.testing.assert_array_equal(swapped.touch[:, 1], alone.touch[:, 1])
    assert (swapped.touch[:, 0] != alone.touch[:, 0]).any((-1, -2)).all()


def test_a_single_prompt_has_nobody_to_swap_with():
    one = tiny.features(0, 1)
    swapped = swap_touch(one, jax.random.key(0))
    assert not swapped.applies.any()
    np.testing.assert_array_equal(swapped.features.touch, one.touch)


def test_the_touch_of_the_same_contact_is_no_control():
    """Two questions about one contact and one about another: by a shift of 1 or 2, each prompt sees the next."""
    features = jax.tree.map(lambda x: x[jnp.array([0, 0, 1])], FEATURES)
    found = {tuple(swap_touch(features, key).applies.tolist()) for key in many()[:20]}
    assert found == {(False, True, True), (True, False, True)}


def test_one_present_stream_is_masked_uniformly():
    p = 2000
    features = tiny.features(0, 3)
    present = jnp.array([[True, True], [False, True], [False, False]])
    features = jax.tree.map(lambda x: jnp.repeat(x, p, 0), features.replace(stream_mask=present))
    masked, stream = mask_one_stream(features, NOISE, jax.random.key(0))
    changed = np.asarray(jnp.any(masked != features.touch, (-1, -2))).reshape(3, p, tiny.S)
    np.testing.assert_array_equal(changed[0].sum(-1), 1)
    np.testing.assert_array_equal(changed[0].argmax(-1), np.asarray(stream)[:p])
    assert abs(changed[0, :, 0].mean() - 0.5) < 5 * 0.5 / p**0.5
    np.testing.assert_array_equal(changed[1], [[False, True]] * p)
    assert not changed[2].any()
    replaced = np.asarray(masked).reshape(3, p, tiny.S, -1)[1, :, 1]
    bank = np.asarray(NOISE).reshape(7, tiny.S, -1)
    count = [(replaced == bank[k, 1]).all(-1).sum() for k in range(7)]  # a draw of this sensor's noise
    assert sum(count) == p
    assert min(count) > p / 7 - 5 * (p / 7) ** 0.5
