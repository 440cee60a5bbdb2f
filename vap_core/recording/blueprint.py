"""How a recording looks when it is opened.

Layouts are values that rerun stores inside the recording; `views` makes their single views.
"""

from collections.abc import Sequence

import rerun.blueprint as rrb

from vap_core.base.types import Grounding
from vap_core.recording.stream import StoredBlueprint
from vap_core.recording.views import (
    Part,
    attention_view,
    cosine_view,
    coverage_view,
    crops_view,
    events_view,
    gripper_view,
    instruction_view,
    mask_view,
    method_curve_views,
    policy_view,
    references_view,
    robot_curve_views,
    scene_view,
    status_view,
    track_view,
    vote_view,
    votes_view,
)
from vap_core.rollout.failure import Diagnosis
from vap_core.rollout.types import EpisodeHeader

EVIDENCE_SHARES = [0.72, 0.28]
"""Height of the evidence, and of the time course below it."""


def episode_blueprint(
    header: EpisodeHeader, diagnosis: Diagnosis | None = None, *, queries: Sequence[str] = ()
) -> StoredBlueprint:
    """Everything; before it the evidence of a diagnosed failure; last the policy's attention.

    `queries` are those whose attention is recorded; each has a tab of its own.
    """
    tabs: list[Part] = [_overview(header)]
    if queries:
        tabs.append(_attention_tab(header, queries))
    if diagnosis is not None and header.cameras:
        tabs.insert(0, _evidence_tab(header, diagnosis))
    if len(tabs) == 1:
        return full_window(tabs[0], header.hz)
    return full_window(rrb.Tabs(*tabs, active_tab=0), header.hz)


def grounding_blueprint(grounding: Grounding, fps: float = 1.0) -> StoredBlueprint:
    """One picture, or the frames of a clip, and why that box won."""
    camera = grounding.camera
    pictures = rrb.Horizontal(vote_view(camera), mask_view(camera), policy_view(camera))
    evidence = rrb.Horizontal(
        instruction_view(),
        references_view(),
        votes_view(camera, [grounding]),
        cosine_view(camera),
        column_shares=[1, 1.2, 1, 1],
    )
    return full_window(rrb.Vertical(pictures, evidence, row_shares=[1.5, 1]), fps)


def dataset_blueprint(cameras: Sequence[str], fps: float) -> StoredBlueprint:
    """A recorded episode: per camera what a policy would see, the track and the vote."""
    rows: list[Part] = []
    for camera in cameras:
        rows.append(rrb.Vertical(policy_view(camera), mask_view(camera), vote_view(camera)))
    score, _ = method_curve_views()
    below = rrb.Horizontal(
        instruction_view(), score, references_view(), column_shares=[1.2, 1.4, 1]
    )
    return full_window(rrb.Vertical(rrb.Horizontal(*rows), below, row_shares=[2.6, 1]), fps)


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


def _overview(header: EpisodeHeader) -> rrb.Container:
    """Pictures, scene and votes above; text, curves and events below."""
    pictures, share = _camera_grid(header)
    votes = []
    for camera in header.cameras:
        votes.append(votes_view(camera.name, header.groundings.get(camera.name, ())))
    right = rrb.Vertical(scene_view(header), rrb.Horizontal(*votes), row_shares=[2.4, 1])
    top = rrb.Horizontal(pictures, right, column_shares=[share, 1 - share])
    return rrb.Vertical(
        top,
        _time_course(header, with_gripper=True),
        row_shares=[0.745, 0.255],
        name="everything",
    )


def _attention_tab(header: EpisodeHeader, queries: Sequence[str]) -> rrb.Container:
    """Where the attention was, in every view; the query is switched by a tab."""
    per_query: list[Part] = []
    for query in queries:
        views = [attention_view(camera.name, query) for camera in header.cameras]
        per_query.append(rrb.Horizontal(*views, name=query))
    return rrb.Vertical(
        rrb.Tabs(*per_query, active_tab=0),
        _time_course(header, with_gripper=True),
        row_shares=EVIDENCE_SHARES,
        name="attention",
    )


