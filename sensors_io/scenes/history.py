"""Load history: what unloading gives back.

A press obeys the elastic contact solution at an *elastic force* that lags behind the applied one by friction inside the
materials, proportional to the load and independent of the rate:

    F_e,k = clip(F_e,k−1, F_k, F_k / (1 − β)),   F_e,0 = 0

the proportional play operator, of one parameter and one remembered number.  Loading follows the virgin curve, F_e = F;
after a reversal the depth stays until the force has fallen by the share β, then the curve is that of F/(1 − β); loading
again closes the loop.  For any virgin curve the work done by unloading is 1 − β of the work of loading, so β is the
loop's relative area, and no closed cycle gains energy.

Assumed, not sourced: the form, its independence of the rate, and every value of β.  The vendor's Tac3D examples, the
only public load–unload recordings of such a gel with forces that we know, cannot source it: their loops of force over
displacement turn the wrong way, −27 to −48 % of the work, and close to 0 to 3 % when the force is read one frame
(30 ms) later, so they show a lag of the force estimate and no loss beyond a few per cent.  Nor do they back a spectrum
of relaxation times: a contact held for 6 s drifts by less than the hand does.
"""

import dataclasses

import numpy as np

from sensors_io.layer import Layer, normal_compliance
from sensors_io.scenes.config import require

_ENERGY_WAVE = 1.5


@dataclasses.dataclass(frozen=True, kw_only=True)
class Loss:
    """Shares of the stored energy that gel and object keep on unloading, in [0, 1)."""

    gel: float
    body: float

    def __post_init__(self) -> None:
        for name in ("gel", "body"):
            value = getattr(self, name)
            require(0 <= value < 1, name, value, "must lie in [0, 1)")

    def of_contact(self, body_share: float) -> float:
        """β of both in series, weighted by their shares of the stored energy: β_gel (1 − s) + β_body s.

        Args:
          body_share: s, the object's share of the energy, of `body_share`.
        """
        require(0 <= body_share <= 1, "body_share", body_share, "must lie in [0, 1]")
        return self.gel * (1 - body_share) + self.body * body_share


def elastic_force(force_n: np.ndarray, loss: float) -> np.ndarray:
    """Force at which the elastic contact is to be solved, frame by frame.

    Args:
      force_n: applied normal force over time [F], ≥ 0, beginning with the untouched gel.
      loss: β, the relative area of a full loop, in [0, 1).

    Returns:
      F_e [F], N, ≥ the applied force, equal to it on the virgin curve; 0 where nothing touches.

    Raises:
      ValueError: a negative force, a loss outside [0, 1).
    """
    require(0 <= loss < 1, "loss", loss, "must lie in [0, 1)")
    require(bool(np.all(force_n >= 0)), "force_n", float(force_n.min(initial=0)), "must be ≥ 0")
    elastic, found = 0.0, np.empty(len(force_n))
    for k, force in enumerate(force_n):
        elastic = min(max(elastic, force), force / (1 - loss))
        found[k] = elastic
    return found


def body_share(gel: Layer, body: Layer, contact_radius_mm: float) -> float:
    """Share of the elastic energy that the object stores, G_body / (G_gel + G_body) at q = 1.5/a.

    The pressure of a round contact of radius a has its energy about that wave number; the estimate is within 0.07 of
    Σ p u_body / Σ p u for spheres on gels of 3 to 5 mm.

    Args:
      gel: the gel.
      body: the object at its own modulus.
      contact_radius_mm: a.
    """
    require(contact_radius_mm > 0, "contact_radius_mm", contact_radius_mm, "must be > 0")
    q = np.array(_ENERGY_WAVE / contact_radius_mm)
    soft = float(normal_compliance(q, body))
    return soft / (soft + float(normal_compliance(q, gel)))


def returned_share(force_n: np.ndarray, depth_mm: np.ndarray) -> float:
    """Share of the work that comes back over a path that begins and ends untouched: −∫ F dδ, δ shrinking, over ∫ F dδ,
    δ growing; 1 for an elastic body, more where the force is read too early.

    Args:
      force_n: applied force [F].
      depth_mm: δ, approach or indentation [F].

    Raises:
      ValueError: a path along which no work was done.
    """
    work = (force_n[1:] + force_n[:-1]) / 2 * np.diff(depth_mm)
    put_in = float(work[work > 0].sum())
    require(put_in > 0, "force_n", put_in, "must do work: record a load and its unload")
    return float(-work[work < 0].sum()) / put_in
