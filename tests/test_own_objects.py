"""measure objects: the folder form, what is wrong with bad folders, the figures, and resuming."""

import os
import shlex
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

from tests.command import refused, vap
from tests.scanned import box, put
from vap_core.base.errors import BadObject, BadStudy
from vap_core.simulation.assets.scans.storage import VARIABLE
from vap_core.study import objects as own
from vap_core.study.objects import (
    ObjectMeasurement,
    group_table,
    object_table,
    objects_in,
    read_source,
    text_report,
)


def test_the_folder_is_read_and_depends_on_all_of_it(tmp_path):
    for name in ("a.glb", "b.glb"):
        put(tmp_path, name, box(rgb=(200, 60, 30)))
    (tmp_path / "objects.csv").write_text(
        "file,category,height_cm,groups\na.glb,cup,6,loud\nb.glb,vase,,quiet\n"
    )
    source = read_source(tmp_path)
    assert set(source.groups) == set(source.files)
    assert source.sha256 == read_source(tmp_path).sha256
    text = (tmp_path / "objects.csv").read_text()
    (tmp_path / "objects.csv").write_text(text.replace("vase,", "cup,"))
    assert source.sha256 != read_source(tmp_path).sha256


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
    command, _, then = line.partition("./vap ")[2].partition("; ")
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
    refused = pd.DataFrame([{"object": "x", "why": "no"}])
    tables = {"views": views, "episodes": episodes, "refused": refused}
    groups: dict[str, tuple[str, ...]] = {"mug": ("loud",), "pot": ()}
    assert object_table(tables).to_numpy().tolist() == [
        ["mug", 3, 3, 2, 1, 1, "0.90", "2 of 2", "1 of 2"],
        ["pot", 1, 0, 0, 0, 0, "-", "0 of 1", "0 of 0"],
    ]
    found = group_table(tables, groups)
    by_name = found.set_index(found.iloc[:, 0].str.strip("- "))
    assert list(by_name.index) == ["all", "front views", "side views", "wrist views", "loud"]
    of_all = by_name.loc["all"]
    assert of_all["proposed"].startswith("75 ")
    assert of_all["right"].startswith("50 ")
    assert of_all["not in view"].startswith("50 ")
    assert of_all["not in view"].endswith(" 2")
    assert of_all["wrong tint"].startswith("20 ")
    assert of_all["VAP"].startswith("50 ")
    assert of_all["VAP"].endswith(" 2")
    assert by_name.loc["loud", "proposed"].startswith("100 ")
    assert "left out: x: no" in text_report(tables, groups)
    nothing = {**tables, "episodes": pd.DataFrame()}
    assert object_table(nothing).iloc[0, -2:].tolist() == ["-", "-"]


def test_folders_that_are_none_are_one_line(tmp_path: Path):
    assert "is no folder" in refused(
        "measure", "objects", tmp_path / "none", "--out", tmp_path / "out"
    )


def test_an_object_that_is_left_out_at_a_later_task_has_no_rows(tmp_path, monkeypatch):
    def openings(rows, stack):
        if rows == ["wide", "select-shoe"]:
            raise BadStudy("too wide")
        return [{"object": rows[0]}], np.zeros((4, 4, 3), np.uint8)

    def study(asked, suite, task, name):
        return SimpleNamespace(object=name, rows=lambda suite, task: [name, task])

    tasks = (("vlabench", "select-mug"), ("vlabench", "select-shoe"))
    monkeypatch.setattr(own, "_load_stack", lambda name: None)
    monkeypatch.setattr(own.suites, "tasks_of", lambda suites, name: tasks)
    monkeypatch.setattr(own, "measure_openings", openings)
    monkeypatch.setattr(own.ObjectMeasurement, "study", study)
    asked = ObjectMeasurement(tmp_path, suites=("vlabench",), views_only=True)
    (tmp_path / "parts").mkdir()
    wide, slim = (asked.run(own.Job(name), tmp_path) for name in ("wide", "slim"))
    assert wide["refused"] == [{"object": "wide", "why": "too wide"}]
    assert not wide["views"]
    assert [row["object"] for row in slim["views"]] == ["slim", "slim"]
