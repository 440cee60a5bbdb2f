"""The real command records an episode of a published run with its maps: heat maps, numbers, masks and outcome are in the file, of the same steps, and agree with each other."""

import shlex
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pandas as pd
import pytest

from tests.command import refused, vap
from tests.drawn import SUCCESS, columns, entities, frame, opening, rerun
from tests.test_why import tabs
from vap_core.base.errors import BadStudy
from vap_core.base.files import DATA, SHIPPED
from vap_core.policies.mini_pi0 import learned_token
from vap_core.policies.mini_pi0.vlm import load_vlm
from vap_core.policies.protocol import heat_map
from vap_core.recording import Recorder, read_summary
from vap_core.recording.entities.pictures import attention_overlay
from vap_core.recording.read import read_pictures
from vap_core.recording.show import attended
from vap_core.simulation import suites
from vap_core.study import attention

RUN = DATA / "results" / "mini_pi0.parquet"
"""simpler-bridge's first policy, whose token is kept."""
NAME = "simpler-bridge/pick-shaver/soft/12"
IMAGE = "/observation.images.front"
QUERIES = ("token", "action")
"""What soft's instruction has."""
EXECUTE = 4
"""Steps between two calls of the policy."""


def put_token(memory: Path) -> None:
    """A token of the published tables, so that nothing is learned here."""
    table = pd.read_parquet(DATA / "results" / "token_embeddings.parquet")
    kept = table[(table["learned_in"] == "vlm") & (table["k"] == learned_token.K)]
    (row,) = kept[kept["object"] == "shaver-personal"].to_dict("records")
    embedding = np.array(row["embedding"], np.float32)
    model = load_vlm(SHIPPED / "mini-paligemma-tint-free").sha256()
    suffix = learned_token.file_suffix(suites.rows("simpler-bridge", "pick-shaver"), model)
    learned_token.save(
        memory, learned_token.Token("shaver-personal", embedding, 1.0, model), suffix
    )


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """The recording of the command, and what it printed."""
    out = tmp_path_factory.mktemp("attention")
    put_token(out / "memory")
    done = vap("measure", "attention", RUN, "--record", NAME, "--out", out)
    assert done.returncode == 0, done.stderr
    path = out / "recordings" / "simpler-bridge.pick-shaver.soft.12.rrd"
    assert path.exists(), done.stdout
    return path, done.stdout


def numbers(path: Path, query: str) -> dict[Any, np.ndarray]:
    """The tensor of a query by step."""
    found = {}
    for step, cells in columns(path, f"/vap/attention/front/{query}", "Tensor:data").items():
        (tensor,) = cells  # type: ignore[misc]
        values = np.array(tensor["buffer"], np.float32)
        found[step] = values.reshape(tensor["shape"])
    return found


def masks(path: Path) -> dict[Any, np.ndarray]:
    """The true mask of the target by step."""
    found = {}
    for step, cells in columns(path, f"{IMAGE}/mask/gt", "SegmentationImage:buffer").items():
        (pixels,) = cells  # type: ignore[misc]
        flat = np.array(pixels, np.uint8)
        side = round(len(flat) ** 0.5)
        found[step] = flat.reshape(side, side) > 0
    return found


@pytest.mark.slow
def test_maps_numbers_and_masks_are_of_the_policys_calls(recorded: tuple[Path, str]) -> None:
    path, _ = recorded
    assert rerun("rrd", "verify", path).returncode == 0
    assert attended(path) == {"front": QUERIES}
    calls = list(numbers(path, "token"))
    assert calls[:3] == [0, EXECUTE, 2 * EXECUTE]
    assert all(step % EXECUTE == 0 for step in calls)
    overlays = read_pictures(path, {f"{IMAGE}/attention/{query}" for query in QUERIES})
    for query in QUERIES:
        tensors = numbers(path, query)
        assert list(tensors) == calls == sorted(overlays[f"{IMAGE}/attention/{query}"])
        for weights in tensors.values():
            assert weights.shape == (4, 8, 7, 7)
            assert weights.min() >= 0
            assert weights.sum((2, 3)).max() < 1
    true = masks(path)
    assert set(calls) <= set(true)
    assert true[0].any()
    assert true[0].mean() < 0.2


@pytest.mark.slow
def test_every_overlay_is_its_numbers_over_its_own_picture(recorded: tuple[Path, str]) -> None:
    """Drawn again from the file's numbers and pictures; another step's numbers differ more."""
    path, _ = recorded
    names = {f"{IMAGE}/attention/{query}" for query in QUERIES} | {f"{IMAGE}/prompted"}
    stored = read_pictures(path, names)
    for query in QUERIES:
        tensors = numbers(path, query)
        apart, mixed = [], []
        steps = list(tensors)
        for step, other in zip(steps, steps[::-1], strict=True):
            overlay = stored[f"{IMAGE}/attention/{query}"][step].astype(float)
            seen = stored[f"{IMAGE}/prompted"][step]
            for kept, of in ((apart, step), (mixed, other)):
                drawn = attention_overlay(seen, heat_map(tensors[of], query))
                kept.append(np.abs(drawn - overlay).mean())
        assert max(apart) < 4, "JPEG's noise"
        assert np.mean(mixed) > 2 * np.mean(apart)


