"""Whether the track finds the target again that was hidden (P tab:occlusion_sweep)."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from vap_core.evaluation.diagnosis.thresholds import THRESHOLDS
from vap_core.evaluation.statistics import rate_over_layouts
from vap_core.rollout.types import Episode, MaskCoverage
from vap_core.simulation.occluder import Occlusion

if TYPE_CHECKING:
    import pandas as pd

CALLS = 2
"""The track is kept if the prompt is on the target in one of so many prompted steps after it."""


def columns(episode: Episode, occlusion: Occlusion | None) -> dict[str, Any]:
    """What a results table keeps of an episode whose target was hidden; nothing of any other.

    `hidden_s` is for how long, `track_kept` whether the track found it again.
    """
    if occlusion is None or not episode.frames:
        return {}
    later = []
    for frame in episode.frames:
        if frame.frame_index >= occlusion.start + occlusion.frames:
            later.append(frame.coverage)
    return {
        "hidden_s": occlusion.frames / episode.header.hz,
        "track_kept": is_track_kept(later, episode.header.row.target),
    }


def is_track_kept(later: Sequence[Sequence[MaskCoverage]], target: str) -> bool | None:
    """Whether the prompt is on the target, in every view that shows it, soon after it was hidden.

    `later` are the steps after that. Soon is the first or second prompted step in which the target
    is visible; None where it never is, for the episode is over or the target out of view.
    """
    visible = []
    for coverage in later:
        showing = [view for view in coverage if view.pixels >= THRESHOLDS.pixels]
        if showing:
            visible.append(showing)
    if not visible:
        return None
    return any(all(view.object == target for view in views) for views in visible[:CALLS])


def hiding_lines(episodes: "pd.DataFrame") -> list[str]:
    """How often the track was kept, by suite and method; none where nothing was hidden.

    Its interval is over layouts where one returns, else Wilson's.
    """
    if "track_kept" not in episodes:
        return []
    lines = []
    hidden = episodes[episodes["track_kept"].notna()]
    for (suite, method), part in hidden.groupby(["suite", "method"], sort=False):
        kept = rate_over_layouts(part, "track_kept")
        seconds = float(part["hidden_s"].iloc[0])
        lines.append(f"{suite} {method}: hidden for {seconds:.1f} s, track kept in {kept}")
    return lines
