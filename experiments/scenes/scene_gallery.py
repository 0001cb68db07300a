"""What do generated objects and touches look like?

    python -m experiments scene_gallery

Draws sheets of pictures: views of objects by material, true and false; presses over force by every sensor; every
exploratory motion over time; objects that vary over their surface; and the ranges of the five properties by material,
with a table of the levels of each property by material.

Cost: under two minutes on two cores.

Expected: a level predicted from the material alone is right for half of the objects; the pictures are for inspection.
"""

import dataclasses

import cv2
import jax.numpy as jnp
import numpy as np

from experiments.core.charts import Panel, Rule, Series, draw
from experiments.core.context import Context
from experiments.core.look import SHARED
from experiments.core.pictures import image_grid
from experiments.core.results import Cell, Picture, Results, Table, named_table
from experiments.core.runner import Experiment
from sensors_io.scenes import appearance, objects, properties, surface
from sensors_io.scenes.config import SceneConfig
from sensors_io.scenes.protocol import contact_key, make_contact
from sensors_io.schema import MATERIALS, SENSORS, Sequence
from sensors_io.viewer.panels import coloured

VIEW_PX = 96
ARROW = 4.0  # length of a line over the displacement that it shows

UNITS = {"hardness": "MPa", "roughness": "mm", "protrusion": "mm", "elasticity": "share", "friction": ""}


@dataclasses.dataclass(frozen=True, kw_only=True)
class GalleryConfig:
    """Sizes of the sheets."""

    views: int = 9  # objects per material; the pictures of the last two show another material
    presses: int = 3  # objects that are pressed
    columns: int = 8  # frames per row of a touch
    varied: int = 4  # objects of two parts, and as many graded ones
    image_px: int = 112  # side of the sensors' pictures
    protocol: SceneConfig = SceneConfig(objects=12, sequences=4 * 48, frames=24, contact_grid=48)
    """Small enough to be planned at once, with every motion in it."""
    seed: int = 0  # of all objects


def run(config: GalleryConfig, context: Context) -> Results:
    """Draw all sheets."""
    sheets = {"views": views, "presses": presses, "motions": motions, "varied": varied, "properties": ranges}
    pictures: list[Picture] = []
    for name, sheet in context.each("drawing", sheets.items()):
        with context.timed(name):
            pictures += sheet(config)
    return Results(
        verdict=(f"{len(pictures)} sheets, drawn from seed {config.seed}.",),
        tables=(odds(),),
        pictures=tuple(pictures),
        settings={"sensors": ", ".join(SENSORS), "picture": f"{config.image_px} px"},
    )


def views(config: GalleryConfig) -> list[Picture]:
    """RGB views of objects by true material; the two last columns lie."""
    rows = {}
    for material, name in enumerate(MATERIALS):
        rng = np.random.default_rng([config.seed, material])
        lies = rng.choice(objects.lie_materials(material), 2)
        shown = [material] * (config.views - 2) + [int(other) for other in lies]
        rows[name] = [appearance.view(look, VIEW_PX, rng)[0] for look in shown]
    caption = "One row per material. The two objects on the right lie: they look like another material."
    return [_sheet("views", "Views by material", caption, rows, ["honest"] * (config.views - 2) + ["lie"] * 2, 0.95)]


def presses(config: GalleryConfig) -> list[Picture]:
    """One sheet per object: every sensor over force."""
    scenes = SceneConfig(
        objects=config.presses,
        sites=1,
        frames=config.columns,
        image_px=config.image_px,
        max_force_n=10.0,
        seed=config.seed,
    )
    return [press_sheet(make_contact(scenes, index), index) for index in range(config.presses)]


