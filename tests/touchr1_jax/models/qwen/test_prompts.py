"""Conversations with pictures and videos as the model reads them."""

import numpy as np
import pytest

from tests.touchr1_jax.models.qwen.small_policy import CONFIG, TOKENIZER
from touchr1_jax.models.qwen.geometry import Grid
from touchr1_jax.models.qwen.pictures import PixelBudget
from touchr1_jax.models.qwen.positions import picture, position_ids, video
from touchr1_jax.models.qwen.prompts import Film, prepare, show_picture, show_video
from touchr1_jax.text.chat import ChatMessage, Media, render

BUDGET = PixelBudget(least=64, most=1024)
WIDE, TALL = (
    np.random.default_rng(i).integers(0, 256, s, dtype=np.uint8) for i, s in enumerate([(8, 16, 3), (24, 8, 3)])
)
FILM = Film(np.random.default_rng(2).integers(0, 256, (3, 16, 8, 3), dtype=np.uint8), 2.0)
MESSAGES = [
    ChatMessage(role="user", parts=(Media.PICTURE, "soft", Media.VIDEO, Media.PICTURE)),
    ChatMessage(role="assistant", parts=("hard",)),
]


def prepared(**changes):
    shown = {"pictures": [WIDE, TALL], "videos": [FILM]} | changes
    return prepare(MESSAGES, TOKENIZER, CONFIG, **shown, picture_budget=BUDGET, video_budget=BUDGET)


@pytest.fixture(scope="module")
def ready():
    return prepared()


def test_everything_shown_stands_in_its_order(ready):
    """Both kinds in the order of the conversation, patches and grids alike; the film's odd frame is shown twice."""
    inputs, grids = ready
    assert grids == (Grid(1, 2, 4), Grid(2, 4, 2), Grid(1, 6, 2))
    parts = [show_picture(WIDE, CONFIG.vision, BUDGET), show_video(FILM, CONFIG.vision, BUDGET)]
    parts.append(show_picture(TALL, CONFIG.vision, BUDGET))
    np.testing.assert_array_equal(inputs.patches, np.concatenate([part.patches for part in parts]))
    ids = np.asarray(inputs.ids)[np.asarray(inputs.slots)]
    np.testing.assert_array_equal(ids, [CONFIG.image_id] * 2 + [CONFIG.video_id] * 4 + [CONFIG.image_id] * 3)


def test_words_are_those_of_the_conversation(ready):
    inputs, _ = ready
    ids = np.asarray(inputs.ids)
    pads = np.isin(ids, [CONFIG.image_id, CONFIG.video_id])
    text = [i for i in TOKENIZER.encode(render(MESSAGES)) if i not in (CONFIG.image_id, CONFIG.video_id)]
    np.testing.assert_array_equal(ids[~pads], text)


def test_positions_are_counted_over_the_whole(ready):
    """Two frames a second and two a step: one second a step, two ids."""
    inputs, _ = ready
    slots = np.asarray(inputs.slots)
    gaps = np.diff(np.concatenate([[-1], slots, [len(inputs.ids)]])) - 1  # words before each token
    seen = [picture(Grid(1, 2, 4), 2), video(Grid(2, 4, 2), 2, 1.0, 2), picture(Grid(1, 6, 2), 2)]
    words = gaps[[0, 2, 6, -1]]
    runs = [int(words[0]), seen[0], int(words[1]), seen[1], int(words[2]), seen[2], int(words[3])]
    np.testing.assert_array_equal(inputs.positions, position_ids(runs))


def test_text_alone_has_nothing_to_show():
    inputs, grids = prepare([ChatMessage(role="user", parts=("soft",))], TOKENIZER, CONFIG)
    assert grids == ()
    assert inputs.slots.size == inputs.patches.size == 0
    np.testing.assert_array_equal(inputs.positions, [range(len(inputs.ids))] * 3)


@pytest.mark.parametrize(
    ("changes", "message"),
    [({"pictures": [WIDE]}, "the text has more of them"), ({"videos": [FILM, FILM]}, "are left over")],
)
def test_every_place_needs_its_picture(changes, message):
    with pytest.raises(ValueError, match=message):
        prepared(**changes)


def test_film_must_have_frames():
    with pytest.raises(ValueError, match="frames are 0 of 16×8 px"):
        show_video(FILM._replace(frames=FILM.frames[:0]), CONFIG.vision, BUDGET)
