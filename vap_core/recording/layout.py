"""The single views of a recording's layout."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from vap_core.base.types import Grounding, value
from vap_core.recording.colours import BACKGROUND, image_root, target_suffix
from vap_core.recording.entities.scene import mean_placement
from vap_core.recording.stream import StoredBlueprint
from vap_core.rollout.types import Diagnosis, EpisodeHeader

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


def named_view(camera: str) -> Part:
    """The same with the outlines and the names of the objects over it."""
    return _image_view(camera, "what the policy sees", ["/prompted", "/identity/**"])


def track_view(camera: str, title: str) -> Part:
    """The raw picture with the tracked mask, white, and the true one, orange."""
    return _image_view(camera, title, ["", "/mask/**"])


def vote_view(camera: str, title: str = "vote at t = 0", j: int = 0) -> Part:
    """The candidates of target j over the picture that the vote was held on."""
    return _image_view(camera, title, [f"/candidates{target_suffix(j)}/**"])


def attention_view(camera: str, query: str) -> Part:
    """The attention of one query over the policy's input."""
    title = f"where {QUERY_NAMES[query]} looks"
    return _image_view(camera, title, [f"/attention/{query}"])


def vote_picture_view(camera: str) -> Part:
    """The candidates, the reference photos, and the cosines that were compared."""
    return rrb.Spatial2DView(
        origin=f"/vap/vote_picture/{camera}", name=f"{camera} · vote", background=BACKGROUND
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


def track_score_view(axes: Axes = DEFAULT_AXES) -> Part:
    """How sure the tracker is of the target, in every view."""
    return _curve_view("/vap/track_score", "track score", axes, UNIT_RANGE)


def gripper_view(axes: Axes = DEFAULT_AXES) -> Part:
    """The gripper's distance from the target and the nearest other object, and what it holds."""
    return _curve_view("/vap/hand", "distance to yours, cm", axes, axes.gripper_cm)


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
) -> rrb.TimeSeriesView:
    """Curves over the control steps; a legend stands to the right of their end."""
    axis = None
    time = None
    if axes.steps is not None:
        last = round((1 + LEGEND_SHARE) * axes.steps)
        time = rrb.TimeAxis(
            view_range=rr.TimeRange(
                start=rr.TimeRangeBoundary.absolute(seq=0),
                end=rr.TimeRangeBoundary.absolute(seq=last),
            )
        )
    if limits is not None:
        axis = rrb.ScalarAxis(range=limits)
    overrides: Any = None
    if visible is not None:
        overrides = {origin: rr.SeriesLines(visible_series=list(visible))}
    return rrb.TimeSeriesView(
        origin=origin,
        name=name,
        contents=["$origin/**"],
        axis_x=time,
        axis_y=axis,
        plot_legend=rrb.PlotLegend(rrb.Corner2D.RightTop),
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


VERDICT_SHARES = [0.145, 0.855]
"""Height of the verdict, and of everything below it."""
EVIDENCE_SHARES = [0.58, 0.42]
"""Height of the evidence, and of the time course below it."""


def episode_blueprint(
    header: EpisodeHeader,
    diagnosis: Diagnosis | None = None,
    *,
    queries: Sequence[str] = (),
    axes: Axes = DEFAULT_AXES,
) -> StoredBlueprint:
    """The verdict; below it what the policy saw, the vote and the distance, then a tab with
    everything, last the policy's attention.

    `queries` are those whose attention is recorded; each has a tab of its own. `axes` are those of
    the charts.
    """
    tabs = [_first_tab(header, diagnosis, axes), _overview(header, axes)]
    if queries:
        tabs.append(_attention_tab(header, queries, axes))
    body = rrb.Tabs(*tabs, active_tab=0)
    window = rrb.Vertical(verdict_view(), body, row_shares=VERDICT_SHARES)
    return full_window(window, header.hz)


def grounding_blueprint(grounding: Grounding, fps: float = 1.0) -> StoredBlueprint:
    """One picture, or the frames of a clip, and why that box won."""
    camera = grounding.camera
    pictures = rrb.Horizontal(vote_view(camera), mask_view(camera), policy_view(camera))
    evidence = rrb.Horizontal(instruction_view(), vote_picture_view(camera), column_shares=[1, 2])
    return full_window(rrb.Vertical(pictures, evidence, row_shares=[1.2, 1]), fps)


def full_window(root: Part, fps: float = 1.0) -> StoredBlueprint:
    """The whole window: `root`, and the time panel below it."""
    return StoredBlueprint(
        root,
        rrb.TimePanel(state="collapsed", timeline="frame_index", play_state="paused", fps=fps),
        rrb.SelectionPanel(state="hidden"),
        rrb.BlueprintPanel(state="hidden"),
        rrb.TopPanel(state="hidden"),
        auto_layout=False,
        auto_views=False,
    )


def _overview(header: EpisodeHeader, axes: Axes) -> rrb.Container:
    """Every view's pictures and the scene above; text, curves and events below."""
    tabs: list[Part] = []
    for camera in header.cameras:
        pictures = [policy_view(camera.name), track_view(camera.name, "track, truth")]
        for j, grounding in enumerate(header.groundings.get(camera.name, ())):
            title = f"vote, {grounding.object}" if j else "vote at t = 0"
            pictures.append(vote_view(camera.name, title, j))
        tabs.append(rrb.Grid(*pictures, grid_columns=min(3, len(pictures)), name=camera.name))
    parts = [rrb.Tabs(*tabs, active_tab=0)] if tabs else []
    top = rrb.Horizontal(*parts, scene_view(header), column_shares=[1.6, 1.0][-1 - len(parts) :])
    return rrb.Vertical(
        top, _time_course(header, axes), row_shares=EVIDENCE_SHARES, name="everything"
    )


def _attention_tab(header: EpisodeHeader, queries: Sequence[str], axes: Axes) -> rrb.Container:
    """Where the attention was, in every view; the query is switched by a tab."""
    per_query: list[Part] = []
    for query in queries:
        views = [attention_view(camera.name, query) for camera in header.cameras]
        per_query.append(rrb.Horizontal(*views, name=query))
    return rrb.Vertical(
        rrb.Tabs(*per_query, active_tab=0),
        _time_course(header, axes),
        row_shares=EVIDENCE_SHARES,
        name="attention",
    )


def _first_tab(header: EpisodeHeader, diagnosis: Diagnosis | None, axes: Axes) -> rrb.Container:
    """What the policy saw in every view, the vote, and the distance to the target.

    The votes are tabs, before all that of the deciding view. What decided a failure has most room.
    """
    case, name, first = "", "what happened", ""
    if diagnosis is not None:
        case, first = diagnosis.case, diagnosis.camera
        name = f"{case}: {diagnosis.sub_case}"
    seen = [named_view(camera.name) for camera in header.cameras]
    voting = _voting(header)
    evidence: list[Part] = []
    if voting:
        active = voting.index(first) if first in voting else 0
        evidence.append(rrb.Tabs(*map(vote_picture_view, voting), active_tab=active))
    if axes.gripper_cm is not None:
        evidence.append(gripper_view(axes))
    elif voting:
        evidence.append(track_score_view(axes))
    shares = [0.8, 1.0] if case in ("case 3", "unprompted") else [1.0, 0.8]
    shares = shares[: len(evidence)]
    if len(seen) == 1:
        beside = [rrb.Vertical(*evidence, row_shares=shares)] if evidence else []
        return rrb.Horizontal(*seen, *beside, name=name)
    rows: list[Part] = [rrb.Horizontal(*seen)] if seen else []
    if evidence:
        rows.append(rrb.Horizontal(*evidence, column_shares=shares))
    return rrb.Vertical(*rows, name=name)


def _time_course(header: EpisodeHeader, axes: Axes) -> Part:
    """Instruction, curves and events."""
    n_arm = len(header.action_names) - 1
    curves: list[Part] = [
        _curve_view("/action", "action", axes, visible=[True] * n_arm + [False]),
        _curve_view("/action", "gripper", axes, visible=[False] * n_arm + [True]),
        _curve_view("/observation.state", "state", axes),
    ]
    if _voting(header):
        curves += [
            track_score_view(axes),
            _curve_view("/vap/vote_margin", "margin", axes, UNIT_RANGE),
        ]
    parts = [instruction_view(), rrb.Tabs(*curves, active_tab=0), events_view()]
    return rrb.Horizontal(*parts, column_shares=[0.8, 1.2, 1.2])


def _voting(header: EpisodeHeader) -> list[str]:
    """The cameras in whose views a vote was held."""
    return [camera for camera, groundings in header.groundings.items() if groundings]
