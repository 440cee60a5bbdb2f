"""What notebook 02 shows of one episode or one photo, as tables and figures, against simulator ground truth that the method never sees."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from vap_core.analysis.gallery import seen
from vap_core.analysis.plots import candidates
from vap_core.associate import PAIRINGS, Pairing, compare_views
from vap_core.attend import Attender, Prompting
from vap_core.base.errors import BadOutput, UnknownName
from vap_core.base.figures import GENERIC, OTHER, WINNER, empty_figure
from vap_core.base.types import Grounding, Mask, PersonalObject
from vap_core.evaluation.perception.episodes import OFF
from vap_core.evaluation.perception.first_frames import LEAST_PX, View, under
from vap_core.evaluation.perception.run import TABLES
from vap_core.evaluation.perception.tracking import KEPT
from vap_core.perception.boxes import mask_box, mask_iou
from vap_core.perception.protocols import Stack
from vap_core.policies.scripted.expert import Expert
from vap_core.rollout.loop import Trial, rollout
from vap_core.rollout.prompters.tint import TintPrompter
from vap_core.rollout.types import EpisodeHeader, Frame
from vap_core.simulation import suites
from vap_core.simulation.assets.objects import get_object
from vap_core.simulation.occluder import Occlusion
from vap_core.simulation.studio import write_views
from vap_core.simulation.suites.open_row import build_scene
from vap_core.simulation.types import EpisodeRow, Outcome

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.artist import Artist
    from matplotlib.figure import Figure

Ways = Mapping[str, Mapping[str, Grounding]]
"""By way to associate (survey.episodes.OFF, or a name of PAIRINGS): the first target's grounding in every view."""


def episode(suite: str, task: str, number: int) -> EpisodeRow:
    """Episode `number` of a task's list. Raises: UnknownName."""
    listed = suites.rows(suite, task, n=None if suite in suites.BENCHMARKS else number + 1)
    for row in listed:
        if row.episode == number:
            return row
    raise UnknownName(
        f"inspection.episode: no episode {number} of {suite}/{task}; its list has {listed[0].episode} to {listed[-1].episode}."
    )


def grounding_table(
    grounding: Grounding, truth: Mapping[str, Mask] | None = None
) -> "pd.DataFrame":
    """One line per candidate: score, votes, whether it shared the most, mean cosine; and with ground truth the object its mask covers best."""
    import pandas as pd

    lines, columns = (
        [],
        [
            "candidate",
            "score",
            "votes",
            "tied",
            "mean cosine",
            "winner",
            *(("is", "iou") if truth else ()),
        ],
    )
    for i, mask in enumerate(grounding.masks):
        line: dict[str, object] = {
            "candidate": i, "score": float(grounding.candidates.score[i]), "votes": int(grounding.ballot.votes[i]), "tied": bool(grounding.ballot.tied[i]),
            "mean cosine": float(grounding.similarity[i].mean()), "winner": i == grounding.winner,
        }  # fmt: skip
        if truth:
            overlaps = {name: mask_iou(mask, true) for name, true in truth.items()}
            best = max(overlaps, key=lambda name: overlaps[name])
            line |= {"is": best, "iou": overlaps[best]}
        lines.append(line)
    return pd.DataFrame(lines, columns=columns)


def associations(stack: Stack, mine: PersonalObject, views: Sequence[View]) -> Ways:
    """The views grounded one by one, and once with each pairing (geometry: if all have `optics`): the same candidates, perhaps other choices."""
    images = {view.camera: view.rgb for view in views}
    optics = {view.camera: view.optics for view in views if view.optics is not None}
    can = {
        name: pairing
        for name, pairing in PAIRINGS.items()
        if len(optics) == len(views) or "geometry" not in pairing.terms
    }
    ways: Mapping[str, Pairing | None] = {OFF: None, **can}
    found: dict[str, dict[str, Grounding]] = {}
    for name, pairing in ways.items():
        attender = Attender(stack, {mine.name: mine}, Prompting(associate=pairing))
        _, attended = attender.start(images, views[0].row.instruction, cameras=optics)
        found[name] = {camera: first for camera, (first, *_) in attended.groundings.items()}
    return found


def association_table(ways: Ways, views: Sequence[View]) -> "pd.DataFrame":
    """One line per way: the object highlighted in each view ("-" where none is), and what the views show together (SPEC section 7)."""
    import pandas as pd

    by_camera, target = {view.camera: view for view in views}, views[0].row.target
    lines = []
    for way, groundings in ways.items():
        shown = {
            camera: None if g.winner is None else under(by_camera[camera], g.candidates.xyxy[g.winner]) for camera, g in groundings.items()
        }  # fmt: skip
        distinct = {
            camera: f"nothing in {camera}" if what == "nothing" else what
            for camera, what in shown.items()
        }
        lines.append(
            {
                "associate": way,
                **{camera: what or "-" for camera, what in shown.items()},
                "together": compare_views(distinct, target),
            }
        )
    return pd.DataFrame(lines).set_index("associate")


