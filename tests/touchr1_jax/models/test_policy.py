"""The prompt: what exists in it, at which positions, and what must not matter."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.touchr1_jax import tiny
from touchr1_jax.models.policy import Policy, Slots, prompt_mask, prompt_positions

P, G, T = 2, 3, 6
TOKENS = tiny.completions(0, P, G, T)
SLOTS = Slots(touch=np.array([[5, 6, 7, 8], [10, 11, 12, 13]]), view=np.arange(4), stream_text=np.array([-1] * 17))
SLOTS.stream_text[[4, 9]] = 0, 1
HAND_MASK = np.array([True] * 14 + [False, True, True])
TIME = np.array([[0, 0, 3, 3], [2, 2, 5, 5]])
HAND = [
    *[(0, 0, 0), (0, 0, 1), (0, 1, 0), (0, 1, 1)],  # the view, 2 × 2
    *[(2, 2, 2)],  # a sensor's name
    *[(3, 3, 3), (3, 3, 4), (6, 3, 3), (6, 3, 4)],  # its tokens: frames 0 and 3, two tokens each
    *[(7, 7, 7)],
    *[(10, 8, 8), (10, 8, 9), (13, 8, 8), (13, 8, 9)],  # frames 2 and 5
    *[(13, 13, 13), (14, 14, 14), (15, 15, 15)],  # padding, then two words
]

group_logits = jax.jit(jax.vmap(tiny.FNS.group_logits, in_axes=(None, 0, 0, 0, 0)))


def logits(batch, tokens=TOKENS):
    return group_logits(tiny.params(), batch.features, batch.ids, batch.mask, tokens)


@pytest.fixture(scope="module")
def batch():
    return tiny.question_batch(1, P)


@pytest.mark.long
def test_positions_by_hand():
    """Frame indices are in them: frames 0 and 3, and 2 and 5, keep their distance of three."""
    ours = prompt_positions(jnp.asarray(TIME), jnp.asarray(HAND_MASK), SLOTS, grid=2)
    np.testing.assert_array_equal(ours.T[HAND_MASK], np.array(HAND)[HAND_MASK])


def test_positions_without_a_stream_by_hand():
    """The first stream and its name take no room: the second starts where the view ends."""
    mask = HAND_MASK.copy()
    mask[4:9] = False
    ours = prompt_positions(jnp.asarray(TIME), jnp.asarray(mask), SLOTS, grid=2)
    moved = np.array(HAND)
    moved[9:] -= 5
    np.testing.assert_array_equal(ours.T[mask], moved[mask])


def test_positions_in_order_by_hand():
    """One by one, and what does not exist takes no room: a server that is sent the others numbers them alike."""
    ours = prompt_positions(jnp.asarray(TIME), jnp.asarray(HAND_MASK), SLOTS, grid=None)
    np.testing.assert_array_equal(ours[:, HAND_MASK], np.tile(np.arange(HAND_MASK.sum()), (3, 1)))


def test_encoded_touch_carries_its_frame_indices():
    batch = tiny.touch_batch(0, 1)
    features = jax.jit(lambda b: tiny.FNS.encode(tiny.params(), b))(batch)
    np.testing.assert_array_equal(features.touch_time, np.repeat(batch.frame_index[..., ::2], 2, -1))
    assert len(np.unique(features.touch_time[0, 0])) == tiny.FRAMES // 2


@pytest.mark.long
@pytest.mark.parametrize("content", [0.0, 1e4])
def test_absent_streams_and_views_hold_nothing(batch, content):
    """Whatever stands in a stream or view that is not there, the logits stay the same to the bit."""
    f = batch.features
    stream_mask = f.stream_mask.at[:, 1].set(False)
    without = f.replace(stream_mask=stream_mask, view_mask=jnp.zeros_like(f.view_mask))
    filled = without.replace(
        touch=f.touch.at[:, 1].set(content),
        touch_time=f.touch_time.at[:, 1].set(jnp.array([1, 1, 50, 50])),
        view=jnp.full_like(f.view, content),
    )
    np.testing.assert_array_equal(logits(batch.replace(features=without)), logits(batch.replace(features=filled)))


@pytest.mark.long
def test_absent_stream_is_a_prompt_without_its_tokens(batch):
    """Oracle: the same prompt with name and tokens of stream 0 cut out, under a layout of one stream."""
    f = batch.features
    masked = batch.replace(features=f.replace(stream_mask=f.stream_mask.at[:, 0].set(False)))
    cut = [*tiny.LAYOUT.touch[0], *np.flatnonzero(tiny.LAYOUT.stream_text == 0)]
    keep = np.setdiff1d(np.arange(tiny.L), cut)
    new_place = np.searchsorted(keep, np.arange(tiny.L))
    text = tiny.LAYOUT.stream_text[keep]
    fns = tiny.make_fns(slots=Slots(new_place[tiny.LAYOUT.touch[1:]], tiny.LAYOUT.view, np.where(text == 1, 0, -1)))
    shorter = f.replace(touch=f.touch[:, 1:], touch_time=f.touch_time[:, 1:], stream_mask=f.stream_mask[:, 1:])
    cut_logits = jax.jit(jax.vmap(fns.group_logits, in_axes=(None, 0, 0, 0, 0)))(
        tiny.params(), shorter, batch.ids[:, keep], batch.mask[:, keep], TOKENS
    )
    np.testing.assert_allclose(logits(masked), cut_logits, rtol=1e-5, atol=2e-5)


def test_time_steps_without_a_frame_do_not_exist():
    """A recording of fewer frames than a clip: the padded step adds no token, whatever stands in its frames."""
    index, mask = jnp.array([[[2, 7, 0, 0]]]), jnp.array([[[True, True, False, False]]])
    time = Policy(tiny.CONFIG).token_time(index, mask)
    np.testing.assert_array_equal(time, [[[2, 2, -1, -1]]])
    late = Policy(tiny.CONFIG).token_time(index, jnp.array([[[False, True, True, False]]]))
    np.testing.assert_array_equal(late, [[[7, 7, 0, 0]]])
    one = jax.tree.map(lambda x: x[0], tiny.features(0, 1))
    short = one.replace(touch_time=one.touch_time.at[0].set(time[0, 0]))
    there = np.asarray(prompt_mask(short, jnp.asarray(tiny.LAYOUT.mask[0]), tiny.SLOTS))
    np.testing.assert_array_equal(there[tiny.LAYOUT.touch], [[True, True, False, False], [True] * 4])
    rows = prompt_positions(jnp.array([[2, 2, -1, -1], [2, 2, 5, 5]]), jnp.asarray(there_by_hand()), SLOTS, grid=2)
    assert rows[0, 9] == 6  # the second name follows frame 2 of the block that starts at 3


def there_by_hand() -> np.ndarray:
    """`HAND_MASK` without the second step of the first stream."""
    mask = HAND_MASK.copy()
    mask[7:9] = False
    return mask


def test_names_of_absent_streams_do_not_exist():
    features = jax.tree.map(lambda x: x[0], tiny.features(0, 1)).replace(stream_mask=jnp.array([False, True]))
    mask = np.asarray(prompt_mask(features, jnp.asarray(tiny.LAYOUT.mask[0]), tiny.SLOTS))
    assert not mask[tiny.LAYOUT.touch[0]].any()
    assert not mask[tiny.LAYOUT.stream_text == 0].any()
    assert mask[tiny.LAYOUT.touch[1]].all()
    assert mask[tiny.LAYOUT.stream_text == 1].all()
    outside = np.delete(np.arange(tiny.L), [*tiny.LAYOUT.touch[0], *np.flatnonzero(tiny.LAYOUT.stream_text == 0)])
    np.testing.assert_array_equal(mask[outside], tiny.LAYOUT.mask[0][outside])


def test_fresh_parameters_are_float32_and_a_function_of_the_key():
    """Traced, not run: the shapes of `initialise` are those that the tests' own parameters take."""
    shapes = jax.eval_shape(lambda: tiny.initialise(jax.random.key(0)))
    assert {x.dtype for x in jax.tree.leaves(shapes)} == {jnp.dtype(jnp.float32)}
    assert jax.tree.map(jnp.shape, tiny.params()) == jax.tree.map(lambda x: x.shape, shapes)
    assert set(shapes) == {"tactile", "tactile_norm", "tactile_in", "tactile_out", "vision", "decoder"}
