"""Examples of answers with the touch behind them."""

import dataclasses

import numpy as np

from experiments.study.examples import SCALE_PX, depth_scale, field_picture


def test_fields_are_drawn_in_colour_with_arrows(data):
    recorded = data.store.contact(int(data.parts["test"][0]))
    picture = field_picture(recorded["tac3d"])
    assert picture.shape == (192, 192 + SCALE_PX, 3)
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 20
    still = dataclasses.replace(recorded["tac3d"], deformation_mm=np.zeros_like(recorded["tac3d"].deformation_mm))
    assert not np.array_equal(field_picture(still), picture)
    bare = dataclasses.replace(
        recorded["tac3d"],
        depth_mm=None,
        deformation_mm=None,
        frames=np.zeros((len(recorded["tac3d"]), 4, 4, 3), np.uint8),
    )
    assert field_picture(bare) is None


def test_a_scale_of_depth_states_its_ends():
    assert not np.array_equal(depth_scale(0.0, 0.5), depth_scale(0.0, 0.7))
    assert depth_scale(0.0, 0.5)[0, 8, 1] > depth_scale(0.0, 0.5)[-1, 8, 1]  # bright is deep
