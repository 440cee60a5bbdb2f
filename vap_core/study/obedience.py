"""Does a policy obey a tint? The same episodes under true, wrong and no masks.

The test was chosen beforehand. `oracle-mask` is compared with `generic` on the same episodes, after
30, 60, 90, 120 and 150 of them: exact McNemar at .01 a look, which says "obeys" wrongly in at most
5 % of all studies (union bound over five looks). It stops as soon as that is shown, or as soon as
the 99 % interval of the difference ends below 10 points: then the policy does not obey by as much.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from html import escape
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np

from vap_core.base.errors import BadStudy, command
from vap_core.base.files import write_atomic, writing
from vap_core.study.measurement import Measurement, Row, Tables, measure
from vap_core.study.stats import Estimate, compare, mcnemar, points_text, rate
from vap_core.study.table import printed
from vap_core.study.trials import Study, make_trial, register_personal

if TYPE_CHECKING:
    import pandas as pd

    from vap_core.simulation.types import EpisodeRow

ARMS = {
    "generic": "nothing",
    "rewrite-only": "the words alone",
    "oracle-mask": "tint, half",
    "obeys-tint-0.3": "tint, .3",
    "obeys-tint-0.8": "tint, .8",
    "obeys-contour": "contour",
    "wrong-mask": "tint on a look-alike",
}
"""What every arm shows, with the true mask of t = 0 unless it says otherwise."""
WAVE, LOOKS = 30, 5
ALPHA = 0.05 / LOOKS
"""The level of every look."""
LEAST = 0.10
"""A policy that gains less than this by a tint does not obey it."""
Z99 = 2.576
FILMED = ("oracle-mask", "wrong-mask")
"""The arms of which the first episode is recorded."""
KEPT = (
    *("suite", "task", "split", "variant", "episode", "seed", "method", "policy", "outcome"),
    *("success", "wrong_object", "first_object_correct", "steps", "detail"),
)
"""The columns of an episode's row."""
type Verdict = Literal["obeys", "does not obey", "open"]


@dataclass(frozen=True)
class Job:
    """The rows of one task and variant under one arm, in one wave."""

    wave: int
    method: str
    rows: "tuple[EpisodeRow, ...]"

    @property
    def name(self) -> str:
        first = self.rows[0]
        variant = first.variant.replace("/", "-") or "any"
        return f"{self.wave}-{self.method}-{first.task}-{variant}"


@dataclass(frozen=True)
class Obedience(Measurement):
    """One policy on one suite that has ground truth; `waves` of WAVE episodes an arm.

    Raises: as `Study`; BadStudy where a policy reads the simulator.
    """

    suite: str
    policy: str
    stack: str = "embedded"
    seed: int = 0
    waves: int = 1
    caller: ClassVar[str] = "measure obedience"

    def study(self, *methods: str) -> Study:
        from vap_core.simulation import suites

        tasks = suites.tasks_of([self.suite], "")
        return Study(tasks, methods, policy=self.policy, stack=self.stack, seed=self.seed)

    def settings(self) -> dict[str, Any]:
        return {**self.study(*ARMS).configuration(), "wave": WAVE}

    def order(self) -> "list[EpisodeRow]":
        """All episodes of the suite, in an order that its seed decides."""
        study = self.study(*ARMS)
        rows = [row for task in study.tasks for row in study.rows(*task)]
        return [rows[i] for i in np.random.default_rng([11, self.seed]).permutation(len(rows))]

    def jobs(self) -> Sequence[Job]:
        found = []
        rows = self.order()
        for wave in range(self.waves):
            part = sorted(rows[wave * WAVE : (wave + 1) * WAVE], key=_scene)
            for method in ARMS:
                for _, of in groupby(part, key=_scene):
                    found.append(Job(wave, method, tuple(of)))
        return found

    def prepare(self, folder: Path) -> None:
        register_personal(self.study(*ARMS), folder / "memory")

    def run(self, job: Job, folder: Path) -> Tables:
        from vap_core.recording import Recorder, recording_name
        from vap_core.rollout.loop import rollout
        from vap_core.study.diagnosis import explain

        study = self.study(job.method)
        trial = make_trial(study, job.rows, job.method, folder / "memory")
        first = self.order()[0]
        rows: list[Row] = []
        for row in job.rows:
            path = folder / "recordings" / recording_name(row, job.method)
            sink = None
            if job.method in FILMED and row.key == first.key:
                path.unlink(missing_ok=True)

                def sink(header: Any, path: Path = path) -> Recorder:
                    return Recorder(path, header, explain=explain)

            (episode,) = rollout(trial, [row], sink)
            kept = episode.summary()
            rows.append({"wave": job.wave, **{name: kept[name] for name in KEPT}})
        return {"obedience": rows}


def _scene(row: "EpisodeRow") -> tuple[str, str]:
    return row.task, row.variant


