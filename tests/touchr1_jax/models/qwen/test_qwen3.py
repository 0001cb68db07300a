"""Qwen3-VL without transformers: positions and levels by hand, and a policy on it in the released format."""

import json
import shutil

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.paper.tiny_checkpoint import SMALLEST_QWEN3, write_tiny
from sensors_io.schema import SENSORS
from tests.experiments import tiny as experiments_tiny
from tests.touchr1_jax.models.qwen.tiny import Block, position_ids
from touchr1_jax.models.blocked_attention import Segments
from touchr1_jax.models.deepstack import add_level, placed, split_levels
from touchr1_jax.models.layers import mrope
from touchr1_jax.models.load import WeightsError, load_checkpoint
from touchr1_jax.models.policy import Row, prompt_mask, prompt_positions
from touchr1_jax.models.qwen.config import Qwen3VisionConfig
from touchr1_jax.models.qwen.geometry import Grid, stretched
from touchr1_jax.models.released_policy import ReleasedModel, build_released_policy, instruction
from touchr1_jax.models.touch_policy import touch_shapes
from touchr1_jax.text.language import TOUCH_LANGUAGE
from touchr1_jax.training.packing import existing_tokens
from touchr1_jax.training.sft import SFTBatch, encoded_group

MODEL = ReleasedModel(
    tactile=experiments_tiny.MODEL.tactile, frames=4, image_px=56, completion_tokens=48, view_px=16, dtype="float32"
)


def test_axes_take_turns_among_the_frequencies():
    """Sections 4, 3, 1: time, row, column, time, row, time, time, row; time has what the others leave."""
    positions = jnp.array([[1], [10], [100]])
    rotation = mrope(positions, 16, (4, 3, 1), 1e4, interleaved=True)
    axis = np.array([1, 10, 100, 1, 10, 1, 1, 10])
    angle = axis * 1e4 ** (-np.arange(8) / 8)
    np.testing.assert_allclose(rotation.cos[0], np.cos(angle), atol=1e-5)
    np.testing.assert_allclose(rotation.sin[0], np.sin(angle), atol=1e-5)


def test_levels_are_added_after_their_layers_at_the_tokens_of_pictures():
    seen = jnp.arange(12.0).reshape(2, 6)
    first, levels = split_levels(seen, 2)
    np.testing.assert_array_equal(first, [[0, 1], [6, 7]])
    levels = placed(levels, np.array([3, 1]), 4)
    np.testing.assert_array_equal(levels[0], [[0, 0], [8, 9], [0, 0], [2, 3]])
    y = jnp.ones((4, 2))
    after = [add_level(y, levels, jnp.int32(i)) - 1 for i in range(4)]
    np.testing.assert_array_equal(after[0], levels[0])
    np.testing.assert_array_equal(after[1], [[0, 0], [10, 11], [0, 0], [4, 5]])
    assert not np.any(after[2:])
    assert split_levels(first, 2)[1] is placed(None, np.array([1]), 4) is None


def test_a_table_is_stretched_corner_to_corner():
    """A grid of 2 × 4 patches on a table of 3 × 3 places: columns at 0, 2/3, 4/3 and 2, both steps alike."""
    config = Qwen3VisionConfig(out_size=8, depth=1, hidden_size=8, num_heads=1, positions=9, deepstack_layers=())
    place = stretched((Grid(2, 2, 4),), config)
    weight = np.zeros((16, 9))
    np.add.at(weight, (np.arange(16), place.corner), place.weight)
    np.testing.assert_array_equal(weight[:8], weight[8:])
    np.testing.assert_array_equal(place.row[:8], [0, 0, 1, 1] * 2)
    second, third = weight[1].reshape(3, 3), weight[6].reshape(3, 3)
    np.testing.assert_allclose(second, [[1 / 3, 2 / 3, 0], [0, 0, 0], [0, 0, 0]], atol=1e-6)
    np.testing.assert_allclose(third, [[0, 0, 0], [0, 0, 0], [0, 2 / 3, 1 / 3]], atol=1e-6)
    np.testing.assert_array_equal(place.frames.length, [8, 8])


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    directory = tmp_path_factory.mktemp("qwen3")
    write_tiny(directory, TOUCH_LANGUAGE, instruction(TOUCH_LANGUAGE), SMALLEST_QWEN3)
    return directory


@pytest.fixture(scope="module")
def policy(folder):
    return build_released_policy(MODEL, load_checkpoint(folder, jnp.float32), SENSORS)


@pytest.fixture(scope="module")
def batch():
    """One contact; the first stream lacks its last two frames."""
    zeros = jax.tree.map(lambda x: np.zeros(x.shape, x.dtype), touch_shapes(MODEL, MODEL.view_px, SENSORS))
    there = np.ones_like(zeros.frame_mask)
    there[0, 0, 2:] = False
    index = np.broadcast_to(np.arange(MODEL.frames, dtype=np.int32), there.shape)
    rng = np.random.default_rng(0)
    drawn = lambda x: rng.integers(0, 255, x.shape, np.uint8)
    return zeros.replace(
        frames=drawn(zeros.frames),
        view=drawn(zeros.view),
        frame_mask=there,
        frame_index=index,
        stream_mask=np.ones_like(zeros.stream_mask),
        view_mask=np.ones_like(zeros.view_mask),
    )