def motions(config: GalleryConfig) -> list[Picture]:
    """The first contact of every motion of the protocol, over time, by the marker sensors' fields and one picture."""
    scenes = dataclasses.replace(config.protocol, image_px=config.image_px, seed=config.seed)
    first: dict[str, int] = {}
    for index in range(scenes.contact_count):
        first.setdefault(contact_key(scenes, index).motion, index)
    rows = {}
    for motion, index in sorted(first.items()):
        by_sensor = {s.sensor: s for s in make_contact(scenes, index)}
        rows[f"{motion}\ngelsight_mini"] = _frames(by_sensor["gelsight_mini"], config.columns, amplify=True)
        rows[f"{motion}\ntac3d"] = _frames(by_sensor["tac3d"], config.columns)
    caption = (
        "Each motion by two sensors, from left to right in time: change of the Mini's picture, three times, and depth "
        "and marker displacement of the Tac3D."
    )
    return [_sheet("motions", "Motions over time", caption, rows, cell_inch=0.95)]


def varied(config: GalleryConfig) -> list[Picture]:
    """Height maps of objects that change over their surface, with the level of hardness where a press would land."""
    x = jnp.linspace(-12, 12, 320)
    pose = surface.SensorPose(offset_mm=jnp.zeros(2), turn_rad=jnp.zeros(()), tilt=jnp.zeros(2))
    rows: dict[str, list[np.ndarray]] = {}
    for kind, shares in (("two parts", (1.0, 0.0)), ("graded", (0.0, 1.0))):
        rows[kind] = []
        for i in range(config.varied):
            solid = objects.sample(np.random.default_rng([config.seed, 7, i]), 0.0, 0.8, *shares)
            height = -np.asarray(surface.gap(surface.make_skin(solid, np.zeros(2), 0.0), pose, x))
            rows[kind].append(mark_levels(coloured(height - height.min(), float(np.ptp(height))), solid))
    caption = (
        "Relief and roughness of 24 mm, bodies flattened; the letters are the hardness (s, m, h) where a press would "
        "land."
    )
    return [_sheet("varied", "Objects that vary over their surface", caption, rows, cell_inch=1.9)]


def ranges(_: GalleryConfig) -> list[Picture]:
    """Where 90 % of the objects of each material lie, for every property, with the thresholds of the levels."""
    panels: list[Panel] = []
    for name, prop in {**properties.PROPERTIES, **properties.DYNAMIC}.items():
        low, middle, high = ([prop.value(mean + prop.spread * z) for mean in prop.means] for z in (-1.645, 0.0, 1.645))
        panels.append(
            Panel(
                [Series(x=middle, low=low, high=high)],
                title=f"{name} ({UNITS[name]})" if UNITS[name] else name,
                rows=MATERIALS if not panels else [""] * len(MATERIALS),
                x_scale="log",
                rules=[Rule(x=threshold, line="--", colour=SHARED, width=0.8) for threshold in prop.thresholds],
            )
        )
    caption = (
        "From the 5th to the 95th percentile, dot at the median; lines are the thresholds between the levels. Every "
        "material reaches every level."
    )
    content = draw(panels, columns=len(panels), size=(2.2 * len(panels), 2.6))
    return [Picture(name="properties", title="Properties by material", caption=caption, content=content)]


def odds() -> Table:
    """Odds of each level by material, which bound the accuracy from an honest picture alone."""
    every = {**properties.PROPERTIES, **properties.DYNAMIC}
    chances = {name: 100 * properties.level_odds(prop) for name, prop in every.items()}
    rows: list[dict[str, Cell]] = [
        {"material": material, **{n: " · ".join(f"{share:.0f}" for share in c[i]) for n, c in chances.items()}}
        for i, material in enumerate(MATERIALS)
    ]
    best = {name: f"{found.max(1).mean():.0f}" for name, found in chances.items()}
    rows.append({"material": "right by the likeliest level", **best})
    return named_table(
        "Levels by material",
        rows,
        units=dict.fromkeys(every, "%"),
        meanings=dict.fromkeys(every, "levels 0 · 1 · 2"),
        note="Materials are drawn evenly.  Pictures lie about three objects in ten, so their accuracy is lower.",
    )


