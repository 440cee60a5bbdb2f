"""How a recording looks when it is opened: what the policy saw, why that box won, what happened.

Layouts are values that rerun stores inside the recording. `/vap/...` paths are explained in `recorder.py`.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from vap_core.failures import Diagnosis
from vap_core.record.file import Layout
from vap_core.values import Grounding, Opening

TARGET = (255, 150, 40)
"""The winner, the track and the target object: one orange everywhere."""
QUIET = (126, 160, 205)
"""Every other candidate and object."""
TRUTH = (60, 230, 150)
"""Simulator ground truth."""
SERIES = [(88, 166, 255), (255, 150, 40), (60, 210, 140), (240, 100, 110), (190, 140, 255), (235, 205, 90), (120, 215, 235), (200, 200, 200)]
"""Curves on a dark plot: no dark colour among them."""
BACKGROUND = (24, 28, 36)

type Part = rrb.Container | rrb.View


def evidence_line(grounding: Grounding) -> str:
    """One view's verdict in a few words: the vote with its margin, or `no candidate`; before it what association chose instead."""
    if grounding.elected is None:
        return "no candidate, view unmodified"
    tie = " · TIE" if int(grounding.tied.sum()) > 1 else ""
    chosen = "" if grounding.overruled is None else f"{'none' if grounding.winner is None else f'#{grounding.winner}'} by association · "
    return (
        f"{chosen}#{grounding.elected} wins {grounding.votes[grounding.elected]}/{grounding.similarity.shape[1]} · margin {grounding.margin:.2f}{tie}"
    )


def short_verdict(grounding: Grounding) -> str:
    """The same in the width of a small title."""
    if grounding.elected is None:
        return "no candidate"
    if grounding.overruled is not None:
        return "overruled"
    return "TIE" if int(grounding.tied.sum()) > 1 else f"margin {grounding.margin:.2f}"


def _image(cam: str, title: str, contents: Sequence[str]) -> rrb.Spatial2DView:
    root = f"/observation.images.{cam}"
    return rrb.Spatial2DView(origin=root, contents=[f"{root}{tail}" for tail in contents], name=f"{cam} · {title}", background=BACKGROUND)


def policy_view(cam: str) -> Part:
    return _image(cam, "policy input", ["/prompted"])


def track_view(cam: str, narrow: bool = False) -> Part:
    return _image(cam, "track" if narrow else "track, truth", ["", "/mask/**"])


def vote_view(cam: str, targets: int = 1, narrow: bool = False) -> Part:
    return _image(cam, "vote" if narrow else "vote at t = 0", ["/candidates/**", *(f"/candidates_{j}/**" for j in range(1, targets))])


def bars_view(cam: str, groundings: Sequence[Grounding]) -> Part:
    title = short_verdict(groundings[0]) if groundings else "no personal object"
    return rrb.BarChartView(origin=f"/vap/votes/{cam}", name=f"{cam} votes · {title}", plot_legend=rrb.PlotLegend(visible=False))


def _cameras(opening: Opening) -> tuple[Part, float]:
    """Every camera's three pictures, and the share of the width they deserve: squares in a box of about 10 : 7."""
    names = [camera.name for camera in opening.cameras]
    narrow = len(names) == 2
    trios = [(policy_view(cam), track_view(cam, narrow), vote_view(cam, len(opening.groundings.get(cam, ())), narrow)) for cam in names]
    if len(names) <= 2:
        columns = [rrb.Vertical(saw, rrb.Horizontal(track, vote), row_shares=[5, 3]) for saw, track, vote in trios]
        return rrb.Horizontal(*columns), 0.4 if len(names) == 1 else 0.52
    return rrb.Vertical(*(rrb.Horizontal(*trio, column_shares=[1, 1, 1]) for trio in trios)), 0.44


def _eye(opening: Opening) -> rrb.EyeControls3D:
    """Look at the middle of the objects from beside the first camera, a little above the table."""
    xy = np.array([[p.x, p.y] for p in opening.row.placements]).mean(axis=0)
    centre = np.array([*xy, 0.12])
    away = opening.cameras[0].pose_world[:2, 3] - xy if opening.cameras else np.array([1.0, 0.0])
    away = away / max(float(np.linalg.norm(away)), 1e-6)
    turn = np.deg2rad(50.0)
    side = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]) @ away
    return rrb.EyeControls3D(position=centre + np.array([*(0.9 * side), 0.5]), look_target=centre, eye_up=(0, 0, 1), kind=rrb.Eye3DKind.Orbital)


