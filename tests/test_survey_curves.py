"""Curves of a survey, on tables made by hand: what they count, and that every figure draws what it was given."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from vap_core.base.pictures import write_png
from vap_core.study import charts
from vap_core.study.perception import KS, OFF, RULES
from vap_core.study.stats import rate
from vap_core.study.survey import measures, report

SUITES = {
    "vlabench": ("select-shoe", ("front", "side")),
    "simpler-bridge": ("pick-shaver", ("front",)),
}
KEYS = [
    {"suite": s, "task": task, "episode": i, "camera": camera}
    for s, (task, cameras) in SUITES.items()
    for i in range(4)
    for camera in cameras
]


def tables() -> dict[str, pd.DataFrame]:
    """Twelve views, of which those of episode 3 miss the target; in every other one the detector and the vote are right by turns."""
    views, objects, detections, choices, tracks = [], [], [], [], []
    for n, key in enumerate(KEYS):
        counts, good = key["episode"] < 3, n % 2 == 0
        known = good if counts else None
        views.append(
            {
                **key,
                "counts": counts,
                "proposed": known,
                "mask_iou_true_box": 0.9 if counts else None,
                "false_alarm": False,
            }
        )
        for role, tier, cosine in (
            ("target", "personal", 0.8),
            ("look-alike", "hard", 0.9 if n == 0 else 0.5),
        ):
            if counts or role != "target":
                line = {
                    "role": role,
                    "tier": tier,
                    "px": 200 + 10 * n,
                    "recalled": good,
                    "proposed": good,
                    "cosine": cosine,
                    "recalled_unseen": None,
                }
                objects.append({**key, "object": f"{role} {n}", **line})
        detections += [
            {**key, "asked": asked, "score": 0.9 - 0.01 * n, "hit": good}
            for asked in ("category", "unseen")
        ]
        tie = {
            "margin": (n % 3) / 5,
            "cosine_margin": 0.01 * n,
            "elected": "x" if n != 4 else "",
            "mask_iou": 0.9 if good else None,
        }
        if counts:
            choices += [
                {
                    **key,
                    "tier": "hard",
                    "k": k,
                    "rule": rule,
                    "right": good and n != 4,
                    "right_given_boxes": True,
                    **tie,
                }
                for k in KS
                for rule in RULES
            ]
        for hidden, kind in ((0, ""), (3, "plate")):
            over_time = [None, 1.0, 0.5]
            about = {
                "object": "a",
                "target": True,
                "hidden": hidden,
                "kind": kind,
                "kept": good,
                "mean_iou": 0.75,
                "iou_over_time": over_time,
            }
            tracks.append({**key, **about})
    agreements = [{"suite": "vlabench", "task": "t", "episode": 0, "associate": way, "case": case, "right": right, "views": 2}
                  for way, case, right in ((OFF, "case 2", 1), ("geometry", "right", 2))]  # fmt: skip
    took = {"start-up grounding": 200.0, "track step": 60.0, "pass": 20.0}
    speed = [
        {"what": what, "ms": ms, "low_ms": ms - 1, "high_ms": ms + 1, "rounds": 5}
        for what, ms in took.items()
    ]
    references = [{"suite": "vlabench", "task": "t", "target": "a", "k": 4, "whole": 1}]
    made = {
        "views": views,
        "objects": objects,
        "detections": detections,
        "choices": choices,
        "tracks": tracks,
    }
    return {
        name: pd.DataFrame(lines)
        for name, lines in {
            **made,
            "agreements": agreements,
            "speed": speed,
            "references": references,
        }.items()
    }


def test_measures_count_what_shows_the_target() -> None:
    found = {m.name: m for m in measures(tables())}
    hard = found["right instance, hard"]
    assert list(hard.cells) == ["simpler-bridge", "vlabench", "all"]
    assert (hard.cells["all"].n, hard.cells["all"].value) == (9, pytest.approx(4 / 9))
    assert (hard.cells["all"].low, hard.cells["all"].high) == (rate(4, 9).low, rate(4, 9).high)
    assert hard.verdict == "short: simpler-bridge, vlabench"
    assert found["right instance, standard"].verdict == "not measured"
    assert found["mask IoU of the right instance"].verdict == "met"
    assert found["track IoU, whole episodes"].cells["vlabench"].value == pytest.approx(0.75)
    assert found["target proposed"].cells["all"].n == 9
    assert found["false alarm, absent category"].cells["all"].n == 9
    assert found["detection recall@10, IoU .5"].cells["all"].n == 9 + 12


def test_the_report_tells_every_part() -> None:
    told = report(tables(), "toys")
    for part in (
        "stack toys",
        "simpler-bridge 1 of 4, vlabench 2 of 8",
        "K = 7, average",
        "vlabench side",
        "geometry",
        "by the detector: 75.0",
    ):
        assert part in told
    times = {
        line.split("  ")[0]: line.split() for line in told.splitlines() if ", 5 rounds" in line
    }
    assert times["track step, 5 rounds"][-2:] == ["3.00", "short"]
    assert times["start-up grounding, 5 rounds"][-2:] == ["10.00", "met"]


def test_abstention_covers_more_and_more_and_never_a_view_without_candidates() -> None:
    curve = charts.abstention(tables()["choices"], "cosine_margin")
    assert curve.threshold.is_monotonic_decreasing
    assert curve.coverage.tolist() == pytest.approx([i / 9 for i in range(1, 9)])
    assert (curve.n.iloc[-1], curve.right.iloc[-1]) == (8, pytest.approx(4 / 8))
    assert len(charts.abstention(tables()["choices"], "margin")) == 3


def test_lookalike_pairs_match_a_look_alike_with_the_target_beside_it() -> None:
    found = charts.lookalike_pairs(tables()["objects"])
    assert len(found) == 9
    assert sorted(found.ahead.round(6).unique()) == [-0.1, 0.3]
    assert (found.ahead < 0).sum() == 1


@pytest.mark.parametrize(
    ("draw", "table", "axes"),
    [(charts.abstention_figure, "choices", 1), (charts.hardness_figure, "objects", 2), (charts.references_figure, "choices", 3),
     (charts.time_figure, "tracks", 1), (charts.hidden_figure, "tracks", 1)],
)  # fmt: skip
def test_figures_draw(draw, table: str, axes: int, tmp_path: Path) -> None:
    figure = draw(tables()[table])
    assert len(figure.axes) == axes
    write_png(figure, tmp_path / "figure.png", dpi=40)
    assert (tmp_path / "figure.png").stat().st_size > 2000


def test_time_and_hidden_figures_show_the_numbers() -> None:
    lines = charts.time_figure(tables()["tracks"]).axes[0].lines
    assert [line.get_label() for line in lines[:2]] == [
        "simpler-bridge, 4 tracks",
        "vlabench, 8 tracks",
    ]
    assert lines[0].get_ydata()[1:].tolist() == [1.0, 0.5]
    assert np.isnan(lines[0].get_ydata()[0])
    lost = charts.hidden_figure(tables()["tracks"]).axes[0].containers[0].lines[0]
    assert lost.get_ydata().tolist() == [50.0, 50.0]
    tracks = tables()["tracks"]
    arm = tracks[tracks.hidden > 0].assign(kind="arm").iloc[:3]
    n = int(arm.target.sum())
    axes = charts.hidden_figure(pd.concat([tracks, arm], ignore_index=True)).axes[0]
    assert axes.get_legend_handles_labels()[1][1] == f"an arm moves in front (n = {n})"
