"""The pictures of a report: every line of its tables, methods told apart, the right recording."""

from collections.abc import Generator
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.test_report import run
from vap_core.base import palette
from vap_core.evaluation.report import page
from vap_core.evaluation.report.pictures import differences_figure, forest_figure
from vap_core.evaluation.report.results import results
from vap_core.evaluation.report.runs import load_runs
from vap_core.evaluation.statistics import compare
from vap_core.recording import recording_file_name
from vap_core.simulation import suites


def test_a_failure_is_pictured_by_the_recording_of_its_own_policy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two runs of one suite and method, with different policies, name their files alike."""
    name = recording_file_name("simpler-bridge", "put-camera", 3, 0, "vap")
    sources = [tmp_path / run for run in ("a", "b", "damaged")]
    for source in sources:
        (source / "recordings").mkdir(parents=True)
        (source / "recordings" / name).write_bytes(b"")

    def summaries(paths: list[Path]) -> Generator[tuple[Path, dict[str, str] | None, str]]:
        for path in paths:
            damaged = "damaged" in path.parts
            yield path, None if damaged else {"policy": path.parts[-3]}, "damaged"

    monkeypatch.setattr("vap_core.recording.isolated.read_summaries", summaries)
    row = {
        "suite": "simpler-bridge",
        "task": "put-camera",
        "episode": 3,
        "seed": 0,
        "method": "vap",
    }
    for policy, found in (("b", [sources[1] / "recordings" / name]), ("c", [])):
        recorded = list(page._recorded([{**row, "policy": policy}], sources))
        assert [path for _, path in recorded] == found


def test_a_card_gives_a_command_for_a_shell(tmp_path: Path) -> None:
    row = dict.fromkeys(("suite", "task", "method", "case", "sub_case", "case_sentence"), "a")
    card = page._card({**row, "episode": 1, "deciding_frame": 2}, tmp_path / "a b.rrd", tmp_path)
    assert f"view &#x27;{tmp_path}/a b.rrd&#x27; --frame 2" in card


def test_pictures_show_every_line_and_overlap_nothing(tmp_path: Path) -> None:
    tasks = tuple(
        (name, task.name) for name in suites.BENCHMARKS for task in suites.suite(name).tasks
    )
    runs = load_runs([run(tmp_path / "run", tasks)])
    lines, compared = results(runs), compare(runs.table, runs.methods)
    for figure, count in (
        (forest_figure(lines), len(lines) // 2),
        (differences_figure(compared), len(compared)),
    ):
        figure.savefig(tmp_path / "drawn.png")
        (axes,) = figure.axes
        assert len(axes.get_yticks()) == count
        boxes = [
            text.get_window_extent()
            for text in (*axes.get_yticklabels(), *axes.texts, *figure.legends[0].get_texts())
        ]
        assert not any(a.overlaps(b) for i, a in enumerate(boxes) for b in boxes[:i])
        assert all(text.get_fontsize() >= 8 for text in (*axes.get_yticklabels(), *axes.texts))
    assert np.asarray(Image.open(tmp_path / "drawn.png").convert("L")).std() > 10


def test_methods_are_told_apart_by_colour_and_by_marker() -> None:
    marks = palette.method_marks(["generic", "vap", "mask-only", "rewrite-only", "vap-associated"])
    assert (
        len({colour for colour, _ in marks.values()})
        == len({marker for _, marker in marks.values()})
        == 5
    )
    assert marks["vap"] == palette.METHODS["vap"]
