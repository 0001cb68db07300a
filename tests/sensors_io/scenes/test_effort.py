"""The effort of a sequence, and the generator that is asked for an error."""

import dataclasses

import numpy as np
import pytest

from sensors_io import codec
from sensors_io.scenes import effort, protocol
from sensors_io.scenes.config import SceneConfig
from sensors_io.scenes.draws import draw
from sensors_io.scenes.sensors import TAC3D
from sensors_io.scenes.sequence import make_sequence
from sensors_io.schema import Flag

CONFIG = SceneConfig(objects=2, sites=1, frames=3, max_force_n=4.0)
ORDER = 2  # Tac3D, which has no picture to render


def _drawn(config=CONFIG, index=0):
    return draw(config, index, protocol.slot(config, index), ORDER)


def _choose(error, index=0):
    made = _drawn(index=index)
    return effort.choose(error, made.press, made.unit.modulus_factor, made.sensor)


def _cost(chosen):
    (setting,) = [s for s in effort.menu(TAC3D) if (s.grid, s.tolerance) == (chosen.grid, chosen.tolerance)]
    return setting.cost


@pytest.mark.long
def test_less_error_takes_more_effort_and_what_cannot_be_met_is_said():
    costs = [_cost(_choose(error)) for error in (0.5, 0.1, 0.03)]
    assert costs == sorted(costs)
    assert (_choose(0.9).met, _choose(1e-4).met) == (True, False)


@pytest.mark.long
def test_records_say_on_which_grid_they_were_solved():
    asking = dataclasses.replace(CONFIG, error=1e-4)
    made = make_sequence(asking, 0, protocol.slot(asking, 0), ORDER, 0)
    chosen = _choose(1e-4)
    np.testing.assert_array_equal(made.contact_grid, np.full(3, chosen.grid, np.uint16))
    assert np.all(made.flags & Flag.ERROR_UNMET)
    again = codec.decode_sequence(codec.encode_sequence(made))
    np.testing.assert_array_equal(again.contact_grid, made.contact_grid)
