"""Clips and their batches: shapes and masks by hand, order by seed, resumed = uninterrupted."""

import dataclasses
import itertools

import numpy as np
import pytest

from sensors_io.augment import AugmentConfig
from sensors_io.pipeline import ClipConfig, ClipMemory, clip_batches, make_clip
from sensors_io.records import RecordStore
from sensors_io.schema import CLIP_ARRAYS, SENSORS, UNKNOWN, Flag, SchemaError
from tests.sensors_io import fakes
from tests.sensors_io.checks import refused

SMALL = ClipConfig(frames=4, image_px=8, view_px=6)
LIVELY = AugmentConfig(mirror=0.5, turn=0.5, exposure_stops=0.5, white_balance_stops=0.2, frame_dropout=0.3)
RNG = lambda: np.random.default_rng(7)


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    return RecordStore(fakes.write(tmp_path_factory.mktemp("records") / "r", 7))


def contact(n=0, sensors=SENSORS, **changes):
    return {sensor: fakes.sequence(n, sensor, **changes) for sensor in sensors}


def same(a, b):
    assert a.keys() == b.keys()
    for name in a:
        np.testing.assert_array_equal(a[name], b[name])


def test_a_batch_without_touch_differs_in_its_streams_alone(store):
    touched, untouched = (
        next(iter(clip_batches(store, range(7), SMALL, batch_size=7, seed=3, with_touch=with_touch)))
        for with_touch in (True, False)
    )
    for name in ("contact", "view", "view_mask", "label"):
        np.testing.assert_array_equal(touched[name], untouched[name])
    assert untouched["frames"].shape == (7, 4, 4, 1, 1, 3)
    assert not any(untouched[name].any() for name in ("frames", "force_n", "frame_index", "frame_mask", "stream_mask"))


class TestClipMemory:
    """Batches from memory are those that are read; what does not fit is read again."""

    def feed(self, store, memory, **changes):
        options = {"batch_size": 3, "seed": 3, "repeat": False} | changes
        return list(clip_batches(store, range(7), SMALL, **options, memory=memory))

    @pytest.mark.parametrize("kept", [0, 2, 7, 14])
    def test_batches_are_those_without_it_and_clips_without_touch_are_others(self, store, kept):
        one = sum(a.nbytes for a in self.feed(store, None, batch_size=1)[0].values())
        memory = ClipMemory(SMALL, kept * one)
        for with_touch in (True, False, True, False):
            for a, b in zip(
                self.feed(store, memory, with_touch=with_touch),
                self.feed(store, None, with_touch=with_touch),
                strict=True,
            ):
                same(a, b)
        assert min(kept, 7) * one <= memory.held_bytes <= kept * one
        random = ClipMemory(SMALL, 10**9)
        self.feed(store, random, augment=LIVELY)
        assert random.held_bytes == 0  # changes are drawn anew

    def test_it_belongs_to_its_clips_and_its_process(self, store):
        other = ClipMemory(ClipConfig(frames=2, image_px=8, view_px=6), 10**9)
        refused(SchemaError, r"memory keeps .*frames=2", self.feed, store, other)
        assert other.contacts is None  # what was refused does not bind it
        elsewhere = ClipMemory(SMALL, 10**9)
        self.feed(store, elsewhere)
        refused(SchemaError, "with the same numbers; make a memory", self.feed, RecordStore(store.path), elsewhere)
        refused(SchemaError, "1 worker processes", lambda: self.feed(store, ClipMemory(SMALL, 10**9), workers=1))


