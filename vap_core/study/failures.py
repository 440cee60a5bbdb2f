"""From the table of a run to the frame that explains a failure, its recording and its picture.

failures = list_failures(Path("data/results/mini_pi0.parquet"), case=2, suite="vlabench")
print(failures_text(failures))
path = recording_of(failures, 0)
"""

import json
import os
import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, fields
from functools import cache
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vap_core.base.errors import BadOutput, BadRecording, BadStudy, an, one_of
from vap_core.base.files import (
    code_digest,
    code_version,
    rows_matching,
    take_name,
    write_atomic,
    writing,
)
from vap_core.rollout.types import CASES
from vap_core.simulation import suites
from vap_core.simulation.types import EpisodeRow
from vap_core.study import store
from vap_core.study.diagnosis import STAGES, explain
from vap_core.study.results import EXECUTED, read_runs, reads_simulator, scene_of
from vap_core.study.stats import rates
from vap_core.study.store import KEY, ROW_KEY
from vap_core.study.table import printed
from vap_core.study.trials import Study, make_trial, policy_today, register_personal

if TYPE_CHECKING:
    import pandas as pd

FILE = "corrections.csv"
NAMED = [*KEY, "policy"]
CORRECTED = ["case", "sub_case", "case_sentence"]


def parse_case(text: str) -> tuple[str, str]:
    """Case and sub-case of "case 3: slip". Raises: UnknownName."""
    case, _, sub_case = (part.strip() for part in text.partition(":"))
    if case not in CASES:
        raise one_of("correct: case", case, CASES)
    if sub_case not in CASES[case]:
        raise one_of(f"correct: sub-case of {case}", sub_case, CASES[case])
    return case, sub_case


def correct(folder: Path, row: Mapping[str, Any], text: str, note: str = "") -> Path:
    """Correct the case of a failure, in place of an earlier correction; returns the table.

    Raises: UnknownName for what is no case; BadStudy for an episode that did not fail; BadOutput.
    """
    import pandas as pd

    case, sub_case = parse_case(text)
    if row["outcome"] != "failure":
        raise BadStudy(f"correct: it ended in {row['outcome']}; only failures have a case.")
    new = {**{name: row[name] for name in NAMED}, "case": case, "sub_case": sub_case}
    new["case_sentence"] = note or f"corrected to {case}, {sub_case}"
    table = pd.concat([read(folder), pd.DataFrame([new])]).drop_duplicates(NAMED, keep="last")
    path = folder / FILE
    with writing(path, "correct", "copy the run to where you may write"):
        folder.mkdir(parents=True, exist_ok=True)
        write_atomic(path, printed(table, "csv").encode())
    return path


def read(folder: Path) -> "pd.DataFrame":
    """The corrections in a folder, the last of each episode. Raises: BadOutput."""
    import pandas as pd

    path = folder / FILE
    if not path.exists():
        return pd.DataFrame(columns=[*NAMED, *CORRECTED])
    try:
        table = pd.read_csv(path, keep_default_na=False)[[*NAMED, *CORRECTED]]
    except (OSError, ValueError, KeyError) as error:
        raise BadOutput(
            f"corrections: {path} is damaged ({error}); mend it, or delete it and correct again."
        ) from error
    return table


def with_corrections(table: "pd.DataFrame") -> "pd.DataFrame":
    """The failures of a table as corrected in their `folder`, marked in the column `corrected`."""
    table = table.assign(corrected=False)
    if "case" not in table or "policy" not in table:
        return table
    for folder, part in table[table["outcome"].eq("failure")].groupby("folder", sort=False):
        found = read(Path(str(folder))).set_index(NAMED)[CORRECTED]
        for index, name in zip(part.index, part[NAMED].itertuples(index=False), strict=True):
            if tuple(name) in found.index:
                table.loc[index, CORRECTED] = found.loc[[tuple(name)]].iloc[-1]
                table.loc[index, ["case_confidence", "corrected"]] = [1.0, True]
    return table


