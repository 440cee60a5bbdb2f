"""calibrate: development scenes, the choice of a threshold, its price, and the file that keeps it."""

import json
from dataclasses import asdict, replace

import numpy as np
import pandas as pd
import pytest

from tests.command import refused
from tests.toys import MeanColour, SameColour, segmenter
from vap_core.base.errors import BadOutput
from vap_core.base.types import Boxes
from vap_core.perception import protocols, stacks
from vap_core.perception.foundation import weights as hub
from vap_core.perception.protocols import Stack, Thresholds
from vap_core.simulation.assets import objects
from vap_core.study import grounding
from vap_make.calibration import report, run, scenes


def quarters(images, phrase, threshold=None):
    """Four boxes of every picture."""
    h, w = images[0].shape[:2]
    x, y = w / 2, h / 2
    xyxy = np.array([[0, 0, x, y], [x, 0, w, y], [0, y, x, h], [x, y, w, h]], np.float32)
    return [Boxes(xyxy, np.ones(4, np.float32), phrase) for _ in images]


TOY = Stack("toy", quarters, MeanColour(), segmenter, SameColour())


def answers(right: list[float], absent: list[float], familiar: bool = True) -> pd.DataFrame:
    """One scene per answer."""
    rows = []
    for case, likeness in [("present", right), ("absent", absent)]:
        for i, cosine in enumerate(likeness):
            row = {"scene": i, "case": case, "likeness": cosine, "right": case == "present"}
            rows.append({**row, "familiar": familiar, "source": "rendered scenes"})
    return pd.DataFrame(rows)


def test_the_highest_threshold_within_the_price_is_chosen():
    table = answers([0.415, 0.513] + [0.9] * 48, [0.3, 0.6])
    assert report.choose(table, price=0.0).familiar == 0.41
    assert report.choose(table, price=0.02).familiar == 0.51
    assert report.choose(table, price=0.04).familiar == 0.9
    assert report.choose(table).unfamiliar is None


def test_too_few_objects_choose_nothing_and_the_report_says_so():
    table = answers([0.8] * (report.LEAST_RIGHT - 1), [0.3])
    chosen = report.choose(table)
    assert chosen.familiar is None
    text = report.text_report(table, chosen, TOY)
    assert "29 rightly elected objects, fewer than 30" in text
    assert "--photos" in text


def test_the_table_has_the_price_and_the_gain():
    table = answers([0.5] + [0.9] * 49, [0.3, 0.3, 0.3, 0.95])
    rows = report.threshold_rows(table, 0.52, 0.3)
    by_threshold = {row[0]: row for row in rows[1:]}
    assert by_threshold["0.52"][1] == "chosen"
    assert by_threshold["0.30"][1] == "now"
    assert by_threshold["0.52"][2].startswith("2 [")
    assert by_threshold["0.52"][2].endswith("50")
    assert by_threshold["0.52"][5].startswith("25 [")
    assert by_threshold["0.30"][2].startswith("0 [")
    assert by_threshold["0.30"][5].startswith("100 [")


def test_views_without_candidates_are_not_tinted():
    table = answers([0.9] * 40, [np.nan, np.nan])
    assert report.threshold_rows(table, 0.5, None)[1][5].startswith("0 [")


def test_a_stack_without_a_judge_needs_the_threshold_of_familiar_views_alone():
    assert report.Choice(0.6, None).thresholds(TOY) == Thresholds(0.6, 0.6)
    judged = replace(TOY, detector=Judge())
    assert report.Choice(0.6, None).thresholds(judged) is None
    assert report.Choice(0.6, 0.5).thresholds(judged) == Thresholds(0.6, 0.5)


class Judge:
    def __call__(self, images, phrase, threshold=None):
        return quarters(images, phrase)

    def is_familiar(self, image, phrase):
        return False


@pytest.mark.parametrize("number", [0, 5, 10, 15])
def test_scenes_ask_for_what_is_absent(number):
    start = scenes.scene(number)
    assert asdict(start) == asdict(scenes.scene(number))
    placed = {place.model for place in start.placements}
    lookalike = scenes.absent_lookalike(start)
    assert lookalike not in placed
    assert objects.get_object(lookalike).category == start.category
    other = objects.get_object(scenes.absent_other(start, number))
    assert other.category not in {objects.get_object(name).category for name in placed}
    assert other.split == "generic"


def test_a_scene_is_measured():
    rows = pd.DataFrame(scenes.measure_scene(1, TOY))
    assert set(rows.case) == {"present", "look-alikes", "absent"}
    assert not rows[rows.case != "present"].right.any()
    assert rows.likeness.between(-1, 1).all()


