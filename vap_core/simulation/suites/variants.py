"""Variants of the room: SIMPLER's axes of visual matching and variant aggregation."""

from vap_core.base.types import value
from vap_core.simulation.scene_style import DEFAULT_STYLE, SceneStyle


@value
class Variant:
    """One setting of one axis; `distractors` more objects of other categories stand around."""

    axis: str
    style: SceneStyle = DEFAULT_STYLE
    distractors: int = 0


MARBLE = ((0.86, 0.86, 0.84), (0.86, 0.86, 0.84))
SLATE = ((0.33, 0.36, 0.40), (0.29, 0.32, 0.36))
VARIANTS: dict[str, Variant] = {
    "base": Variant("base"),
    "robot-dark": Variant("robot colour", SceneStyle(robot=(0.45, 0.47, 0.52))),
    "robot-sand": Variant("robot colour", SceneStyle(robot=(0.95, 0.82, 0.62))),
    "robot-blue": Variant("robot colour", SceneStyle(robot=(0.58, 0.72, 0.95))),
    "background-brick": Variant(
        "background", SceneStyle(wall=(0.58, 0.33, 0.27), floor=(0.30, 0.24, 0.20))
    ),
    "background-green": Variant(
        "background", SceneStyle(wall=(0.42, 0.55, 0.42), floor=(0.62, 0.57, 0.47))
    ),
    "table-marble": Variant("table", SceneStyle(planks=MARBLE)),
    "table-slate": Variant("table", SceneStyle(planks=SLATE)),
    "light-bright": Variant("lighting", SceneStyle(lamp=0.72, ambient=0.52)),
    "light-dim": Variant(
        "lighting", SceneStyle(lamp=0.30, ambient=0.20, lamp_pos_m=(-0.2, 1.0, 1.4))
    ),
    "camera-left": Variant("camera", SceneStyle(camera_shift_m=(0.0, 0.06, 0.03))),
    "camera-right": Variant("camera", SceneStyle(camera_shift_m=(-0.03, -0.06, -0.02))),
    "distractors-few": Variant("distractors", distractors=2),
    "distractors-many": Variant("distractors", distractors=3),
}
MATCHING = ("base", "robot-dark", "robot-sand", "robot-blue")
"""Visual matching: the usual room with four robot colours."""
AGGREGATION = tuple(name for name, variant in VARIANTS.items() if variant.axis != "robot colour")
"""Variant aggregation of the pick task: the usual room and two settings of each other axis."""