CHUNK = "vap_core"
"""The name of the text chunk in the PNG."""
NOT_DRAWN = {"__init__", "clips", "read", "stream"}
"""The modules of `vap_core.recording` that do not decide what a recording shows."""


def write_provenance(png: Path, study: Study) -> None:
    """Keep in a PNG what it shows: the study, with weights and world by digest, and the recorder.

    Raises: BadOutput for a file that is no PNG.
    """
    from PIL import Image
    from PIL.PngImagePlugin import PngInfo

    configuration = study.configuration()
    about = {
        "study": {
            field.name: configuration[field.name]
            for field in fields(Study)
            if field.name in configuration
        },
        "configuration": store.digest(configuration),
        "recorder": recorder_digest(),
        "code": code_version(),
    }
    info = PngInfo()
    info.add_text(CHUNK, json.dumps(about, sort_keys=True))
    try:
        with Image.open(png) as picture:
            picture.load()
            picture.save(png, "PNG", pnginfo=info, optimize=True)
    except OSError as error:
        raise BadOutput(
            f"write_provenance: {png} is no PNG ({error}); save the picture again."
        ) from error


@cache
def recorder_digest() -> str:
    """A digest of the code that decides what a recording shows, its colours and vote included.

    Comments, docstrings and line breaks do not count.
    """
    from vap_core import recording
    from vap_core.base import pictures

    drawn = Path(str(recording.__file__)).parent
    digests = [code_digest(drawn, without=NOT_DRAWN), code_digest(Path(str(pictures.__file__)))]
    return store.digest({"modules": digests})


BY = ["suite", "method"]
"""The columns that name a group of episodes here."""
SUBGOAL = "subgoal"
"""The column of the sub-goal that was diagnosed, counted from 1, where there are several."""
DIAGNOSIS_COLUMNS = ("case", "sub_case", "deciding_frame")
PLAYED = ["suite", "task", "episode", "seed", "method"]
"""The columns that name a recording."""
SUB_CASES = [f"{case}: {sub_case}" for case, named in CASES.items() for sub_case in named]
"""The columns of a breakdown that count sub-cases."""


def check_diagnosed(table: "pd.DataFrame") -> None:
    """Raises: BadOutput when the whole table is older than the diagnosis."""
    if not set(DIAGNOSIS_COLUMNS) <= set(table.columns):
        raise BadOutput(
            "diagnose: this run was made before failures were diagnosed; run the same eval again "
            "in another folder."
        )


def diagnosed(table: "pd.DataFrame") -> "pd.DataFrame":
    """The episodes whose failures were diagnosed.

    Raises: as `check_diagnosed`.
    """
    check_diagnosed(table)
    return table[table["case"].notna()].astype({"deciding_frame": int})


def older_text(n_more: int) -> str:
    """How many episodes are not shown, because no failure of their runs was diagnosed."""
    return f"{n_more} more of runs older than the diagnosis are left out"


def why_other(summary: Mapping[str, Any], row: Mapping[str, Any]) -> str:
    """Why a recording is not the whole one of an episode, as the rest of a sentence; "" where it
    is.

    `summary` is what the recording says of itself, nothing where it is damaged.
    """
    if not summary:
        return "is damaged"
    for name in (*PLAYED, "policy"):
        if summary.get(name) != row[name]:
            return f"is of {name} {summary.get(name)}, not {row[name]}"
    if "outcome" not in summary or "steps" not in summary:
        return "is unfinished"
    return ""


