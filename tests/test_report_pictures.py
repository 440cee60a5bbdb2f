"""The pictures of a report: every line of its tables, methods told apart, the right recording."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.test_report import run
from vap_core.base import pictures
from vap_core.base.errors import BadRecording
from vap_core.recording import recording_file_name
from vap_core.simulation import suites
from vap_core.study import report
from vap_core.study.charts import differences_figure, forest_figure, funnel_figure
from vap_core.study.failures import FunnelRow
from vap_core.study.results import load_runs, results
from vap_core.study.stats import compare


def test_a_failure_is_pictured_by_the_recording_of_its_own_policy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two runs of one suite and method, with different policies, name their files alike."""
    name = recording_file_name("simpler-bridge", "put-camera", 3, 0, "vap")
    sources = [tmp_path / run for run in ("a", "b", "damaged")]
    for source in sources:
        (source / "recordings").mkdir(parents=True)
        (source / "recordings" / name).write_bytes(b"")

    row = {
        "suite": "simpler-bridge",
        "task": "put-camera",
        "episode": 3,
        "seed": 0,
        "method": "vap",
    }
    whole = {**row, "outcome": "failure", "steps": 60}
    said = whole

    def summary(path: Path) -> dict[str, object]:
        if "damaged" in path.parts:
            raise BadRecording("damaged")
        return {**said, "policy": path.parts[-3]}

    monkeypatch.setattr("vap_core.recording.read_summary", summary)
    of_b = {**row, "policy": "b"}
    path = sources[1] / "recordings" / name
    assert list(report._recorded([of_b], sources)) == [(of_b, path)]
    assert not list(report._recorded([{**row, "policy": "c"}], sources))
    for other in ({**whole, "episode": 4}, {**whole, "method": "generic"}, row):
        said = other
        assert not list(report._recorded([of_b], sources))


def test_a_card_gives_a_command_for_a_shell(tmp_path: Path) -> None:
    row = dict.fromkeys(("suite", "task", "method", "case", "sub_case", "case_sentence"), "a")
    card = report._card({**row, "episode": 1, "deciding_frame": 2}, tmp_path / "a b.rrd", tmp_path)
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
    marks = pictures.method_marks(["generic", "vap", "mask-only", "rewrite-only", "vap-associated"])
    assert (
        len({colour for colour, _ in marks.values()})
        == len({marker for _, marker in marks.values()})
        == 5
    )
    assert marks["vap"] == pictures.METHODS["vap"]


def test_policies_of_one_method_are_told_apart(tmp_path: Path) -> None:
    shaver = (("simpler-bridge", "pick-shaver"),)
    sources = []
    for name in "abcd":
        sources.append(
            run(tmp_path / name, tasks=shaver, methods=["generic", "vap"], label=name, policy=name)
        )
    handles, labels = forest_figure(results(load_runs(sources))).axes[0].get_legend_handles_labels()
    marks = {}
    for handle, label in zip(handles, labels, strict=True):
        marks[label] = (
            handle[0].get_color(),
            handle[0].get_marker(),
            handle[0].get_markerfacecolor(),
        )
    assert len(labels) == len(set(marks.values())) == 8
    colour, marker = pictures.METHODS["vap"]
    assert marks["vap, a policy"] == (colour, marker, colour)
    assert marks["vap, b policy"] == (colour, marker, "white")


def test_policies_of_one_method_have_a_marker_each_in_the_funnel() -> None:
    left = (None, None, None, None, 3, 2, 1)
    names = ("vap", "vap, a", "vap, b", "generic, a", "generic, b")
    rows = [FunnelRow(suite="s", method=name, n=4, left=left, succeeded=1) for name in names]
    figure = funnel_figure(rows)
    lines = [line for line in figure.axes[0].lines if len(line.get_xdata()) > 1]
    assert [line.get_marker() for line in lines] == ["o", "^", "s", "o", "^"]


def test_a_difference_is_filled_after_holms_correction_alone(tmp_path: Path) -> None:
    runs = load_runs([run(tmp_path / "run")])
    compared = compare(runs.table, runs.methods)[0]
    pictured = []
    for p_holm in (0.08, 0.04):
        figure = differences_figure([replace(compared, p=0.03, p_holm=p_holm)])
        (container,) = figure.axes[0].containers
        pictured.append(container.lines[0].get_markerfacecolor())
    assert pictured == ["white", pictures.METHODS["vap"][0]]


def test_a_rate_is_drawn_with_the_interval_over_layouts(tmp_path: Path) -> None:
    shaver = (("simpler-bridge", "pick-shaver"),)
    sources = []
    for seed in range(2):
        sources.append(run(tmp_path / str(seed), shaver, seed=seed, methods=["vap"]))
    lines = results(load_runs(sources))
    (container,) = forest_figure(lines).axes[0].containers
    ((low, _), (high, _)) = container.lines[2][0].get_segments()[0]
    assert low == pytest.approx(100 * lines["sr_layout_low"][0])
    assert high == pytest.approx(100 * lines["sr_layout_high"][0])
    assert low != pytest.approx(100 * lines["sr_low"][0])