@pytest.mark.long
def test_steps_are_blocks_after_their_time(policy, batch):
    """The time and marks of a step without frames are absent, and both computations of which tokens exist agree."""
    fns, layout = policy.fns, policy.layout
    touch_time = fns.module.token_time(jnp.asarray(batch.frame_index), jnp.asarray(batch.frame_mask))[0]
    features = jax.eval_shape(lambda p, b: fns.encode(p, b), policy.init(0, batch), batch)
    assert features.view.shape[-1] == 3 * SMALLEST_QWEN3.hidden_size  # and two levels
    one = jax.tree.map(lambda x: jnp.zeros(x.shape[1:], x.dtype), features).replace(
        touch_time=touch_time, stream_mask=jnp.ones(len(SENSORS), bool), view_mask=jnp.array(True)
    )
    mask = np.asarray(prompt_mask(one, jnp.asarray(layout.mask[0]), fns.slots))
    shown = policy.tokenizer.decode(layout.ids[0, mask])
    times = [f"<{t / 2:.1f} seconds>" for t in range(MODEL.frames)]
    assert [shown.count(time) for time in times] == [4, 4, 3, 3]
    again = existing_tokens(
        fns.module,
        fns.slots,
        batch,
        layout.mask[None, :1],
        np.ones((1, 1, len(SENSORS)), bool),
        np.ones((1, 1, 1), bool),
    )
    np.testing.assert_array_equal(again[0, 0, :-1], mask)
    ours = prompt_positions(touch_time, jnp.asarray(mask), fns.slots, fns.module.config.vision.grid)
    pads = np.isin(np.arange(len(mask)), layout.touch)[mask]
    grid, tokens = fns.module.config.vision.grid, policy.model.tactile.tokens_per_step
    runs, here = [int(layout.view[0]), Block([0], len(layout.view) // grid, grid)], int(layout.view[-1]) + 1
    text = 0
    for pad in pads[here:]:
        text += not pad
        if pad and text:
            runs, text = [*runs, text, Block([0], 1, tokens)], 0
    np.testing.assert_array_equal(np.asarray(ours)[:, mask], position_ids([*runs, text]))


@pytest.mark.long
def test_packed_rows_are_the_prompts(policy, batch):
    """Levels reach the decoder in both forms: hidden states of a prompt with a picture, and of a row that holds it."""
    fns, layout, params = policy.fns, policy.layout, policy.init(0, batch)
    tokens = jnp.asarray(np.random.default_rng(0).choice(np.flatnonzero(~policy.tokenizer.banned), 3), jnp.int32)
    features = jax.jit(lambda p, b: fns.encode(p, b))(params, jax.tree.map(jnp.asarray, batch))
    one = jax.tree.map(lambda x: x[0], features)
    ids, mask = jnp.asarray(layout.ids[0]), jnp.asarray(layout.mask[0])
    states = jax.jit(lambda p, f: fns.group_states(p, f, ids, mask, tokens[None])[0][0])
    wanted = states(params, one)
    flat = one.replace(view=one.view.at[:, SMALLEST_QWEN3.hidden_size :].set(0))
    assert float(jnp.abs(states(params, flat) - wanted).max()) > 1e-4
    shown = SFTBatch(
        touch=features,
        ids=ids[None, None],
        mask=mask[None, None],
        streams=jnp.ones((1, 1, len(SENSORS)), bool),
        tokens=tokens[None, None],
        token_mask=jnp.ones((1, 1, 3), bool),
    )
    seen, _ = encoded_group(fns, params, shown)
    exists = prompt_mask(one, mask, fns.slots)
    place = np.full(len(ids), -1)
    place[layout.touch] = np.arange(layout.touch.size).reshape(layout.touch.shape)
    place[layout.view] = layout.touch.size + np.arange(len(layout.view))
    positions = prompt_positions(one.touch_time, exists, fns.slots, fns.module.config.vision.grid)
    after = jnp.max(jnp.where(exists, positions, -1)) + 1 + jnp.arange(2)
    keep = np.flatnonzero(np.append(np.asarray(exists), [True, True]))
    row = Row(
        ids=jnp.append(ids, tokens[:2])[keep],
        feature=jnp.asarray(np.append(place, [-1, -1])[keep]),
        positions=jnp.concatenate([positions, jnp.broadcast_to(after, (3, 2))], 1)[:, keep],
        segments=Segments(jnp.zeros(len(keep), jnp.int32), reach=len(keep)),
        places=jnp.arange(len(keep) - 3, len(keep)),
    )
    ours = jax.jit(lambda p, f: fns.packed_states(p, f, row))(params, seen[0])
    np.testing.assert_allclose(ours, wanted, rtol=0, atol=2e-5 * float(jnp.abs(wanted).max()))


@pytest.mark.long
def test_a_wrong_folder_gives_one_error(folder, tmp_path):
    shutil.copytree(folder, tmp_path / "copy")
    settings = tmp_path / "copy" / "preprocessor_config.json"
    found = json.loads(settings.read_text())
    settings.write_text(json.dumps({k: v for k, v in found.items() if k != "image_mean"}))
    with pytest.raises(WeightsError, match=r"image_mean is \[0\.48.*must be \[0\.5"):
        load_checkpoint(tmp_path / "copy")
    config = json.loads((folder / "config.json").read_text())
    config["vision_config"]["deepstack_visual_indexes"] = [0, 9]
    (tmp_path / "copy" / "config.json").write_text(json.dumps(config))
    with pytest.raises(WeightsError, match=r"deepstack_visual_indexes is \[0, 9\]: must rise and lie in 0\.\.1"):
        load_checkpoint(tmp_path / "copy")