def follow(
    attender: Attender, row: EpisodeRow, occlusion: Occlusion | None = None
) -> tuple[Frame, ...]:
    """Every frame of one episode of the expert, which reads the simulator and no prompt, watched by `attender`.

    Raises: RuntimeError when the episode broke off.
    """
    kept: list[Frame] = []

    class Watch:
        def frame(self, frame: Frame) -> None:
            kept.append(frame)

        def close(self, outcome: Outcome) -> None:
            pass

    def watch(opening: EpisodeHeader) -> Watch:
        return Watch()

    suite, models = suites.suite(row.suite), [place.model for place in row.placements]
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
        (ended,) = rollout(trial, [row], watch)
    if ended.outcome.status == "error":
        raise RuntimeError(
            f"follow: {row.key} broke off after {ended.outcome.steps} steps: {ended.outcome.detail}"
        )
    return tuple(kept)


def track_table(frames: Sequence[Frame], target: str) -> "pd.DataFrame":
    """One line per step and camera: the first target's track against ground truth.

    `shown`: whether the view shows as much of the target as the survey asks for; `iou` with it, nan where it does not; `visible`: what the
    tracker says, with its `score`; `on`: the object most of the track's mask lies on, "" where there is no mask.
    """
    import pandas as pd

    lines = []
    for frame in frames:
        for camera, (track, *_) in frame.tracks.items():
            masks = frame.truth.masks[camera]
            true, mask = masks[target], track.mask
            shown = bool(true.sum() >= LEAST_PX * true.size / 224**2)
            covered = (
                {}
                if mask is None
                else {name: int((mask & other).sum()) for name, other in masks.items()}
            )
            best = max(covered, key=lambda name: covered[name], default="")
            lines.append(
                {
                    "step": frame.frame_index, "camera": camera, "shown": shown, "visible": mask is not None, "score": track.score,
                    "iou": (0.0 if mask is None else mask_iou(mask, true)) if shown else np.nan,
                    "on": "" if mask is None else best if covered.get(best) else "nothing",
                }
            )  # fmt: skip
    return pd.DataFrame(lines)


def recovery(track: "pd.DataFrame", occlusion: Occlusion) -> "pd.DataFrame":
    """One line per camera of `track_table`: mean IoU before, whether the tracker noticed that the target was hidden, and what it holds after.

    `back after`: frames that show the target again until the track is on it (IoU above 0.5); nan when it never is.
    """
    import pandas as pd

    lines = []
    for camera, part in track.groupby("camera", sort=False):
        covered = [occlusion.covers(str(camera), int(step)) for step in part.step]
        before, hidden = part[part.step < occlusion.start], part[covered]
        after = part[(part.step >= occlusion.start + occlusion.frames) & part.shown]
        back = np.flatnonzero(after.iou > KEPT)
        lines.append(
            {
                "camera": camera, "IoU before": before.iou.mean(), "hidden frames": len(hidden), "said not visible": int((~hidden.visible).sum()),
                "back after": float(back[0]) if len(back) else np.nan, "IoU after": after.iou.mean(), "at the end on": part.on.iloc[-1] or "-",
            }
        )  # fmt: skip
    return pd.DataFrame(lines).set_index("camera")


def published(folder: Path, stack: str = "embedded") -> "dict[str, pd.DataFrame]":
    """The survey's tables that survey.run.publish keeps in `folder`. Raises: BadOutput."""
    import pandas as pd

    paths = {
        name: folder / f"perception{'' if stack == 'embedded' else f'_{stack}'}_{name}.parquet"
        for name in TABLES
    }
    missing = [path.name for path in paths.values() if not path.exists()]
    if missing:
        raise BadOutput(
            f"inspection.published: {folder} lacks {', '.join(missing)}; make them with eval-perception --publish {folder}."
        )
    return {name: pd.read_parquet(path) for name, path in paths.items()}


def contradicted(agreements: "pd.DataFrame") -> EpisodeRow | None:
    """The first surveyed episode whose views, grounded one by one, highlight different objects, and do not once geometry associates them.

    Where there is none, any whose views contradict each other; None where there is none of these.
    """
    key = ["suite", "task", "episode"]
    alone = agreements[(agreements.associate == OFF) & (agreements.case == "case 2")]
    mended = alone.merge(
        agreements.loc[(agreements.associate == "geometry") & (agreements.case == "right"), key],
        on=key,
    )
    for line in (mended if len(mended) else alone)[key].itertuples(index=False, name=None):
        return episode(*line)
    return None


