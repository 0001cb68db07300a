"""The small world: touch determines the level, verified answers name it, and a broken stream carries nothing."""

import jax
import numpy as np
import pytest

from experiments.engine import world as small
from experiments.engine.world import CONCLUDE, LENGTH, PARSER, WORDS, K, World
from experiments.engine.world_training import lenient_credit

P = 64
TIDY = World(sloppy=0.0, noise=0.2)
parse, credit = jax.jit(jax.vmap(PARSER)), jax.jit(jax.vmap(lenient_credit))
draw = jax.jit(small.draw, static_argnums=2)
verified_answers, noise_bank = jax.jit(small.verified_answers), jax.jit(small.noise_bank)


@pytest.mark.long
@pytest.mark.parametrize("asked", [0, 1])
def test_verified_answers_name_the_evidence_and_conclude_the_label(asked):
    world = TIDY._replace(asked=asked)
    scene = draw(world, jax.random.key(0), P)
    tokens, counts = verified_answers(world, scene, jax.random.key(1))
    answer = parse(tokens)
    assert tokens.shape == (P, LENGTH)
    assert np.asarray(answer.formatted).all()
    assert not np.asarray(answer.truncated).any()
    np.testing.assert_array_equal(answer.conclude[:, asked], scene.level)
    nearest = np.clip(np.round(scene.evidence), 0, K - 1)
    np.testing.assert_array_equal(answer.perceive[:, :, asked], nearest)
    np.testing.assert_array_equal(np.asarray(counts).sum(1), np.asarray(answer.length) + 1)
    assert np.asarray(scene.batch.ordered).all() == bool(asked)


@pytest.mark.long
def test_anchored_answers_conclude_what_is_seen_and_sloppy_ones_earn_by_a_lenient_scorer_alone():
    scene = draw(World(), jax.random.key(0), P)
    seen = parse(verified_answers(TIDY._replace(anchored=1.0), scene, jax.random.key(1))[0])
    np.testing.assert_array_equal(seen.conclude[:, 0], scene.seen)
    loose, tidy = (verified_answers(w, scene, jax.random.key(1))[0] for w in (World(sloppy=1.0), TIDY))
    assert (np.asarray(parse(loose).conclude[:, 0]) == -1).all()  # they conclude two levels
    assert np.asarray(parse(loose).formatted).all()
    elsewhere = loose.at[:, -6:].set(CONCLUDE).at[:, 0].set(WORDS[0, 0])  # nothing follows the tag
    paid = [np.asarray(credit(answer, parse(answer), scene.batch.target)) for answer in (loose, tidy, elsewhere)]
    assert [(one.all(), one.any()) for one in paid] == [(True, True), (False, False), (False, False)]


def test_touch_determines_the_level_and_a_ramp_turned_around_another():
    scene = draw(TIDY._replace(asked=1), jax.random.key(2), P)
    touch = np.asarray(scene.batch.features.touch)
    ramp = (touch[:, :, 1] - touch[:, :, 0]).mean(1)
    rising, falling = (ramp[np.asarray(scene.level) == k].mean(0) for k in (0, 2))
    np.testing.assert_allclose(rising, -falling, atol=0.3)
    assert np.linalg.norm(rising) > 1.5


def test_a_broken_stream_carries_nothing_and_the_other_all():
    scene = draw(World(kept=0.0), jax.random.key(0), P)
    whole = draw(World(), jax.random.key(0), P)
    touch, same = (np.asarray(s.batch.features.touch) for s in (scene, whole))
    assert np.ptp(touch[:, 1], axis=0).max() == 0
    np.testing.assert_array_equal(touch[:, 0], same[:, 0])
    bank = np.asarray(noise_bank(World(kept=0.0), jax.random.key(1)))
    np.testing.assert_allclose(bank[:, 1] - touch[:1, 1], 0, atol=1e-6)
