"""The numbers of every control step of a run, and SQL over them.

`query(run, "select camera, min(track_score) from steps group by camera")`; `steps` has a row for
each step and camera with the columns of its episode, `episodes` a row for each episode.
"""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vap_core.base.errors import BadRecording, BadStudy, one_of
from vap_core.base.files import read_parquet, select
from vap_core.rollout.types import Episode, SubGoalSpan
from vap_core.study import store
from vap_core.study.cases import has_truth, trace_episode
from vap_core.study.failures import with_corrections

if TYPE_CHECKING:
    import pandas as pd

FOLDER = "steps"
QUESTIONS = {
    "narrow-vote": "margin < 0.05 and outcome = 'failure'",
    "lost-track": "track_score < 0.3",
    "wrong-cover": "covers <> '' and covers <> target",
    "near-miss": "gap_cm < 1 and lift_cm < 1 and outcome = 'failure'",
    "slip": "lift_cm > 2 and outcome = 'failure'",
}
"""Ready conditions, by name."""
MATCHES = """
select suite, task, method, seed, episode, outcome, "case", sub_case,
  count(distinct frame_index) as matching_steps,
  min(frame_index) as first_step, max(frame_index) as last_step
from steps where {} group by suite, task, method, seed, episode, outcome, "case", sub_case
order by suite, task, episode, seed, method
"""


def step_rows(episode: Episode) -> list[dict[str, Any]]:
    """A row for each step and camera.

    `margin` is that of the present sub-goal's vote, `covers` the object under the prompt, "" for
    none, `gap_cm` the gripper's distance from the target, `lift_cm` how far the target is lifted.
    """
    whole = {}
    if has_truth(episode) and episode.outcome.status != "error":
        trace = trace_episode(episode)
        hands = np.stack([trace.gap_m, trace.lift_m[trace.target]], axis=1)
        whole = dict(zip(trace.steps, hands, strict=True))
    rows = []
    spans = episode.subgoals or (SubGoalSpan(episode.header, 0),)
    for frame in episode.frames:
        header = [span.header for span in spans if span.first <= frame.frame_index][-1]
        covered = {view.camera: view for view in frame.coverage}
        gap_cm, lift_cm = 100 * whole.get(frame.frame_index, np.full(2, np.nan))
        for camera in [camera.name for camera in header.cameras] or [""]:
            ballots = [each.ballot for each in header.groundings.get(camera, ())[:1]]
            scores = [track.score for track in frame.tracks.get(camera, ())[:1]]
            view = covered.get(camera)
            rows.append(
                {
                    **dict(zip(store.KEY, episode.key, strict=True)),
                    "frame_index": frame.frame_index,
                    "camera": camera,
                    "target": header.row.target,
                    "margin": next((b.margin for b in ballots if b.winner is not None), np.nan),
                    "track_score": next(iter(scores), np.nan),
                    "covers": "" if view is None else view.object or "",
                    "cover_iou": np.nan if view is None else view.iou,
                    "gap_cm": gap_cm,
                    "lift_cm": lift_cm,
                }
            )
    return rows


def write(folder: Path, episodes: Sequence[Episode]) -> None:
    """Add the steps of some episodes to a run, as one part. Raises: BadOutput."""
    rows = [row for episode in episodes for row in step_rows(episode)]
    if rows:
        store.write_part(folder, FOLDER, rows, caller=FOLDER)


def read(run: Path) -> "tuple[pd.DataFrame, pd.DataFrame]":
    """The steps of a run, with the columns of their episode, and its episodes, as corrected.

    Of an episode that was tried again the steps are those of the last part that has it.

    Raises: BadRecording where there are no steps; BadOutput for a damaged part.
    """
    import pandas as pd

    parts = sorted((run / FOLDER).glob("*.parquet"), key=lambda path: path.stat().st_mtime)
    if not parts:
        raise BadRecording(
            f"query: {run} has no step rows; name the folder of an eval, rollout or demo, or "
            "run it again."
        )
    frames = [read_parquet(path, "query", "run the same command again") for path in parts]
    steps = pd.concat(frames, keys=range(len(frames)), names=["part"]).reset_index("part")
    steps = steps[steps["part"] == steps.groupby(store.KEY)["part"].transform("max")]
    episodes = with_corrections(store.read(run).assign(folder=str(run)))
    joined = steps.drop(columns="part").merge(episodes, on=store.KEY, suffixes=("", "_of_episode"))
    return joined, episodes


def query(run: Path, question: str) -> "pd.DataFrame":
    """What SQL finds in `steps` and `episodes`; of a condition, or a name of QUESTIONS, the
    episodes in which it holds, with their first and last such step.

    Raises: BadStudy for SQL that fits no table; as `read`.
    """
    steps, episodes = read(run)
    sql = question
    if re.fullmatch(r"[\w-]+", question) and question not in {"true", "false", *QUESTIONS, *steps}:
        raise one_of("query: question", question, QUESTIONS)
    if not question.lstrip().lower().startswith(("select", "with")):
        sql = MATCHES.format(QUESTIONS.get(question, question))
    return select({"steps": steps, "episodes": episodes}, sql, question)


def recording_at(run: Path, found: "pd.DataFrame", number: int) -> tuple[Path, int]:
    """The recording of one line that `query` found, and its first step. Raises: BadStudy."""
    from vap_core.recording import recording_file_name

    if not 0 <= number < len(found):
        raise BadStudy(f"query: no line #{number}; {len(found)} were found, counted from 0.")
    line = found.iloc[number].to_dict()
    if not line.keys() >= set(store.KEY):
        raise BadStudy(f"query: --open needs the columns {', '.join(store.KEY)}; select them, too.")
    name = recording_file_name(*(line[n] for n in ("suite", "task", "episode", "seed", "method")))
    return run / "recordings" / name, int(line.get("first_step", line.get("frame_index", 0)))
