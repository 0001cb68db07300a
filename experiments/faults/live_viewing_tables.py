"""The watched recordings and the bridge as tables and figures to be kept."""

from collections.abc import Sequence

import numpy as np

from experiments.core.results import Column, Requirement, Table
from experiments.faults.live_viewing import BridgeTransfer, ViewedRecording, quantiles_ms
from experiments.faults.picture_flood import SHAPE

_FASTEST_HZ = 120.0  # of the vendors' cameras, a DM-Tac


def requirements(recordings: Sequence[ViewedRecording], carried: BridgeTransfer) -> tuple[Requirement, ...]:
    """Nothing is lost to watchers, who see the present; a bridge keeps up with the fastest camera."""
    seen = [w for w in recordings if len(w.ages_s)]
    oldest = max(float(np.quantile(w.ages_s, 0.95)) for w in seen)
    return (
        Requirement(
            name="samples lost while watched", measured=sum(w.lost for w in recordings), bound=0, better="lower"
        ),
        Requirement(
            name="age of what a browser shows, p95, worst", measured=1e3 * oldest, bound=150, better="lower", unit="ms"
        ),
        Requirement(
            name="pictures of 640 × 480 through a bridge",
            measured=carried.rate_hz,
            bound=_FASTEST_HZ,
            better="higher",
            unit="Hz",
        ),
    )


def tables(recordings: Sequence[ViewedRecording], carried: BridgeTransfer) -> tuple[Table, ...]:
    """What browsers see and the recorder notices; what a bridge carries."""
    ages = quantiles_ms(carried.ages_s, (0.5, 0.95))
    return (
        Table(
            title="A recording that is watched",
            columns=(
                Column(name="watched by"),
                Column(name="shown", unit="Hz", format=".1f", meaning="states that one browser shows"),
                Column(name="age, median", unit="ms", format=".0f", meaning="of all panels when the last is there"),
                Column(name="age, p95", unit="ms", format=".0f"),
                Column(name="look, p99", unit="ms", format=".1f", meaning="between two looks of the recorder"),
                Column(name="look, longest", unit="ms", format=".1f"),
                Column(name="recorded", format="d"),
                Column(name="lost", format="d"),
            ),
            rows=tuple(
                (
                    w.name,
                    None if np.isnan(w.shown_hz) else w.shown_hz,
                    *quantiles_ms(w.ages_s, (0.5, 0.95)),
                    *quantiles_ms(w.looks_s, (0.99, 1.0)),
                    w.written,
                    w.lost,
                )
                for w in recordings
            ),
            note="Camera, recorder, server and browsers share the cores that the run has; four panels a page.",
        ),
        Table(
            title="Pictures through a bridge",
            columns=(
                Column(name="picture"),
                Column(name="rate", unit="Hz", format=".0f"),
                Column(name="carried", unit="MB/s", format=".0f"),
                Column(name="age when read, median", unit="ms", format=".1f"),
                Column(name="age when read, p95", unit="ms", format=".1f"),
            ),
            rows=(
                (" × ".join(map(str, SHAPE)), carried.rate_hz, carried.rate_hz * float(np.prod(SHAPE)) / 1e6, *ages),
            ),
            note="As fast as an adapter gives them, so that the age is that of a full pipe.",
        ),
    )
