"""Recordings: what is in them, and that rerun's own tools accept them."""

import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.drawn import (
    ROW,
    SIDE,
    SUCCESS,
    K,
    columns,
    draw,
    entities,
    frame,
    opening,
    record,
    rerun,
)
from vap_core.base.pictures import result_line
from vap_core.base.types import Association, PersonalObject, Track
from vap_core.recording import Recorder, read_summary, record_grounding, recording_name
from vap_core.rollout.types import EpisodeHeader, Frame
from vap_core.study.diagnosis import explain


def test_rerun_loads_only_when_a_recording_is_asked_for() -> None:
    subprocess.run(
        [
            sys.executable,
            "-c",
            "import vap_core, vap_core.base.types, sys; assert 'rerun' not in sys.modules",
        ],
        check=True,
    )


def test_every_entity_has_its_promised_name(three: tuple[Path, EpisodeHeader, list[Frame]]) -> None:
    views = [
        f"/observation.images.{cam}{tail}"
        for cam in ("front", "side", "wrist")
        for tail in ("", "/prompted", "/candidates", "/mask/target", "/mask/gt")
    ]
    votes = [
        f"/vap/{part}/{cam}"
        for cam in ("front", "side", "wrist")
        for part in ("votes", "candidates", "vote_picture", "vote_margin", "track_score")
    ]
    plain = [
        "/observation.state",
        "/action",
        "/next.reward",
        "/next.success",
        "/vap/instruction",
        "/vap/verdict",
        "/vap/events",
    ]
    status = [
        "/__properties/rollout",
        "/__properties/outcome",
    ]
    world = [
        "/world/table",
        "/world/robot/link0",
        "/world/robot/link_finger1",
        "/world/objects/owl_a",
        "/world/objects/owl_c",
    ]
    assert {*views, *votes, *plain, *status, *world} <= entities(three[0])


def test_numbers_come_back_at_their_step(three: tuple[Path, EpisodeHeader, list[Frame]]) -> None:
    path, start, frames = three
    assert columns(path, "/vap/vote_margin/side", "Scalars:scalars") == {
        step: [0.6] for step in range(12)
    }
    assert columns(path, "/next.success", "Scalars:scalars") == {
        step: [float(step == 11)] for step in range(12)
    }
    assert columns(path, "/vap/votes/front", "counts") == {
        0: start.groundings["front"][0].ballot.votes.tolist()
    }
    similarity = columns(path, "/vap/candidates/front", "similarity")[0]
    np.testing.assert_allclose(
        np.reshape(similarity, (3, K)), start.groundings["front"][0].similarity
    )
    actions = columns(path, "/action", "Scalars:scalars")
    np.testing.assert_allclose(
        np.array([actions[step] for step in range(12)]), np.stack([f.action for f in frames])
    )
    lift = columns(path, "/world/objects/owl_b", "Transform3D:translation")[3]
    np.testing.assert_allclose(lift, [frames[3].truth.objects_world["owl_b"][:3]], atol=1e-6)


def test_pictures_and_masks_come_back_at_their_step(
    three: tuple[Path, EpisodeHeader, list[Frame]],
) -> None:
    path, _, frames = three
    for entity, views in (("", frames[7].images), ("/prompted", frames[7].prompted)):
        blob = columns(path, f"/observation.images.wrist{entity}", "EncodedImage:blob")[7]
        decoded = cv2.cvtColor(
            cv2.imdecode(np.frombuffer(bytes(blob[0]), np.uint8), cv2.IMREAD_COLOR),
            cv2.COLOR_BGR2RGB,
        )
        assert np.abs(decoded.astype(int) - views["wrist"]).mean() < 4
    for tail, mask in (
        ("target", frames[7].tracks["wrist"][0].mask),
        ("gt", frames[7].truth.masks["wrist"]["owl_a"]),
    ):
        buffer = columns(
            path, f"/observation.images.wrist/mask/{tail}", "SegmentationImage:buffer"
        )[7]
        np.testing.assert_array_equal(
            np.frombuffer(bytes(buffer[0]), np.uint8).reshape(SIDE, SIDE) > 0, mask
        )


def test_summary_tells_what_ran_and_how_it_ended(
    three: tuple[Path, EpisodeHeader, list[Frame]],
) -> None:
    summary = read_summary(three[0])
    expected = {
        "suite": "tabletop",
        "method": "vap",
        "seed": 7,
        "success": True,
        "steps": 12,
        "frames": 12,
    }
    assert {name: summary[name] for name in expected} == expected
    assert summary["git"]