def verdict(only_generic: int, only_tinted: int, n: int) -> Verdict:
    """What a look says, from the episodes in which only one of the two arms succeeds."""
    if mcnemar(only_generic, only_tinted) <= ALPHA and only_tinted > only_generic:
        return "obeys"
    # Agresti and Min's interval, with one pair more of each kind: none of 30 shows nothing yet.
    b, c, total = only_generic + 1, only_tinted + 1, n + 4
    gain = (c - b) / total
    half = Z99 * np.sqrt(b + c - (c - b) ** 2 / total) / total
    return "does not obey" if gain + half < LEAST else "open"


def look(table: "pd.DataFrame") -> Verdict:
    """The verdict on the episodes so far."""
    wide = table[table["method"].isin(["generic", "oracle-mask"])].pivot_table(
        index=["task", "episode"], columns="method", values="success", aggfunc="last"
    )
    plain, tinted = wide["generic"].astype(bool), wide["oracle-mask"].astype(bool)
    lost, won = int((plain & ~tinted).sum()), int((~plain & tinted).sum())
    return verdict(lost, won, len(wide))


def run(asked: Obedience, folder: Path, *, workers: int = 1) -> str:
    """Measure until a look stops it, write `obedience.html` beside the tables, and return the text.

    Raises: as `measure`; BadStudy where every episode of an arm is an error.
    """
    n_rows = len(asked.order())
    for waves in range(1, LOOKS + 1):
        table = measure(replace(asked, waves=waves), folder, workers=workers)["obedience"]
        errors = table["outcome"].eq("error")
        if errors.groupby(table["method"]).all().any():
            raise BadStudy(
                f"measure obedience: every episode of an arm is an error; the last: "
                f"{table[errors]['detail'].iloc[-1].strip().splitlines()[-1]}"
            )
        found = look(table)
        if found != "open" or waves * WAVE >= n_rows:
            break
    sentence = in_words(table, found)
    page = _page(table, sentence, folder)
    with writing(folder, "measure obedience"):
        write_atomic(folder / "obedience.html", page.encode())
    return f"{sentence}\n\n{printed(arms(table))}\n\nwrote {folder / 'obedience.html'}"


def arms(table: "pd.DataFrame") -> "pd.DataFrame":
    """A line an arm: its rates with 95 % intervals, and its difference from generic."""
    import pandas as pd

    lines = []
    for method, shown in ARMS.items():
        part = table[table["method"] == method]
        line: Row = {"arm": method, "shows": shown, "n": len(part)}
        line["errors"] = int(part["outcome"].eq("error").sum())
        line["success"] = str(_rate(table, method, "success"))
        line["wrong object"] = str(_rate(table, method, "wrong_object"))
        line["against generic, points"] = line["p"] = "-"
        if method != "generic":
            found = _against_generic(table, method)
            line["against generic, points"] = points_text(found)
            line["p"] = f"{found.p:.2g}"
        lines.append(line)
    return pd.DataFrame(lines)


def in_words(table: "pd.DataFrame", found: Verdict) -> str:
    """The answer in one sentence."""
    plain, tinted = (_rate(table, method, "success") for method in ("generic", "oracle-mask"))
    moved = _rate(table, "wrong-mask", "wrong_object")
    gain = points_text(_against_generic(table, "oracle-mask"))
    policy, suite = table["policy"].iloc[0], table["suite"].iloc[0]
    said = {
        "obeys": "obeys a tint",
        "does not obey": f"does not obey a tint by {100 * LEAST:.0f} points",
        "open": "may obey a tint, which so many episodes do not decide",
    }[found]
    return (
        f"{policy} {said} on {suite}: success {plain} without, {tinted} with the true mask ({gain} "
        f"points, n {plain.n}, 95 %); with a look-alike's mask it moves a wrong object in {moved}."
    )


def _rate(table: "pd.DataFrame", method: str, measure: str) -> Estimate:
    part = table[table["method"] == method]
    return rate(int(part[measure].sum()), len(part))


def _against_generic(table: "pd.DataFrame", method: str) -> "pd.Series":
    pair = table[table["method"].isin(["generic", method])]
    return compare(pair, ["generic", method], by_task=False).iloc[0]


def _page(table: "pd.DataFrame", sentence: str, folder: Path) -> str:
    from vap_core.study.report import STYLE

    recordings = sorted((folder / "recordings").glob("*.rrd"))
    opens = "".join(f"<li><code>{escape(command('view', path))}</code></li>" for path in recordings)
    errors = f"{ALPHA:g} a look, {LOOKS} looks of {WAVE} episodes"
    return "\n".join(
        [
            "<!doctype html><html lang='en'><head><meta charset='utf-8'><title>Obedience</title>",
            f"<style>{STYLE}</style></head><body><h1>Does it obey a tint?</h1>",
            f"<p><strong>{escape(sentence)}</strong></p>",
            printed(arms(table), "html"),
            f"<p>The test was chosen beforehand: exact McNemar, {errors}; it calls a policy "
            "obedient that is not in at most 5 % of studies. The other rows are not corrected for "
            "each other.</p>",
            f"<h2>Two recordings</h2><ul>{opens}</ul></body></html>\n",
        ]
    )
