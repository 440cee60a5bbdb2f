"""An imported scan takes the target's place: where it stands, what is refused, and whether it can be done."""

from dataclasses import asdict, replace

import numpy as np
import pytest

from tests.command import refused, vap
from tests.scanned import box, put
from vap_core.base.errors import BadStudy
from vap_core.memory import load_bank
from vap_core.simulation.assets.scans import storage
from vap_core.simulation.assets.scans.import_scan import import_scan
from vap_core.simulation.suites import listed
from vap_core.simulation.suites.starts import APART_M, _disc_radii_m, with_object
from vap_core.study.report import _rows_by_key
from vap_core.study.results import command_line
from vap_core.study.store import read
from vap_core.study.trials import Study, check_feasible, feasible, register_personal

TASKS = (("tabletop", "select-cup"),)


@pytest.fixture(scope="module", autouse=True)
def shelf(tmp_path_factory):
    """A folder of objects with a mug, for speed a box, and a board half as wide as the table; all lookups go there."""
    with pytest.MonkeyPatch.context() as patch:
        folder = tmp_path_factory.mktemp("shelf")
        patch.setenv("VAP_OBJECTS", str(folder / "objects"))
        for name, height_cm in (("mug", 6.0), ("board", 30.0)):
            file = put(folder, f"{name}.glb", box(rgb=(90, 60, 30)))
            scan = import_scan(file, name, "cup", height_cm=height_cm, mass_kg=0.1)
            storage.save_scan(folder / "objects", *scan)
        yield folder


def test_it_stands_where_the_target_stood_among_the_same_look_alikes():
    rows = listed("tabletop", "select-cup", own_target="mug")
    as_listed = listed("tabletop", "select-cup")
    assert len(rows) == len(as_listed) == 20
    for row, before in zip(rows, as_listed, strict=True):
        assert row.target == "mug"
        assert row.placements[1:] == before.placements[1:]
        assert asdict(replace(row, placements=before.placements)) == asdict(before)
        assert row.placements[0].yaw == before.placements[0].yaw


def test_every_neighbour_keeps_its_distance():
    rows = listed("tabletop", "select-cup", own_target="mug")
    radii_m = _disc_radii_m(rows, "mug")
    assert radii_m["mug"] == pytest.approx(0.06, abs=1e-3)
    for row in rows:
        target, *others = row.placements
        for other in others:
            apart_m = np.hypot(target.x - other.x, target.y - other.y)
            assert apart_m >= radii_m["mug"] + radii_m[other.model] + APART_M - 1e-9


def test_a_taken_place_gives_way_to_the_nearest_free_one():
    row, *rest = listed("tabletop", "select-cup")
    first, second = row.placements[:2]
    crowded = replace(row, placements=(first, replace(second, x=first.x, y=first.y + 0.03)))
    (moved,) = with_object([crowded], "mug", [crowded, *rest])
    place = moved.placements[0]
    assert (place.x, place.y) != (first.x, first.y)
    assert (place.x, place.y) in {(other.placements[0].x, other.placements[0].y) for other in rest}


@pytest.mark.parametrize(
    ("task", "name", "words"),
    [
        ("select-vase", "mug", "mug is a cup, and tabletop/select-vase asks for a vase; .*vlabench/select-cup"),
        ("select-cup", "board", "too wide to stand among the objects .*smaller --height-cm"),
        ("select-cup", "cup-lookalike-1", "is one of the objects around the target"),
        ("select-vase", "slipper-prop", "object 'slipper-prop' is unknown"),
    ],
)  # fmt: skip
def test_what_does_not_fit_is_refused(task, name, words):
    with pytest.raises(Exception, match=words):
        listed("tabletop", task, own_target=name)


@pytest.mark.parametrize(
    ("suite", "task"),
    [("shared-sequence", "select-cup-put-plant"), ("shared-pair", "put-pouch-near-cup")],
)
def test_a_scene_that_people_share_takes_no_other_object(suite, task):
    name = "mug" if suite == "shared-sequence" else "pouch-generic-9501"
    with pytest.raises(BadStudy, match="people share, and names the objects that they own"):
        listed(suite, task, own_target=name)


def test_the_expert_says_what_can_be_done():
    study = Study(TASKS, ("generic",), episodes=1, object="mug")
    rows = study.rows(*TASKS[0])
    assert feasible(rows) == (True,)
    (tried,) = check_feasible(study)
    assert str(tried) == "tabletop/select-cup: the expert succeeds in 1 of 1 episodes"


def test_a_task_that_the_expert_never_does_is_refused(monkeypatch):
    study = Study(TASKS, ("generic",), episodes=1, object="mug")
    monkeypatch.setattr("vap_core.study.trials.feasible", lambda rows: [False])
    with pytest.raises(BadStudy, match=r"in 0 of 1 episodes; not in 0\. mug may be too wide"):
        check_feasible(study)


def test_runs_with_and_without_it_are_different_runs():
    without = Study(TASKS, ("generic",), episodes=1)
    with_mug = replace(without, object="mug")
    assert "object" not in without.configuration(), "digests are those of versions without it"
    assert with_mug.configuration()["object"] == "mug"
    assert "--object mug" in command_line(with_mug.configuration())
    (row,) = _rows_by_key(with_mug.configuration()).values()
    assert row.target == "mug"


@pytest.mark.slow
def test_it_is_photographed_for_the_memory(tmp_path):
    register_personal(Study(TASKS, ("vap",), episodes=1, object="mug"), tmp_path)
    (obj,) = load_bank(tmp_path).values()
    assert (obj.name, obj.category, len(obj.crops)) == ("mug", "cup", 5)


@pytest.mark.slow
def test_the_command_tries_it_first_and_runs_it(tmp_path):
    out = tmp_path / "run"
    done = vap(
        *("rollout", "--suite", "tabletop", "--task", "select-cup", "--object", "mug"),
        *("--episodes", 1, "--workers", 1, "--policy", "random", "--out", out),
    )
    assert done.returncode == 0, done.stderr
    assert "tabletop/select-cup: the expert succeeds in 1 of 1 episodes" in done.stderr
    (row,) = read(out).to_dict("records")
    assert row["outcome"] != "error"


def test_eval_takes_the_tasks_of_its_category(tmp_path):
    said = refused(
        "eval", "--suite", "simpler-bridge", "--object", "mug", "--out", tmp_path / "run"
    )
    assert "mug is a cup, and no task of simpler-bridge asks for one" in said
