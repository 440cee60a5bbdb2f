"""The survey as text: every measure with its target, per suite, with n and 95 % intervals; then by camera, by K and rule, and what it costs."""

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from vap_core.base.files import write_atomic
from vap_core.base.tables import align
from vap_core.base.types import value
from vap_core.evaluation.perception.estimates import NONE, Estimate, mean, precision, share
from vap_core.evaluation.perception.first_frames import KS, RULES, USUAL_K
from vap_core.evaluation.perception.speed import LIMITS_MS
from vap_core.simulation import suites

if TYPE_CHECKING:
    import pandas as pd

Survey = Mapping[str, "pd.DataFrame"]
ALL = "all"
HIDDEN = 3
NOTE = (
    f"value [95 % interval] n; K = {USUAL_K}, vote, unless said otherwise. Shares: Wilson over views (objects for recall, tracks for identity);"
    " IoU and AP50: bootstrap by episode.\nViews that show less of the target than 100 px of 224 x 224 do not count. 'hard': a look-alike of the"
    " target's own base and ink colours is in view."
)


@value
class Measure:
    """One figure per suite and over all of them, and the least it should be (None: it only explains the others)."""

    name: str
    target: float | None
    cells: Mapping[str, Estimate]

    @property
    def short(self) -> list[str]:
        """The suites whose value misses the target."""
        return [
            name
            for name, e in self.cells.items()
            if name != ALL and e.n and self.target is not None and e.value < self.target
        ]

    @property
    def verdict(self) -> str:
        if self.target is None:
            return ""
        if not any(e.n for e in self.cells.values()):
            return "not measured"
        return f"short: {', '.join(self.short)}" if self.short else "met"

    def row(self) -> list[str]:
        return [
            self.name,
            "" if self.target is None else f">= {100 * self.target:.0f}",
            *(e.told() for e in self.cells.values()),
            self.verdict,
        ]


def measures(tables: Survey) -> list[Measure]:
    """Every measure of perception by suite, in %."""
    views, seen, choices, tracks = (
        _counted(tables[name]) for name in ("views", "objects", "choices", "tracks")
    )
    names = [name for name in suites.BENCHMARKS if (views.suite == name).any()]

    def by_suite(
        name: str,
        target: float | None,
        table: "pd.DataFrame",
        figure: "Callable[[pd.DataFrame], Estimate]",
    ) -> Measure:
        parts = {suite: table[table.suite == suite] if len(table) else table for suite in names} | {
            ALL: table
        }
        return Measure(
            name,
            target,
            {suite: figure(part) if len(part) else NONE for suite, part in parts.items()},
        )

    def ap(asked: str) -> "Callable[[pd.DataFrame], Estimate]":
        found = tables["detections"]
        mine = found[found.asked == asked] if len(found) else found
        return lambda wanted: precision(
            mine[mine.suite.isin(wanted.suite.unique())] if len(mine) else mine, wanted
        )

    def of(column: str) -> "Callable[[pd.DataFrame], Estimate]":
        return lambda table: share(table[column])

    usual = choices[(choices.k == USUAL_K) & (choices.rule == "vote")]
    standard, hard = usual[usual.tier == "standard"], usual[usual.tier == "hard"]
    unseen = seen.dropna(subset=["recalled_unseen"])
    target = tracks[tracks.target] if len(tracks) else tracks
    free, after = (target[target.hidden == n] if len(target) else target for n in (0, HIDDEN))
    plate, arm = (after[after.kind == kind] if len(after) else after for kind in ("plate", "arm"))
    rest = tracks[~tracks.target & (tracks.hidden == 0)] if len(tracks) else tracks
    return [
        by_suite("detection recall@10, IoU .5", 0.97, seen, of("recalled")),
        by_suite("detection AP50", 0.85, seen, ap("category")),
        by_suite("right instance, standard", 0.97, standard, of("right")),
        by_suite("right instance, hard", 0.90, hard, of("right")),
        by_suite("mask IoU of the right instance", 0.88, usual, lambda t: mean(t, "mask_iou")),
        by_suite("identity kept, never hidden", 0.98, free, of("kept")),
        by_suite(f"identity kept, {HIDDEN} frames fully hidden", 0.95, plate, of("kept")),
        by_suite("track IoU, whole episodes", 0.80, free, lambda t: mean(t, "mean_iou")),
        by_suite("recall at the detector's own threshold", None, seen, of("proposed")),
        by_suite("target proposed", None, views, of("proposed")),
        by_suite("right given true boxes, standard", None, standard, of("right_given_boxes")),
        by_suite("right given true boxes, hard", None, hard, of("right_given_boxes")),
        by_suite("right where proposed, all", None, _where_proposed(usual, views), of("right")),
        by_suite("mask IoU from the true box", None, views, lambda t: mean(t, "mask_iou_true_box")),
        by_suite("recall@10, unseen phrase", None, unseen, of("recalled_unseen")),
        by_suite("AP50, unseen phrase", None, unseen, ap("unseen")),
        by_suite("false alarm, absent category", None, views, of("false_alarm")),
        by_suite("look-alikes: identity kept, never hidden", None, rest, of("kept")),
        by_suite("look-alikes: track IoU", None, rest, lambda t: mean(t, "mean_iou")),
        by_suite(f"identity kept, {HIDDEN} frames behind an arm", None, arm, of("kept")),
    ]


