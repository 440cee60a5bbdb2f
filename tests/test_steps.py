"""Step rows beside a run: they say what the recordings draw, and SQL finds what was asked."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.command import refused, vap
from tests.drawn import SUCCESS, frame, opening
from vap_core.base.errors import BadRecording, BadStudy, UnknownName, VapError
from vap_core.rollout.types import Episode
from vap_core.study import diagnosis, failures, steps, store

FAILURE = replace(SUCCESS, status="failure", success=False, success_once=False)


def episode(number: int, outcome=SUCCESS, lost=range(0)) -> Episode:
    start = opening(3, "side")
    header = replace(start, row=replace(start.row, episode=number))
    frames = [frame(step, header, lost).without_images() for step in range(6)]
    return Episode(header, tuple(frames), outcome, {})


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("run")
    played = [episode(0), episode(1, FAILURE, range(3, 6))]
    rows = [{**each.summary(), **diagnosis.columns(each), "attempt": 1} for each in played]
    store.append(folder, rows)
    steps.write(folder, played[:1])
    steps.write(folder, played[1:])
    steps.write(folder, played[1:])  # tried again
    return folder


def test_a_row_a_step_and_camera_with_the_columns_of_its_episode(run: Path) -> None:
    table, episodes = steps.read(run)
    assert len(table) == 2 * 6 * 3
    assert len(episodes) == 2
    played = episode(0)
    votes = played.header.groundings
    for camera, part in table[table["episode"] == 0].groupby("camera"):
        (grounding,) = votes[camera][:1] or (None,)
        voted = grounding is not None and grounding.ballot.winner is not None
        assert part["margin"].notna().all() == voted
        assert not voted or set(part["margin"]) == {grounding.ballot.margin}
        scores = [each.tracks[camera][0].score for each in played.frames if each.tracks.get(camera)]
        np.testing.assert_allclose(part["track_score"].dropna(), scores)
    trace = diagnosis.trace_episode(played)
    one = table[(table["episode"] == 0) & (table["camera"] == table["camera"].iloc[0])]
    np.testing.assert_allclose(one["gap_cm"], 100 * trace.gap_m)
    np.testing.assert_allclose(one["lift_cm"], 100 * trace.lift_m[trace.target])


def test_a_condition_finds_episodes_and_sql_finds_anything(run: Path) -> None:
    found = steps.query(run, "frame_index >= 4 and success = false")
    assert found[["episode", "matching_steps", "first_step", "last_step"]].values.tolist() == [
        [1, 2, 4, 5]
    ]
    path, at = steps.recording_at(run, found, 0)
    assert (path.name, at) == ("tabletop.pick-owl.001.s7.vap.rrd", 4)
    counted = steps.query(run, "select episode, count(*) as n from steps group by episode")
    assert sorted(counted["n"]) == [18, 18]
    assert steps.query(run, "select max(seed) as seed from episodes")["seed"].tolist() == [7]
    for name in steps.QUESTIONS:
        assert set(steps.query(run, name)["episode"]) <= {0, 1}
    said = vap("query", run, "frame_index >= 4 and success = false").stdout
    assert said.startswith("1 found")
    assert "near-miss" in vap("query", run).stdout


def test_a_correction_counts_in_a_query(run: Path) -> None:
    _, episodes = steps.read(run)
    rows = episodes.to_dict("records")
    file = failures.correct(run, rows[1], "case 3: slip", "it held, a moment")
    failures.correct(run, rows[1], "case 1: drift")
    failures.correct(run, rows[1], "case 3: slip", "it held, a moment")
    asked = "select sub_case, case_sentence from episodes where corrected"
    assert steps.query(run, asked).values.tolist() == [["slip", "it held, a moment"]]
    file.unlink()
    assert steps.query(run, asked).empty


@pytest.mark.parametrize(
    ("question", "said"),
    [
        ("margin <", "is none on this table"),
        ("nothing > 1", "No field named nothing"),
        (
            "marjin > 1",
            "condition: 'marjin > 1' is none on this table (Schema error: No field named marjin.); did you mean margin or variant?",
        ),
        ("near-mis", "query: question 'near-mis' is unknown; known: near-miss, "),
        ("select * from recordings", "is none on this table"),
        ("with a as (select 1) insert into steps select * from a", "is none on this table"),
        ("select 1 as x; drop table steps", "is none on this table"),
        ("select repeat('x', 1000000000) from steps", "'repeat'"),
    ],
)
def test_a_question_that_fits_nothing_is_refused(run: Path, question: str, said: str) -> None:
    assert said in refused("query", run, question)


def test_what_cannot_be_opened_is_refused(run: Path, tmp_path: Path) -> None:
    rows = steps.read(run)[1].to_dict("records")
    calls = {
        "no line #2; 2 were found": lambda: steps.recording_at(run, steps.query(run, "true"), 2),
        "--open needs the columns suite": lambda: steps.recording_at(
            run, steps.query(run, "select 1 as one from steps"), 0
        ),
        "has no step rows; name the folder": lambda: steps.read(tmp_path),
        "only failures have a case": lambda: failures.correct(run, rows[0], "case 3: slip"),
        "case 'case 4' is unknown": lambda: failures.correct(run, rows[1], "case 4: slip"),
    }
    for said, call in calls.items():
        with pytest.raises(VapError, match=said) as caught:
            call()
        assert isinstance(caught.value, BadRecording | BadStudy | UnknownName)