class TestMakeClip:
    def test_it_holds_what_the_schema_says(self):
        clip = make_clip(contact(1), fakes.card(1), SMALL)
        assert clip.frames.shape == (4, 4, 8, 8, 3)
        assert (clip.stream_mask.all(), clip.frame_mask.all(), clip.view_mask) == (True, True, True)
        np.testing.assert_array_equal(clip.view, 10)
        np.testing.assert_array_equal(clip.label, [1, 2, 0, 1])
        for s, sensor in enumerate(SENSORS):
            force = fakes.sequence(1, sensor).force_n
            np.testing.assert_array_equal(clip.force_n[s], force[clip.frame_index[s]])
            assert clip.force_n[s, -1, 2] == -20
            assert clip.frame_index[s].tolist() == [0, 4, 7, 11]

    def test_images_are_area_means_of_the_frames(self):
        made = contact(0)
        block = make_clip(made, fakes.card(0), ClipConfig(frames=1, image_px=4, view_px=6))
        frame = made["xense"].frames[block.frame_index[1, 0]].reshape(4, 4, 4, 5, 3)
        np.testing.assert_allclose(block.frames[1, 0], frame.mean(axis=(1, 3)), atol=0.51)

    def test_a_sensor_without_camera_shows_its_fields(self):
        clip = make_clip(contact(0, valid=None), fakes.card(0), SMALL)
        depth = clip.frames[2, :, 3, 3, 2].astype(int)
        assert (np.diff(depth) > 0).all()
        assert 128 <= depth[0] < 140
        assert clip.frames[2, -1, ..., 2].max() == round(128 + 1.2 * 127 / 1.5)

    def test_a_missing_sensor_is_masked(self):
        clip = make_clip(contact(0, ("dmtac_x",)), fakes.card(0), SMALL)
        assert clip.stream_mask.tolist() == [False, False, False, True]
        assert [frames.any() for frames in clip.frames] == [mask.any() for mask in clip.frame_mask] == [0, 0, 0, 1]

    def test_short_sequences_are_padded_and_rejected_frames_do_not_enter(self):
        clip = make_clip(contact(0, length=3), fakes.card(0), SMALL)
        assert clip.frame_mask.tolist() == [[True] * 3 + [False]] * 4
        assert clip.frame_index.tolist() == [[0, 1, 2, 0]] * 4
        assert not clip.frames[:, 3].any()
        flags = np.where(np.arange(12) < 8, 0, int(Flag.NOT_CONVERGED)).astype(np.uint32)
        assert make_clip(contact(0, flags=flags), fakes.card(0), SMALL).frame_index.max() == 7

    def test_what_is_unknown_is_zero_or_masked(self):
        card = fakes.card(0, view=None, view_depth_mm=None, labels={"hardness": 2})
        clip = make_clip(contact(0, force_n=None), card, SMALL)
        assert (clip.force_n.any(), clip.view_mask, clip.view.any()) == (False, False, False)
        assert clip.label.tolist() == [2, UNKNOWN, UNKNOWN, UNKNOWN]

    def test_bad_input_is_named(self):
        refused(SchemaError, r"contact is \{\}", lambda: make_clip({}, fakes.card(0), SMALL))
        refused(SchemaError, "card is of object 'object_1': the", make_clip, contact(0), fakes.card(1), SMALL)
        mirror = AugmentConfig(mirror=1)
        said = r"rng is None: .* needs a source of randomness; pass one"
        refused(SchemaError, said, lambda: make_clip(contact(0), fakes.card(0), SMALL, augment=mirror))
        refused(SchemaError, "frames is 0: must be ≥ 1", ClipConfig, frames=0)
        refused(SchemaError, "each once", ClipConfig, sensors=("xense", "xense"))