def report(tables: Survey, stack: str) -> str:
    """What the command prints."""
    found = measures(tables)
    head = ["measure, %", "target", *found[0].cells, "verdict"]
    views, references, names = (
        tables["views"],
        tables["references"],
        [name for name in found[0].cells if name != ALL],
    )
    unseen = ", ".join(
        f"{name} {int((~part.counts).sum())} of {len(part)}"
        for name in names
        for part in [views[views.suite == name]]
    )
    whole = share([i >= line.whole for line in references.itertuples() for i in range(line.k)])
    return "\n".join(
        [
            align([head, *(m.row() for m in found if m.target), [""] * len(head), *(m.row() for m in found if not m.target)]),
            "",
            f"stack {stack}. {NOTE}",
            f"Views without target, left out: {unseen}. Reference photos cut by the detector: {whole.told()}.",
            "",
            align([["right instance, %", *found[0].cells], *_by_k(tables["choices"], list(found[0].cells))]),
            "",
            *([align(_by_association(tables["agreements"])), ""] if len(tables["agreements"]) else []),
            align([["by camera, %", "views", "recall@10", "AP50", "right, standard", "right, hard", "mask IoU"], *_by_camera(tables)]),
            "",
            align(_speed(tables["speed"])),
        ]
    )  # fmt: skip


def summary(found: list[Measure]) -> list[dict[str, object]]:
    """The measures as JSON."""
    return [
        {"measure": m.name, "target": m.target, "verdict": m.verdict,
         "cells": {name: {"value": e.value, "low": e.low, "high": e.high, "n": e.n} if e.n else None for name, e in m.cells.items()}}
        for m in found
    ]  # fmt: skip


def _by_k(choices: "pd.DataFrame", cells: list[str]) -> list[list[str]]:
    rows = []
    for k in KS:
        for rule in RULES:
            part = choices[(choices.k == k) & (choices.rule == rule)]
            rows.append(
                [
                    f"K = {k}, {rule}",
                    *(
                        share((part if name == ALL else part[part.suite == name]).right).told()
                        for name in cells
                    ),
                ]
            )
    return rows


def _by_association(agreements: "pd.DataFrame") -> list[list[str]]:
    """Head and a line per suite and way to associate: what its episodes' views show together, and how many views show the target highlighted."""
    cases = ("right", "case 1", "case 2", "nothing")
    rows = [["views associated, % of episodes", "by", *cases, "% of views right"]]
    for (suite, way), part in agreements.groupby(["suite", "associate"], sort=False):
        views = share([i < line.right for line in part.itertuples() for i in range(line.views)])
        rows.append(
            [
                str(suite),
                str(way),
                *(share(part.case == name).told() for name in cases),
                views.told(),
            ]
        )
    return rows


def _by_camera(tables: Survey) -> list[list[str]]:
    rows = []
    for suite, camera in (
        tables["views"][["suite", "camera"]].drop_duplicates().itertuples(index=False, name=None)
    ):
        views, seen, found, choices = (
            _of(tables[name], suite, camera)
            for name in ("views", "objects", "detections", "choices")
        )
        usual = choices[(choices.k == USUAL_K) & (choices.rule == "vote")]
        right = [share(usual[usual.tier == tier].right).told() for tier in ("standard", "hard")]
        detected = [
            share(seen.recalled).told(),
            precision(found[found.asked == "category"], seen).told(),
        ]
        rows.append(
            [
                f"{suite} {camera}",
                str(int(views.counts.sum())),
                *detected,
                *right,
                mean(usual, "mask_iou").told(),
            ]
        )
    return rows


def _of(table: "pd.DataFrame", suite: str, camera: str) -> "pd.DataFrame":
    return table[(table.suite == suite) & (table.camera == camera)]


def _speed(speed: "pd.DataFrame") -> list[list[str]]:
    """Head and a line per piece of work, with its ratio to each that has no budget of its own."""
    ms = {str(line.what): float(line.ms) for line in speed.itertuples()}
    others = [name for name in ms if name not in LIMITS_MS]
    rows = [
        [
            "one thread, 224 px view",
            "ms (quartiles)",
            "budget",
            *(f"x {name}" for name in others),
            "verdict",
        ]
    ]
    for line in speed.itertuples():
        limit = LIMITS_MS.get(line.what)
        told = [
            f"{line.what}, {line.rounds} rounds",
            f"{line.ms:.1f} ({line.low_ms:.1f}, {line.high_ms:.1f})",
            f"<= {limit:g}" if limit else "",
        ]
        verdict = "" if limit is None else "met" if line.ms <= limit else "short"
        rows.append([*told, *(f"{line.ms / ms[name]:.2f}" for name in others), verdict])
    return rows


def _counted(table: "pd.DataFrame") -> "pd.DataFrame":
    """Lines of views that count: the others have no figure of the target."""
    return table[table.counts] if "counts" in table.columns else table


def _where_proposed(choices: "pd.DataFrame", views: "pd.DataFrame") -> "pd.DataFrame":
    key = ["suite", "task", "episode", "camera"]
    return choices.merge(views[[*key, "proposed"]], on=key).query("proposed == True")


def conclude(tables: Survey, stack: str, folder: Path) -> str:
    """Write `summary.json` into the run's folder, and return the text to print."""
    write_atomic(folder / "summary.json", json.dumps(summary(measures(tables)), indent=1).encode())
    return f"{report(tables, stack)}\n\nwrote {folder / 'summary.json'} and the tables beside it"