def breakdown(table: "pd.DataFrame") -> "pd.DataFrame":
    """One row per suite and method: how many episodes failed, by case and sub-case.

    `n` episodes, `failed`, a column of counts for each case (`case 1`, ...) and sub-case
    (`case 1: drift`, ...), and `mean_confidence`. The cases of a row sum to `failed`; errors are in
    `n` alone. Where there are sub-goals, `sub-goal 1`, ... count the failures by the first that
    failed. A method that ran with several policies on a suite has a row for each, and is named with
    it.

    Raises: BadOutput when the table is older than the diagnosis.
    """
    episodes = _by_policy(diagnosed(table))
    failed = episodes["outcome"].eq("failure")
    flags = {"failed": failed}
    for case, sub_cases in CASES.items():
        # Older versions gave some errors a case, too.
        flags[case] = failed & episodes["case"].eq(case)
        for sub_case in sub_cases:
            flags[f"{case}: {sub_case}"] = flags[case] & episodes["sub_case"].eq(sub_case)
    if SUBGOAL in episodes:
        for number in sorted({int(number) for number in episodes.loc[failed, SUBGOAL].dropna()}):
            flags[f"sub-goal {number}"] = failed & episodes[SUBGOAL].eq(number)
    flat = episodes[BY].assign(n=1, **{name: flag.astype(int) for name, flag in flags.items()})
    with_case = failed & episodes["case"].ne("")  # no failure: there may be no such column
    confidence = episodes.reindex(columns=["case_confidence"])["case_confidence"].where(with_case)
    counts = flat.groupby(BY, sort=False).sum()
    means = flat[BY].assign(mean_confidence=confidence).groupby(BY, sort=False).mean()
    return counts.join(means).reset_index()


def _by_policy(episodes: "pd.DataFrame") -> "pd.DataFrame":
    """The methods that ran with several policies on one suite named "METHOD, POLICY"."""
    if "policy" not in episodes:
        return episodes
    several = episodes.groupby(BY)["policy"].transform("nunique") > 1
    named = episodes["method"] + ", " + episodes["policy"]
    return episodes.assign(method=episodes["method"].mask(several, named))


def breakdown_table(counts: "pd.DataFrame") -> "pd.DataFrame":
    """`breakdown` to print, cases that never occurred left out.

    Failures in percent of all episodes, cases in percent of failures, each with its 95 % Wilson
    interval.
    """
    table = counts[[*BY, "n"]].copy()
    table["fail % [95 %]"] = rates(counts["failed"], counts["n"])
    cases = [case for case in CASES if counts[case].any()]
    for column in (*cases, *counts.columns[counts.columns.str.startswith("sub-goal ")]):
        table[f"{column} % of failures"] = rates(counts[column], counts["failed"])
    return table.assign(
        confidence=counts["mean_confidence"].map("{:.2f}".format).replace("nan", "-")
    )


def sub_cases_table(counts: "pd.DataFrame") -> "pd.DataFrame":
    """One row per sub-case that occurred, by case; a column of counts per suite and method."""
    flat = counts.set_index(BY)[SUB_CASES].T
    table = flat[flat.sum(axis=1) > 0]
    table.index = table.index.str.split(": ", n=1, expand=True).set_names(["case", "sub-case"])
    return table


def sub_cases_text(counts: "pd.DataFrame") -> str:
    """How often each sub-case occurred, most frequent first, one line per suite and method."""
    lines = []
    for line in counts.to_dict("records"):
        occurred = sorted(((int(line[name]), name) for name in SUB_CASES), reverse=True)
        text = ", ".join(f"{n} x {name}" for n, name in occurred if n)
        lines.append(f"{line['suite']} {line['method']}: {text or 'no failure'}")
    return "\n".join(lines)


def funnel_table(table: "pd.DataFrame") -> "pd.DataFrame":
    """One row per suite, method and stage: how many of `n` episodes are left after it.

    An episode counts up to the first stage that it does not pass; a method lacks the stages that it
    does not have. The last stage, SR, is every success, also one that failed an earlier stage.
    `bound` marks a method or policy that reads the simulator. Methods that ran with several
    policies are named as in `breakdown`.

    Raises: BadOutput when the table is older than the diagnosis.
    """
    import pandas as pd

    lines = []
    for (suite, method), part in _by_policy(diagnosed(table)).groupby(BY, sort=False):
        passing = part["outcome"].ne("error")
        bound = bool(len(reads_simulator(part)))
        for stage in STAGES:
            passed = part.get(f"stage_{stage}")
            if passed is not None and passed.notna().any():
                passing &= passed.eq(True)
                lines.append((suite, method, stage, len(part), int(passing.sum()), bound))
        succeeded = int(part["outcome"].eq("success").sum())
        lines.append((suite, method, "SR", len(part), succeeded, bound))
    found = pd.DataFrame(lines, columns=[*BY, "stage", "n", "left", "bound"])
    found["stage"] = pd.Categorical(found["stage"], [*STAGES, "SR"])
    return found.assign(value=found["left"] / found["n"])


