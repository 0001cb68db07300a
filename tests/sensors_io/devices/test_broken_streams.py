"""Messages that break a protocol end no stream and are counted once."""

import numpy as np
import pytest

from sensors_io.clock import JumpingClock
from sensors_io.devices.intake import Intake
from sensors_io.devices.reader import Reader
from tests.sensors_io.devices.fakes import sample, sent
from tests.sensors_io.devices.test_tac3d import datagrams, listening, pushed

FINE = pushed([0, 0, -1], [0, 0, -0.1])


def message(arrays=FINE, **rest):
    return lambda number: datagrams(arrays, **{"number": number, "index": number} | rest)


@pytest.mark.parametrize(
    "bad",
    [
        message(time_s="nan"),
        message(time_s="inf"),
        message(time_s=1e11),
        message(index=10**30),
        message({**FINE, "3D_Displacements": np.zeros((399, 3))}),
        message({**FINE, "3D_ResultantForce": np.zeros((2, 2))}),
        lambda number: [b"\0" * 3],
    ],
)
def test_a_broken_tac3d_message_ends_no_stream(vendor, bad):
    sender, port = vendor
    with sent(sender, bad, message()), Reader(listening(port)) as reader:
        forces = [reader.next(5.0).arrays["force_n"].tolist() for _ in range(4)]
        counts = reader.counts
    assert forces == [[0, 0, -1]] * 4
    assert counts.broken >= 2


def test_a_broken_sample_is_lost_once():
    intake = Intake(capacity=9, clock=JumpingClock())
    for index in (0, 1, None, 3, 6):
        intake.broke() if index is None else intake.offer(sample(index))
    assert (intake.counts.missing, intake.counts.broken, intake.counts.lost) == (2, 1, 3)
