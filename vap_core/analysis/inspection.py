"""What notebook 02 shows of one episode or one photo, as tables and figures.

The simulator's ground truth, with which they compare, is never given to the method.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from vap_core.analysis.gallery import camera_images
from vap_core.analysis.plots import candidates
from vap_core.associate import PAIRINGS, Pairing, compare_views
from vap_core.attend import Attender, Prompting
from vap_core.base.errors import BadOutput, UnknownName
from vap_core.base.files import read_parquet, writing
from vap_core.base.pictures import GENERIC, OTHER, WINNER, empty_figure
from vap_core.base.types import Grounding, Mask, PersonalObject
from vap_core.perception.boxes import mask_box, mask_iou
from vap_core.perception.protocols import Stack
from vap_core.policies.scripted.expert import Expert
from vap_core.rollout.loop import Trial, rollout
from vap_core.rollout.prompters import TintPrompter
from vap_core.rollout.types import EpisodeHeader, Frame
from vap_core.simulation import suites
from vap_core.simulation.assets.objects import get_object
from vap_core.simulation.occluder import Occlusion
from vap_core.simulation.studio import write_views
from vap_core.simulation.suites.open_row import build_scene
from vap_core.simulation.types import EpisodeRow, Outcome
from vap_core.study.perception import OFF, VISIBLE_PX, View, object_under_box
from vap_core.study.survey import TABLES
from vap_core.study.tracking import KEPT

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

NAMED_IOU = 0.1
"""A candidate whose mask overlaps every object by less is none of them."""

Ways = Mapping[str, Mapping[str, Grounding]]
"""The first target's grounding in every view, by way to associate: OFF, or a name of PAIRINGS."""


def episode(suite: str, task: str, number: int) -> EpisodeRow:
    """Episode `number` of a task's list. Raises: UnknownName."""
    if number < 0:
        raise UnknownName(
            f"inspection.episode: no episode {number} of {suite}/{task}; the first is 0."
        )
    n = number + 1 if suite in suites.WARM_UPS else None
    rows = suites.rows(suite, task, n=n)
    for row in rows:
        if row.episode == number:
            return row
    raise UnknownName(
        f"inspection.episode: no episode {number} of {suite}/{task}; "
        f"its list has {rows[0].episode} to {rows[-1].episode}."
    )


def grounding_table(
    grounding: Grounding, truth: Mapping[str, Mask] | None = None
) -> "pd.DataFrame":
    """One line per candidate: score, votes, whether it shared the most votes, and mean cosine.

    With ground truth also the object that the candidate's mask covers best, and its IoU; "-" below
    NAMED_IOU.
    """
    import pandas as pd

    columns = ["candidate", "score", "votes", "tied", "mean cosine", "winner"]
    if truth:
        columns += ["is", "iou"]
    ballot = grounding.ballot
    lines = []
    for i, mask in enumerate(grounding.masks):
        line: dict[str, object] = {
            "candidate": i,
            "score": float(grounding.candidates.score[i]),
            "votes": int(ballot.votes[i]),
            "tied": bool(ballot.tied[i]),
            "mean cosine": float(grounding.similarity[i].mean()),
            "winner": i == grounding.winner,
        }
        if truth:
            name, iou = _best_overlap(mask, truth)
            line["is"] = name if iou >= NAMED_IOU else "-"
            line["iou"] = iou
        lines.append(line)
    return pd.DataFrame(lines, columns=columns)


def associations(stack: Stack, mine: PersonalObject, views: Sequence[View]) -> Ways:
    """The views grounded one by one, and once with each pairing.

    The candidates are the same, the choices perhaps others. Pairings need the `optics` of all
    views.

    Raises: as `Attender.start`.
    """
    images = {view.camera: view.rgb for view in views}
    optics = {}
    for view in views:
        if view.optics is not None:
            optics[view.camera] = view.optics
    ways: dict[str, Pairing | None] = {OFF: None}
    if len(optics) == len(views):
        ways |= PAIRINGS
    found: dict[str, dict[str, Grounding]] = {}
    for name, way in ways.items():
        attender = Attender(stack, {mine.name: mine}, Prompting(associate=way))
        _, attended = attender.start(images, views[0].row.instruction, cameras=optics)
        found[name] = {}
        for camera, (first, *_) in attended.groundings.items():
            found[name][camera] = first
    return found


