"""measure objects: made-up designs, the folder form, what is wrong with bad folders, the figures, and resuming."""

import os
import shlex
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
from tqdm import tqdm

from tests.command import refused, vap
from tests.scanned import box, put
from vap_core.base.errors import BadObject, BadOutput, BadStudy
from vap_core.simulation.assets.scans.mesh_file import count_edge_flaws, weld
from vap_core.simulation.assets.scans.storage import VARIABLE
from vap_core.simulation.assets.shapes import area_vectors
from vap_core.simulation.suites import suite
from vap_core.study import objects as own
from vap_core.study.objects import (
    Source,
    Tables,
    group_rows,
    object_rows,
    objects_in,
    read_source,
    text_report,
)
from vap_make.objects.closed_parts import blob, hollow, lathe, ring, tube
from vap_make.objects.design_paint import LOUD, QUIET, SIDE, draw_colours
from vap_make.objects.designs import FORMS, HANDLED, draw_design, write_designs


def volume(corner: np.ndarray) -> float:
    return float((corner[:, 0] * area_vectors(corner)).sum() / 6)


@pytest.mark.parametrize(
    ("corner", "wanted"),
    [
        (lathe([(0, 0), (0.02, 0), (0.02, 0.05), (0, 0.05)], 4), 2 * 0.02**2 * 0.05),
        (lathe([(0, 0), (0.02, 0), (0.02, 0.05), (0, 0.05)]), np.pi * 0.02**2 * 0.05),
        (blob((0, 0, 0), (0.02, 0.03, 0.01)), 4 / 3 * np.pi * 0.02 * 0.03 * 0.01),
        (tube([(0, 0, 0), (0, 0, 0.02), (0, 0, 0.05)], 0.004), np.pi * 0.004**2 * 0.05),
    ],
)
def test_forms_are_closed_and_have_their_volumes(corner, wanted):
    assert count_edge_flaws(weld(corner)[1]) == (0, 0)
    assert volume(corner) == pytest.approx(wanted, rel=0.1)


def test_a_vessel_is_its_wall():
    vessel = hollow([(0.02, 0.0), (0.02, 0.06)], 0.003)
    solid = lathe([(0, 0), (0.02, 0), (0.02, 0.06), (0, 0.06)])
    assert count_edge_flaws(weld(vessel)[1]) == (0, 0)
    assert 0 < volume(vessel) < 0.5 * volume(solid)


def test_every_design_of_every_kind_is_closed():
    rng = np.random.default_rng(0)
    for forms in FORMS.values():
        for name, form in forms:
            for part in form(rng):
                assert count_edge_flaws(weld(part)[1]) == (0, 0), name
                assert volume(part) > 0
            size = np.ptp(np.concatenate(form(rng)), axis=(0, 1))
            assert (size > 0.015).all(), name
            assert (size < 0.13).all(), name
    assert len(ring((0, 0, 0), (0.01, 0.02), 0.001, corners=3)) == 5


def test_designs_are_of_tabletops_kinds_half_loud_and_the_same_for_the_same_seed():
    assert set(FORMS) == {task.category for task in suite("tabletop").tasks}
    drawn = [draw_design(i, 0) for i in range(24)]
    assert len({design.name for design in drawn}) == 24
    assert sum("loud" in design.groups for design in drawn) == 12
    assert 8 <= sum("with handle" in design.groups for design in drawn) <= 16
    assert {name for design in drawn for name in design.groups} == {
        "with handle", "no handle", "loud", "quiet"
    }  # fmt: skip
    names = {name for forms in FORMS.values() for name, _ in forms}
    assert set(HANDLED) <= names
    assert drawn[0].glb == draw_design(0, 0).glb
    assert drawn[0].glb != draw_design(0, 1).glb


@pytest.mark.parametrize("paint", [*QUIET, *LOUD])
def test_paint_wraps_twice_and_only_loud_paint_has_many_colours(paint):
    rng = np.random.default_rng(3)
    picture = paint(rng, draw_colours(rng))
    assert picture.shape == (SIDE, 2 * SIDE, 3)
    assert (picture[:, :SIDE] == picture[:, SIDE:]).all()
    count = len(np.unique(picture.reshape(-1, 3), axis=0))
    assert (count <= 2) == (paint in QUIET)


def test_the_folder_of_designs_is_read_and_depends_on_all_of_it(tmp_path):
    write_designs(tmp_path, 3, 0)
    source = read_source(tmp_path)
    assert len(source.groups) == 3
    assert set(source.groups) == set(source.files)
    assert source.sha256 == read_source(tmp_path).sha256
    text = (tmp_path / "objects.csv").read_text()
    (tmp_path / "objects.csv").write_text(text.replace("vase,", "cup,"))
    assert source.sha256 != read_source(tmp_path).sha256