def _curves(
    origin: str, name: str, contents: Sequence[str] = ("$origin/**",), limits: tuple[float, float] | None = None, shown: Sequence[bool] | None = None
) -> rrb.TimeSeriesView:
    axis = rrb.ScalarAxis(range=limits) if limits else None
    legend = rrb.PlotLegend(rrb.Corner2D.RightBottom if limits else rrb.Corner2D.LeftTop)
    overrides: Any = {origin: rr.SeriesLines(visible_series=list(shown))} if shown else None
    return rrb.TimeSeriesView(origin=origin, name=name, contents=list(contents), axis_y=axis, plot_legend=legend, overrides=overrides)


def panels(root: Part, fps: float = 1.0) -> Layout:
    """The whole window: `root`, and the time line at its foot."""
    return Layout(
        root,
        rrb.TimePanel(state="collapsed", timeline="frame_index", play_state="paused", fps=fps),
        rrb.SelectionPanel(state="hidden"),
        rrb.BlueprintPanel(state="hidden"),
        rrb.TopPanel(state="hidden"),
        auto_layout=False,
        auto_views=False,
    )


def _scene(opening: Opening) -> Part:
    return rrb.Spatial3DView(
        origin="/",
        contents=["/world/**", *(f"/observation.images.{camera.name}" for camera in opening.cameras)],
        name="scene (simulator truth)",
        background=BACKGROUND,
        line_grid=rrb.LineGrid3D(visible=False),
        eye_controls=_eye(opening),
    )


def _course(opening: Opening, *more: Part) -> Part:
    """The words, the curves, `more` first, and the course of events."""
    unit, arm = (-0.05, 1.05), [True] * (len(opening.action_names) - 1)
    columns = rrb.archetypes.TextLogColumns(
        timeline_columns=[rrb.encodings.TimelineColumn("frame_index")],
        text_log_columns=[rrb.encodings.TextLogColumn("loglevel"), rrb.encodings.TextLogColumn("body")],
    )
    actions = [
        _curves("/action", "action", shown=[*arm, False]),
        _curves("/action", "gripper", shown=[*(not shown for shown in arm), True]),
        _curves("/observation.state", "state"),
    ]
    scores = [_curves("/vap/track_score", "track score", limits=unit), _curves("/vap/vote_margin", "vote margin", limits=unit)]
    return rrb.Horizontal(
        rrb.TextDocumentView(origin="/vap/instruction", name="instruction"),
        rrb.Tabs(*more, *actions, active_tab=0),
        rrb.Tabs(*scores, active_tab=0),
        rrb.StateTimelineView(origin="/vap/status", name="course"),
        rrb.TextLogView(origin="/vap/events", name="events", columns=columns),
        column_shares=[1.15, 1, 1, 0.95, 1.15],
    )


def _hand() -> Part:
    return _curves("/vap/hand", "hand")


def _everything(opening: Opening) -> rrb.Container:
    """Big pictures first; beside them the scene and the votes; below, the words, the curves and the course of events."""
    pictures, share = _cameras(opening)
    votes = rrb.Horizontal(*(bars_view(camera.name, opening.groundings.get(camera.name, ())) for camera in opening.cameras))
    right = rrb.Vertical(_scene(opening), votes, row_shares=[2.4, 1])
    top = rrb.Horizontal(pictures, right, column_shares=[share, 1 - share])
    return rrb.Vertical(top, _course(opening, _hand()), row_shares=[0.745, 0.255], name="everything")


def _attention(opening: Opening) -> rrb.Container:
    """Where the policy looked when it decided, in every view."""
    views = rrb.Horizontal(*(_image(camera.name, "where the policy looks", ["/attention"]) for camera in opening.cameras))
    return rrb.Vertical(views, _course(opening, _hand()), row_shares=[0.72, 0.28], name="attention")


def identity_view(cam: str) -> Part:
    return _image(cam, "prompt by whom it covers", ["", "/identity"])


def crops_view(cam: str) -> Part:
    return rrb.Spatial2DView(origin=f"/vap/crops/{cam}", name=f"{cam} · reference views, and the candidates below", background=BACKGROUND)