def association_table(ways: Ways, views: Sequence[View]) -> "pd.DataFrame":
    """One line per way: the object highlighted in each view ("-" where none is).

    And what the views show together (SPEC section 7).
    """
    import pandas as pd

    by_camera = {view.camera: view for view in views}
    target = views[0].row.target
    lines = []
    for way, groundings in ways.items():
        line = {"associate": way}
        distinct: dict[str, str | None] = {}
        for camera, grounding in groundings.items():
            name = _highlighted_object(by_camera[camera], grounding)
            line[camera] = name or "-"
            distinct[camera] = f"nothing in {camera}" if name == "nothing" else name
        line["together"] = compare_views(distinct, target)
        lines.append(line)
    return pd.DataFrame(lines).set_index("associate")


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
        trial = Trial(
            method="vap",
            scene=scene,
            policy=Expert(),
            prompter=TintPrompter(attender),
            control=suite.control,
            sensor=suite.sensor,
            occlusion=occlusion,
        )
        (ended,) = rollout(trial, [row], open_sink)
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
            iou = np.nan
            if shown:
                iou = 0.0 if track.mask is None else mask_iou(track.mask, true)
            lines.append(
                {
                    "step": frame.frame_index,
                    "camera": camera,
                    "shown": shown,
                    "visible": track.mask is not None,
                    "score": track.score,
                    "iou": iou,
                    "on": _most_covered(track.mask, masks),
                }
            )
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
        covered = [occlusion.covers(str(camera), int(step)) for step in part.step]
        before = part[part.step < occlusion.start]
        hidden = part[covered]
        after = part[(part.step >= occlusion.start + occlusion.frames) & part.shown]
        back = np.flatnonzero(after.iou > KEPT)
        lines.append(
            {
                "camera": camera,
                "IoU before": before.iou.mean(),
                "hidden frames": len(hidden),
                "said not visible": int((~hidden.visible).sum()),
                "back after": float(back[0]) if len(back) else np.nan,
                "IoU after": after.iou.mean(),
                "at the end on": part.on.iloc[-1] or "-",
            }
        )
    return pd.DataFrame(lines).set_index("camera")


def published(folder: Path, stack: str = "embedded") -> "dict[str, pd.DataFrame]":
    """The survey's tables that survey.run.publish keeps in `folder`. Raises: BadOutput."""

    prefix = "perception" if stack == "embedded" else f"perception_{stack}"
    paths = {}
    missing = []
    for name in TABLES:
        paths[name] = folder / f"{prefix}_{name}.parquet"
        if not paths[name].exists():
            missing.append(paths[name].name)
    if missing:
        raise BadOutput(
            f"inspection.published: {folder} lacks {', '.join(missing)}; "
            f"make them with measure perception --publish {folder}."
        )
    tables = {}
    for name, path in paths.items():
        tables[name] = read_parquet(path, "inspection", "publish it again")
    return tables


def contradicted(agreements: "pd.DataFrame") -> EpisodeRow | None:
    """The first surveyed episode whose views highlight different objects until associated.

    Grounded one by one they differ, and associated by geometry they do not. Where there is no such
    episode, the first whose views contradict each other; None where there is none of these.

    Raises: UnknownName for an episode that the list of today does not have.
    """
    key = ["suite", "task", "episode"]
    alone = agreements[(agreements.associate == OFF) & (agreements.case == "case 2")]
    right = (agreements.associate == "geometry") & (agreements.case == "right")
    remedied = alone.merge(agreements.loc[right, key], on=key)
    chosen = remedied if len(remedied) else alone
    if chosen.empty:
        return None
    suite, task, number = next(chosen[key].itertuples(index=False, name=None))
    return episode(suite, task, number)


def write_photo(folder: Path, row: EpisodeRow, camera: str, size: int = 448) -> tuple[Path, Path]:
    """Write a photo to inspect, and the reference photos of its target.

    The photo is `row`'s opening frame through one camera. Returns the path of the photo, and the
    folder of the reference photos. Raises: BadOutput.
    """
    from PIL import Image

    references = folder / "references"
    photo = folder / "photo.png"
    with writing(folder, "inspection.write_photo", "choose another folder"):
        write_views(get_object(row.target), references, replace=True)
        images = camera_images(row, size=size)
        Image.fromarray(images[camera]).save(photo)
    return photo, references


def choices_figure(ways: Ways, views: Sequence[View], shown: Sequence[str]) -> "Figure":
    """The candidates of every view, by these ways; the highlighted one is orange.

    Titles name the object under the highlighted candidate.
    """
    figure = empty_figure(3.3 * len(views), 3.5 * len(shown))
    grid = figure.subplots(len(shown), len(views), squeeze=False)
    for axes_row, way in zip(grid, shown, strict=True):
        for axes, view in zip(axes_row, views, strict=True):
            grounding = ways[way][view.camera]
            candidates(axes, view.rgb, grounding)
            name = _highlighted_object(view, grounding)
            if name is None:
                name = "none highlighted"
            axes.set_title(f"{view.camera}: {name}", fontsize=9)
            axes.set(xticks=[], yticks=[])
        axes_row[0].set_ylabel("one by one" if way == OFF else f"associated: {way}")
    return figure


