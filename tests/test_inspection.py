"""What the inspector tells is exact: whom a track is on, what hiding did to it, what associated views show together, and which tables it reads."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from tests.toys import TOYS, personal, scene
from vap_core.attend import Attender
from vap_core.base import pictures
from vap_core.base.errors import BadOutput, UnknownName
from vap_core.base.types import Mask, Track
from vap_core.notebook import choice_sheet, mask_sheet
from vap_core.rollout.types import Frame
from vap_core.simulation.occluder import Occlusion
from vap_core.simulation.suites import BENCHMARKS, rows
from vap_core.simulation.types import EE_ACTION, Placement, Truth
from vap_core.study.inspection import (
    association_table,
    associations,
    contradicted,
    episode,
    follow,
    grounding_table,
    recovery,
    track_table,
)
from vap_core.study.perception import View
from vap_core.study.survey import TABLES, published

TEAL, GREY = (40, 120, 110), (90, 90, 90)
LINE = scene([(4, 20, GREY), (24, 20, TEAL)])
ROW = replace(
    rows("widowx-pick", "pick-straw-cup", 1)[0],
    instruction="bring my cup",
    category="cup",
    placements=(Placement("mug", 0.2, 0.0, 0.0), Placement("other", 0.2, 0.1, 0.0)),
)


def mask_of(colour: tuple[int, int, int], rgb: np.ndarray = LINE) -> Mask:
    return (rgb == colour).all(axis=2)


def view(camera: str, rgb: np.ndarray = LINE) -> View:
    return View(ROW, camera, rgb, {"mug": mask_of(TEAL, rgb), "other": mask_of(GREY, rgb)})


def frame(step: int, track: Track, masks: dict[str, Mask]) -> Frame:
    truth = Truth({}, {}, (), {}, {}, {"front": masks})
    state, action = np.zeros(14, np.float32), np.zeros(len(EE_ACTION), np.float32)
    return Frame(step, 0.2 * step, {}, {}, {"front": (track,)}, (), state, action, truth, ())


def squares(hidden: bool) -> dict[str, Mask]:
    """Half of each other, 100 of 10 000 pixels and more."""
    mug, other = np.zeros((100, 100), bool), np.zeros((100, 100), bool)
    mug[:20, :20], other[50:60, :20] = not hidden, True
    return {"mug": mug, "other": other}


def test_an_episode_is_found_by_its_number() -> None:
    assert episode("vlabench", "select-cup", 7).episode == 7
    assert episode("widowx-pick", "pick-straw-cup", 3).episode == 3
    assert episode("simpler-bridge-red", "put-camera", 3).episode == 3
    with pytest.raises(
        UnknownName, match="no episode 50 of vlabench/select-cup; its list has 0 to 49"
    ):
        episode("vlabench", "select-cup", 50)
    for suite, task in (("vlabench", "select-cup"), ("widowx-pick", "pick-straw-cup")):
        with pytest.raises(
            UnknownName, match=f"no episode -1 of {suite}/{task}; its list has 0 and up"
        ):
            episode(suite, task, -1)


def test_a_track_is_told_by_what_lies_under_it() -> None:
    seen, covered = squares(hidden=False), squares(hidden=True)
    half = seen["mug"].copy()
    half[:10] = False
    nowhere = np.zeros((100, 100), bool)
    nowhere[90:, 90:] = True
    tracks = [
        (Track(half, 0.9), seen),
        (Track(None, 0.7), covered),
        (Track(seen["other"], 0.6), seen),
        (Track(nowhere, 0.5), seen),
    ]
    table = track_table([frame(i, track, masks) for i, (track, masks) in enumerate(tracks)], "mug")
    assert table.on.tolist() == ["mug", "", "other", "nothing"]
    assert table.shown.tolist() == [True, False, True, True]
    assert table.visible.tolist() == [True, False, True, True]
    assert table.iou.fillna(-1).tolist() == [0.5, -1, 0, 0]
    assert table.score.tolist() == [0.9, 0.7, 0.6, 0.5]


def test_recovery_counts_the_frames_that_pass_before_the_track_is_back() -> None:
    seen, covered = squares(hidden=False), squares(hidden=True)
    right, gone, wrong = Track(seen["mug"], 1.0), Track(None, 0.5), Track(seen["other"], 0.5)
    story = [
        (right, seen),
        (right, seen),
        (gone, covered),
        (wrong, covered),
        (gone, seen),
        (wrong, seen),
        (right, seen),
    ]
    track = track_table([frame(i, found, masks) for i, (found, masks) in enumerate(story)], "mug")
    line = recovery(track, Occlusion(2, 2)).loc["front"]
    assert line.to_dict() == {
        "IoU before": 1.0, "hidden frames": 2, "said not visible": 1, "back after": 2.0, "IoU after": pytest.approx(1 / 3), "at the end on": "mug",
    }  # fmt: skip
    never = recovery(track[track.step < 6], Occlusion(2, 2)).loc["front"]
    assert np.isnan(never["back after"])
    assert never["at the end on"] == "other"


def test_associated_views_are_told_by_the_object_under_their_boxes() -> None:
    mine = personal("mug", "cup", TEAL)
    views = [
        view("front"),
        view("side", scene([(30, 8, TEAL), (4, 40, GREY)])),
        view("back", scene([(4, 40, GREY)])),
    ]
    ways = associations(TOYS, mine, views[:2])
    table = association_table(ways, views[:2])
    assert list(table.index) == ["off"]  # these views have no calibrated cameras
    assert (table[["front", "side"]] == "mug").all(axis=None)
    assert set(table.together) == {"right"}
    alone = {camera: first for view in views for camera, (first, *_) in _ground(view).items()}
    torn = association_table({"off": alone}, views).loc["off"]
    assert torn.to_dict() == {"front": "mug", "side": "mug", "back": "other", "together": "case 2"}
    blind = association_table(
        {"off": {"back": replace(alone["back"], winner=None)}}, views[2:]
    ).loc["off"]
    assert blind.to_dict() == {"back": "-", "together": "nothing"}
    assert len(choice_sheet({"off": alone}, views)["off"]) == 3


def _ground(one: View) -> dict[str, tuple]:
    _, attended = Attender(TOYS, {"mug": personal("mug", "cup", TEAL)}).start(
        {one.camera: one.rgb}, "bring my cup"
    )
    return dict(attended.groundings)


def test_a_mask_is_drawn_against_what_is_there() -> None:
    (grounding,) = _ground(view("front"))["front"]
    (drawn,) = mask_sheet([view("front")], {"front": grounding})
    assert drawn.title == "front: IoU 1.00"
    assert (drawn.picture == TEAL).all(axis=2).sum() == mask_of(TEAL).sum()
    other = View(ROW, "front", LINE, {"mug": mask_of(GREY), "other": mask_of(TEAL)})
    (wrong,) = mask_sheet([other], {"front": grounding})
    for colour in (pictures.LOOKALIKES[0], pictures.TARGET):
        assert (wrong.picture == pictures.rgb8(colour)).all(axis=2).any()


def test_a_photo_has_no_truth_and_an_empty_view_no_lines() -> None:
    (grounding,) = _ground(view("front"))["front"]
    assert list(grounding_table(grounding)) == [
        "candidate",
        "score",
        "votes",
        "tied",
        "mean cosine",
        "winner",
    ]
    (nothing,) = _ground(View(ROW, "front", np.zeros_like(LINE), {}))["front"]
    assert len(grounding_table(nothing, {"mug": mask_of(TEAL)})) == 0
    assert "iou" in grounding_table(nothing, {"mug": mask_of(TEAL)})


def test_following_hides_the_target_when_told() -> None:
    row = replace(rows("widowx-pick", "pick-straw-cup", 1)[0], max_steps=3)
    mine = personal(row.target, row.category, TEAL)
    frames = follow(Attender(TOYS, {row.target: mine}), row, Occlusion(1, 1))
    track = track_table(frames, row.target)
    assert [one.frame_index for one in frames] == [0, 1, 2, 3]
    assert track.shown.tolist() == [True, False, True, True]


def test_the_contradicted_episode_is_one_that_geometry_mends_if_there_is_any() -> None:
    def lines(number: int, off: str, geometry: str) -> list[dict[str, object]]:
        key = {"suite": "vlabench", "task": "select-cup", "episode": number}
        return [
            {**key, "associate": "off", "case": off},
            {**key, "associate": "associated", "case": geometry},
        ]

    never = pd.DataFrame(lines(0, "right", "right") + lines(1, "case 1", "case 2"))
    assert contradicted(never) is None
    kept = pd.DataFrame(lines(0, "right", "right") + lines(1, "case 2", "case 1"))
    mended = pd.DataFrame(
        lines(0, "right", "right") + lines(1, "case 2", "case 1") + lines(2, "case 2", "right")
    )
    assert [found.episode for found in (contradicted(kept), contradicted(mended)) if found] == [
        1,
        2,
    ]


def test_published_tables_are_all_there_or_named(tmp_path: Path) -> None:
    for name in TABLES[1:]:
        pd.DataFrame({"suite": list(BENCHMARKS)}).to_parquet(
            tmp_path / f"perception_{name}.parquet"
        )
    with pytest.raises(
        BadOutput,
        match=f"lacks perception_{TABLES[0]}.parquet; run the same measure perception .*--publish",
    ):
        published(tmp_path)
    pd.DataFrame({"suite": ["vlabench"]}).to_parquet(tmp_path / f"perception_{TABLES[0]}.parquet")
    assert list(published(tmp_path)) == list(TABLES)