def cosine_view(cam: str) -> Part:
    return rrb.TensorView(
        origin=f"/vap/similarity/{cam}",
        name="cosine (candidate x reference)",
        scalar_mapping=rrb.TensorScalarMapping(mag_filter=rr.components.MagnificationFilter.Nearest, colormap=rr.components.Colormap.Viridis),
        view_fit=rrb.components.ViewFit.Fill,
    )


def _vote_first(opening: Opening, cam: str, drifted: bool) -> Part:
    """Case 1: what was compared with what, and who won; after a drift, what the prompt is on now."""
    groundings = opening.groundings.get(cam, ())
    big, small = (identity_view(cam), vote_view(cam)) if drifted else (vote_view(cam), identity_view(cam))
    compared = rrb.Vertical(crops_view(cam), rrb.Horizontal(cosine_view(cam), bars_view(cam, groundings)), row_shares=[1.25, 1])
    return rrb.Horizontal(big, rrb.Vertical(small, policy_view(cam)), compared, column_shares=[1.3, 0.68, 1.2])


def _views_first(opening: Opening) -> Part:
    """Case 2: every view's prompt in the colour of what it covers, side by side."""
    names = [camera.name for camera in opening.cameras]
    columns = [rrb.Vertical(identity_view(cam), rrb.Horizontal(vote_view(cam, narrow=True), policy_view(cam)), row_shares=[1.9, 1]) for cam in names]
    return rrb.Horizontal(*columns)


def _hand_first(opening: Opening) -> Part:
    """Case 3: the scene, the way of the hand, and what the policy saw."""
    names = [camera.name for camera in opening.cameras]
    views = rrb.Vertical(*(policy_view(cam) for cam in names)) if len(names) > 1 else rrb.Vertical(policy_view(names[0]), identity_view(names[0]))
    return rrb.Horizontal(_scene(opening), views, _hand(), column_shares=[1.45, 0.55 if len(names) > 1 else 0.75, 1])


def episode_blueprint(opening: Opening, diagnosis: Diagnosis | None = None, *, looked: bool = False) -> Layout:
    """Everything; before it, once a failure is diagnosed, the evidence that decided its case; last, if `looked`, the policy's attention."""
    whole = [_everything(opening), *([_attention(opening)] if looked else [])]
    if diagnosis is None or not opening.cameras:
        return panels(rrb.Tabs(*whole, active_tab=0) if looked else whole[0], opening.hz)
    cam, more = diagnosis.camera or opening.cameras[0].name, [_hand()]
    match diagnosis.case:
        case "case 1" | "unlabelled":
            why = _vote_first(opening, cam, diagnosis.sub_case == "drift")
        case "case 2":
            why = _views_first(opening)
        case _:
            why, more = _hand_first(opening), []
    first = rrb.Vertical(why, _course(opening, *more), row_shares=[0.72, 0.28], name=f"{diagnosis.case}: {diagnosis.sub_case}")
    return panels(rrb.Tabs(first, *whole, active_tab=0), opening.hz)


def grounding_blueprint(cam: str, grounding: Grounding) -> Layout:
    """One image, and why that box won."""
    words = rrb.TextDocumentView(origin="/vap/instruction", name="instruction")
    references = rrb.Spatial2DView(origin="/vap/references", name="reference views #0, #1, ...", background=BACKGROUND)
    cosine = cosine_view(cam)
    top = rrb.Horizontal(vote_view(cam), _image(cam, "mask", ["", "/mask/**"]), policy_view(cam))
    why = rrb.Horizontal(words, references, bars_view(cam, [grounding]), cosine, column_shares=[1, 1.2, 1, 1])
    return panels(rrb.Vertical(top, why, row_shares=[1.5, 1]))


def series_style(names: Sequence[str]) -> rr.SeriesLines:
    """Names, widths and visible colours for the curves of one entity."""
    return rr.SeriesLines(names=list(names), colors=[SERIES[i % len(SERIES)] for i in range(len(names))], widths=[1.5] * len(names))


def packed(rgb: tuple[int, int, int]) -> np.uint32:
    """0xRRGGBBAA, opaque."""
    return np.uint32(rgb[0] << 24 | rgb[1] << 16 | rgb[2] << 8 | 0xFF)


def state_style(colours: Mapping[str, tuple[int, int, int]]) -> rr.StateConfiguration:
    """One colour for each state of a lane."""
    return rr.StateConfiguration(values=list(colours), labels=list(colours), colors=[packed(rgb) for rgb in colours.values()])
