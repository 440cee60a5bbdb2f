"""One episode's grounding and tracks beside ground truth, as tables.

The simulator's ground truth, with which they compare, is never given to the method.
"""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from vap_core.associate import compare_views
from vap_core.attend import Attender, Prompting
from vap_core.base.errors import UnknownName
from vap_core.base.types import Grounding, Mask, PersonalObject
from vap_core.perception.boxes import mask_iou
from vap_core.perception.protocols import Stack
from vap_core.policies.scripted.expert import Expert
from vap_core.rollout.loop import Trial, rollout
from vap_core.rollout.prompters import TintPrompter
from vap_core.rollout.types import EpisodeHeader, Frame
from vap_core.simulation import suites
from vap_core.simulation.occluder import Occlusion
from vap_core.simulation.suites.open_row import build_scene
from vap_core.simulation.types import EpisodeRow, Outcome
from vap_core.study.perception import ASSOCIATED, OFF, VISIBLE_PX, View, object_under_box
from vap_core.study.tracking import KEPT

if TYPE_CHECKING:
    import pandas as pd

NAMED_IOU = 0.1
"""A candidate whose mask overlaps every object by less is none of them."""
Ways = Mapping[str, Mapping[str, Grounding]]
"""The first target's grounding in every view, by way to associate: OFF or ASSOCIATED."""


def episode(suite: str, task: str, number: int) -> EpisodeRow:
    """Episode `number` of a task's list. Raises: UnknownName."""
    n = number + 1 if suite in suites.WARM_UPS else None
    rows = suites.rows(suite, task, n=n) if number >= 0 else ()
    for row in rows:
        if row.episode == number:
            return row
    there = f"{rows[0].episode} to {rows[-1].episode}" if rows else "0 and up"
    raise UnknownName(f"episode: no episode {number} of {suite}/{task}; its list has {there}.")


def grounding_table(
    grounding: Grounding, truth: Mapping[str, Mask] | None = None
) -> "pd.DataFrame":
    """One line per candidate: score, votes, whether it shared the most votes, and mean cosine.

    With ground truth also the object that the candidate's mask covers best, and its IoU; "-" below
    NAMED_IOU.
    """
    import pandas as pd

    ballot = grounding.ballot
    table = pd.DataFrame(
        {
            "candidate": range(len(grounding.masks)),
            "score": grounding.candidates.score.astype(float),
            "votes": ballot.votes,
            "tied": ballot.tied,
            "mean cosine": grounding.similarity.astype(float).mean(axis=1),
            "winner": [i == grounding.winner for i in range(len(grounding.masks))],
        }
    )
    if truth:
        best = [
            max(((mask_iou(mask, true), name) for name, true in truth.items()))
            for mask in grounding.masks
        ]
        table["is"] = [name if iou >= NAMED_IOU else "-" for iou, name in best]
        table["iou"] = [iou for iou, _ in best]
    return table


def associations(stack: Stack, mine: PersonalObject, views: Sequence[View]) -> Ways:
    """The views grounded one by one, and associated where the `optics` of all views are known.

    The candidates are the same, the choices perhaps others.

    Raises: as `Attender.start`.
    """
    images = {view.camera: view.rgb for view in views}
    optics = {view.camera: view.optics for view in views if view.optics is not None}
    found = {}
    for name in (OFF, ASSOCIATED) if len(optics) == len(views) else (OFF,):
        prompting = Prompting(associate=name == ASSOCIATED)
        attender = Attender(stack, {mine.name: mine}, prompting)
        _, attended = attender.start(images, views[0].row.instruction, cameras=optics)
        found[name] = {camera: first for camera, (first, *_) in attended.groundings.items()}
    return found


def association_table(ways: Ways, views: Sequence[View]) -> "pd.DataFrame":
    """One line per way: the object highlighted in each view ("-" where none is).

    And what the views show together (SPEC section 7).
    """
    import pandas as pd

    lines = []
    for way, groundings in ways.items():
        names = {view.camera: highlighted(view, groundings[view.camera]) for view in views}
        distinct = {
            c: f"nothing in {c}" if name == "nothing" else name for c, name in names.items()
        }
        shown = {camera: name or "-" for camera, name in names.items()}
        together = compare_views(distinct, views[0].row.target)
        lines.append({"associate": way, **shown, "together": together})
    return pd.DataFrame(lines).set_index("associate")


