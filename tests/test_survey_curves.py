"""Measures and curves of a survey, on tables made by hand: what they count."""

import pandas as pd
import pytest

from vap_core.study import survey
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
                  for way, case, right in ((OFF, "case 2", 1), ("associated", "right", 2))]  # fmt: skip
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
    table = measures(tables())
    found = {line["measure"]: line for line in table.to_dict("records")}
    hard = found["right instance, hard"]
    assert list(table.columns[2:-1]) == ["simpler-bridge", "vlabench", "all"]
    assert (hard["all"].n, hard["all"].value) == (9, pytest.approx(4 / 9))
    assert (hard["all"].low, hard["all"].high) == (rate(4, 9).low, rate(4, 9).high)
    assert hard["verdict"] == "short: simpler-bridge, vlabench"
    assert found["right instance, standard"]["verdict"] == "not measured"
    assert found["mask IoU of the right instance"]["verdict"] == "met"
    assert found["track IoU, whole episodes"]["vlabench"].value == pytest.approx(0.75)
    assert found["target proposed"]["all"].n == 9
    assert found["false alarm, absent category"]["all"].n == 9
    assert found["detection recall@10, IoU .5"]["all"].n == 9 + 12


def test_the_report_tells_every_part() -> None:
    told = report(tables(), "toys")
    for part in (
        "stack toys",
        "vlabench 2 of 8, simpler-bridge 1 of 4",
        "K = 7, average",
        "vlabench side",
        "associated",
        "by the detector: 75.0",
    ):
        assert part in told
    times = {
        line.split("  ")[0]: line.split() for line in told.splitlines() if ", 5 rounds" in line
    }
    assert times["track step, 5 rounds"][-2:] == ["3.00", "short"]
    assert times["start-up grounding, 5 rounds"][-2:] == ["10.00", "met"]


def test_abstention_covers_more_and_more_and_never_a_view_without_candidates() -> None:
    curve = survey.abstention(tables()["choices"], "cosine_margin")
    assert curve.threshold.is_monotonic_decreasing
    assert curve.coverage.tolist() == pytest.approx([i / 9 for i in range(1, 9)])
    assert (curve.n.iloc[-1], curve.right.iloc[-1]) == (8, pytest.approx(4 / 8))
    assert len(survey.abstention(tables()["choices"], "margin")) == 3


def test_lookalike_pairs_match_a_look_alike_with_the_target_beside_it() -> None:
    found = survey.lookalike_pairs(tables()["objects"])
    assert len(found) == 9
    assert sorted(found.ahead.round(6).unique()) == [-0.1, 0.3]
    assert (found.ahead < 0).sum() == 1