COLUMNS = {
    "suite": "suite",
    "task": "task",
    "method": "method",
    "episode": "episode",
    "seed": "seed",
    "subgoal": "sub-goal",
    "case": "case",
    "sub_case": "sub_case",
    "deciding_frame": "frame",
    "case_confidence": "confidence",
    "case_sentence": "why",
}
"""The columns that `failures_text` shows, and their titles; the sub-goal where there are any."""
UNSAFE = r"[^\w.@-]|^\.+"
"""What is replaced in the name of a folder: characters of a policy's label, and dots before it."""
ARTIFACTS = Path("data/runs")
"""Below it are the recordings and corrections of published tables."""


@dataclass(frozen=True)
class Failures:
    """The failed episodes of runs (folders, or published tables) that were asked for.

    `manifests` are the runs' run.json by digest. `all_episodes` are all episodes of the runs,
    failed or not; `episodes` those of the suite, task and method asked for; `table` the failures
    among them that are left. Each table has the run's digest as `configuration`, its `source`, and
    as `folder` where the recordings and corrections of the row are. `notes` are sentences on what
    none of them has.
    """

    manifests: Mapping[str, dict[str, Any]]
    all_episodes: "pd.DataFrame"
    episodes: "pd.DataFrame"
    table: "pd.DataFrame"
    notes: tuple[str, ...] = ()


def list_failures(
    *sources: Path,
    suite: str | None = None,
    task: str | None = None,
    method: str | None = None,
    case: int | str | None = None,
    sub_case: str | None = None,
    where: str | None = None,
) -> Failures:
    """The failures in run folders or published tables, narrowed down.

    An episode that several sources hold is of the first of them that was diagnosed.

    `where` is a SQL condition on the table's columns.

    Raises: BadOutput when there is no such run, or it was never diagnosed; BadStudy for a name or a
        condition that fits nothing in it.
    """
    manifests, once = _read_once(sources)
    check_diagnosed(once)
    older = once[once["case"].isna()]  # episodes of runs that are older than the diagnosis
    all_episodes = with_corrections(_with_folders(diagnosed(once).reset_index(drop=True)))
    selected = all_episodes
    for column, wanted in (("suite", suite), ("task", task), ("method", method)):
        selected = _select(selected, column, wanted)
        older = older if wanted is None else older[older[column] == wanted]
    table = selected[selected["outcome"].eq("failure")]
    table = _select(table, "case", f"case {case}" if str(case).isdigit() else case)
    table = _select(table, "sub_case", sub_case)
    if where is not None:
        table = rows_matching(table, where)
    n_failures = int(older["outcome"].eq("failure").sum())
    notes = (f"{older_text(len(older))}; {n_failures} of them failed.",) if len(older) else ()
    return Failures(manifests, all_episodes, selected, table.reset_index(drop=True), notes)


def failures_text(failures: Failures, limit: int = 20) -> str:
    """How the failures divide, and the first of them, numbered as `recording_of` takes them."""
    counts = breakdown(failures.episodes)
    parts = [printed(breakdown_table(counts)), sub_cases_text(counts), *failures.notes]
    if failures.table.empty:
        return "\n\n".join([*parts, "no failure is left of what was asked for."])
    shown = failures.table.head(limit)
    if shown["corrected"].any():
        parts.append("* as corrected by hand")
    listing = _listing(shown)
    rest = len(failures.table) - len(shown)
    if rest:
        listing += (
            f"\nand {rest} more; --limit shows them, --case, --suite, --where narrow them down."
        )
    return "\n\n".join([*parts, listing])


