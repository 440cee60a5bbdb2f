"""Opens listed failures: their recordings, pictures and corrections.

A failure that was not recorded is run again: the same row, weights and seed give the same episode.
"""

import os
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import fields, replace
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vap_core.base.errors import BadRecording, BadStudy
from vap_core.base.files import take_name, writing
from vap_core.evaluation.corrections import correct
from vap_core.evaluation.diagnosis import explain
from vap_core.evaluation.diagnosis.failures import (
    Failures,
    deciding_frame,
    failure_row,
)
from vap_core.evaluation.policy_names import policy_today
from vap_core.evaluation.publish import scene_of
from vap_core.evaluation.report.failures import why_other
from vap_core.evaluation.run_schema import EXECUTED
from vap_core.evaluation.stills import write_provenance
from vap_core.evaluation.store import ROW_KEY
from vap_core.evaluation.study import Study
from vap_core.evaluation.trials import make_trial, register_personal
from vap_core.simulation import suites
from vap_core.simulation.types import EpisodeRow, Outcome

if TYPE_CHECKING:
    import pandas as pd


def recording_of(failures: Failures, number: int) -> Path:
    """The recording of a listed failure; made by running the episode again where there is none.

    What has its name and is not that recording is renamed, and a line says so.

    Raises: BadStudy for a number that is not listed, or for an episode list or policy that has
        changed since; BadRecording for a recording without the right to read it; BadOutput.
    """
    return _recording_of_row(failures, failure_row(failures, number))


def side_by_side_recording(failures: Failures, number: int, method: str) -> Path:
    """One recording of a listed failure and of another method on the same episode.

    Raises: as `recording_of`; BadStudy for a method that did not run the episode, or that is the
        failure's own.
    """
    from vap_core.recording import combine_recordings

    row = failure_row(failures, number)
    same = _in_scene_of(row, failures)
    for name in (*ROW_KEY, "policy"):
        same = same[same[name] == row[name]]
    if method == row["method"]:
        others = sorted(set(same["method"]) - {method})
        raise BadStudy(
            f"diagnose: {method!r} is that failure's own method; "
            f"there is {', '.join(others) or 'no other'}."
        )
    other = same[same["method"] == method]
    if other.empty:
        raise BadStudy(
            f"diagnose: {method!r} did not run this episode here; there is "
            f"{', '.join(sorted(same['method']))}."
        )
    paths = {}
    for each in (row, other.iloc[0].to_dict()):
        paths[each["method"]] = _recording_of_row(failures, each)
    stem = paths[row["method"]].stem
    out = Path(row["folder"]) / "together" / f"{stem}-{method}.rrd"
    _unlink(out)
    combine_recordings(paths, out)
    return out


def _in_scene_of(row: Mapping[str, Any], failures: Failures) -> "pd.DataFrame":
    """The episodes of runs with the robots and the object of a row's."""
    scenes = {}
    for digest, manifest in failures.manifests.items():
        scenes[digest] = scene_of(manifest["configuration"])
    table = failures.all_episodes
    return table[table["configuration"].map(scenes) == scenes[row["configuration"]]]


def recording_to_show(
    failures: Failures, number: int, against: str | None = None
) -> tuple[Path, int]:
    """The recording of a listed failure and the frame that decided it.

    `against` is another method on the same episode, to be shown next to it.

    Raises: as `side_by_side_recording`.
    """
    together = None
    if against is not None:  # a wrong name is said before anything is run
        together = side_by_side_recording(failures, number, against)
    single = recording_of(failures, number)
    return together or single, _opening_frame(failures, number, single)


def save_screenshot(failures: Failures, number: int, png: Path, against: str | None = None) -> str:
    """Save the viewer's picture of a listed failure at its deciding frame; return why it failed.

    `against` is another method on the same episode, to be shown next to it. The PNG keeps what it
    shows (`stills`).

    Raises: as `side_by_side_recording`; MissingGL.
    """
    from vap_core.recording import screenshot

    path, frame = recording_to_show(failures, number, against)
    screenshot(path, png, frame_index=frame, size=(1920, 1080))
    row = failure_row(failures, number)
    write_provenance(png, study_of(failures.manifests[row["configuration"]], row))
    return str(row["case_sentence"])


def _opening_frame(failures: Failures, number: int, recording: Path) -> int:
    """The frame that decided a recorded failure.

    An episode that was run again may end a little otherwise than the table says: its own recording
    goes first.
    """
    from vap_core.recording import read_summary

    frame = int(read_summary(recording).get("deciding_frame", -1))
    return frame if frame >= 0 else deciding_frame(failures, number)


