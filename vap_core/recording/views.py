"""The single views of a recording's layout."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from vap_core.base.types import Grounding
from vap_core.recording.colours import BACKGROUND
from vap_core.recording.entities.paths import image_root
from vap_core.recording.entities.scene import mean_placement
from vap_core.recording.texts import vote_title
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


def policy_view(camera: str) -> Part:
    """What the policy saw."""
    return _image_view(camera, "policy input", ["/prompted"])


def track_view(camera: str, title: str) -> Part:
    """The raw picture with the tracked and the true mask."""
    return _image_view(camera, title, ["", "/mask/**"])


def vote_view(camera: str, title: str = "vote at t = 0", n_targets: int = 1) -> Part:
    """The candidates of every target over the picture that the vote was held on."""
    contents = ["/candidates/**"]
    for j in range(1, n_targets):
        contents.append(f"/candidates_{j}/**")
    return _image_view(camera, title, contents)


def coverage_view(camera: str) -> Part:
    """The prompt in the colour of the object that it covers."""
    return _image_view(camera, "prompt, coloured by object", ["", "/identity"])


def attention_view(camera: str, query: str) -> Part:
    """The attention of one query over the policy's input."""
    title = f"where {QUERY_NAMES[query]} looks"
    return _image_view(camera, title, [f"/attention/{query}"])


def votes_view(camera: str, groundings: Sequence[Grounding]) -> Part:
    """The votes as bars, the first target's result in the title."""
    title = vote_title(groundings[0]) if groundings else "no personal object"
    return rrb.BarChartView(
        origin=f"/vap/votes/{camera}",
        name=f"{camera} · {title}",
        plot_legend=rrb.PlotLegend(visible=False),
    )


def crops_view(camera: str) -> Part:
    """The crops that were compared."""
    return rrb.Spatial2DView(
        origin=f"/vap/crops/{camera}",
        name=f"{camera} · reference views, and the candidates below",
        background=BACKGROUND,
    )


def cosine_view(camera: str) -> Part:
    """The cosines that were compared."""
    return rrb.TensorView(
        origin=f"/vap/similarity/{camera}",
        name="cosine (candidate x reference)",
        scalar_mapping=rrb.TensorScalarMapping(
            mag_filter=rr.components.MagnificationFilter.Nearest,
            colormap=rr.components.Colormap.Viridis,
        ),
        view_fit=rrb.components.ViewFit.Fill,
    )


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


def references_view() -> Part:
    """The reference crops of one grounded picture."""
    return rrb.Spatial2DView(
        origin="/vap/references",
        name="reference views #0, #1, ...",
        background=BACKGROUND,
    )


def mask_view(camera: str) -> Part:
    """The elected candidate's mask over the picture."""
    return _image_view(camera, "mask", ["", "/mask/**"])


def status_view() -> Part:
    """The state lanes."""
    return rrb.StateTimelineView(origin="/vap/status", name="status")


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


def robot_curve_views(header: EpisodeHeader) -> list[Part]:
    """Arm action, gripper action, and robot state."""
    n_arm = len(header.action_names) - 1
    return [
        _curve_view("/action", "action", visible=[True] * n_arm + [False]),
        _curve_view("/action", "gripper", visible=[False] * n_arm + [True]),
        _curve_view("/observation.state", "state"),
    ]


def method_curve_views() -> list[Part]:
    """Track scores and vote margins."""
    return [
        _curve_view("/vap/track_score", "track score", limits=UNIT_RANGE),
        _curve_view("/vap/vote_margin", "vote margin", limits=UNIT_RANGE),
    ]


def gripper_view() -> Part:
    """The gripper's distance from the target, and the target's lift."""
    return _curve_view("/vap/hand", "gripper and target")


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
    limits: tuple[float, float] | None = None,
    visible: Sequence[bool] | None = None,
) -> rrb.TimeSeriesView:
    axis = None
    corner = rrb.Corner2D.LeftTop
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
        axis_y=axis,
        plot_legend=rrb.PlotLegend(corner),
        overrides=overrides,
    )


def _viewpoint(header: EpisodeHeader) -> rrb.EyeControls3D:
    """Towards the middle of the objects, from beside the first camera and above the table."""
    xy = mean_placement(header.row)
    centre = np.array([*xy, 0.12])
    direction = np.array([1.0, 0.0])
    if header.cameras:
        direction = header.cameras[0].pose_world[:2, 3] - xy
    direction = direction / max(float(np.linalg.norm(direction)), 1e-6)
    angle = np.deg2rad(50.0)
    rotation = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    return rrb.EyeControls3D(
        position=centre + np.array([*(0.9 * (rotation @ direction)), 0.5]),
        look_target=centre,
        eye_up=(0, 0, 1),
        kind=rrb.Eye3DKind.Orbital,
    )