def test_a_finished_scene_is_not_measured_again(tmp_path, monkeypatch):
    asked = []

    def measure(number, stack):
        asked.append(number)
        row = {"scene": number, "camera": "front", "familiar": True}
        return [{**row, "case": "present", "likeness": 0.7, "right": True}] * 20

    monkeypatch.setattr(run, "load_stack", lambda name: TOY)
    monkeypatch.setattr(run, "measure_scene", measure)
    run.calibrate("toy", tmp_path / "out", scenes=1, progress=False)
    text, chosen = run.calibrate("toy", tmp_path / "out", scenes=2, progress=False)
    assert asked == [0, 1]
    assert chosen.familiar == 0.7
    assert (
        "chosen: Thresholds(familiar=0.7, unfamiliar=0.7, together=None); the stack has None"
        in text
    )
    (tmp_path / "out" / "scenes" / "00000.json").write_text("[")
    with pytest.raises(BadOutput, match="delete it"):
        run.calibrate("toy", tmp_path / "out", scenes=2, progress=False)


def test_answers_of_a_photo_set_count_by_what_is_in_the_photo():
    answers = pd.DataFrame(
        {
            "scene": list("abcd"),
            "familiar": False,
            "likeness": [0.7, 0.6, 0.5, None],
            "present": [True, True, False, False],
            "lookalikes": [1, 0, 2, 0],
            "chosen_iou": [0.8, 0.4, 0.0, None],
        }
    )
    rows = run._photo_rows(answers)
    assert rows.case.tolist() == ["present", "present", "look-alikes", "absent"]
    assert rows.right.tolist() == [True, False, False, False]


def test_kept_thresholds_hold_for_their_encoder(tmp_path):
    thresholds = Thresholds(0.61, 0.55)
    path = protocols.keep_thresholds(tmp_path, "foundation", "dino", thresholds)
    assert protocols.read_thresholds(tmp_path, "foundation", "dino") == thresholds
    assert protocols.read_thresholds(tmp_path, "foundation", "other") is None
    assert protocols.read_thresholds(tmp_path, "foundation-small", "dino") is None
    path.write_text(json.dumps({"encoder": "dino"}))
    with pytest.raises(BadOutput, match="calibration --stack foundation --keep"):
        protocols.read_thresholds(tmp_path, "foundation", "dino")


def test_keep_is_for_stacks_that_ship_none(tmp_path, monkeypatch):
    with pytest.raises(BadOutput, match="leave --keep out"):
        run.refuse_keep("embedded")
    with pytest.raises(BadOutput, match="embedded:tracker=edgetam ships its thresholds"):
        run.refuse_keep("embedded:tracker=edgetam")
    run.refuse_keep("embedded:encoder=dinov2-small", [tmp_path])
    run.refuse_keep("foundation")
    run.refuse_keep("embedded", [tmp_path])
    monkeypatch.setattr(run, "load_stack", lambda name: TOY)
    monkeypatch.setenv(hub.VARIABLE, str(tmp_path))
    path = run.keep_choice("foundation", report.Choice(0.6, None))
    kept = protocols.read_thresholds(tmp_path, "foundation", TOY.encoder.name)
    assert path.parent == tmp_path
    assert kept == Thresholds(0.6, 0.6)
    with pytest.raises(BadOutput, match="more --scenes"):
        run.keep_choice("foundation", report.Choice(None, None))


@pytest.mark.parametrize(
    "name",
    [
        "embedded:encoder=dinov2-small",
        "embedded:detector=grounding-dino-tiny",
        "foundation:tracker=embedded",
    ],
)
def test_a_stack_with_an_embedded_part_is_calibrated_on_photos(name, tmp_path, monkeypatch):
    """It judges views, so that the scenes alone give too few that are not familiar."""
    with pytest.raises(BadOutput, match=f"calibration --stack {name} --photos SET --keep"):
        run.refuse_keep(name)
    run.refuse_keep(name, [tmp_path])
    judged = replace(TOY, detector=Judge())
    monkeypatch.setattr(stacks, "load_own", lambda name: judged)
    assert f"calibration --stack {name} --photos SET --keep" in grounding.missing_threshold(name)
    monkeypatch.setattr(run, "load_stack", lambda name: judged)
    monkeypatch.setenv(hub.VARIABLE, str(tmp_path))
    with pytest.raises(BadOutput, match="more photos in the set"):
        run.keep_choice(name, report.Choice(0.6, None))
    run.keep_choice(name, report.Choice(0.6, 0.5))
    kept = protocols.read_thresholds(tmp_path, name, TOY.encoder.name)
    assert kept == Thresholds(0.6, 0.5)