def correct_failure(failures: Failures, number: int, case: str, note: str = "") -> Path:
    """Correct the case of a listed failure, to "case 3: slip" for example; returns the table.

    Raises: BadStudy, UnknownName, BadOutput.
    """
    row = failure_row(failures, number)
    return correct(Path(row["folder"]), row, case, note)


def _recording_of_row(failures: Failures, row: Mapping[str, Any]) -> Path:
    from vap_core.recording import Recorder, recording_name
    from vap_core.rollout.loop import rollout

    study = study_of(failures.manifests[row["configuration"]], row)
    episode_row = listed_row(study, row)
    folder = Path(row["folder"])
    path = folder / "recordings" / recording_name(episode_row, row["method"])
    other = ""
    if os.path.lexists(path):
        summary = _summary(path)
        other = why_other(summary, row)
        if not other:
            _note_otherwise("recorded", summary["outcome"], summary["steps"], row)
            return path
    memory = folder / "memory"
    register_personal(study, memory)
    trial = make_trial(study, [episode_row], row["method"], memory)
    if trial.policy.label != row["policy"]:
        raise BadStudy(
            f"diagnose: this was run with {row['policy']}, and {trial.policy.label} is here now; "
            "run eval again."
        )
    if other:
        kept = _keep_beside(path)
        print(f"note: {path} {other}; it is kept as {kept.name}, and the episode is run again.")
    (episode,) = rollout(
        trial,
        [episode_row],
        lambda header: Recorder(path, header, explain=explain),
        batch=1,
    )
    note_changed(episode.outcome, row)
    return path


def note_changed(outcome: Outcome, row: Mapping[str, Any]) -> None:
    """Print a line where an episode that was run again ended otherwise than its `row` says."""
    _note_otherwise("run again", outcome.status, outcome.steps, row)


def _note_otherwise(how: str, status: str, steps: int, row: Mapping[str, Any]) -> None:
    if (status, steps) != (row["outcome"], row["steps"]):
        print(
            f"note: {how}, it is a {status} after {steps} steps "
            f"(was {row['outcome']} after {row['steps']})."
        )


def _summary(recording: Path) -> dict[str, Any]:
    """What a recording is of; nothing where it is damaged.

    Raises: BadRecording, where the rights to read it are missing.
    """
    from vap_core.recording import read_summary

    try:
        if recording.is_file():
            recording.open("rb").close()
    except OSError as error:
        raise BadRecording(
            f"diagnose: {recording} cannot be read ({error.strerror}); give yourself the right to "
            "read it, or move it away."
        ) from error
    with suppress(BadRecording):
        return read_summary(recording)
    return {}


def _keep_beside(path: Path) -> Path:
    """Give what has a recording's name a free one, which no command reads. Raises: BadOutput."""
    numbers = count(1)
    with writing(path.parent, "diagnose", "copy the run to where you may write"):
        while True:
            kept = path.with_name(f"{path.name}.replaced-{next(numbers)}")
            with suppress(FileExistsError):
                take_name(path, kept)
                return kept


def _unlink(path: Path) -> None:
    """Remove what is made again. Raises: BadOutput."""
    with writing(path.parent, "diagnose", "copy the run to where you may write"):
        path.unlink(missing_ok=True)


def study_of(manifest: Mapping[str, Any], row: Mapping[str, Any]) -> Study:
    """The study of a run, of one task and method alone; its policy as it is named here today.

    Nothing is executed that the manifest names.

    Raises: BadStudy when the suite's episode list has changed since; as `Study`, when something
        that the manifest names is not here today.
    """
    configuration = manifest["configuration"]
    suite = row["suite"]
    listed = configuration.get("lists", {}).get(suite)
    if listed is not None and suites.changed_lists({suite: listed}):
        raise BadStudy(
            f"diagnose: the list of {suite} has changed since this was run; use the version that "
            "ran it, or run eval again."
        )
    settings = {}
    for field in fields(Study):
        if field.name in configuration and field.name != EXECUTED:
            settings[field.name] = configuration[field.name]
    settings["tasks"] = ((suite, row["task"]),)
    settings["methods"] = (row["method"],)
    label = str(row.get("policy", ""))
    settings["policy"] = policy_today(settings["policy"], label, suite)
    return replace(Study(**settings), audit=False)


def listed_row(study: Study, row: Mapping[str, Any]) -> EpisodeRow:
    """The row of a failure in the episode list of today. Raises: BadStudy."""
    for listed in study.rows(row["suite"], row["task"]):
        if (listed.episode, listed.seed) == (row["episode"], row["seed"]):
            return listed
    raise BadStudy(
        f"diagnose: episode {row['episode']} of {row['suite']}/{row['task']} is in today's list no "
        "more; run eval again."
    )