def mask_figure(views: Sequence[View], groundings: Mapping[str, Grounding]) -> "Figure":
    """Close-ups of the winner's mask against the target's visible pixels.

    Where they agree the picture is unchanged; missed pixels are orange, wrong ones blue.
    """
    from matplotlib.patches import Patch

    figure = empty_figure(3.0 * len(views), 3.9)
    grid = figure.subplots(1, len(views), squeeze=False)[0]
    for axes, view in zip(grid, views, strict=True):
        _draw_mask(axes, view, groundings[view.camera].mask)
    figure.legend(
        handles=[Patch(color=WINNER, label="missed"), Patch(color=OTHER, label="too much")],
        loc="outside lower center",
        ncols=2,
        frameon=False,
    )
    return figure


def following_figure(track: "pd.DataFrame", hz: float) -> "Figure":
    """`track_table` over time, a panel per camera.

    IoU with the target, the tracker's score, and where it says "not visible"; grey where the camera
    does not show the target.
    """
    cameras = list(dict.fromkeys(track.camera))
    figure = empty_figure(8.5, 1.75 * len(cameras) + 0.6)
    grid = figure.subplots(len(cameras), 1, sharex=True, squeeze=False)[:, 0]
    legend: dict[str, Artist] = {}
    for axes, camera in zip(grid, cameras, strict=True):
        _draw_track(axes, track[track.camera == camera], hz)
        axes.set(ylabel=camera, ylim=(-0.03, 1.05), yticks=(0, 0.5, 1))
        axes.spines[["top", "right"]].set_visible(False)
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            legend[label] = handle
    grid[-1].set_xlabel("seconds from the opening frame")
    figure.legend(
        legend.values(),
        legend.keys(),
        loc="outside upper center",
        ncols=4,
        frameon=False,
        fontsize=9,
    )
    return figure


def _highlighted_object(view: View, grounding: Grounding) -> str | None:
    """The object under the winner's box, None without a winner."""
    if grounding.winner is None:
        return None
    return object_under_box(view, grounding.candidates.xyxy[grounding.winner])


def _best_overlap(mask: Mask, truth: Mapping[str, Mask]) -> tuple[str, float]:
    """The object whose mask has the highest IoU with `mask`, and the IoU."""
    best = ("", -1.0)
    for name, true in truth.items():
        iou = mask_iou(mask, true)
        if iou > best[1]:
            best = (name, iou)
    return best


def _most_covered(mask: Mask | None, masks: Mapping[str, Mask]) -> str:
    """The object of which `mask` covers the most pixels; "" without a mask, "nothing" for none."""
    if mask is None:
        return ""
    best = "nothing"
    most = 0
    for name, object_mask in masks.items():
        covered = int((mask & object_mask).sum())
        if covered > most:
            best = name
            most = covered
    return best


def _draw_mask(axes: "Axes", view: View, drawn: Mask | None) -> None:
    """One panel of `mask_figure`; `drawn` is None where nothing is highlighted."""
    from matplotlib.colors import to_rgb

    true = view.masks[view.row.target]
    mask = np.zeros_like(true) if drawn is None else drawn
    both = (true & mask)[..., None]
    picture = np.where(both, view.rgb, 110 + view.rgb // 3).astype(np.uint8)
    picture[true & ~mask] = np.uint8(255 * np.array(to_rgb(WINNER)))
    picture[mask & ~true] = np.uint8(255 * np.array(to_rgb(OTHER)))
    axes.imshow(picture, interpolation="nearest")
    box = mask_box(true | mask)
    if box is not None:
        size = np.array(true.shape[::-1])
        half = min(0.7 * float((box[2:] - box[:2]).max()), 0.5 * size.min())
        x, y = np.clip((box[:2] + box[2:]) / 2, half, size - half) - 0.5
        axes.set(xlim=(x - half, x + half), ylim=(y + half, y - half))
    text = "nothing highlighted" if drawn is None else f"IoU {mask_iou(mask, true):.2f}"
    axes.set(xticks=[], yticks=[], title=f"{view.camera}: {text}")


def _draw_track(axes: "Axes", part: "pd.DataFrame", hz: float) -> None:
    """The lines and marks of one camera in `following_figure`."""
    time = part.step.to_numpy() / hz
    missing = ~part.visible.to_numpy()
    for moment in time[~part.shown.to_numpy()]:
        axes.axvspan(
            moment - 0.5 / hz,
            moment + 0.5 / hz,
            color=GENERIC,
            alpha=0.3,
            linewidth=0,
            label="target not in this picture",
        )
    axes.plot(time, part.iou, color=OTHER, marker=".", label="IoU with the target")
    axes.plot(time, part.score, color=WINNER, linewidth=1, linestyle="--", label="tracker's score")
    axes.scatter(
        time[missing],
        part.score[missing],
        s=22,
        marker="x",
        color="black",
        zorder=3,
        label='it says "not visible"',
    )