def write_photo(folder: Path, row: EpisodeRow, camera: str, size: int = 448) -> tuple[Path, Path]:
    """A photo to inspect where there is none at hand: `row`'s opening frame through one camera, and the folder of its target's reference photos."""
    from PIL import Image

    references, photo = folder / "references", folder / "photo.png"
    try:
        write_views(get_object(row.target), references)
        Image.fromarray(seen(row, size=size)[camera]).save(photo)
    except OSError as error:
        raise BadOutput(
            f"inspection.write_photo: {folder} cannot be written ({error.strerror}); choose another folder."
        ) from error
    return photo, references


def choices_figure(ways: Ways, views: Sequence[View], shown: Sequence[str]) -> "Figure":
    """The candidates of every view, and in orange the one highlighted, by these ways; titles name the object under it."""
    figure = empty_figure(3.3 * len(views), 3.5 * len(shown))
    grid = figure.subplots(len(shown), len(views), squeeze=False)
    for line, way in zip(grid, shown, strict=True):
        for axes, view in zip(line, views, strict=True):
            g = ways[way][view.camera]
            candidates(axes, view.rgb, g)
            name = (
                "none highlighted" if g.winner is None else under(view, g.candidates.xyxy[g.winner])
            )
            axes.set_title(f"{view.camera}: {name}", fontsize=9)
            axes.set(xticks=[], yticks=[])
        line[0].set_ylabel("one by one" if way == OFF else f"associated: {way}")
    return figure


def mask_figure(views: Sequence[View], groundings: Mapping[str, Grounding]) -> "Figure":
    """Close-ups of the winner's mask against the target's visible pixels: agreed left as seen, missed orange, too much blue."""
    from matplotlib.colors import to_rgb
    from matplotlib.patches import Patch

    figure = empty_figure(3.0 * len(views), 3.9)
    for axes, view in zip(figure.subplots(1, len(views), squeeze=False)[0], views, strict=True):
        true, drawn = view.masks[view.row.target], groundings[view.camera].mask
        mask = np.zeros_like(true) if drawn is None else drawn
        box = mask_box(true | mask)
        picture = np.where((true & mask)[..., None], view.rgb, 110 + view.rgb // 3).astype(np.uint8)
        picture[true & ~mask], picture[mask & ~true] = (
            np.uint8(255 * np.array(to_rgb(colour))) for colour in (WINNER, OTHER)
        )
        axes.imshow(picture, interpolation="nearest")
        if box is not None:
            size = np.array(true.shape[::-1])
            half = min(0.7 * float((box[2:] - box[:2]).max()), 0.5 * size.min())
            x, y = np.clip((box[:2] + box[2:]) / 2, half, size - half) - 0.5
            axes.set(xlim=(x - half, x + half), ylim=(y + half, y - half))
        axes.set(
            xticks=[],
            yticks=[],
            title=f"{view.camera}: {'nothing highlighted' if drawn is None else f'IoU {mask_iou(mask, true):.2f}'}",
        )
    figure.legend(
        handles=[Patch(color=WINNER, label="missed"), Patch(color=OTHER, label="too much")],
        loc="outside lower center",
        ncols=2,
        frameon=False,
    )
    return figure


def following_figure(track: "pd.DataFrame", hz: float) -> "Figure":
    """`track_table` over time, a panel per camera: IoU with the target, the tracker's score, and where it says "not visible"; grey: not shown."""
    cameras = list(dict.fromkeys(track.camera))
    figure = empty_figure(8.5, 1.75 * len(cameras) + 0.6)
    grid = figure.subplots(len(cameras), 1, sharex=True, squeeze=False)[:, 0]
    key: dict[str, Artist] = {}
    for axes, camera in zip(grid, cameras, strict=True):
        part = track[track.camera == camera]
        time, missing = part.step.to_numpy() / hz, ~part.visible.to_numpy()
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
        axes.plot(
            time, part.score, color=WINNER, linewidth=1, linestyle="--", label="tracker's score"
        )
        axes.scatter(
            time[missing],
            part.score[missing],
            s=22,
            marker="x",
            color="black",
            zorder=3,
            label='it says "not visible"',
        )
        axes.set(ylabel=camera, ylim=(-0.03, 1.05), yticks=(0, 0.5, 1))
        axes.spines[["top", "right"]].set_visible(False)
        key |= {
            label: handle for handle, label in zip(*axes.get_legend_handles_labels(), strict=True)
        }
    grid[-1].set_xlabel("seconds from the opening frame")
    figure.legend(
        key.values(), key.keys(), loc="outside upper center", ncols=4, frameon=False, fontsize=9
    )
    return figure
