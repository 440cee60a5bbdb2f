"""The single views of a recording's layout."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from vap_core.base.types import value
from vap_core.recording.colours import BACKGROUND
from vap_core.recording.entities.comparison import vote_picture_entity
from vap_core.recording.entities.paths import image_root, target_suffix
from vap_core.recording.entities.scene import mean_placement
from vap_core.rollout.types import EpisodeHeader

type Part = rrb.Container | rrb.View
QUERY_NAMES = {
    "token": "the learned token",
    "colour": "the colour word",
    "category": "the category word",
    "action": "the action expert",
}
UNIT_RANGE = (-0.05, 1.05)
"""The axis of numbers between 0 and 1."""
LEGEND_SHARE = 0.45
"""Steps after the end of a chart whose legend stands there, as a share of the episode's."""


@value
class Axes:
    """The axes of an episode's charts.

    `gripper_cm` is the vertical axis of the gripper's distances, `steps` the number of control
    steps; None leaves it to the viewer.
    """

    gripper_cm: tuple[float, float] | None = None
    steps: int | None = None


DEFAULT_AXES = Axes()


def policy_view(camera: str) -> Part:
    """What the policy saw."""
    return _image_view(camera, "policy input", ["/prompted"])


def track_view(camera: str, title: str) -> Part:
    """The raw picture with the tracked mask, white, and the true one, orange."""
    return _image_view(camera, title, ["", "/mask/**"])


def vote_view(camera: str, title: str = "vote at t = 0", j: int = 0) -> Part:
    """The candidates of target j over the picture that the vote was held on."""
    return _image_view(camera, title, [f"/candidates{target_suffix(j)}/**"])


def coverage_view(camera: str) -> Part:
    """The prompt in the colour of the object that it covers."""
    return _image_view(camera, "what the prompt covers", ["", "/identity"])


def attention_view(camera: str, query: str) -> Part:
    """The attention of one query over the policy's input."""
    title = f"where {QUERY_NAMES[query]} looks"
    return _image_view(camera, title, [f"/attention/{query}"])


def vote_picture_view(camera: str) -> Part:
    """The candidates, the reference photos, and the cosines that were compared."""
    return rrb.Spatial2DView(
        origin=vote_picture_entity(camera), name=f"{camera} · vote", background=BACKGROUND
    )


def verdict_view(origin: str = "/vap/verdict", name: str = "verdict") -> Part:
    """How the episode ended, over the full width."""
    return rrb.TextDocumentView(origin=origin, name=name, titlebar=False)


def scene_view(header: EpisodeHeader) -> Part:
    """Simulator truth in three dimensions, with the cameras."""
    cameras = [image_root(camera.name) for camera in header.cameras]
    return rrb.Spatial3DView(
        origin="/",
        contents=["/world/**", *cameras],
        name="scene (simulator truth)",
        background=BACKGROUND,
        line_grid=rrb.LineGrid3D(visible=False),
        eye_controls=_viewpoint(header),
    )


def instruction_view() -> Part:
    """The instruction pane."""
    return rrb.TextDocumentView(origin="/vap/instruction", name="instruction")


def mask_view(camera: str) -> Part:
    """The elected candidate's mask over the picture."""
    return _image_view(camera, "mask", ["", "/mask/**"])


def events_view() -> Part:
    """The events with their step and level."""
    columns = rrb.archetypes.TextLogColumns(
        timeline_columns=[rrb.encodings.TimelineColumn("frame_index")],
        text_log_columns=[
            rrb.encodings.TextLogColumn("loglevel"),
            rrb.encodings.TextLogColumn("body"),
        ],
    )
    return rrb.TextLogView(origin="/vap/events", name="events", columns=columns)


def robot_curve_views(header: EpisodeHeader, axes: Axes) -> list[Part]:
    """Arm action, gripper action, and robot state."""
    n_arm = len(header.action_names) - 1
    return [
        _curve_view("/action", "action", axes, visible=[True] * n_arm + [False]),
        _curve_view("/action", "gripper", axes, visible=[False] * n_arm + [True]),
        _curve_view("/observation.state", "state", axes),
    ]


def method_curve_views(header: EpisodeHeader, axes: Axes) -> list[Part]:
    """Track scores and vote margins, where the method has some."""
    cameras = [camera for camera, groundings in header.groundings.items() if groundings]
    if not cameras:
        return []
    return [
        track_score_view(axes),
        _curve_view("/vap/vote_margin", "vote margin", axes, UNIT_RANGE),
    ]


def track_score_view(axes: Axes = DEFAULT_AXES) -> Part:
    """How sure the tracker is of the target, in every view."""
    return _curve_view("/vap/track_score", "track score", axes, UNIT_RANGE)


def gripper_view(axes: Axes = DEFAULT_AXES) -> Part:
    """The gripper's distance from the target and the nearest other object, and what it holds."""
    title = "gripper to target (orange), to nearest other (blue), cm"
    return _curve_view("/vap/hand", title, axes, axes.gripper_cm, legend=False)


def _image_view(camera: str, title: str, suffixes: Sequence[str]) -> rrb.Spatial2DView:
    root = image_root(camera)
    return rrb.Spatial2DView(
        origin=root,
        contents=[f"{root}{suffix}" for suffix in suffixes],
        name=f"{camera} · {title}",
        background=BACKGROUND,
    )


def _curve_view(
    origin: str,
    name: str,
    axes: Axes,
    limits: tuple[float, float] | None = None,
    visible: Sequence[bool] | None = None,
    *,
    legend: bool = True,
) -> rrb.TimeSeriesView:
    """Curves over the control steps; a legend stands to the right of their end."""
    axis = None
    time = None
    if legend and axes.steps is not None:
        last = round((1 + LEGEND_SHARE) * axes.steps)
        time = rrb.TimeAxis(
            view_range=rr.TimeRange(
                start=rr.TimeRangeBoundary.absolute(seq=0),
                end=rr.TimeRangeBoundary.absolute(seq=last),
            )
        )
    corner = rrb.Corner2D.RightTop
    if limits is not None:
        axis = rrb.ScalarAxis(range=limits)
        corner = rrb.Corner2D.RightBottom
    overrides: Any = None
    if visible is not None:
        overrides = {origin: rr.SeriesLines(visible_series=list(visible))}
    return rrb.TimeSeriesView(
        origin=origin,
        name=name,
        contents=["$origin/**"],
        axis_x=time,
        axis_y=axis,
        plot_legend=rrb.PlotLegend(corner, visible=legend),
        overrides=overrides,
    )


def _viewpoint(header: EpisodeHeader) -> rrb.EyeControls3D:
    """Towards the middle of the objects, from beside the first camera and above the table."""
    xy = mean_placement(header.row)
    centre = np.array([*xy, 0.06])
    direction = np.array([1.0, 0.0])
    if header.cameras:
        direction = header.cameras[0].pose_world[:2, 3] - xy
    direction = direction / max(float(np.linalg.norm(direction)), 1e-6)
    angle = np.deg2rad(50.0)
    rotation = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    return rrb.EyeControls3D(
        position=centre + np.array([*(0.72 * (rotation @ direction)), 0.45]),
        look_target=centre,
        eye_up=(0, 0, 1),
        kind=rrb.Eye3DKind.Orbital,
    )