def test_designs_replace_no_file_of_anothers(tmp_path):
    """The same designs again are no error: nothing is lost."""
    (tmp_path / "objects.csv").write_text("file,category\nmug.glb,cup\n")
    line = refused("objects", "designs", tmp_path, "--count", "2")
    assert "objects.csv exists with other contents; choose another folder" in line
    assert [path.name for path in tmp_path.iterdir()] == ["objects.csv"]
    assert (tmp_path / "objects.csv").read_text() == "file,category\nmug.glb,cup\n"
    (tmp_path / "objects.csv").unlink()
    paths = write_designs(tmp_path, 2, 0)
    assert write_designs(tmp_path, 2, 0) == paths
    paths[0].write_bytes(b"mine")
    with pytest.raises(BadOutput, match="exists with other contents"):
        write_designs(tmp_path, 2, 0)
    assert paths[0].read_bytes() == b"mine"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (None, "holds neither objects.csv nor imported objects"),
        ("file\nmug.glb\n", "lacks the column 'category'"),
        ("file,category\nmgu.glb,cup\n", "line 2 names 'mgu.glb'"),
        ("file,category\nmug.glb,cup\nmug.glb,cup\n", "line 3 names a second 'mug'"),
        ("file,category,height_cm\nmug.glb,cup,tall\n", "the height 'tall'"),
        ("file,category\n", "names no file"),
        ("file,category\nmug.glb,my cup\n", "line 2 has the category 'my cup'; .* example cup"),
    ],
)
def test_what_is_wrong_with_a_folder_is_one_line(tmp_path, text, message):
    put(tmp_path, "mug.glb", box(rgb=(90, 60, 30)))
    if text is not None:
        (tmp_path / "objects.csv").write_text(text)
    with pytest.raises(BadObject, match=message):
        read_source(tmp_path)


def test_where_every_object_is_left_out_the_remedy_is_one_that_there_is(tmp_path):
    """The option that mends an open surface is that of `objects import`."""
    folder, out = tmp_path / "a b's", tmp_path / "out"
    folder.mkdir()
    open_box = box(rgb=(200, 60, 30))
    open_box.update_faces(np.arange(10))
    for name in ("open.ply", "other.ply"):
        put(folder, name, open_box)
    table = "file,category,height_cm\nopen.ply,coffee cup,6\nother.ply,cup,\n"
    (folder / "objects.csv").write_text(table)
    line = refused("measure", "objects", folder, "--views-only", "--out", out)
    assert "measure objects: every object was left out. open: " in line
    assert "is not watertight" in line
    assert "report.txt in out says why of 1 more." in line
    command, _, then = line.partition("python -m vap_core ")[2].partition("; ")
    assert shlex.split(command) == [
        "objects", "import", str(folder / "open.ply"), "--category", "coffee cup",
        "--height-cm", "6", "--repair", "--out", "DIR",
    ]  # fmt: skip
    assert then.startswith("then measure objects DIR.")
    report = (out / "report.txt").read_text()
    assert [words.split(":")[1] for words in report.splitlines()] == [" open", " other"]


def test_where_objects_are_looked_up_is_as_before_afterwards(tmp_path, monkeypatch):
    monkeypatch.setenv(VARIABLE, "elsewhere")
    with objects_in(tmp_path):
        assert os.environ[VARIABLE] == str(tmp_path)
    assert os.environ[VARIABLE] == "elsewhere"
    monkeypatch.delenv(VARIABLE)
    with objects_in(tmp_path):
        pass
    assert VARIABLE not in os.environ


@pytest.mark.sweep
def test_the_command_imports_looks_runs_and_resumes(tmp_path):
    folder, out = tmp_path / "mine", tmp_path / "out"
    folder.mkdir()
    put(folder, "crate.glb", box(rgb=(200, 60, 30)))
    put(folder, "desk-lamp.glb", box(rgb=(20, 60, 30)))
    (folder / "objects.csv").write_text(
        "file,category,height_cm,groups\ncrate.glb,cup,6,loud\ndesk-lamp.glb,lamp,,\n"
    )
    words = ("measure", "objects", folder, "--episodes", "1", "--policy", "scripted", "--out", out)
    done = vap(*words)
    assert done.returncode == 0, done.stderr
    assert "left out: desk-lamp: no task of tabletop asks for a lamp" in done.stdout
    views = pd.read_parquet(out / "views.parquet")
    assert sorted(views.camera) == ["front", "side", "wrist"]
    assert set(views.target) == {"crate"}
    assert views[views.counts].right.notna().all()
    (episode,) = pd.read_parquet(out / "episodes.parquet").to_dict("records")
    assert (episode["object"], episode["method"]) == ("crate", "vap")
    assert episode["expert"] in (True, False)
    assert (out / "sheet-01.png").stat().st_size > 10_000
    parts = {path: path.stat().st_mtime_ns for path in (out / "parts").iterdir()}
    again = vap(*words)
    assert again.stdout == done.stdout
    assert parts == {path: path.stat().st_mtime_ns for path in (out / "parts").iterdir()}
    assert "holds another run" in refused(*words[:3], "--episodes", "2", "--out", out)