def _evidence_tab(header: EpisodeHeader, diagnosis: Diagnosis) -> rrb.Container:
    """The evidence that decided the case of a failure."""
    camera = diagnosis.camera or header.cameras[0].name
    with_gripper = True
    match diagnosis.case:
        case "case 1" | "unlabelled":
            evidence = _vote_evidence(header, camera, diagnosis.sub_case == "drift")
        case "case 2":
            evidence = _views_evidence(header)
        case _:
            evidence = _manipulation_evidence(header)
            with_gripper = False  # its curves are in the evidence
    return rrb.Vertical(
        evidence,
        _time_course(header, with_gripper),
        row_shares=EVIDENCE_SHARES,
        name=f"{diagnosis.case}: {diagnosis.sub_case}",
    )


def _vote_evidence(header: EpisodeHeader, camera: str, drifted: bool) -> Part:
    """Case 1: what was compared and what won; after a drift, what the prompt covers now."""
    large, small = vote_view(camera), coverage_view(camera)
    if drifted:
        large, small = small, large
    votes = votes_view(camera, header.groundings.get(camera, ()))
    comparison = rrb.Vertical(
        crops_view(camera),
        rrb.Horizontal(cosine_view(camera), votes),
        row_shares=[1.25, 1],
    )
    return rrb.Horizontal(
        large,
        rrb.Vertical(small, policy_view(camera)),
        comparison,
        column_shares=[1.3, 0.68, 1.2],
    )


def _views_evidence(header: EpisodeHeader) -> Part:
    """Case 2: every view's prompt in the colour of the object it covers, side by side."""
    columns = []
    for camera in header.cameras:
        pictures = rrb.Horizontal(vote_view(camera.name, "vote"), policy_view(camera.name))
        columns.append(rrb.Vertical(coverage_view(camera.name), pictures, row_shares=[1.9, 1]))
    return rrb.Horizontal(*columns)


def _manipulation_evidence(header: EpisodeHeader) -> Part:
    """Case 3: the scene, what the policy saw, and the gripper's distance from the target."""
    views = [policy_view(camera.name) for camera in header.cameras]
    share = 0.55
    if len(views) == 1:
        views.append(coverage_view(header.cameras[0].name))
        share = 0.75
    return rrb.Horizontal(
        scene_view(header),
        rrb.Vertical(*views),
        gripper_view(),
        column_shares=[1.45, share, 1],
    )


def _camera_grid(header: EpisodeHeader) -> tuple[Part, float]:
    """Three pictures of every camera, and their share of the width.

    The pictures are squares in a box of about 10 : 7.
    """
    n_cameras = len(header.cameras)
    grid: list[Part] = []
    for camera in header.cameras:
        track_title, vote_title = "track, truth", "vote at t = 0"
        if n_cameras == 2:
            track_title, vote_title = "track", "vote"
        n_targets = len(header.groundings.get(camera.name, ()))
        policy = policy_view(camera.name)
        track = track_view(camera.name, track_title)
        vote = vote_view(camera.name, vote_title, n_targets)
        if n_cameras <= 2:
            below = rrb.Horizontal(track, vote)
            grid.append(rrb.Vertical(policy, below, row_shares=[5, 3]))
        else:
            grid.append(rrb.Horizontal(policy, track, vote, column_shares=[1, 1, 1]))
    if n_cameras > 2:
        return rrb.Vertical(*grid), 0.44
    return rrb.Horizontal(*grid), 0.4 if n_cameras == 1 else 0.52


def _time_course(header: EpisodeHeader, with_gripper: bool) -> Part:
    """Instruction, curves, states and events."""
    curves = robot_curve_views(header)
    if with_gripper:
        curves.insert(0, gripper_view())
    return rrb.Horizontal(
        instruction_view(),
        rrb.Tabs(*curves, active_tab=0),
        rrb.Tabs(*method_curve_views(), active_tab=0),
        status_view(),
        events_view(),
        column_shares=[1.15, 1, 1, 0.95, 1.15],
    )
