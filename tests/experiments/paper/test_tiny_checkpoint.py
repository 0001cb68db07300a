"""A tiny checkpoint learns answers that parse and agree with themselves, and nothing of touch."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.paper.tiny_checkpoint import UNUSED_TOUCH, drawn_batch, empty_touch
from sensors_io.schema import SENSORS
from touchr1_jax.models.policy import Features, prompt_mask
from touchr1_jax.models.released_policy import build_released_policy
from touchr1_jax.text.oracle import read


@pytest.fixture(scope="module")
def writer(checkpoint):
    return build_released_policy(UNUSED_TOUCH, checkpoint, SENSORS)


@pytest.fixture(scope="module")
def batch(writer):
    return drawn_batch(writer, empty_touch(64), np.random.default_rng(0))


def answers(writer, batch):
    for i in range(len(batch.tokens)):
        asked = (writer.layout.ids == batch.ids[i, 0]).all(-1).argmax()
        text = writer.tokenizer.decode(batch.tokens[i, 0][batch.token_mask[i, 0]])
        yield asked, batch.streams[i, 0], read(writer.language, text)


@pytest.mark.long
def test_drawn_answers_parse_and_agree_with_themselves(writer, batch):
    """What is concluded was compared, and no other level is perceived by more of the sensors that the prompt names."""
    for asked, streams, said in answers(writer, batch):
        assert said.formatted
        perceived = np.asarray(said.perceive)[:, asked]
        np.testing.assert_array_equal(perceived >= 0, streams)
        counts = np.bincount(perceived[streams])
        assert said.conclude[asked] == said.compare[asked] == counts.argmax()


@pytest.mark.long
def test_the_prompt_names_sensors_and_shows_empty_touch(writer, batch):
    """Of the words of a prompt those alone are left out that stand for touch and picture."""
    layout, slots = writer.layout, writer.fns.slots
    touch = jax.tree.map(jnp.asarray, batch.touch)
    streams = touch.stream_mask[0] & batch.streams[0, 0]
    features = Features(
        touch=jnp.zeros((*slots.touch.shape, 1)),
        touch_time=writer.fns.module.token_time(touch.frame_index[0], touch.frame_mask[0]),
        stream_mask=streams,
        view=jnp.zeros((len(slots.view), 1)),
        view_mask=touch.view_mask[0],
    )
    seen = np.asarray(prompt_mask(features, jnp.asarray(batch.mask[0, 0]), slots))
    assert not seen[layout.touch].any()
    assert not seen[layout.view].any()
    names = [s for s in range(len(SENSORS)) if seen[layout.stream_text == s].all()]
    assert names == np.flatnonzero(batch.streams[0, 0]).tolist()