def test_what_is_undefined_is_none_in_the_summary(tmp_path: Path) -> None:
    start = opening(1)
    with Recorder(tmp_path / "one.rrd", start, explain=explain) as recorder:
        recorder.frame(frame(0, start))
        recorder.close(replace(SUCCESS, cmr=None))
    assert read_summary(tmp_path / "one.rrd").get("cmr") is None, "a selection has none"


def test_a_recording_has_a_safe_name_of_its_own() -> None:
    assert recording_name(ROW, "vap") == "tabletop.pick-owl.003.s7.vap.rrd"
    assert recording_name(replace(ROW, task="/x y"), "a/b") == "tabletop.-x-y.003.s7.a-b.rrd"


@pytest.mark.parametrize(("cameras", "none"), [(3, ""), (2, "side"), (1, "front")])
def test_rerun_verifies_every_finished_recording(tmp_path: Path, cameras: int, none: str) -> None:
    path = tmp_path / "one.rrd"
    record(path, opening(cameras, none), lost=range(4, 7))
    done = rerun("rrd", "verify", path)
    assert done.returncode == 0, done.stderr
    assert [p.name for p in tmp_path.iterdir()] == ["one.rrd"]


def test_a_view_without_candidates_and_a_lost_track_are_results(tmp_path: Path) -> None:
    record(tmp_path / "one.rrd", opening(2, "side"), lost=range(4, 7))
    assert columns(tmp_path / "one.rrd", "/vap/votes/side", "counts") == {}
    assert columns(tmp_path / "one.rrd", "/vap/candidates/side", "winner") == {0: [-1]}
    assert columns(tmp_path / "one.rrd", "/vap/candidates/side", "winner") == {0: [-1]}
    buffers = columns(
        tmp_path / "one.rrd", "/observation.images.front/mask/target", "SegmentationImage:buffer"
    )
    assert [step for step, buffer in buffers.items() if not np.any(buffer)] == [4, 5, 6]


def test_what_the_views_agreed_on_can_be_read_back(tmp_path: Path) -> None:
    """The vote stays; beside it the choice, its scores, and a view without the target."""
    start = opening(2)
    front, side = (start.groundings[cam][0] for cam in ("front", "side"))
    support = {"front": np.array([0.5, 3.25, -1.0, 0.0]), "side": np.array([1.0, 2.0, -1.0, 3.25])}
    agreed = Association(
        {"front": 1, "side": None}, 3.25, 1.25, {"references": 2.0, "geometry": 1.25}, support
    )
    groundings = {
        "front": (replace(front, winner=1),),
        "side": (replace(side, winner=None),),
    }
    record(tmp_path / "one.rrd", replace(start, groundings=groundings, associations=(agreed, None)))
    for cam, winner in (("front", 1), ("side", -1)):
        read = {
            name: columns(tmp_path / "one.rrd", f"/vap/candidates/{cam}", name)
            for name in ("winner", "elected")
        }
        assert read == {"winner": {0: [winner]}, "elected": {0: [0]}}
    numbers = {
        name: columns(tmp_path / "one.rrd", "/vap/association", name)[0]
        for name in ("chosen", "total", "margin", "scores", "support_side")
    }
    assert numbers == {
        "chosen": [1, -1],
        "total": [3.25],
        "margin": [1.25],
        "scores": [2.0, 1.25],
        "support_side": [1.0, 2.0, -1.0, 3.25],
    }
    assert columns(tmp_path / "one.rrd", "/vap/association", "cameras")[0] == ["front", "side"]
    assert result_line(groundings["front"][0]).startswith(
        "#1 is chosen, against the vote for #0: votes 4 of 5, lead +0.12"
    )
    assert result_line(groundings["side"][0]).startswith(
        "none is chosen, against the vote for #0: votes 4 of 5, lead +0.12"
    )
    assert "/vap/votes/side/winner" not in entities(tmp_path / "one.rrd")
    assert rerun("rrd", "verify", tmp_path / "one.rrd").returncode == 0


def test_a_method_that_grounds_nothing_records_too(tmp_path: Path) -> None:
    start = replace(opening(1), method="generic", groundings={}, rewritten=ROW.instruction)
    with Recorder(tmp_path / "one.rrd", start, explain=explain) as recorder:
        recorder.frame(replace(frame(0, opening(1)), tracks={}))
        recorder.close(replace(SUCCESS, status="failure", success=False, steps=1))
    summary = read_summary(tmp_path / "one.rrd")
    assert (
        summary["case"],
        summary["sub_case"],
        summary["deciding_frame"],
    ) == ("unprompted", "timeout", 0)
    assert "/vap/vote_margin/front" not in entities(tmp_path / "one.rrd")


