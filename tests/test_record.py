"""Recordings: what is in them, how large they are, how they survive, and that rerun's own tools accept them."""

import math
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rerun.chunk import RrdReader

from vap_core.errors import BadOutput, BadRecording, MissingGL
from vap_core.record import Recorder, read_summary, record_grounding, recording_name, recover, screenshot
from vap_core.record.blueprint import evidence_line
from vap_core.record.evidence import apart, classes, jpeg, label_spots
from vap_core.record.file import rerun_cli, temporary
from vap_core.values import (
    ROBOT,
    Association,
    Boxes,
    Camera,
    EpisodeRow,
    Event,
    Frame,
    Grounding,
    Mask,
    Opening,
    Outcome,
    PersonalObject,
    Placement,
    Rgb,
    Track,
    Truth,
)  # fmt: skip

SIDE, K = 224, 5
SIZES = {"owl_a": (0.07, 0.07, 0.11), "owl_b": (0.07, 0.07, 0.10), "owl_c": (0.06, 0.08, 0.11)}
PAINT = {"owl_a": (150, 95, 60), "owl_b": (165, 110, 70), "owl_c": (135, 90, 75)}
PLACES = tuple(Placement(model, 0.32, y, 0.0) for model, y in zip(SIZES, (0.0, 0.14, -0.15), strict=True))
ROW = EpisodeRow("tabletop", "pick-owl", 3, 7, "bring my owl", "owl", PLACES, 60)
TINT = np.array([230, 40, 40])


