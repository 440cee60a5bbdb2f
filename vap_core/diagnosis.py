"""From the table of a run to the frame that explains a failure.

    failures = listed(Path("data/results/mini_pi0.parquet"), case=2, suite="vlabench")
    path = recording(failures, 0)

A failure that was not recorded is run again: the same row, weights and seed give the same episode.
"""

from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vap_core.condition import matching
from vap_core.errors import BadOutput, BadStudy
from vap_core.experiments import Study, make_trial, register_personal
from vap_core.publish import runs
from vap_core.report.failures import breakdown, breakdown_rows, diagnosed, sub_cases_text
from vap_core.report.text import align

if TYPE_CHECKING:
    import pandas as pd

COLUMNS = ("suite", "task", "method", "episode", "seed", "case", "sub_case", "deciding_frame", "case_confidence", "case_sentence")
SHORT = {"deciding_frame": "frame", "case_confidence": "sure", "case_sentence": "why"}


@dataclass(frozen=True)
class Failures:
    """The failed episodes of runs (folders, or published tables) that were asked for. `notes` are the runs' configurations by digest,
    `table` has their digests as `configuration`; `whole` are all episodes, failed or not, of the suites and methods asked for, `every` of all."""

    notes: dict[str, dict[str, Any]]
    every: "pd.DataFrame"
    whole: "pd.DataFrame"
    table: "pd.DataFrame"


def listed(
    *places: Path,
    suite: str | None = None,
    task: str | None = None,
    method: str | None = None,
    case: int | str | None = None,
    sub_case: str | None = None,
    where: str | None = None,
) -> Failures:
    """The failures in run folders or published tables, narrowed down; `where` is a SQL condition on the table's columns.

    Raises: BadOutput when there is no such run, or it was never diagnosed; BadStudy for a name or a condition that fits nothing in it.
    """
    import pandas as pd

    held = [(place, *run) for place in places for run in runs(place)]
    tables = [diagnosed(table.assign(configuration=about["digest"], place=str(place))) for place, about, table in held if not table.empty]
    if not tables:
        raise BadOutput(f"diagnose: {' and '.join(map(str, places))} hold no finished episode; run eval first.")
    whole = every = _corrected(pd.concat(tables, ignore_index=True))
    for name, wanted in (("suite", suite), ("task", task), ("method", method)):
        whole = _only(whole, name, wanted)
    table = whole[whole["outcome"].eq("failure")]
    table = _only(table, "case", f"case {case}" if str(case).isdigit() else case)
    table = _only(table, "sub_case", sub_case)
    if where is not None:
        table = matching(table, where)
    return Failures({about["digest"]: about for _, about, _ in held}, every, whole, table.reset_index(drop=True))


def _corrected(table: "pd.DataFrame") -> "pd.DataFrame":
    """With what researchers have corrected since, marked in `corrected`."""
    from vap_core.record import corrections, file_name

    table = table.assign(corrected=False)
    for place, part in table.groupby("place", sort=False):
        held = corrections(_home(Path(str(place))))
        for at, line in part[["suite", "task", "episode", "seed", "method"]].iterrows() if held else ():
            if (right := held.get(file_name(*line))) is not None:
                told = {"case": right.case, "sub_case": right.sub_case, "case_sentence": right.note, "case_confidence": 1.0, "corrected": True}
                table.loc[at, list(told)] = list(told.values())
    return table


def _home(place: Path) -> Path:
    """Where recordings and corrections of a run lie: in its folder, and for a published table in one of its own."""
    return Path("data/runs") / f"{place.stem}-diagnosed" if place.suffix == ".parquet" else place


def correct(failures: Failures, number: int, case: str, note: str = "") -> Path:
    """Say what a listed failure really is, "case 3: slip" for example; kept as a layer beside its recording. Raises: BadStudy, UnknownName."""
    from vap_core.record import Correction
    from vap_core.record import correct as keep

    name, _, part = case.partition(":")
    return keep(recording(failures, number), Correction(name.strip(), part.strip(), note), deciding_frame(failures, number))


def _only(table: "pd.DataFrame", column: str, wanted: Any) -> "pd.DataFrame":
    if wanted is None:
        return table
    known = sorted(set(table[column]))
    if wanted not in known:
        raise BadStudy(f"diagnose: no {column.replace('_', '-')} {wanted!r} here; there is {', '.join(map(str, known)) or 'none'}.")
    return table[table[column] == wanted]