def failure_row(failures: Failures, number: int) -> dict[str, Any]:
    """The row of one listed failure. Raises: BadStudy for a number that is not listed."""
    if not 0 <= number < len(failures.table):
        last = len(failures.table) - 1
        listed = "none is listed" if last < 0 else f"they are #0 to #{last}"
        raise BadStudy(f"diagnose: no failure #{number}; {listed}.")
    return failures.table.iloc[number].to_dict()


def deciding_frame(failures: Failures, number: int) -> int:
    """The control step that decides a listed failure; 0 where none does.

    Raises: BadStudy for a number that is not listed.
    """
    return max(0, int(failure_row(failures, number)["deciding_frame"]))


def _read_once(sources: Sequence[Path]) -> "tuple[dict[str, dict[str, Any]], pd.DataFrame]":
    """The manifests of all runs, by digest, and every episode once; a diagnosed one goes first.

    Raises: BadOutput.
    """
    import pandas as pd

    manifests, settings, tables = {}, {}, []
    for source in dict.fromkeys(sources):
        for manifest, episodes in read_runs(source):
            digest, study = manifest["digest"], manifest["configuration"]
            manifests[digest] = manifest
            # Episodes of other scenes or another perception stack are others.
            settings[digest] = f"{scene_of(study)}, {study.get('stack', '')}"
            if not episodes.empty:
                check_diagnosed(episodes)
                tables.append(episodes.assign(configuration=digest, source=str(source)))
    if not tables:
        raise BadOutput(
            f"diagnose: {' and '.join(map(str, sources))} hold no finished episode; run eval first."
        )
    whole = pd.concat(tables, ignore_index=True).sort_values("case", key=pd.isna, kind="stable")
    keys = whole[[name for name in (*KEY, "policy") if name in whole]]
    keys = keys.assign(setting=whole["configuration"].map(settings))
    return manifests, whole[~keys.duplicated()].reset_index(drop=True)


def _with_folders(table: "pd.DataFrame") -> "pd.DataFrame":
    """With the folder of each row's recordings and corrections.

    That is the run's; a published table has one for each of its runs and policies, in one folder
    for all tables of its file name.
    """
    named = table if "policy" in table else table.assign(policy="unnamed")
    folders = []
    for source, digest, policy in named[["source", "configuration", "policy"]].values:
        path = Path(source)
        if path.suffix == ".parquet":
            path = ARTIFACTS / f"{path.stem}-diagnosed"
            path = path / re.sub(UNSAFE, "-", str(digest)) / re.sub(UNSAFE, "-", str(policy))
        folders.append(str(path))
    return table.assign(folder=folders)


def _select(table: "pd.DataFrame", column: str, wanted: Any) -> "pd.DataFrame":
    """The rows that hold `wanted` in a column; all of them where it is None. Raises: BadStudy."""
    if wanted is None:
        return table
    known = sorted(set(table[column]))
    if wanted not in known:
        raise BadStudy(
            f"diagnose: no {column.replace('_', '-')} {wanted!r} here; there is "
            f"{', '.join(map(str, known)) or 'none'}."
        )
    return table[table[column] == wanted]


def _listing(shown: "pd.DataFrame") -> str:
    """A numbered line per failure; corrected ones have a star."""
    columns = [name for name in COLUMNS if name in shown and shown[name].notna().any()]
    listed = shown[columns].rename(columns=COLUMNS)
    if SUBGOAL in columns:
        listed[COLUMNS[SUBGOAL]] = listed[COLUMNS[SUBGOAL]].astype("Int64").astype(object)
    marks = [f"{i}*" if star else str(i) for i, star in enumerate(shown["corrected"])]
    listed.insert(0, "#", marks)
    if "confidence" in listed:
        listed["confidence"] = listed["confidence"].map("{:.2f}".format)
    return printed(listed)


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
    digests = failures.manifests.items()
    scenes = {digest: scene_of(manifest["configuration"]) for digest, manifest in digests}
    same = failures.all_episodes
    same = same[same["configuration"].map(scenes) == scenes[row["configuration"]]]
    for name in (*ROW_KEY, "policy"):
        same = same[same[name] == row[name]]
    others = sorted(set(same["method"]) - {method})
    other = same[same["method"] == method]
    if method == row["method"] or other.empty:
        flaw = "is that failure's own method"
        flaw = flaw if method == row["method"] else "did not run this episode here"
        raise BadStudy(f"diagnose: {method!r} {flaw}; there is {', '.join(others) or 'no other'}.")
    both = (row, other.iloc[0].to_dict())
    paths = {each["method"]: _recording_of_row(failures, each) for each in both}
    out = Path(row["folder"]) / "together" / f"{paths[row['method']].stem}-{method}.rrd"
    with writing(out.parent, "diagnose", "copy the run to where you may write"):
        out.unlink(missing_ok=True)
    combine_recordings(paths, out)
    return out