def look_at(name: str, eye: tuple[float, float, float], at: tuple[float, float, float] = (0.32, 0.0, 0.05)) -> Camera:
    z = np.subtract(at, eye) / np.linalg.norm(np.subtract(at, eye))
    x = np.cross(z, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = np.stack([x, np.cross(z, x), z], axis=1), eye
    return Camera(name, SIDE, SIDE, np.array([[210.0, 0, 112], [0, 210.0, 112], [0, 0, 1]]), pose)


def rig(step: int, n: int) -> tuple[Camera, ...]:
    """Front, side, and a wrist camera that travels."""
    s = step / 60
    return (look_at("front", (0.95, 0.0, 0.45)), look_at("side", (0.35, 0.75, 0.4)), look_at("wrist", (0.02 + 0.1 * s, 0.02, 0.42 - 0.1 * s)))[:n]


def poses(step: int) -> dict[str, np.ndarray]:
    lift = max(0.0, (step - 35) / 25 * 0.15)
    return {p.model: np.array([p.x, p.y, lift if i == 0 else 0.0, 1, 0, 0, 0], np.float64) for i, p in enumerate(ROW.placements)}


def links(step: int) -> dict[str, np.ndarray]:
    """A planar arm of four bones and two fingers."""
    t = min(step / 35, 1.0)
    turns, bones = np.array([0.1, 0.35 + 0.25 * t, 0.9 + 0.2 * t, 0.75 - 0.1 * t]), np.array([0.06, 0.2, 0.2, 0.1])
    found, at, angle = {}, np.zeros(3), 0.0
    for i, (turn, bone) in enumerate(zip(turns, bones, strict=True)):
        angle += turn
        found[f"link{i}"] = np.array([*at, math.cos(angle / 2), 0, math.sin(angle / 2), 0])
        at = at + bone * np.array([math.sin(angle), 0, math.cos(angle)])
    for side in (-1, 1):
        found[f"finger{side}"] = np.array([at[0], at[1] + 0.03 * side, at[2], math.cos(angle / 2), 0, math.sin(angle / 2), 0])
    return found


def draw(camera: Camera, step: int) -> tuple[Rgb, dict[str, Mask]]:
    """A table with a smooth light and a little grain, and every object as a shaded, patterned silhouette."""
    grain = np.random.default_rng([7, step]).normal(0, 1.5, (SIDE, SIDE, 1))
    v, u = np.mgrid[:SIDE, :SIDE]
    base = np.stack([165 + 40 * np.sin(u / 90 + v / 160), 140 + 30 * np.cos(u / 120), 110 + 25 * np.sin(v / 70)], axis=-1)
    wood = 8 * np.sin(v / 3.0 + 3 * np.sin(u / 40.0))[..., None]
    image, masks = base + wood + grain, {}
    world_to_cam = np.linalg.inv(camera.pose_world)
    for name, pose in poses(step).items():
        sx, sy, sz = np.array(SIZES[name]) / 2
        corners = np.array([[x, y, z] for x in (-sx, sx) for y in (-sy, sy) for z in (0, 2 * sz)]) + pose[:3]
        pixels = (corners @ world_to_cam[:3, :3].T + world_to_cam[:3, 3]) @ camera.k.T
        hull = cv2.convexHull((pixels[:, :2] / pixels[:, 2:]).astype(np.int32))
        mask = cv2.fillConvexPoly(np.zeros((SIDE, SIDE), np.uint8), hull, 1).astype(bool)
        pattern = np.array(PAINT[name]) + 25 * np.sin((u + v) / (3 + len(masks)))[..., None] + (v - v[mask].mean())[..., None] * -0.5
        image = np.where(mask[..., None], pattern + grain, image)
        masks[name] = mask
    return np.clip(image, 0, 255).astype(np.uint8), masks


def ground(camera: Camera, none: bool = False) -> Grounding:
    _, masks = draw(camera, 0)
    if none:
        nothing = (np.zeros((0, K), np.float32), np.zeros(0, np.int64), np.zeros(0, bool))
        return Grounding(camera.name, "owl_a", Boxes.empty("owl"), *nothing, None, 0.0, 0.0, np.zeros((0, SIDE, SIDE), bool))
    boxes = [[*np.argwhere(m).min(0)[::-1], *(np.argwhere(m).max(0)[::-1] + 1)] for m in masks.values()]
    cos = np.array([[0.83, 0.81, 0.62, 0.9, 0.85], [0.7, 0.72, 0.66, 0.71, 0.6], [0.5, 0.61, 0.6, 0.55, 0.52]], np.float32)
    votes = np.bincount(cos.argmax(0), minlength=3)
    scores = np.array([0.71, 0.83, 0.64], np.float32)
    means = cos.mean(1)
    boxes_found, best = Boxes(np.array(boxes, np.float32), scores, "owl"), votes == votes.max()
    return Grounding(camera.name, "owl_a", boxes_found, cos, votes, best, 0, 0.6, float(means[0] - means[1]), np.stack(list(masks.values())))


def opening(cameras: int = 3, none: str = "") -> Opening:
    rig0 = rig(0, cameras)
    groundings = {c.name: (ground(c, c.name == none),) for c in rig0}
    return Opening(ROW, "vap", "mini-pi0", 10.0, rig0, ROW.instruction, "bring the red owl", groundings, SIZES)


def frame(step: int, start: Opening, lost: range = range(0)) -> Frame:
    cameras = rig(step, len(start.cameras))
    images, prompted, tracks, truths = {}, {}, {}, {}
    for camera in cameras:
        image, masks = draw(camera, step)
        seen = masks["owl_a"] if start.groundings[camera.name][0].winner is not None and step not in lost else None
        track = None if seen is None else np.roll(seen, 2, axis=1)
        images[camera.name] = image
        shown = image
        if track is not None:
            shown = image.copy()
            shown[track] = (0.5 * image[track] + 0.5 * TINT).astype(np.uint8)
        prompted[camera.name], truths[camera.name] = shown, masks
        tracks[camera.name] = (Track(track, 0.0 if track is None else 0.9 - 0.12 * len(tracks) + 0.05 * math.sin(step / 5 + len(tracks))),)
    touched = ("owl_a",) if step > 30 else ("owl_b",) if 20 < step < 24 else ()
    contacts = {"owl_a": frozenset({ROBOT})} if step > 35 else {}
    events = (Event(0, "INFO", "grounded in every view"),) if step == 0 else (Event(step, "WARN", "front: track lost"),) if step in lost[:1] else ()
    state = np.array([0.3, 0, 0.3, 0, 0, 0, step < 33, *np.sin(np.arange(6) + step / 20)], np.float32)
    action = np.array([*0.02 * np.sin(np.arange(6) + step / 9), step < 33], np.float32)
    return Frame(
        step, step / 10, images, prompted, tracks, cameras, state, action, Truth(poses(step), links(step), touched, {}, contacts, truths), events
    )


SUCCESS = Outcome("success", True, True, 20, True, False, True, 60)


def record(path: Path, start: Opening, steps: int = 12, lost: range = range(0)) -> list[Frame]:
    frames = [frame(step, start, lost) for step in range(steps)]
    with Recorder(path, start, flush_every=5) as recorder:
        for one in frames:
            recorder.frame(one)
        recorder.close(replace(SUCCESS, steps=steps))
    return frames


def columns(path: Path, entity: str, name: str) -> dict[int | None, object]:
    """Every value of one component by frame_index; None is static."""
    found: dict[int | None, object] = {}
    for chunk in RrdReader(path).stream():
        batch = chunk.to_record_batch()
        if chunk.entity_path == entity and name in batch.schema.names:
            timed = "frame_index" in batch.schema.names
            steps = batch["frame_index"].to_pylist() if timed else [None] * batch.num_rows
            found |= dict(zip(steps, batch[name].to_pylist(), strict=True))
    return found


def entities(path: Path) -> set[str]:
    return {chunk.entity_path for chunk in RrdReader(path).stream()}


def rerun(*words: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run(rerun_cli(*map(str, words)), capture_output=True, text=True, check=False)


@pytest.fixture(scope="module")
def three(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Opening, list[Frame]]:
    path, start = tmp_path_factory.mktemp("three") / "three.rrd", opening(3)
    return path, start, record(path, start)


def test_rerun_loads_only_when_a_recording_is_asked_for() -> None:
    subprocess.run([sys.executable, "-c", "import vap_core, vap_core.values, sys; assert 'rerun' not in sys.modules"], check=True)


def test_every_entity_has_its_promised_name(three: tuple[Path, Opening, list[Frame]]) -> None:
    views = [
        f"/observation.images.{cam}{tail}"
        for cam in ("front", "side", "wrist")
        for tail in ("", "/prompted", "/candidates", "/mask/target", "/mask/gt")
    ]
    votes = [f"/vap/{part}/{cam}" for cam in ("front", "side", "wrist") for part in ("votes", "candidates", "vote_margin", "track_score")]
    plain = ["/observation.state", "/action", "/next.reward", "/next.success", "/vap/instruction", "/vap/events"]
    status = ["/vap/status/outcome", "/vap/status/grasp", "/__properties/rollout", "/__properties/outcome"]
    world = ["/world/table", "/world/robot/link0", "/world/robot/link_finger1", "/world/objects/owl_a", "/world/objects/owl_c"]
    assert {*views, *votes, *plain, *status, *world} <= entities(three[0])


def test_numbers_come_back_at_their_step(three: tuple[Path, Opening, list[Frame]]) -> None:
    path, start, frames = three
    assert columns(path, "/vap/vote_margin/side", "Scalars:scalars") == {step: [0.6] for step in range(12)}
    assert columns(path, "/next.success", "Scalars:scalars") == {step: [float(step == 11)] for step in range(12)}
    assert columns(path, "/vap/votes/front", "counts") == {0: start.groundings["front"][0].votes.tolist()}
    similarity = columns(path, "/vap/candidates/front", "similarity")[0]
    np.testing.assert_allclose(np.reshape(similarity, (3, K)), start.groundings["front"][0].similarity)  # type: ignore[arg-type]
    actions = columns(path, "/action", "Scalars:scalars")
    np.testing.assert_allclose(np.array([actions[step] for step in range(12)]), np.stack([f.action for f in frames]))
    lift = columns(path, "/world/objects/owl_b", "Transform3D:translation")[3]
    np.testing.assert_allclose(lift, [frames[3].truth.objects_world["owl_b"][:3]], atol=1e-6)


def test_pictures_and_masks_come_back_at_their_step(three: tuple[Path, Opening, list[Frame]]) -> None:
    path, _, frames = three
    for entity, views in (("", frames[7].images), ("/prompted", frames[7].prompted)):
        blob = columns(path, f"/observation.images.wrist{entity}", "EncodedImage:blob")[7]
        decoded = cv2.cvtColor(cv2.imdecode(np.frombuffer(bytes(blob[0]), np.uint8), cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB)  # type: ignore[index]
        assert np.abs(decoded.astype(int) - views["wrist"]).mean() < 4
    for tail, mask in (("target", frames[7].tracks["wrist"][0].mask), ("gt", frames[7].truth.masks["wrist"]["owl_a"])):
        buffer = columns(path, f"/observation.images.wrist/mask/{tail}", "SegmentationImage:buffer")[7]
        np.testing.assert_array_equal(np.frombuffer(bytes(buffer[0]), np.uint8).reshape(SIDE, SIDE) > 0, mask)  # type: ignore[index]


def test_the_catalog_server_sees_properties_and_columns(three: tuple[Path, Opening, list[Frame]]) -> None:
    import rerun as rr

    with rr.server.Server(host="127.0.0.1", datasets={"r": [three[0]]}) as server:
        dataset = server.client().get_dataset("r")
        table = dataset.segment_table().to_pandas()
        assert table["property:rollout:task"][0][0] == "pick-owl"
        assert bool(table["property:outcome:success"][0][0])
        margins = dataset.filter_contents(["/vap/vote_margin/**"]).reader(index="frame_index").to_pandas()
        assert len(margins) == 12


def test_summary_tells_what_ran_and_how_it_ended(three: tuple[Path, Opening, list[Frame]]) -> None:
    summary = read_summary(three[0])
    expected = {"rollout.suite": "tabletop", "rollout.method": "vap", "rollout.seed": 7, "outcome.success": True, "outcome.length": 12, "frames": 12}
    assert {name: summary[name] for name in expected} == expected
    assert summary["rollout.git"]


def test_what_is_undefined_is_none_in_the_summary(tmp_path: Path) -> None:
    start = opening(1)
    with Recorder(tmp_path / "one.rrd", start) as recorder:
        recorder.frame(frame(0, start))
        recorder.close(replace(SUCCESS, cmr=None))
    assert read_summary(tmp_path / "one.rrd").get("outcome.cmr") is None, "a selection has none"


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
    buffers = columns(tmp_path / "one.rrd", "/observation.images.front/mask/target", "SegmentationImage:buffer")
    assert [step for step, buffer in buffers.items() if not np.any(buffer)] == [4, 5, 6]


def test_what_the_views_agreed_on_can_be_read_back(tmp_path: Path) -> None:
    """The vote stays as it was; beside it the choice, its scores, and a view of which the target is no part."""
    start = opening(2)
    front, side = (start.groundings[cam][0] for cam in ("front", "side"))
    support = {"front": np.array([0.5, 3.25, -1.0, 0.0]), "side": np.array([1.0, 2.0, -1.0, 3.25])}
    agreed = Association({"front": 1, "side": None}, 3.25, 1.25, {"references": 2.0, "geometry": 1.25}, support)
    groundings = {"front": (replace(front, winner=1, overruled=0),), "side": (replace(side, winner=None, overruled=0),)}
    record(tmp_path / "one.rrd", replace(start, groundings=groundings, associations=(agreed, None)))
    for cam, winner in (("front", 1), ("side", -1)):
        read = {name: columns(tmp_path / "one.rrd", f"/vap/candidates/{cam}", name) for name in ("winner", "elected")}
        assert read == {"winner": {0: [winner]}, "elected": {0: [0]}}
    numbers = {name: columns(tmp_path / "one.rrd", "/vap/association", name)[0] for name in ("chosen", "total", "margin", "scores", "support_side")}
    assert numbers == {"chosen": [1, -1], "total": [3.25], "margin": [1.25], "scores": [2.0, 1.25], "support_side": [1.0, 2.0, -1.0, 3.25]}
    assert columns(tmp_path / "one.rrd", "/vap/association", "cameras")[0] == ["front", "side"]
    assert evidence_line(groundings["front"][0]).startswith("#1 by association · #0 wins 4/5")
    assert evidence_line(groundings["side"][0]).startswith("none by association · #0 wins 4/5")
    assert "/vap/votes/side/winner" not in entities(tmp_path / "one.rrd")
    assert rerun("rrd", "verify", tmp_path / "one.rrd").returncode == 0


def test_a_method_that_grounds_nothing_records_too(tmp_path: Path) -> None:
    start = replace(opening(1), method="generic", groundings={}, rewritten=ROW.instruction)
    with Recorder(tmp_path / "one.rrd", start) as recorder:
        recorder.frame(replace(frame(0, opening(1)), tracks={}))
        recorder.close(replace(SUCCESS, status="failure", success=False, steps=1))
    summary = read_summary(tmp_path / "one.rrd")
    assert (summary["outcome.failure_case"], summary["outcome.sub_case"], summary["outcome.deciding_frame"]) == ("unprompted", "timeout", 0)
    assert "/vap/vote_margin/front" not in entities(tmp_path / "one.rrd")


def test_an_episode_that_fails_before_its_first_step_records_its_error(tmp_path: Path) -> None:
    with Recorder(tmp_path / "one.rrd", opening(1)) as recorder:
        recorder.close(replace(SUCCESS, status="error", success=False, steps=0, detail="no grasp pose"))
    summary = read_summary(tmp_path / "one.rrd")
    assert (summary["frames"], summary["outcome.detail"]) == (0, "no grasp pose")
    assert rerun("rrd", "verify", tmp_path / "one.rrd").returncode == 0


def test_a_second_target_wears_a_suffix(tmp_path: Path) -> None:
    start = opening(1)
    second = replace(start.groundings["front"][0], object="owl_b", winner=1)
    start = replace(start, groundings={"front": (start.groundings["front"][0], second)})
    with Recorder(tmp_path / "one.rrd", start) as recorder:
        one = frame(0, start)
        recorder.frame(replace(one, tracks={"front": (*one.tracks["front"], Track(one.truth.masks["front"]["owl_b"], 0.7))}))
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


def test_a_killed_episode_keeps_all_flushed_steps(tmp_path: Path) -> None:
    path = tmp_path / "killed.rrd"
    program = (
        f"import sys, os, signal, pathlib; sys.path.insert(0, {str(Path(__file__).parent)!r})\n"
        "import test_record as t\n"
        "start = t.opening(1)\n"
        f"recorder = t.Recorder(pathlib.Path({str(path)!r}), start, flush_every=5)\n"
        "for step in range(13): recorder.frame(t.frame(step, start))\n"
        "os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    done = subprocess.run([sys.executable, "-c", program], check=False)
    assert done.returncode == -signal.SIGKILL
    assert [p.name for p in tmp_path.iterdir()] == [".killed.rrd.tmp"]
    with pytest.raises(BadRecording, match="rerun rrd optimize"):
        read_summary(temporary(path))
    assert recover(temporary(path)) == path
    summary = read_summary(path)
    assert (summary["frames"], summary["rollout.task"], "outcome.status" in summary) == (10, "pick-owl", False)
    assert rerun("rrd", "verify", path).returncode == 0
    assert [p.name for p in tmp_path.iterdir()] == ["killed.rrd"]


def test_an_exception_keeps_every_step_under_the_temporary_name(tmp_path: Path) -> None:
    def crash() -> None:
        with Recorder(tmp_path / "one.rrd", opening(1)) as recorder:
            recorder.frame(frame(0, opening(1)))
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        crash()
    assert [p.name for p in tmp_path.iterdir()] == [".one.rrd.tmp"]
    assert read_summary(recover(tmp_path / ".one.rrd.tmp"))["frames"] == 1


def test_a_process_that_records_much_keeps_neither_threads_nor_memory(tmp_path: Path) -> None:
    def held() -> tuple[int, float]:
        told = Path("/proc/self/status").read_text()
        threads, kilobytes = (int(re.search(rf"^{name}:\s*(\d+)", told, re.MULTILINE)[1]) for name in ("Threads", "VmRSS"))  # type: ignore[index]
        return threads, kilobytes / 1024

    start = opening(3)
    frames = [frame(step, start) for step in range(6)]
    after = []
    for n in range(24):
        with Recorder(tmp_path / f"{n}.rrd", start) as recorder:
            for one in frames:
                recorder.frame(one)
            recorder.close(replace(SUCCESS, status="failure", success=False) if n % 2 else SUCCESS)
        del recorder
        after.append(held())
    assert after[-1][0] <= after[3][0] + 1, "threads"
    assert after[-1][1] < after[11][1] + 12, "megabytes"


@pytest.mark.alone
def test_sixty_steps_of_three_cameras_stay_small_and_quick(tmp_path: Path) -> None:
    """The CPU of recording against that of encoding the same pictures once, in the same run: what `bench loop` measures against a whole rollout."""
    start = opening(3)
    frames = [frame(step, start) for step in range(60)]
    record(tmp_path / "warm.rrd", start, steps=2)

    def encodes(n: int) -> None:
        for one in frames:
            for picture in (*one.images.values(), *one.prompted.values()):
                jpeg(picture, 85)

    def records(n: int) -> None:
        recorder = Recorder(tmp_path / f"{n}.rrd", start)
        for one in frames:
            recorder.frame(one)
        recorder.close(SUCCESS)

    def cpu_s(work: Callable[[int], None], n: int) -> float:
        began = time.process_time()
        work(n)
        return time.process_time() - began

    ratios = [cpu_s(records, n) / cpu_s(encodes, n) for n in range(5)]
    assert (tmp_path / "0.rrd").stat().st_size < 4e6
    assert np.median(ratios) < 10, ratios


def test_nothing_is_ever_overwritten(tmp_path: Path, three: tuple[Path, Opening, list[Frame]]) -> None:
    (tmp_path / "one.rrd").write_bytes(b"precious")
    with pytest.raises(BadOutput, match="never overwritten; choose another"):
        Recorder(tmp_path / "one.rrd", three[1])
    with Recorder(tmp_path / "two.rrd", three[1]) as recorder:
        (tmp_path / "two.rrd").write_bytes(b"precious")
        with pytest.raises(BadOutput, match="kept as"):
            recorder.close(SUCCESS)
    with pytest.raises(BadOutput, match="left as it is"):
        recover(tmp_path / ".two.rrd.tmp")
    assert {p.read_bytes() for p in tmp_path.glob("*.rrd")} == {b"precious"}


def test_a_folder_that_cannot_be_written_says_so(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("not a folder")
    with pytest.raises(BadOutput, match="choose a folder you may write to"):
        Recorder(tmp_path / "file" / "one.rrd", opening(1))


def test_a_damaged_recording_says_how_to_mend_it(tmp_path: Path, three: tuple[Path, Opening, list[Frame]]) -> None:
    whole = three[0].read_bytes()
    for name, data in (("noise", b"noise" * 99), ("half", whole[: len(whole) // 2]), ("empty", b"")):
        (tmp_path / f"{name}.rrd").write_bytes(data)
        with pytest.raises(BadRecording, match="rerun rrd optimize") as caught:
            read_summary(tmp_path / f"{name}.rrd")
        assert "\n" not in str(caught.value)
    with pytest.raises(BadRecording, match="there is no recording"):
        read_summary(tmp_path / "missing.rrd")
    (tmp_path / ".noise2.rrd.tmp").write_bytes(b"noise" * 99)
    with pytest.raises(BadRecording):
        recover(tmp_path / ".noise2.rrd.tmp")


@given(st.lists(st.tuples(st.integers(0, 200), st.integers(0, 200)), min_size=1, max_size=8))
@settings(max_examples=60, deadline=None)
def test_labels_never_overlap(corners: list[tuple[int, int]]) -> None:
    xyxy = np.array([[x, y, x + 20, y + 20] for x, y in corners], np.float32)
    labels = [f"#{i} v1" for i in range(len(corners) - 1)] + ["#7 0.71 · votes 4/5 · cos 0.80"]
    spots = label_spots(xyxy, labels, (SIDE, SIDE))
    unit = SIDE / 170
    wide = {i: (6.6 * len(labels[i]) + 12) * unit for i in spots}
    rects = [(x - wide[i] / 2, y, x + wide[i] / 2, y + 21 * unit) for i, (x, y) in spots.items()]
    assert len(labels) - 1 in spots
    assert all(apart(a, (b[0] + 1e-6, b[1] + 1e-6, b[2] - 1e-6, b[3] - 1e-6)) for i, a in enumerate(rects) for b in rects[:i])


def test_class_image_marks_inside_and_rim() -> None:
    mask = np.zeros((9, 9), bool)
    mask[2:7, 2:7] = True
    image = classes(mask, 3, 1)
    assert (image[3:6, 3:6] == 3).all()
    assert (image > 0).sum() == 25
    assert (image == 4).sum() == 16


def test_a_grounding_alone_records(tmp_path: Path) -> None:
    start = opening(1)
    image, masks = draw(start.cameras[0], 0)
    z = np.eye(K, 16, dtype=np.float32)
    owl = PersonalObject("owl_a", "owl", z, tuple(image[90:150, 60 + k : 120 + k].copy() for k in range(K)), "test")
    record_grounding(
        tmp_path / "g.rrd", image, start.groundings["front"][0], owl, ROW.instruction, start.rewritten, frame(0, start).prompted["front"]
    )
    assert rerun("rrd", "verify", tmp_path / "g.rrd").returncode == 0
    assert {"/vap/references", "/vap/similarity/front", "/observation.images.front/prompted", "/observation.images.front/mask/target"} <= entities(
        tmp_path / "g.rrd"
    )
    assert masks


def test_screenshot_draws_the_recording(tmp_path: Path, three: tuple[Path, Opening, list[Frame]]) -> None:
    try:
        screenshot(three[0], tmp_path / "one.png", frame_index=6, size=(800, 500))
    except MissingGL:
        pytest.skip("no graphics driver on this machine")
    picture = cv2.imread(str(tmp_path / "one.png"))
    assert picture.shape == (500, 800, 3)
    assert picture.std() > 15


def test_screenshot_without_a_driver_names_the_package(
    tmp_path: Path, three: tuple[Path, Opening, list[Frame]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("VK_DRIVER_FILES", "/nonexistent.json")
    monkeypatch.setenv("VK_ICD_FILENAMES", "/nonexistent.json")
    with pytest.raises(MissingGL, match="apt-get install -y mesa-vulkan-drivers") as caught:
        screenshot(three[0], tmp_path / "one.png")
    assert "\n" not in str(caught.value)