class TestAugmentedClip:
    def test_pictures_fields_and_forces_are_mirrored_together(self):
        force = np.tile(np.float32([1, 2, -9]), (12, 1))
        plain, mirrored = (
            make_clip(contact(0, force_n=force), fakes.card(0), SMALL, augment=AugmentConfig(mirror=share), rng=RNG())
            for share in (0, 1)
        )
        cameras = [0, 1, 3]
        before = plain.frames[:, :, :, ::-1].astype(int)
        np.testing.assert_allclose(mirrored.frames[cameras], before[cameras], atol=1)  # rounded before and behind
        np.testing.assert_array_equal(mirrored.force_n, plain.force_n * [-1, 1, 1])
        fields = mirrored.frames[2].astype(int)
        np.testing.assert_allclose(fields[..., 0], 256 - before[2, ..., 0], atol=1)  # 128 is no displacement
        np.testing.assert_allclose(fields[..., 1:], before[2, ..., 1:], atol=1)
        for name in ("frame_index", "frame_mask", "view", "label"):
            np.testing.assert_array_equal(getattr(mirrored, name), getattr(plain, name))

    def test_a_dropped_frame_is_masked_and_holds_nothing(self):
        config = AugmentConfig(frame_dropout=0.6)
        clip = make_clip(contact(0), fakes.card(0), SMALL, augment=config, rng=RNG())
        assert 4 <= clip.frame_mask.sum() < 16
        assert clip.stream_mask.all()
        for name in ("frames", "force_n", "frame_index"):
            assert not getattr(clip, name)[~clip.frame_mask].any()
        assert clip.frames[clip.frame_mask].reshape(clip.frame_mask.sum(), -1).any(1).all()


def iter_state(batches, read):
    """The state of an iterator after some batches; what it reads afterwards does not matter."""
    iterator = iter(batches)
    for _ in range(read):
        next(iterator)
    state = iterator.get_state()
    next(iterator)
    return state