def recording_to_show(
    failures: Failures, number: int, against: str | None = None
) -> tuple[Path, int]:
    """The recording of a listed failure and the frame that decided it.

    `against` is another method on the same episode, to be shown next to it.

    Raises: as `side_by_side_recording`.
    """
    from vap_core.recording import read_summary

    together = None
    if against is not None:  # a wrong name is said before anything is run
        together = side_by_side_recording(failures, number, against)
    single = recording_of(failures, number)
    # An episode that was run again may end a little otherwise than the table says.
    frame = int(read_summary(single).get("deciding_frame", -1))
    return together or single, frame if frame >= 0 else deciding_frame(failures, number)


def save_screenshot(failures: Failures, number: int, png: Path, against: str | None = None) -> str:
    """Save the viewer's picture of a listed failure at its deciding frame; return why it failed.

    `against` is another method on the same episode, to be shown next to it. The PNG keeps what it
    shows (`stills`).

    Raises: as `side_by_side_recording`; MissingGL.
    """
    from vap_core.recording import screenshot
    from vap_core.recording.show import check_viewer

    check_viewer(window=False, picture=True)
    path, frame = recording_to_show(failures, number, against)
    screenshot(path, png, frame_index=frame, size=(1920, 1080))
    row = failure_row(failures, number)
    write_provenance(png, study_of(failures.manifests[row["configuration"]], row))
    return str(row["case_sentence"])


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
            note_changed("recorded", summary["outcome"], summary["steps"], row)
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
    note_changed("run again", episode.outcome.status, episode.outcome.steps, row)
    return path


def note_changed(how: str, status: str, steps: int, row: Mapping[str, Any]) -> None:
    """Print a line where an episode ended otherwise, `how` that is known, than its `row` says."""
    if (status, steps) != (row["outcome"], row["steps"]):
        print(
            f"note: {how}, it is {an(status)} after {steps} steps "
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


def study_of(manifest: Mapping[str, Any], row: Mapping[str, Any]) -> Study:
    """The study of a run, of one task and method alone; its policy as it is named here today.

    Nothing is executed that the manifest names.

    Raises: BadStudy when the suite's episode list has changed since; as `Study`, when something
        that the manifest names is not here today.
    """
    configuration, suite = manifest["configuration"], row["suite"]
    listed = configuration.get("lists", {}).get(suite)
    if listed is not None and suites.changed_lists({suite: listed}):
        raise BadStudy(
            f"diagnose: the list of {suite} has changed since this was run; use the version that "
            "ran it, or run eval again."
        )
    names = {field.name for field in fields(Study)} - {EXECUTED}
    settings = {name: value for name, value in configuration.items() if name in names}
    settings |= {"tasks": ((suite, row["task"]),), "methods": (row["method"],), "audit": False}
    settings["policy"] = policy_today(settings["policy"], str(row.get("policy", "")), suite)
    return Study(**settings)


def listed_row(study: Study, row: Mapping[str, Any]) -> EpisodeRow:
    """The row of a failure in the episode list of today. Raises: BadStudy."""
    for listed in study.rows(row["suite"], row["task"]):
        if (listed.episode, listed.seed) == (row["episode"], row["seed"]):
            return listed
    raise BadStudy(
        f"diagnose: episode {row['episode']} of {row['suite']}/{row['task']} is in today's list no "
        "more; run eval again."
    )