def test_a_view_without_candidates_has_no_margin(tmp_path: Path) -> None:
    """No vote was held there."""
    record(tmp_path / "one.rrd", opening(none="side"))
    for cam, steps in (("front", 12), ("side", 0), ("wrist", 12)):
        margins = columns(tmp_path / "one.rrd", f"/vap/vote_margin/{cam}", "Scalars:scalars")
        assert len(margins) == steps


def test_an_episode_that_fails_before_its_first_step_records_its_error(tmp_path: Path) -> None:
    with Recorder(tmp_path / "one.rrd", opening(1), explain=explain) as recorder:
        recorder.close(
            replace(SUCCESS, status="error", success=False, steps=0, detail="no grasp pose")
        )
    summary = read_summary(tmp_path / "one.rrd")
    assert (summary["frames"], summary["detail"]) == (0, "no grasp pose")
    assert rerun("rrd", "verify", tmp_path / "one.rrd").returncode == 0


def test_a_second_target_wears_a_suffix(tmp_path: Path) -> None:
    start = opening(1)
    second = replace(start.groundings["front"][0], object="owl_b", winner=1)
    start = replace(start, groundings={"front": (start.groundings["front"][0], second)})
    with Recorder(tmp_path / "one.rrd", start, explain=explain) as recorder:
        one = frame(0, start)
        recorder.frame(
            replace(
                one,
                tracks={
                    "front": (*one.tracks["front"], Track(one.truth.masks["front"]["owl_b"], 0.7))
                },
            )
        )
        recorder.close(SUCCESS)
    names = {
        "/vap/votes/front_1",
        "/observation.images.front/candidates_1",
        "/observation.images.front/mask/target_1",
        "/observation.images.front/mask/gt_1",
    }
    assert names <= entities(tmp_path / "one.rrd")


def test_equal_episodes_give_equal_recordings(tmp_path: Path) -> None:
    start = opening(2)
    for name in ("a", "b"):
        record(tmp_path / f"{name}.rrd", start)
        time.sleep(0.3)  # longer than rerun's usual batching tick
    record(tmp_path / "c.rrd", start, lost=range(3, 5))
    same = rerun("rrd", "compare", tmp_path / "a.rrd", tmp_path / "b.rrd")
    assert same.returncode == 0, same.stderr[-500:]
    assert rerun("rrd", "compare", tmp_path / "a.rrd", tmp_path / "c.rrd").returncode != 0


def test_a_grounding_alone_records(tmp_path: Path) -> None:
    start = opening(1)
    image, masks = draw(start.cameras[0], 0)
    z = np.eye(K, 16, dtype=np.float32)
    owl = PersonalObject(
        "owl_a", "owl", z, tuple(image[90:150, 60 + k : 120 + k].copy() for k in range(K)), "test"
    )
    record_grounding(
        tmp_path / "g.rrd",
        image,
        start.groundings["front"][0],
        owl,
        ROW.instruction,
        start.rewritten,
        frame(0, start).prompted["front"],
    )
    assert rerun("rrd", "verify", tmp_path / "g.rrd").returncode == 0
    assert {
        "/vap/vote_picture/front",
        "/observation.images.front/prompted",
        "/observation.images.front/mask/target",
    } <= entities(tmp_path / "g.rrd")
    assert masks


def test_a_later_sub_goal_has_votes_and_an_agreement_of_its_own(tmp_path: Path) -> None:
    def agreed(candidate: int) -> Association:
        return Association(
            chosen={"front": candidate},
            support={"front": np.ones(3)},
            total=1.0,
            margin=0.5,
            terms={"geometry": 1.0},
        )

    first = replace(opening(1), associations=(agreed(0),))
    second = replace(opening(1, none="front"), associations=(agreed(2),))
    path = tmp_path / "one.rrd"
    with Recorder(path, first) as recorder:
        recorder.frame(frame(0, first))
        recorder.begin_subgoal(second)
        recorder.frame(frame(1, second))
        recorder.close(replace(SUCCESS, steps=2))
    entity = "/observation.images.front/candidates"
    boxes = columns(path, entity, "Boxes2D:centers")
    assert {step: len(cells) for step, cells in boxes.items()} == {0: 3, 1: 0}
    labels = columns(path, f"{entity}/labels", "Points2D:positions")
    assert labels[0]
    assert not labels[1]
    chosen = columns(path, "/vap/association", "chosen")
    assert chosen == {0: [0], 1: [2]}
