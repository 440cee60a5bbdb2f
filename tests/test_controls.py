"""The notebooks' controls: defaults, what a choice changes, and what is kept."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
from PIL import Image

from vap_core.analysis import controls, failure_picker
from vap_core.base.errors import BadOutput, UnknownName
from vap_core.base.photos import load_photo
from vap_core.evaluation.diagnosis.failures import Failures

WIDGET = "application/vnd.jupyter.widget-view+json"


def test_an_episode_has_the_tasks_and_cameras_of_its_suite() -> None:
    choice = controls.EpisodeChoice("vlabench", "select-cup", 3, "wrist")
    assert choice.chosen == ("vlabench", "select-cup", 3, "wrist")
    choice.suite.value = "simpler-bridge"
    suite, task, number, camera = choice.chosen
    assert (suite, number, camera) == ("simpler-bridge", 3, "front")
    assert task in choice.task.options
    assert "select-cup" not in choice.task.options
    choice.task.value = "put-camera"
    assert choice.chosen[1] == "put-camera"


def test_a_control_has_words_where_there_is_no_kernel() -> None:
    data = controls.EpisodeChoice("tabletop", "put-pouch", 0, "side")._repr_mimebundle_()
    assert WIDGET in data
    assert "suite tabletop · task put-pouch · episode 0 · camera side" in data["text/html"]
    assert data["text/plain"] in data["text/html"]


def test_a_default_that_is_not_there_is_named() -> None:
    with pytest.raises(UnknownName, match="camera of simpler-bridge"):
        controls.EpisodeChoice("simpler-bridge", "put-camera", 0, "side")
    with pytest.raises(UnknownName, match="task"):
        controls.EpisodeChoice("simpler-bridge", "put-nothing", 0, "front")


def test_own_photos_are_kept_as_they_were_chosen(tmp_path: Path) -> None:
    photos = controls.OwnPhotos(tmp_path / "own", "cup")
    assert photos.chosen == (None, None, "cup")
    Image.fromarray(np.full((9, 12, 3), 200, np.uint8)).save(tmp_path / "a.png")
    upload = SimpleNamespace(name="A.PNG", content=memoryview((tmp_path / "a.png").read_bytes()))
    photos.photo = SimpleNamespace(value=(upload,))
    assert photos.chosen[0] is None
    for n in (2, 1):
        photos.references = SimpleNamespace(value=(upload,) * n)
        photo, references, kind = photos.chosen
        assert photo is not None
        assert references is not None
        assert load_photo(photo).shape == (9, 12, 3)
        assert [path.name for path in sorted(references.iterdir())] == [
            f"{i}.png" for i in range(n)
        ]
        assert kind == "cup"


def choices() -> pd.DataFrame:
    rows = []
    for k in (1, 5):
        for i in range(10):
            rows.append(
                {
                    "suite": "vlabench" if i < 6 else "tabletop",
                    "k": k,
                    "rule": "vote",
                    "elected": "" if i == 9 else "cup",
                    "margin": 1.0 if i < 5 else 0.2,
                    "right": i not in (4, 9) if k == 5 else i < 2,
                }
            )
    return pd.DataFrame(rows)


def test_the_least_lead_says_what_is_answered_and_rightly() -> None:
    table = choices()
    said = controls.answered_text(table, 5, 0.6)
    assert "0.60: 50 % [24, 76] of 10 views are answered" in said
    assert ", 80 % [38, 96] of 5 of these rightly." in said
    assert ": 90 % [60, 98] of 10 views are answered" in controls.answered_text(table, 5, 0.0)
    control = controls.Abstention(table)
    before = control.answer.value
    control.k.value = 1
    assert "K = 1" in control.answer.value
    assert control.answer.value != before
    control.suite.value = "tabletop"
    control.threshold.value = 0.0
    assert ": 75 % [30, 95] of 4 views are answered" in control.answer.value
    with pytest.raises(UnknownName, match="number of photos '2' is unknown; known: 1, 5"):
        controls.Abstention(table, k=2)


@pytest.fixture
def picker(tmp_path: Path) -> failure_picker.FailurePicker:
    rows = []
    for number, (suite, case, sub_case) in enumerate(
        [
            ("vlabench", "case 1", "distractor vote"),
            ("vlabench", "case 2", "views disagree"),
            ("tabletop", "case 3", "slip"),
        ]
    ):
        rows.append(
            {
                "suite": suite,
                "task": "put-cup",
                "episode": number,
                "seed": 0,
                "method": "vap",
                "policy": "mini-pi0",
                "case": case,
                "sub_case": sub_case,
                "case_sentence": f"because of {sub_case}",
            }
        )
    table = pd.DataFrame(rows)
    failures = Failures(manifests={}, all_episodes=table, episodes=table, table=table)
    return failure_picker.FailurePicker(failures, tmp_path / "runs" / "labels.csv")


def test_failures_are_picked_by_suite_and_case(picker: failure_picker.FailurePicker) -> None:
    assert picker.row["case"] == "case 1"
    assert picker.label.value == "case 1: distractor vote"
    picker.suite.value = "tabletop"
    assert [value for _, value in picker.failure.options] == [2]
    assert picker.row["sub_case"] == "slip"
    assert picker.why.value == "because of slip"
    picker.case.value = "case 2"
    assert picker.failure.options == ()
    assert "no failure" in picker.why.value
    assert "vlabench put-cup 0, case 1" in picker._repr_mimebundle_()["text/html"]


def test_a_run_without_failures_has_nothing_to_pick(
    picker: failure_picker.FailurePicker, tmp_path: Path
) -> None:
    none = replace(picker.failures, table=picker.failures.table.iloc[:0])
    empty = failure_picker.FailurePicker(none, tmp_path / "labels.csv")
    assert (empty.failure.value, empty.why.value) == (None, "no failure of this kind")
    assert empty._repr_mimebundle_()["text/plain"] == "no failures"


def test_labels_are_kept_and_the_last_one_counts(picker: failure_picker.FailurePicker) -> None:
    picker.keep.click()
    picker.failure.value = 1
    picker.label.value = "case 1: drift"
    picker.note.value = 'it leaves, "slowly"'
    picker.keep.click()
    assert "2 labelled in labels.csv, 1 as diagnosed" in picker.said.value
    picker.label.value = "case 2: views disagree"
    picker.keep.click()
    assert "2 labelled in labels.csv, 2 as diagnosed" in picker.said.value
    found = failure_picker.read_labels(picker.labels)
    assert list(found["note"]) == ["", 'it leaves, "slowly"']
    assert len(picker.labels.read_text().splitlines()) == 4


@pytest.mark.parametrize("ending", [0, 1, 2])
def test_a_label_begins_its_own_line(picker: failure_picker.FailurePicker, ending: int) -> None:
    """Also below a last line without its end, which an editor may leave."""
    picker.keep.click()
    data = picker.labels.read_bytes()
    assert data.endswith(b"\r\n")
    picker.labels.write_bytes(data[: len(data) - ending])
    picker.failure.value = 1
    picker.keep.click()
    found = failure_picker.read_labels(picker.labels)
    assert found["episode"].tolist() == [0, 1]
    assert found["sub_case"].tolist() == ["distractor vote", "views disagree"]


def test_an_empty_file_of_labels_holds_none(
    picker: failure_picker.FailurePicker, tmp_path: Path
) -> None:
    picker.labels.parent.mkdir()
    picker.labels.touch()
    assert failure_picker.read_labels(picker.labels).empty
    picker.keep.click()
    assert "1 labelled in labels.csv, 1 as diagnosed" in picker.said.value


def test_a_label_is_as_diagnosed_with_its_case_alone(picker: failure_picker.FailurePicker) -> None:
    """`unprompted` has the sub-cases of case 3."""
    picker.failures.table.loc[2, "case"] = "unprompted"
    picker.suite.value = "tabletop"
    assert picker.label.value == "unprompted: slip"
    picker.label.value = "case 3: slip"
    picker.keep.click()
    assert "1 labelled in labels.csv, 0 as diagnosed" in picker.said.value


def test_words_of_a_table_are_no_html(picker: failure_picker.FailurePicker) -> None:
    picker.failures.table.loc[2, "case_sentence"] = "<img src=x onerror=alert(1)>"
    picker.suite.value = "tabletop"
    assert picker.why.value.startswith("&lt;img")


def test_a_label_that_is_no_case_and_a_file_of_something_else_are_named(
    picker: failure_picker.FailurePicker, tmp_path: Path
) -> None:
    assert failure_picker.read_labels(tmp_path / "none.csv").empty
    with pytest.raises(BadOutput, match="'case 9' is no case"):
        failure_picker.write_label(picker.labels, picker.row, "case 9")
    other = tmp_path / "other.csv"
    other.write_text("a,b\n1,2\n")
    with pytest.raises(BadOutput, match="has other columns than labels"):
        failure_picker.read_labels(other)
