"""Film strips of shared scenes: one episode as the policy saw it, sub-goal by sub-goal.

episode = run_episode("shared-sequence-bridge", "put-cameras", 0, bank=Path("data/runs/memory"))
steps_figure(episode, "front")
"""

from pathlib import Path
from typing import TYPE_CHECKING

from vap_core.analysis.plots import film
from vap_core.base.types import Rgb
from vap_core.rollout.loop import rollout
from vap_core.rollout.types import Episode, Frame
from vap_core.simulation import suites
from vap_core.study.trials import Study, make_trial, register_personal

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

PICTURES = 5


def run_episode(
    suite: str,
    task: str,
    number: int,
    *,
    bank: Path,
    method: str = "vap",
    policy: str = "mini-pi0",
) -> Episode:
    """One episode of a list with its pictures kept; the objects are remembered in `bank`.

    Raises: as `Study`, `register_personal` and `make_trial`.
    """
    study = Study(((suite, task),), (method,), policy=policy)
    register_personal(study, bank)
    rows = [row for row in suites.rows(suite, task, None) if row.episode == number]
    (episode,) = rollout(make_trial(study, rows, method, bank), rows, keep_images=True)
    return episode


def first_success(episodes: "pd.DataFrame", suite: str, policy: str) -> tuple[str, int]:
    """Task and number of VAP's first success in a list, in the list's order.

    The first episode stands for it where none succeeded.
    """
    found = episodes[
        (episodes["suite"] == suite)
        & (episodes["policy"] == policy)
        & (episodes["method"] == "vap")
    ]
    succeeded = found[found["success"].astype(bool)]
    line = (succeeded if len(succeeded) else found).iloc[0]
    return str(line["task"]), int(line["episode"])


def steps_figure(episode: Episode, camera: str) -> "Figure":
    """A row of prompted pictures for each sub-goal, from its first to its last."""
    row = episode.header.row
    rows: dict[str, list[Rgb]] = {}
    if not row.subgoals:
        rows[_label(row.instruction, episode.outcome.success)] = _pictures(episode.frames, camera)
    for stage in range(len(episode.subgoals)):
        part = episode.part(stage)
        label = _label(row.subgoals[stage].instruction, part.outcome.success)
        rows[f"{stage + 1}. {label}"] = _pictures(part.frames, camera)
    return film(rows, ["start", *[""] * (PICTURES - 2), "end"])


def _pictures(frames: tuple[Frame, ...], camera: str) -> list[Rgb]:
    """PICTURES of the frames that were prompted, evenly spread."""
    seen = [frame for frame in frames if camera in frame.prompted]
    found = []
    for i in range(PICTURES):
        found.append(seen[round(i * (len(seen) - 1) / (PICTURES - 1))].prompted[camera])
    return found


def _label(instruction: str, success: bool) -> str:
    words = instruction.split()
    middle = (len(words) + 1) // 2
    mark = "✓ success" if success else "✗ failure"
    return f"{' '.join(words[:middle])}\n{' '.join(words[middle:])}\n{mark}"
