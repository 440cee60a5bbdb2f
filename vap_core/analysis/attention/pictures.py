"""An episode as the paper prints it: the reference photos, then frames with the heat map over them.

The frames are the policy's calls at equal distances, in the view with the highest peak. The target
is outlined in white, its look-alikes in cyan; the caption says where the peak is.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from vap_core.analysis.attention.measures import (
    LOOKALIKES,
    TARGET,
    kind_of,
    measure,
    patch_areas,
)
from vap_core.analysis.attention.replay import check_policy
from vap_core.analysis.plots import Tile, sheet
from vap_core.base.pictures import RIGHT_MARK, WRONG_MARK
from vap_core.base.types import Mask, Rgb
from vap_core.policies.protocol import heat_map
from vap_core.recording.entities.pictures import attention_overlay
from vap_core.rollout.calls import QUERIES
from vap_core.rollout.loop import rollout
from vap_core.rollout.types import Episode, EpisodeHeader, Frame
from vap_core.simulation.assets.objects import get_object
from vap_core.simulation.studio import reference_views
from vap_core.simulation.types import Outcome
from vap_core.study.engine import spread_evenly
from vap_core.study.failures import listed_row, note_changed, study_of
from vap_core.study.trials import make_trial, register_personal

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from vap_core.recording import Recorder

OUTLINES = {TARGET: (255, 255, 255), LOOKALIKES: (0, 230, 230)}
REFERENCES = 2
FRAMES = 6


class Calls:
    """A sink that keeps the steps in which the policy was called; it may record as well."""

    def __init__(self, recorder: "Recorder | None") -> None:
        self.frames: list[Frame] = []
        self._recorder = recorder

    def frame(self, frame: Frame) -> None:
        if frame.attention:
            self.frames.append(frame)
        if self._recorder is not None:
            self._recorder.frame(frame)

    def close(self, outcome: Outcome) -> None:
        if self._recorder is not None:
            self._recorder.close(outcome)


def run_again(
    manifest: Mapping[str, Any],
    line: Mapping[str, Any],
    memory: Path,
    recording: Path | None = None,
) -> tuple[Episode, list[Frame]]:
    """An episode of a run with the attention observed: the episode, and the frames of its calls.

    `line` is its row there. It is recorded in `recording` if one is given. Another ending than that
    of the run is noted.

    Raises: BadStudy, as `check_policy`.
    """
    from vap_core.recording import Recorder
    from vap_core.study.diagnosis import explain

    study = study_of(manifest, line)
    row = listed_row(study, line)
    register_personal(study, memory)
    trial = make_trial(study, [row], str(line["method"]), memory)
    check_policy(trial.policy, str(line["policy"]))
    sinks = []

    def observe(header: EpisodeHeader) -> Calls:
        recorder = None
        if recording is not None:
            recording.unlink(missing_ok=True)
            recorder = Recorder(recording, header, explain=explain)
        sinks.append(Calls(recorder))
        return sinks[-1]

    (episode,) = rollout(replace(trial, attention=QUERIES), [row], observe, batch=1)
    note_changed(episode.outcome, line)
    return episode, sinks[0].frames


def strip(episode: Episode, frames: Sequence[Frame], query: str) -> list[Tile]:
    """The tiles of one row: references, and FRAMES calls with the map of a query.

    Raises: UnknownName, BadObject, as `get_object`.
    """
    header = episode.header
    tiles = []
    for photo in reference_views(get_object(header.row.target))[:REFERENCES]:
        tiles.append(Tile(_square(photo), "reference"))
    for frame in spread_evenly(list(frames), FRAMES):
        camera = max(frame.attention, key=lambda name: _peak(frame, name, query))
        heat = heat_map(frame.attention[camera][query], query)
        areas = patch_areas(header.row, frame.truth, camera, heat.shape[0])
        found = measure(heat, areas)
        region = TARGET if found["hit"] else str(found["peak_region"])
        view = f"{camera} " if len(frame.attention) > 1 else ""
        picture = attention_overlay(frame.prompted[camera], heat).copy()
        for name, mask in frame.truth.masks[camera].items():
            colour = OUTLINES.get(kind_of(name, header.row))
            if colour is not None:
                _outline(picture, mask, colour)
        tiles.append(Tile(picture, f"{view}{frame.timestamp_s:.1f} s: {region}"))
    mark, word = (RIGHT_MARK, "success") if episode.outcome.success else (WRONG_MARK, "failure")
    tiles[-1] = replace(tiles[-1], title=f"{tiles[-1].title}\n{mark} {word}")
    return tiles


def examples_figure(rows: Mapping[str, Sequence[Tile]]) -> "Figure":
    """One row of tiles per pattern; its last one says how the episode ended."""
    return sheet(rows, side_in=1.25, label_in=1.35)


def _peak(frame: Frame, camera: str, query: str) -> float:
    return float(heat_map(frame.attention[camera][query], query).max())


def _outline(picture: Rgb, mask: Mask, colour: tuple[int, int, int]) -> None:
    shape = mask.astype(np.uint8)
    contours, _ = cv2.findContours(shape, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(picture, contours, -1, colour, 1)


def _square(rgb: Rgb) -> Rgb:
    """The middle square of a photo."""
    side = min(rgb.shape[:2])
    top = (rgb.shape[0] - side) // 2
    left = (rgb.shape[1] - side) // 2
    return rgb[top : top + side, left : left + side]