def text(failures: Failures, limit: int = 20) -> str:
    """How the failures divide, and the first of them, numbered as `recording` takes them."""
    counts = breakdown(failures.whole)
    lines = [align(breakdown_rows(counts)), "", sub_cases_text(counts), ""]
    if failures.table.empty:
        return "\n".join([*lines, "no failure is left of what was asked for."])
    shown = failures.table.head(limit)
    head = ["#", *(SHORT.get(name, name) for name in COLUMNS)]
    marks = ["*" if corrected else "" for corrected in shown["corrected"]]
    rows = [
        [f"{i}{mark}", *(_cell(row[name]) for name in COLUMNS)] for i, (row, mark) in enumerate(zip(shown.to_dict("records"), marks, strict=True))
    ]
    lines += ["* as corrected by hand", ""] if any(marks) else []
    rest = len(failures.table) - len(shown)
    return "\n".join(
        [*lines, align([head, *rows]), *([f"and {rest} more; --limit shows them, --case, --suite, --where narrow them down."] if rest else [])]
    )


def _cell(cell: Any) -> str:
    return f"{cell:.2f}" if isinstance(cell, float) else str(cell)


def recording(failures: Failures, number: int) -> Path:
    """The recording of one listed failure; made now, by running the episode again, when there is none.

    Raises: BadStudy when there is no such number, or today's weights or lists are not those of the run.
    """
    return _recorded(failures, _line(failures, number))


def beside(failures: Failures, number: int, method: str) -> Path:
    """One recording of a listed failure and of another method on the same episode, on one time line. Raises: as `recording`."""
    from vap_core.record import together

    line = _line(failures, number)
    same = failures.every
    for name in ("suite", "task", "episode", "seed", "policy"):
        same = same[same[name] == line[name]]
    other = same[same["method"] == method]
    if other.empty:
        raise BadStudy(f"diagnose: {method!r} did not run this episode here; there is {', '.join(sorted(same['method']))}.")
    paths = {name: _recorded(failures, one) for name, one in ((line["method"], line), (method, dict(other.iloc[0].items())))}
    out = _home(Path(line["place"])) / "together" / paths[line["method"]].name.replace(".rrd", f"-{method}.rrd")
    out.unlink(missing_ok=True)
    together(paths, out)
    return out


def _recorded(failures: Failures, line: dict[str, Any]) -> Path:
    from vap_core.record import Recorder, read_summary, recording_name
    from vap_core.rollout import rollout

    study = _study(failures.notes[line["configuration"]], line)
    row = next((r for r in study.rows(line["suite"], line["task"]) if (r.episode, r.seed) == (line["episode"], line["seed"])), None)
    if row is None:
        raise BadStudy(f"diagnose: episode {line['episode']} of {line['suite']}/{line['task']} is in today's list no more; run eval again.")
    home = _home(Path(line["place"]))
    path = home / "recordings" / recording_name(row, line["method"])
    if path.exists() and read_summary(path)["rollout.policy"] == line["policy"]:
        return path
    memory = home / "memory"
    register_personal(study, memory)
    trial = make_trial(study, [row], line["method"], memory)
    if trial.policy.label != line["policy"]:
        raise BadStudy(f"diagnose: this was run with {line['policy']}, and {trial.policy.label} is here now; run eval again.")
    path.unlink(missing_ok=True)  # of the weights that a table was published with before
    (episode,) = rollout(trial, [row], lambda opening: Recorder(path, opening), batch=1)
    if (episode.outcome.status, episode.outcome.steps) != (line["outcome"], line["steps"]):
        print(f"note: run again, it is a {episode.outcome.status} after {episode.outcome.steps} steps (was {line['outcome']} after {line['steps']}).")
    return path


def still(failures: Failures, number: int, png: Path, against: str | None = None) -> str:
    """Picture a listed failure at its deciding frame as the viewer shows it, and say why it failed. Raises: as `recording`; MissingGL."""
    from vap_core.record import screenshot

    path = recording(failures, number) if against is None else beside(failures, number, against)
    screenshot(path, png, frame_index=deciding_frame(failures, number), size=(1920, 1080))
    return str(_line(failures, number)["case_sentence"])


def deciding_frame(failures: Failures, number: int) -> int:
    return max(0, int(_line(failures, number)["deciding_frame"]))


def _line(failures: Failures, number: int) -> dict[str, Any]:
    if not 0 <= number < len(failures.table):
        raise BadStudy(f"diagnose: no failure #{number}; there are {len(failures.table)}, counted from 0.")
    return {str(name): cell for name, cell in failures.table.iloc[number].items()}


def _study(about: dict[str, Any], line: dict[str, Any]) -> Study:
    """The study of a run, of one task and method alone."""
    held = about["configuration"]
    known = {field.name: held[field.name] for field in fields(Study) if field.name in held}
    study = Study(**{**known, "tasks": ((line["suite"], line["task"]),), "methods": (line["method"],)})
    return replace(study, audit=False)