def field_picture(depth_mm: np.ndarray, displacement_mm: np.ndarray, top_mm: float) -> np.ndarray:
    """Depth [h, w] in colour, brightest at `top_mm`, displacement [h, w, 2] as lines, uint8 RGB [H, W, 3].

    Lines are four times as long as the displacement, in units of a node of 1 mm.
    """
    picture = coloured(depth_mm, top_mm)
    cell = picture.shape[0] / depth_mm.shape[0]
    for row, column in np.ndindex(*depth_mm.shape):
        start = (np.array([column, row]) + 0.5) * cell
        end = start + ARROW * cell * displacement_mm[row, column]
        begin, tip = np.rint([start, end]).astype(int).tolist()
        cv2.line(picture, begin, tip, (255, 255, 255), 2, cv2.LINE_AA)
    return picture


def press_sheet(sequences: list[Sequence], index: int) -> Picture:
    """One object pressed by all sensors, over force."""
    forces = sequences[0].target_force_n
    assert forces is not None
    rows = {s.sensor: _frames(s, len(forces)) for s in sequences}
    change = {"its change × 3": _frames(sequences[0], len(forces), amplify=True)}
    dense = {"its fields": _fields(sequences[-1], np.arange(len(forces)))}  # its pattern is too fine to see
    rows = {SENSORS[0]: rows.pop(SENSORS[0])} | change | rows | dense
    caption = (
        "The same patch by all sensors. Tac3D exposes no camera: depth, and displacement of its markers, as of the "
        "dense pattern below; dark dots are nodes that were not read."
    )
    return _sheet(f"press-{index}", f"Object {index} pressed", caption, rows, [f"{force:.1f} N" for force in forces])


def _sheet(
    name: str,
    title: str,
    caption: str,
    rows: dict[str, list[np.ndarray]],
    columns: list[str] | None = None,
    cell_inch: float = 1.25,
) -> Picture:
    content = image_grid(rows, columns or (), cell_inch=cell_inch)
    return Picture(name=name, title=title, caption=caption, content=content, kind="png")


def _frames(sequence: Sequence, columns: int, amplify: bool = False) -> list[np.ndarray]:
    """Pictures spread over a sequence, or three times their change since the first; fields where there is no camera."""
    at = np.linspace(0, len(sequence) - 1, min(columns, len(sequence))).astype(int)
    if sequence.frames is not None:
        frames = sequence.frames[at]
        change = 128 + 3 * (frames.astype(np.float32) - frames[0])
        return list(np.clip(change, 0, 255).astype(np.uint8) if amplify else frames)
    return _fields(sequence, at)


def _fields(sequence: Sequence, at: np.ndarray) -> list[np.ndarray]:
    """Depth and displacement of some frames."""
    assert sequence.depth_mm is not None
    assert sequence.deformation_mm is not None
    top = float(sequence.depth_mm.max())
    return [field_picture(sequence.depth_mm[i], sequence.deformation_mm[i], top) for i in at]


def mark_levels(picture: np.ndarray, solid: objects.Solid) -> np.ndarray:
    """Writes the level of hardness at nine sites into the picture of 24 mm."""
    marked = picture.copy()
    size = picture.shape[0] / 160
    rim, stroke = max(2, round(4 * size)), max(1, round(size))
    for x in (-8, 0, 8):
        for y in (-8, 0, 8):
            level = solid.at(np.array([x, y])).levels()["hardness"]
            across, down = ((v / 24 + 0.5) * picture.shape[0] for v in (x, y))
            at = (round(across - 5 * size), round(down + 5 * size))
            for colour, width in (((0, 0, 0), rim), ((255, 255, 255), stroke)):  # readable on any relief
                cv2.putText(marked, "smh"[level], at, cv2.FONT_HERSHEY_SIMPLEX, 0.5 * size, colour, width, cv2.LINE_AA)
    return marked


DEFAULT = GalleryConfig()
SMOKE = dataclasses.replace(
    DEFAULT,
    views=3,
    presses=1,
    columns=3,
    varied=1,
    image_px=56,
    protocol=SceneConfig(objects=4, sequences=4 * 24, frames=20, contact_grid=32),
)

EXPERIMENT = Experiment(name="scene_gallery", config=DEFAULT, scales={"smoke": SMOKE}, run=run)
