"""The style of the room: what a variant of an episode may change apart from the task."""

from vap_core.base.types import value

Colour3 = tuple[float, float, float]


@value
class SceneStyle:
    """The look of the room; colours are linear 0..1.

    `planks` are the table's light and dark wood, or one colour twice for a plain top; `grain` is
    the seed of its boards. `lamp_pos_m` and `lamp` place and dim the one lamp, `ambient` is the
    fill light; `shadows` are off because they triple the frame time. `robot` multiplies every
    colour of the robot; `camera_shift_m` moves the fixed cameras, in the frame of the body that
    carries them, while they look at the same point.
    """

    planks: tuple[Colour3, Colour3] = ((0.80, 0.69, 0.55), (0.70, 0.58, 0.44))
    grain: int = 7
    wall: Colour3 = (0.73, 0.76, 0.78)
    floor: Colour3 = (0.43, 0.42, 0.42)
    lamp_pos_m: tuple[float, float, float] = (0.9, -0.6, 1.8)
    lamp: float = 0.55
    ambient: float = 0.38
    shadows: bool = False
    robot: Colour3 = (1.0, 1.0, 1.0)
    camera_shift_m: tuple[float, float, float] = (0.0, 0.0, 0.0)


DEFAULT_STYLE = SceneStyle()
