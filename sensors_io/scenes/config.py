"""Configuration of generated scenes, its hash, and the streams of randomness."""

import dataclasses
import hashlib
import json
from typing import Literal

import numpy as np

from sensors_io.schema import SENSORS

GENERATOR = 2
"""Version of the generator: part of the hash, raised whenever the same config would give other records."""

_STREAMS = {"object": 1, "view": 2, "split": 3, "unit": 4, "contact": 5, "press": 6, "schedule": 7}

PRESS_FRAMES, PROTOCOL_FRAMES = 8, 90

_LATER = ("past_limit", "coupled", "part_share", "graded_share", "error")
"""Fields that came after records had been made: at their default, which changes nothing, they do not enter the hash."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class SceneConfig:
    """Configuration of generated scenes: presses alone, or the whole protocol.

    Without `sequences` every object is pressed at `sites` sites: `frames` geometric levels between `min_force_n` and
    `max_force_n`, frames past the strain limit flagged.  With `sequences`, a multiple of the number of sensors, every
    object is pressed once and all other contacts are exploratory motions; `sites` does not count, and `past_limit` says
    what becomes of frames past the strain limit, where small-strain theory ends:

    - "replace", for whatever is asked about labels: they are left out and others stand for them, so that the force of
      a frame reveals no label (`schedule`).  Few presses reach 20 N, since gels are strained long before.
    - "flag", for studies of the force itself, or of what lies past the theory: every press reaches 20 N, motions are
      dealt without regard to what objects bear, and frames past the limit carry `Flag.STRAIN_LIMIT`.  To reject these
      afterwards, as `ClipConfig.rejected` does, lets the force reveal hardness and protrusion again.

    `frames` is by default 8 for presses and 90 for the protocol.  `split_shares` are the shares of objects in train,
    val and test.  The hand misses its targets by `force_jitter` (relative), the force sensor has a relative gain error
    per sequence and noise on each axis.  `part_share` and `graded_share` are the shares of objects of two parts and of
    graded ones, see `objects.Variation`.  The numbers that begin with `solver` are the contact solver's.

    `coupled` lets the gel's sideways motion under pressure meet friction, in presses too; without, friction answers to
    sliding, twisting and rolling alone.  It changes the markers' sideways displacement by a quarter in a press, twice
    to thrice the noise of a node, and by 5 to 10 % in a motion, for half a millisecond a frame of a press
    (`pareto_tangential`).  Studies that read markers closely want it; it is off since older records are without.

    With `error`, the relative L₂ error that displacement and slope of a contact may have, the grid and the tolerance of
    every sequence are chosen (`effort`) and its records say on which grid they were solved; without, all are solved on
    `contact_grid` to `solver_tolerance`.

    Contacts are solved without adhesion; frames in which it would widen the contact by more than `adhesion_tolerance`,
    relative, are flagged.  `adhesion_j_per_m2` is its work between gel and object.  The default is that of clean
    silicone (Chaudhury & Whitesides 1991: 44 mJ/m²), an upper estimate: the coatings of real gels stick less.
    """

    objects: int = 600
    sites: int = 3
    sequences: int | None = None
    frames: int | None = None
    image_px: int = 112
    contact_grid: int = 64
    view_px: int = 64
    visual_lie_share: float = 0.3
    min_force_n: float = 0.2
    max_force_n: float = 20.0
    force_jitter: float = 0.03
    force_gain_error: float = 0.01
    force_noise_n: float = 0.03
    ramp_s: float = 3.0
    adhesion_j_per_m2: float = 0.05
    adhesion_tolerance: float = 0.1
    split_shares: tuple[float, float, float] = (0.7, 0.1, 0.2)
    past_limit: Literal["replace", "flag"] = "replace"
    part_share: float = 0.0
    graded_share: float = 0.0
    coupled: bool = False
    error: float | None = None
    solver_tolerance: float = 1e-3
    solver_max_iterations: int = 200
    seed: int = 0

    def __post_init__(self) -> None:
        require(self.objects >= 1, "objects", self.objects, "must be ≥ 1")
        require(self.sites >= 1, "sites", self.sites, "must be ≥ 1")
        least = 1 if self.sequences is None else 20
        require(self.frame_count >= least, "frames", self.frames, f"must be ≥ {least}")
        self._check_sequences()
        require(self.image_px >= 16, "image_px", self.image_px, "must be ≥ 16")
        require(self.view_px >= 16, "view_px", self.view_px, "must be ≥ 16")
        require(self.contact_grid >= 24, "contact_grid", self.contact_grid, "must be ≥ 24 to resolve a contact")
        require(self.contact_grid % 2 == 0, "contact_grid", self.contact_grid, "must be even")
        require(0 <= self.visual_lie_share <= 1, "visual_lie_share", self.visual_lie_share, "must lie in [0, 1]")
        ok = 0 < self.min_force_n <= self.max_force_n
        require(ok, "min_force_n", self.min_force_n, f"must lie in (0, max_force_n = {self.max_force_n}]")
        require(self.max_force_n <= 1e4, "max_force_n", self.max_force_n, "must be ≤ 10⁴")
        require(0 <= self.force_jitter <= 0.1, "force_jitter", self.force_jitter, "must lie in [0, 0.1]")
        require(0 <= self.force_gain_error <= 1, "force_gain_error", self.force_gain_error, "must lie in [0, 1]")
        require(0 <= self.force_noise_n <= 1e4, "force_noise_n", self.force_noise_n, "must lie in [0, 10⁴]")
        require(
            1e-3 <= self.ramp_s <= 1e6, "ramp_s", self.ramp_s, "must lie in [0.001, 10⁶], for times in 64 bits of ns"
        )
        require(self.adhesion_j_per_m2 >= 0, "adhesion_j_per_m2", self.adhesion_j_per_m2, "must be ≥ 0")
        require(self.adhesion_tolerance > 0, "adhesion_tolerance", self.adhesion_tolerance, "must be > 0")
        for name in ("part_share", "graded_share"):
            require(0 <= getattr(self, name) <= 1, name, getattr(self, name), "must lie in [0, 1]")
        most = f"must be ≤ 1 − part_share = {1 - self.part_share:g}: an object is of one kind"
        require(self.part_share + self.graded_share <= 1, "graded_share", self.graded_share, most)
        ok = min(self.split_shares) >= 0 and abs(sum(self.split_shares) - 1) < 1e-6
        require(ok, "split_shares", self.split_shares, "must be ≥ 0 and sum to 1")
        ok = self.error is None or 0 < self.error <= 1
        require(ok, "error", self.error, "must lie in (0, 1], or be None")
        require(0 < self.solver_tolerance < 1, "solver_tolerance", self.solver_tolerance, "must lie in (0, 1)")
        require(self.solver_max_iterations >= 1, "solver_max_iterations", self.solver_max_iterations, "must be ≥ 1")
        require(self.seed >= 0, "seed", self.seed, "must be ≥ 0")

    def _check_sequences(self) -> None:
        if self.sequences is None:
            return
        sensors = len(SENSORS)
        whole = f"must be a multiple of {sensors}: all sensors see every contact"
        require(self.sequences % sensors == 0, "sequences", self.sequences, whole)
        enough = f"must be ≥ {sensors * self.objects}: every one of {self.objects} objects is pressed by all sensors"
        require(self.sequences >= sensors * self.objects, "sequences", self.sequences, enough)

    @property
    def frame_count(self) -> int:
        """Frames of a sequence."""
        if self.frames is not None:
            return self.frames
        return PRESS_FRAMES if self.sequences is None else PROTOCOL_FRAMES

    @property
    def replaces(self) -> bool:
        """True if frames past the strain limit are left out and replaced: only the protocol does so."""
        return self.sequences is not None and self.past_limit == "replace"

    @property
    def contact_count(self) -> int:
        """Contacts of the data set; each gives one sequence per sensor."""
        return self.objects * self.sites if self.sequences is None else self.sequences // len(SENSORS)


def config_hash(config: SceneConfig) -> str:
    """Hash of everything that decides the records: the config and the version of the generator."""
    values = dataclasses.asdict(config)
    for field in dataclasses.fields(config):
        if field.name in _LATER and values[field.name] == field.default:
            del values[field.name]
    payload = json.dumps({"generator": GENERATOR, **values}, sort_keys=True)
    return hashlib.sha256(payload.encode()).hexdigest()[:16]


def stream(seed: int, name: str, *index: int) -> np.random.Generator:
    """Randomness of one thing, independent of that of all others and of the order in which they are made."""
    return np.random.default_rng([seed, _STREAMS[name], *index])


def require(ok: bool, field: str, value: object, constraint: str) -> None:
    """Raise a `ValueError` that names the field, the value and the constraint unless `ok`."""
    if not ok:
        raise ValueError(f"{field} is {value!r}: {constraint}; change {field}")