def highlighted(view: View, grounding: Grounding) -> str | None:
    """The object under the winner's box, None without a winner."""
    if grounding.winner is None:
        return None
    return object_under_box(view, grounding.candidates.xyxy[grounding.winner])


def follow(
    attender: Attender, row: EpisodeRow, occlusion: Occlusion | None = None
) -> tuple[Frame, ...]:
    """Every frame of one episode of the expert, as `attender` tracks it.

    The expert reads the simulator and no prompt. Raises: RuntimeError when the episode broke off.
    """
    frames: list[Frame] = []

    class FrameSink:
        def frame(self, frame: Frame) -> None:
            frames.append(frame)

        def close(self, outcome: Outcome) -> None:
            pass

    def open_sink(opening: EpisodeHeader) -> FrameSink:
        return FrameSink()

    suite = suites.suite(row.suite)
    models = [place.model for place in row.placements]
    with build_scene(row.suite, models, row.variant) as scene:
        parts: dict[str, Any] = dict(control=suite.control, sensor=suite.sensor)
        parts |= dict(policy=Expert(), prompter=TintPrompter(attender), occlusion=occlusion)
        (ended,) = rollout(Trial(method="vap", scene=scene, **parts), [row], open_sink)
    if ended.outcome.status == "error":
        raise RuntimeError(
            f"follow: {row.key} broke off after {ended.outcome.steps} steps: {ended.outcome.detail}"
        )
    return tuple(frames)


def track_table(frames: Sequence[Frame], target: str) -> "pd.DataFrame":
    """One line per step and camera: the first target's track against ground truth.

    `shown`: whether the view shows as much of the target as the survey asks for; `iou` with it, nan
    where it does not; `visible`: what the tracker says, with its `score`; `on`: the object that
    most of the track's mask lies on, "" where there is no mask.
    """
    import pandas as pd

    lines = []
    for frame in frames:
        for camera, (track, *_) in frame.tracks.items():
            masks = frame.truth.masks[camera]
            true = masks[target]
            shown = bool(true.sum() >= VISIBLE_PX * true.size / 224**2)
            on, iou = "", 0.0
            if track.mask is not None:
                iou = mask_iou(track.mask, true)
                covered = {name: int((track.mask & mask).sum()) for name, mask in masks.items()}
                on = max(covered, key=covered.__getitem__)
                on = on if covered[on] else "nothing"
            line = {"step": frame.frame_index, "camera": camera, "shown": shown}
            line |= {"visible": track.mask is not None, "score": track.score}
            lines.append({**line, "iou": iou if shown else np.nan, "on": on})
    return pd.DataFrame(lines)


def recovery(track: "pd.DataFrame", occlusion: Occlusion) -> "pd.DataFrame":
    """One line per camera of `track_table`: the track before, during and after an occlusion.

    Mean IoU before, whether the tracker noticed that the target was hidden, and what it tracks
    after. `back after`: frames that show the target again until the track is on it (IoU above 0.5);
    nan when it never is.
    """
    import pandas as pd

    lines = []
    for camera, part in track.groupby("camera", sort=False):
        hidden = part[[occlusion.covers(str(camera), int(step)) for step in part.step]]
        after = part[(part.step >= occlusion.start + occlusion.frames) & part.shown]
        back = np.flatnonzero(after.iou > KEPT)
        lines.append(
            {
                "camera": camera,
                "IoU before": part[part.step < occlusion.start].iou.mean(),
                "hidden frames": len(hidden),
                "said not visible": int((~hidden.visible).sum()),
                "back after": float(back[0]) if len(back) else np.nan,
                "IoU after": after.iou.mean(),
                "at the end on": part.on.iloc[-1] or "-",
            }
        )
    return pd.DataFrame(lines).set_index("camera")


def contradicted(agreements: "pd.DataFrame") -> EpisodeRow | None:
    """The first surveyed episode whose views highlight different objects until associated.

    Grounded one by one they differ, and associated they do not. Where there is no such
    episode, the first whose views contradict each other; None where there is none of these.

    Raises: UnknownName for an episode that the list of today does not have.
    """
    key = ["suite", "task", "episode"]
    alone = agreements[(agreements.associate == OFF) & (agreements.case == "case 2")]
    right = (agreements.associate == ASSOCIATED) & (agreements.case == "right")
    remedied = alone.merge(agreements.loc[right, key], on=key)
    chosen = remedied if len(remedied) else alone
    if chosen.empty:
        return None
    first = chosen.iloc[0]
    return episode(first["suite"], first["task"], int(first["episode"]))