class TestClipBatches:
    def batches(self, store, **changes):
        return clip_batches(store, range(len(store)), SMALL, **{"batch_size": 3, "seed": 5} | changes)

    def test_a_batch_stacks_clips(self, store):
        batch = next(iter(self.batches(store)))
        assert set(batch) == {*CLIP_ARRAYS, "contact"}
        for name, spec in CLIP_ARRAYS.items():
            assert batch[name].dtype == spec.dtype
            assert batch[name].shape[0] == 3
        assert batch["contact"].dtype == np.int32
        for row, i in enumerate(batch["contact"]):
            clip = make_clip(store.contact(i), store.objects[store.contacts[i].object_id], SMALL)
            same(clip.arrays(), {name: batch[name][row] for name in CLIP_ARRAYS})

    def test_the_order_is_a_function_of_the_seed(self, store):
        order = lambda seed: np.concatenate([b["contact"] for b in itertools.islice(self.batches(store, seed=seed), 7)])
        np.testing.assert_array_equal(order(1), order(1))
        assert (order(1) != order(2)).any()
        epochs = order(1).reshape(3, 7)
        np.testing.assert_array_equal(np.sort(epochs), np.tile(np.arange(7), (3, 1)))
        assert (epochs[0] != epochs[1]).any()

    def test_changes_are_a_function_of_the_seed_and_of_the_place(self, store):
        frames = lambda **options: list(itertools.islice(self.batches(store, **options), 5))
        plain, changed, again = frames(), frames(augment=LIVELY), frames(augment=LIVELY)
        for a, b, c in zip(plain, changed, again, strict=True):
            np.testing.assert_array_equal(a["contact"], b["contact"])
            same(b, c)
        first, later = (np.concatenate([b["frames"] for b in part]) for part in (changed[:2], changed[2:4]))
        assert not any((clip == other).all() for clip in first for other in later)  # another change each time
        same(plain[0], frames(augment=AugmentConfig())[0])

    @pytest.mark.parametrize(("stop", "augment"), [(2, None), (0, LIVELY), (2, LIVELY), (7, LIVELY)])
    def test_resumed_equals_uninterrupted(self, store, stop, augment):
        want = list(itertools.islice(self.batches(store, augment=augment), 9))
        second = iter(self.batches(store, augment=augment))
        second.set_state(iter_state(self.batches(store, augment=augment), stop))
        for batch in want[stop:]:
            same(next(second), batch)

    def test_one_epoch_ends_with_a_smaller_batch_or_without_it(self, store):
        once = {"shuffle": False, "repeat": False}
        assert [b["contact"].tolist() for b in self.batches(store, **once)] == [[0, 1, 2], [3, 4, 5], [6]]
        assert [len(b["contact"]) for b in self.batches(store, **once, drop_remainder=True)] == [3, 3]
        shared = self.batches(store, **once, drop_remainder=True, own=[0, 2])
        assert [b["contact"].tolist() for b in shared] == [[0, 2], [3, 5]]
        some = clip_batches(store, [5, 1], SMALL, batch_size=2, seed=0, **once)
        assert [b["contact"].tolist() for b in some] == [[5, 1]]

    @pytest.mark.long
    def test_worker_processes_change_nothing_but_speed_and_resume_exactly(self, store, tmp_path, monkeypatch):
        """They need no JAX, which takes seconds to import."""
        (tmp_path / "jax.py").write_text("raise ImportError")
        monkeypatch.syspath_prepend(tmp_path)
        want = list(itertools.islice(self.batches(store, augment=LIVELY), 4))
        feeds = first, second = [iter(self.batches(store, workers=2, augment=LIVELY)) for _ in range(2)]
        try:
            same(next(first), want[0])
            second.set_state(first.get_state())
            for batch, feed in itertools.product(want[1:], feeds):
                same(next(feed), batch)
        finally:
            first.close()
            second.close()

    @pytest.mark.long
    @pytest.mark.parametrize("augment", [None, LIVELY], ids=["plain", "changed"])
    def test_machines_that_share_batches_read_them_together(self, store, augment):
        """Random changes too are those of the whole batch; other machines go on from the state of one."""
        options = {"batch_size": 5, "augment": augment}
        whole = iter(self.batches(store, **options))
        want = [next(whole) for _ in range(7)]
        for own in ([0, 1], [2, 4]):
            part = iter(self.batches(store, own=own, **options))
            for batch in want[:3]:
                same(next(part), {name: x[own] for name, x in batch.items()})
            part.set_state(iter_state(self.batches(store, **options), 5))
            same(next(part), {name: x[own] for name, x in want[5].items()})
            other = iter(self.batches(store, own=[3], **options))
            other.set_state(part.get_state())
            same(next(other), {name: x[[3]] for name, x in want[6].items()})

    @pytest.mark.parametrize("own", [[], [1, 0], [0, 3], [-1]])
    def test_rows_that_a_batch_does_not_have_are_named(self, store, own):
        with pytest.raises(SchemaError, match=r"own is .* of batches of 3, all whole: must be ascending rows 0\.\.2"):
            self.batches(store, own=own)
        refused(SchemaError, "the last perhaps smaller", self.batches, store, own=[0], repeat=False)


def test_a_clip_shows_fields_in_the_place_of_pictures_where_asked(store):
    """The same frames, seen as deformation and depth; pictures alone are refused."""
    config = dataclasses.replace(SMALL, sensors=("gelsight_mini",), show="fields")
    recorded, card = store.contact(0)["gelsight_mini"], store.objects["object_0"]
    shown = make_clip({"gelsight_mini": recorded}, card, config)
    bare = dataclasses.replace(recorded, frames=None)
    np.testing.assert_array_equal(shown.frames, make_clip({"gelsight_mini": bare}, card, config).frames)
    [batch] = clip_batches(store, [0, 1], config, batch_size=2, seed=0, shuffle=False, repeat=False)
    np.testing.assert_array_equal(batch["frames"][0], shown.frames)
    pictures = make_clip({"gelsight_mini": recorded}, card, dataclasses.replace(config, show="pictures"))
    assert (shown.frame_index == pictures.frame_index).all()
    assert (shown.frames != pictures.frames).any()
    alone = dataclasses.replace(recorded, depth_mm=None, deformation_mm=None, valid=None)
    refused(SchemaError, "has no fields, and show", make_clip, {"gelsight_mini": alone}, card, config)
