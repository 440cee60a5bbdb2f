"""The single views of a recording's layout."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from vap_core.base.types import Grounding, value
from vap_core.recording.colours import BACKGROUND, image_root, target_suffix
from vap_core.recording.entities.scene import mean_placement
from vap_core.recording.entities.votes import vote_picture_entity
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


VERDICT_SHARES = [0.11, 0.89]
"""Height of the verdict, and of everything below it."""
EVIDENCE_SHARES = [0.71, 0.29]
"""Height of the evidence, and of the time course below it."""
EVENTS_SHARE = 1.7
"""Width of the events, where the instruction has 1."""


def episode_blueprint(
    header: EpisodeHeader,
    diagnosis: Diagnosis | None = None,
    *,
    queries: Sequence[str] = (),
    axes: Axes = DEFAULT_AXES,
) -> StoredBlueprint:
    """The verdict; below it everything, before it the evidence of a diagnosed failure, last the
    policy's attention.

    `queries` are those whose attention is recorded; each has a tab of its own. `axes` are those of
    the charts.
    """
    tabs: list[Part] = [_overview(header, axes)]
    if queries:
        tabs.append(_attention_tab(header, queries, axes))
    if diagnosis is not None and header.cameras:
        tabs.insert(0, _evidence_tab(header, diagnosis, axes))
    body = tabs[0]
    if len(tabs) > 1:
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
    """Pictures, scene and votes above; text, curves and events below."""
    pictures, share = _camera_grid(header)
    right: Part = scene_view(header)
    votes = [vote_picture_view(camera) for camera in _voting(header)]
    if votes:
        right = rrb.Vertical(right, rrb.Tabs(*votes, active_tab=0), row_shares=[1, 1.1])
    top = rrb.Horizontal(pictures, right, column_shares=[share, 1 - share])
    return rrb.Vertical(
        top,
        _time_course(header, axes),
        row_shares=EVIDENCE_SHARES,
        name="everything",
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


def _evidence_tab(header: EpisodeHeader, diagnosis: Diagnosis, axes: Axes) -> rrb.Container:
    """The evidence that decided the case of a failure."""
    camera = diagnosis.camera or header.cameras[0].name
    with_gripper = True
    match diagnosis.case:
        case "case 1" | "unlabelled":
            evidence = _vote_evidence(header, camera, diagnosis.sub_case == "drift")
        case "case 2":
            evidence = _views_evidence(header)
        case _:
            evidence = _manipulation_evidence(header, axes)
            with_gripper = False  # its curves are in the evidence
    return rrb.Vertical(
        evidence,
        _time_course(header, axes, with_gripper=with_gripper),
        row_shares=EVIDENCE_SHARES,
        name=f"{diagnosis.case}: {diagnosis.sub_case}",
    )


def _vote_evidence(header: EpisodeHeader, camera: str, drifted: bool) -> Part:
    """Case 1: what was compared and what won; after a drift, what the prompt covers now."""
    large, small = vote_view(camera), coverage_view(camera)
    if drifted:
        large, small = small, large
    parts = [large, rrb.Vertical(small, policy_view(camera))]
    shares = [1.25, 0.68]
    if camera in _voting(header):
        parts.append(vote_picture_view(camera))
        shares.append(1.3)
    return rrb.Horizontal(*parts, column_shares=shares)


def _views_evidence(header: EpisodeHeader) -> Part:
    """Case 2: every view's prompt in the colour of the object it covers, side by side."""
    columns = []
    for camera in header.cameras:
        pictures = rrb.Horizontal(vote_view(camera.name, "vote"), policy_view(camera.name))
        columns.append(rrb.Vertical(coverage_view(camera.name), pictures, row_shares=[1.9, 1]))
    return rrb.Horizontal(*columns)


def _manipulation_evidence(header: EpisodeHeader, axes: Axes) -> Part:
    """Case 3: every view's prompt is right, the scene, and the gripper's distances.

    A method that prompts nothing shows the target's outline instead.
    """
    rows = []
    for camera in header.cameras:
        shown = track_view(camera.name, "target outlined")
        if _voting(header):
            shown = coverage_view(camera.name)
        rows.append(rrb.Horizontal(shown, policy_view(camera.name)))
    pictures: Part = rrb.Vertical(*rows)
    share = 0.95
    if len(rows) == 1:
        pictures = rrb.Vertical(shown, policy_view(header.cameras[0].name))
        share = 0.7
    return rrb.Horizontal(
        pictures,
        scene_view(header),
        gripper_view(axes),
        column_shares=[share, 1.05, 1],
    )


def _camera_grid(header: EpisodeHeader) -> tuple[Part, float]:
    """The pictures of every camera, and their share of the width.

    The pictures are squares in a box of about 10 : 7.
    """
    n_cameras = len(header.cameras)
    grid: list[Part] = []
    for camera in header.cameras:
        track_title, vote_title = "track, truth", "vote at t = 0"
        if n_cameras == 2:
            track_title, vote_title = "track", "vote"
        pictures = [track_view(camera.name, track_title)]
        for j, grounding in enumerate(header.groundings.get(camera.name, ())):
            title = vote_title if j == 0 else f"vote, {grounding.object}"
            pictures.append(vote_view(camera.name, title, j))
        policy = policy_view(camera.name)
        if n_cameras <= 2:
            grid.append(rrb.Vertical(policy, rrb.Horizontal(*pictures), row_shares=[5, 3]))
        else:
            grid.append(rrb.Horizontal(policy, *pictures))
    if n_cameras > 2:
        return rrb.Vertical(*grid), 0.44
    return rrb.Horizontal(*grid), 0.4 if n_cameras == 1 else 0.52


def _time_course(header: EpisodeHeader, axes: Axes, *, with_gripper: bool = True) -> Part:
    """Instruction, curves and events."""
    curves = robot_curve_views(header, axes)
    if with_gripper:
        curves.insert(0, gripper_view(axes))
    parts = [instruction_view(), rrb.Tabs(*curves, active_tab=0)]
    shares = [1.0, 1.0]
    of_method = method_curve_views(header, axes)
    if of_method:
        parts.append(rrb.Tabs(*of_method, active_tab=0))
        shares.append(0.75)
    parts.append(events_view())
    return rrb.Horizontal(*parts, column_shares=[*shares, EVENTS_SHARE])


def _voting(header: EpisodeHeader) -> list[str]:
    """The cameras in whose views a vote was held."""
    return [camera for camera, groundings in header.groundings.items() if groundings]