def view(**changed: object) -> dict[str, object]:
    usual: dict[str, object] = {
        "target": "mug", "camera": "front", "counts": True, "proposed": True, "right": True,
        "tinted": True, "elected": "mug", "mask_iou": 0.9,
    }  # fmt: skip
    return usual | changed


def test_rows_count_what_they_say():
    views = pd.DataFrame(
        [
            view(),
            view(camera="side", right=False, elected="cup-lookalike-1", mask_iou=None),
            view(camera="side", tinted=False),
            view(camera="wrist", counts=False, proposed=None, right=None, tinted=False, elected=""),
            view(
                target="pot",
                proposed=False,
                right=False,
                tinted=False,
                elected="nothing",
                mask_iou=None,
            ),
        ]
    )
    episodes = pd.DataFrame(
        [
            {"object": "mug", "expert": True, "success": True, "first_object_correct": True},
            {"object": "mug", "expert": True, "success": False, "first_object_correct": None},
            {"object": "pot", "expert": False, "success": True, "first_object_correct": True},
        ]
    )
    tables = Tables(
        views=views, episodes=episodes, groups={"mug": ("loud",), "pot": ()}, refused={"x": "no"}
    )
    assert object_rows(tables)[1:] == [
        ["mug", "3", "3", "2", "1", "1", "0.90", "2 of 2", "1 of 2"],
        ["pot", "1", "0", "0", "0", "0", "-", "0 of 1", "0 of 0"],
    ]
    by_name = {cells[0].strip("- "): cells[1:] for cells in group_rows(tables)[1:]}
    assert list(by_name) == ["all", "front views", "side views", "wrist views", "loud"]
    head = group_rows(tables)[0][1:]
    of_all = dict(zip(head, by_name["all"], strict=True))
    assert of_all["proposed"].startswith("75 ")
    assert of_all["right"].startswith("50 ")
    assert of_all["not in view"].startswith("50 ")
    assert of_all["not in view"].endswith(" 2")
    assert of_all["wrong tint"].startswith("20 ")
    assert of_all["VAP"].startswith("50 ")
    assert of_all["VAP"].endswith(" 2")
    assert by_name["loud"][0].startswith("100 ")
    assert "left out: x: no" in text_report(tables)
    nothing = Tables(views=views, episodes=pd.DataFrame(), groups=tables.groups, refused={})
    assert object_rows(nothing)[1][-2:] == ["-", "-"]


def test_folders_that_are_none_are_one_line(tmp_path: Path):
    assert "is no folder" in refused(
        "measure", "objects", tmp_path / "none", "--out", tmp_path / "out"
    )


def test_an_object_that_is_left_out_at_a_later_task_has_no_rows(tmp_path, monkeypatch):
    def views(study, out, stack):
        if (study.object, study.tasks[0][1]) == ("wide", "select-shoe"):
            raise BadStudy("too wide")
        return [{"object": study.object}]

    tasks = [("vlabench", "select-mug"), ("vlabench", "select-shoe")]
    monkeypatch.setattr(own, "load_stack", lambda name: None)
    monkeypatch.setattr(own, "_tasks", lambda name, suites: tasks)
    monkeypatch.setattr(own, "_views", views)
    monkeypatch.setattr(own, "_episodes", lambda study, out: views(study, out, None))

    def study(asked, suite, task, name):
        return SimpleNamespace(object=name, tasks=((suite, task),))

    monkeypatch.setattr(own.ObjectSurvey, "study", study)
    asked = own.ObjectSurvey(suites=("vlabench",))
    source = Source(groups={"wide": (), "slim": ()}, files={}, sha256="")
    refused: dict[str, str] = {}
    seen, played = own._measure(source, tmp_path, asked, refused, tqdm(disable=True))
    assert refused == {"wide": "too wide"}
    assert seen["object"].tolist() == played["object"].tolist() == ["slim", "slim"]