def test_calibrate_refuses_before_it_measures(tmp_path):
    arguments = ("--stack", "embedded:encoder=dinov2-small", "--keep", "--out", tmp_path / "out")
    assert "--photos SET --keep" in refused("measure", "calibration", *arguments)
    assert not (tmp_path / "out").exists()


def test_too_few_photos_are_answered_by_photos():
    table = answers([0.8] * 3, [0.3], familiar=False)
    text = report.text_report(table, report.choose(table), replace(TOY, detector=Judge()))
    assert "none is chosen; name a photo set with --photos, or one with more photos." in text


@pytest.mark.parametrize("wrong", ["nan", "inf", "-inf"])
@pytest.mark.parametrize("kind", ["familiar", "unfamiliar"])
def test_a_kept_threshold_is_a_number(tmp_path, kind, wrong):
    thresholds = replace(Thresholds(0.5, 0.5), **{kind: float(wrong)})
    protocols.keep_thresholds(tmp_path, "foundation", "dino", thresholds)
    with pytest.raises(BadOutput, match="thresholds-foundation.json is damaged; delete it and run"):
        protocols.read_thresholds(tmp_path, "foundation", "dino")


@pytest.mark.parametrize("name", ["embedded", "embedded:encoder=dinov2-small"])
def test_the_remedy_for_a_damaged_threshold_is_one_that_is_not_refused(name, tmp_path):
    protocols.thresholds_file(tmp_path, name).write_text("{")
    with pytest.raises(BadOutput, match=f"run .* calibration --stack {name} --photos SET --keep"):
        protocols.read_thresholds(tmp_path, name, "dino")


def test_a_threshold_for_own_photos_is_kept_and_runs_do_not_depend_on_it(tmp_path, monkeypatch):
    shipped = replace(TOY, thresholds=Thresholds(0.7, 0.5))
    monkeypatch.setitem(stacks.STACKS, "toy", lambda: shipped)
    monkeypatch.setenv(hub.VARIABLE, str(tmp_path))
    assert stacks.load_own("toy").thresholds == Thresholds(0.7, 0.5)
    run.keep_choice("toy", report.Choice(0.9, 0.61))
    assert stacks.load_own("toy").thresholds == Thresholds(0.7, 0.61)
    assert stacks.load_stack("toy").thresholds == Thresholds(0.7, 0.5)
    with pytest.raises(BadOutput, match="more photos in the set"):
        run.keep_choice("toy", report.Choice(0.9, None))


def test_an_own_stack_without_thresholds_uses_what_was_kept(tmp_path, monkeypatch):
    monkeypatch.setitem(stacks.STACKS, "toy", lambda: TOY)
    monkeypatch.setenv(hub.VARIABLE, str(tmp_path))
    assert "calibration --stack toy --keep" in grounding.missing_threshold("toy")
    run.refuse_keep("toy")
    run.keep_choice("toy", report.Choice(0.9, None))
    assert stacks.load_own("toy").thresholds == Thresholds(0.9, 0.9)
    assert grounding.missing_threshold("toy") == ""
    assert stacks.load_stack("toy").thresholds is None
    monkeypatch.setitem(stacks.STACKS, "toy", lambda: replace(TOY, detector=Judge()))
    with pytest.raises(BadOutput, match="calibration --stack toy --photos SET --keep"):
        run.refuse_keep("toy")


def test_photos_are_measured_without_scenes(tmp_path, monkeypatch):
    monkeypatch.setattr(run, "load_stack", lambda name: TOY)
    with pytest.raises(BadOutput, match="no scenes and no photos"):
        run.calibrate("toy", tmp_path / "none", scenes=0, progress=False)

    def measured(folder, out, stack, kept, progress):
        assert not kept
        rows = {
            "scene": [str(i) for i in range(40)],
            "familiar": False,
            "likeness": 0.64,
            "present": True,
            "lookalikes": 0,
            "chosen_iou": 0.9,
        }
        out.mkdir(parents=True)
        pd.DataFrame(rows).to_parquet(out / f"{run.TABLE}.parquet")

    monkeypatch.setattr(run, "measure_photos", measured)
    text, chosen = run.calibrate(
        "toy", tmp_path / "out", scenes=0, photos=[tmp_path / "mine"], progress=False
    )
    assert (chosen.familiar, chosen.unfamiliar) == (None, 0.64)
    assert "unfamiliar views" in text


def test_ground_says_that_a_stack_cannot_say_not_in_view(monkeypatch):
    monkeypatch.setitem(stacks.STACKS, "toy", lambda: TOY)
    assert "calibration --stack toy --keep" in grounding.missing_threshold("toy")
    monkeypatch.setitem(stacks.STACKS, "toy", lambda: replace(TOY, thresholds=Thresholds(0.5, 0.5)))
    assert grounding.missing_threshold("toy") == ""
