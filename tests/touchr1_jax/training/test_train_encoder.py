"""The encoders learn levels by a linear head; what they never see cannot count."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from tests.touchr1_jax import tiny
from touchr1_jax.distributed.mesh import MeshConfig
from touchr1_jax.distributed.rules import state_shardings
from touchr1_jax.models.layers import SizeError
from touchr1_jax.models.tactile_vit import TactileViTConfig
from touchr1_jax.models.touch_policy import ModelConfig, build_policy
from touchr1_jax.training.encoding import touch_statistics
from touchr1_jax.training.fine_tuning import FineTuneState, label_loss
from touchr1_jax.training.loop import Hooks, SingleDevice
from touchr1_jax.training.train_encoder import (
    EncoderTrainingConfig,
    encoder_program,
    head_log_probs,
    read_tokens,
    some_streams,
    touch_rows,
    train_encoder,
)

MODEL = ModelConfig(
    tactile=TactileViTConfig(sensors=0, width=16, num_layers=0, num_heads=2, stem="statistics", stem_width=8),
    vision=tiny.CONFIG.vision,
    decoder=dataclasses.replace(tiny.CONFIG.decoder, vocab_size=0, num_layers=1),
    image_px=28,
)
POLICY = build_policy(MODEL, tuple(s.name for s in tiny.LANGUAGE.sensors))
CONFIG = EncoderTrainingConfig(steps=40, batch_size=8)


def contacts(n: int = 24):
    """Contacts whose hardness is how much the last frames of both sensors brighten; nothing else is known."""
    batch = tiny.touch_batch(3, n)
    level = np.arange(n) % 3
    frames = np.repeat(batch.frames[:, :, :1] // 4, tiny.FRAMES, axis=2)
    frames[:, :, 2:] += (20 * level + 2).astype(np.uint8)[:, None, None, None, None, None]
    label = np.full_like(batch.label, -1)
    label[:, 0] = level
    return batch.replace(frames=frames, label=label)


@functools.cache
def initial():
    """Parameters of `POLICY`."""
    return jax.jit(functools.partial(POLICY.init, 0))(jax.tree.map(lambda x: x[:1], contacts(1)))


@pytest.mark.long
def test_the_encoders_learn_and_the_decoder_stays():
    touch = touch_statistics(POLICY.model.tactile, [contacts()])
    params = initial()
    lines = []
    feed = touch_rows(touch, np.arange(24), batch_size=8, seed=0)
    found = train_encoder(POLICY, params, feed, CONFIG, Hooks(log=lambda t, metrics: lines.append(metrics)))
    first, last = (np.mean([line["accuracy"] for line in part]) for part in (lines[:5], lines[-5:]))
    assert first < 0.6
    assert last > 0.9
    jax.tree.map(np.testing.assert_array_equal, found["decoder"], params["decoder"])
    assert not np.array_equal(found["tactile"]["stem"]["kernel"], params["tactile"]["stem"]["kernel"])


@pytest.mark.long
def test_statistics_that_were_computed_before_give_the_same_features():
    batch = contacts(2).replace(
        frame_mask=np.arange(tiny.FRAMES) < np.array([4, 2])[:, None, None] + np.zeros((2, 2, 1))
    )
    encode = jax.jit(POLICY.fns.encode)
    pixels, computed = (encode(initial(), b) for b in (batch, touch_statistics(MODEL.tactile, [batch])))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-3), pixels, computed)


@pytest.mark.long
def test_the_head_reads_what_is_there():
    features = tiny.features(0, 2)
    width = read_tokens(features).shape[-1]
    rng = np.random.default_rng(0)
    head = {"kernel": jnp.asarray(rng.normal(size=(width, 36)), jnp.float32), "bias": jnp.zeros(36)}
    other = features.replace(touch=features.touch.at[:, 0].add(1.0))
    unseen = jnp.array([[False, True], [False, True]])
    read = lambda x: np.asarray(head_log_probs((3, 3, 3, 9), head, x))
    assert not np.allclose(read(features)[:, 0], read(other)[:, 0])
    np.testing.assert_array_equal(read(features.replace(stream_mask=unseen)), read(other.replace(stream_mask=unseen)))
    assert np.isneginf(read(features)[:, :3, 3:]).all()
    assert np.isfinite(read(features)[:, 3]).all()


def test_tokens_of_touch_count_alike_and_the_more_the_surer():
    ones = jax.tree.map(jnp.ones_like, tiny.features(0, 2))
    (streams, tokens, width), view = ones.touch.shape[1:], ones.view.shape[1]
    both, one = (np.asarray(read_tokens(ones.replace(stream_mask=jnp.array([[True, x]] * 2)))) for x in (True, False))
    np.testing.assert_allclose(both[:, :width], np.sqrt(streams * tokens), rtol=1e-6)
    np.testing.assert_allclose(one[:, :width], np.sqrt(tokens), rtol=1e-6)
    np.testing.assert_allclose(both[:, width:], np.sqrt(view), rtol=1e-6)


@pytest.mark.long
def test_the_gradient_of_micro_batches_is_that_of_the_batch():
    touch = jax.device_put(touch_statistics(POLICY.model.tactile, [contacts()]))
    params = dict(initial())
    kept = {"decoder": params.pop("decoder")}
    width = jax.eval_shape(lambda: read_tokens(POLICY.fns.encode(initial(), touch))).shape[-1]
    rng = np.random.default_rng(0)
    head = {"kernel": jnp.asarray(rng.normal(size=(width, 36)), jnp.float32), "bias": jnp.zeros(36)}
    trained = {"encoders": params, "head": head}
    optimizer, step = encoder_program(POLICY, CONFIG)
    shown = some_streams(jax.random.key(0), touch.stream_mask)

    def whole(trained):
        features = POLICY.fns.encode(kept | trained["encoders"], touch).replace(stream_mask=shown)
        return label_loss(head_log_probs(POLICY.levels, trained["head"], features), touch.label)

    value, gradient = jax.jit(jax.value_and_grad(whole))(trained)
    state = FineTuneState(params=trained, opt_state=optimizer.init(trained), step=jnp.zeros((), jnp.int32))
    metrics, other = (step(tiny.copy(state), touch, kept, jnp.uint32(seed))[1] for seed in (0, 1))
    np.testing.assert_allclose(metrics["loss"], value, rtol=1e-5)
    np.testing.assert_allclose(metrics["grad_norm"], optax.tree.norm(gradient), rtol=1e-5)
    assert abs(other["loss"] - value) > 1e-3  # another seed shows other sensors


def test_half_of_the_contacts_show_a_part_of_their_sensors():
    present = jnp.asarray(np.tile([True, True, False, True], (4000, 1)))
    shown = np.asarray(some_streams(jax.random.key(0), present))
    assert shown.any(1).all()
    assert not shown[:, 2].any()
    # a part of size 1, 2, 3 or 4 of four streams is whole where it holds the three: (0 + 0 + 1/4 + 1)/4; empty in 1/16
    assert abs((shown.sum(1) == 3).mean() - (0.5 + 0.5 * (5 / 16 + 1 / 16))) < 0.03


def test_a_stem_that_reads_whole_frames_drops_no_patch():
    with pytest.raises(SizeError, match="patches_kept"):
        TactileViTConfig(sensors=2, stem="statistics", patches_kept=4)


@pytest.mark.long
def test_every_parameter_has_a_place_on_a_mesh():
    """Of what is trained and of its optimizer's state; the head once had a bias that no rule fitted."""
    batch = contacts(8)
    placed = []

    class OnMesh(SingleDevice):
        """Devices that note how a mesh would split the state."""

        def shard(self, step, state, batches, rows, *shared):
            placed.append(state_shardings(MeshConfig(data=2, fsdp=2).abstract(), state))
            return super().shard(step, state, batches, rows, *shared)

    feed = touch_rows(touch_statistics(POLICY.model.tactile, [batch]), np.arange(8), batch_size=8, seed=0)
    train_encoder(POLICY, initial(), feed, EncoderTrainingConfig(steps=1, batch_size=8), Hooks(devices=OnMesh()))
    assert placed[0].params["head"]["kernel"].spec[0] == "fsdp"