@pytest.mark.slow
def test_the_recording_opens_with_its_outcome_and_a_tab_per_query(
    recorded: tuple[Path, str],
) -> None:
    path, said = recorded
    summary = read_summary(path)
    assert (summary["suite"], summary["task"], summary["method"], summary["episode"]) == ("simpler-bridge", "pick-shaver", "soft", 12)  # fmt: skip
    assert summary["outcome"] in ("success", "failure")
    assert {"attention", *QUERIES} <= tabs(path)
    verdict = columns(path, "/vap/verdict", "TextDocument:text")
    assert summary["outcome"].upper() in str(verdict[None]).upper()
    assert {"/vap/events", "/vap/instruction", "/vap/verdict"} <= entities(path)
    listed = pd.read_parquet(RUN)
    row = listed[(listed["task"] == "pick-shaver") & (listed["method"] == "soft") & (listed["episode"] == 12)].iloc[0]  # fmt: skip
    ended_so = (summary["outcome"], summary["steps"]) == (row["outcome"], row["steps"])
    assert ended_so != ("note: run again" in said), "another ending is noted"


@pytest.mark.slow
def test_the_command_names_the_step_of_a_words_highest_peak(recorded: tuple[Path, str]) -> None:
    path, said = recorded
    tensors = numbers(path, "token")
    highest = max(tensors, key=lambda step: heat_map(tensors[step], "token").max())
    (line,) = (line for line in said.splitlines() if line.startswith("next: "))
    picture = [
        "view",
        str(path),
        "--png",
        f"{path.stem}.png",
        "--attention",
        "--frame",
        str(highest),
    ]
    assert shlex.split(line) == ["next:", "./vap", *picture]


@pytest.mark.slow
def test_a_picture_has_the_maps_of_all_queries(recorded: tuple[Path, str], tmp_path: Path) -> None:
    path, _ = recorded
    png = tmp_path / "one.png"
    done = vap("view", path, "--png", png, "--attention", "--frame", "0")
    if "could not draw" in done.stderr:
        pytest.skip("no graphics driver on this machine")
    assert done.returncode == 0, done.stderr
    shown = cv2.imread(str(png))
    assert shown.shape == (900, 1600, 3)
    for query in QUERIES:
        entity = f"{IMAGE}/attention/{query}"
        overlay = read_pictures(path, {entity})[entity][0]
        bgr = cv2.cvtColor(overlay, cv2.COLOR_RGB2BGR)
        assert likeness(cv2.resize(shown, (800, 450)), bgr) > 0.9, query
    other = np.ascontiguousarray(np.rot90(bgr, 2))
    assert likeness(cv2.resize(shown, (800, 450)), other) < 0.8, "what is not there is not found"


def likeness(picture: np.ndarray, part: np.ndarray) -> float:
    """The best correlation of a part, as large as a view is drawn, with a place in a picture."""
    best = 0.0
    for side in range(210, 280, 2):
        scaled = cv2.resize(part, (side, side), interpolation=cv2.INTER_LINEAR)
        found = cv2.matchTemplate(picture, scaled, cv2.TM_CCOEFF_NORMED)
        best = max(best, float(found.max()))
    return best


def test_a_recording_without_attention_has_no_such_picture(tmp_path: Path) -> None:
    start = opening(1)
    plain, broken = tmp_path / "plain.rrd", tmp_path / "broken.rrd"
    with Recorder(plain, start) as recorder:
        recorder.frame(frame(0, start))
        recorder.close(SUCCESS)
    assert attended(plain) == {}
    line = refused("view", plain, "--png", tmp_path / "one.png", "--attention")
    assert "plain.rrd holds no attention; record it with --attention all" in line
    broken.write_bytes(plain.read_bytes()[:2000])
    assert "cannot be read" in refused("view", broken, "--png", tmp_path / "one.png", "--attention")


def test_only_the_policy_of_the_run_is_run_again(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Weights that were trained since would be recorded under the run's name."""
    run = DATA / "results" / "mini_pi0.parquet"
    changed = pd.read_parquet(run).assign(policy="mini_pi0:0000000000")
    published = attention.read_runs(run)
    monkeypatch.setattr(attention, "read_runs", lambda _: [(published[0][0], changed)])
    monkeypatch.setattr(attention, "register_personal", lambda *_: None)
    with pytest.raises(BadStudy, match="was run with mini_pi0:0000000000"):
        attention.record(run, "simpler-fractal/pick-pen-holder/generic/0", tmp_path, tmp_path)
    assert not list(tmp_path.rglob("*.rrd"))
