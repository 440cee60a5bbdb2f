"""Charts draw what they were given: every mark where its value is, told apart, and nothing cut."""

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_hex, to_rgb

from tests.test_breakdown import TABLE
from tests.test_report import run
from tests.toys import scene
from vap_core.base.pictures import METHODS, SUITES, THIN_LINES, method_marks, write_png
from vap_core.rollout.types import CASES
from vap_core.simulation import suites
from vap_core.study.charts import (
    Tile,
    bars,
    colours_of,
    curves,
    dots,
    film,
    funnel,
    names_in,
    sheet,
    stacked,
)
from vap_core.study.failures import breakdown, funnel_table
from vap_core.study.report import differences, forest
from vap_core.study.results import load_runs, results
from vap_core.study.stats import compare, rate, summary, tidy
from vap_core.study.table import printed, text_of

LINE = scene([(4, 20, (90, 90, 90)), (24, 20, (40, 120, 110))])
HALF, ALL = rate(2, 4), rate(4, 4)


def marks(**columns: Any) -> pd.DataFrame:
    """A row per mark: rates of four."""
    return tidy(pd.DataFrame({**columns, "sr": [HALF] * len(next(iter(columns.values())))}), ["sr"])


def test_a_summary_counts_groups_in_their_order_and_clusters_widen_it() -> None:
    rows = pd.DataFrame(
        {
            "method": ["vap"] * 4 + ["generic"] * 4,
            "won": [True, True, True, False, False, None, True, True],
            "scene": [1, 1, 2, 2, 1, 1, 2, 2],
        }
    )
    found = summary(rows, ["method"], share=["won"])
    assert found.method.tolist() == ["vap", "generic"]
    assert found.n.tolist() == [4, 4]
    assert [str(each) for each in found.won] == [str(rate(3, 4)), str(rate(2, 3))]
    clustered = summary(rows, ["method"], share=["won"], cluster=["scene"]).won[0]
    assert clustered.low < rate(3, 4).low
    assert tidy(found, ["won"]).value.tolist() == [0.75, 2 / 3]
    assert summary(rows.assign(won=1.0), mean=["won"], cluster=["scene"]).won[0].value == 1


@pytest.mark.parametrize(
    ("style", "wanted"),
    [
        ("markdown", r"| a\|b\x1b | - |"),
        ("html", "<td>a|b\\x1b</td>"),
        ("text", "a|b\\x1b"),
        ("csv", "'=1+1"),
    ],
)
def test_text_from_files_is_escaped_where_it_leaves(style: Any, wanted: str) -> None:
    text = "=1+1" if style == "csv" else "a|b\x1b"
    assert wanted in " ".join(printed(pd.DataFrame({"x": [text], "y": [None]}), style).split())
    assert text_of("a\nb") == "a\\nb"
    assert printed([["h"], ["<b>"]], "html").count("&lt;b&gt;") == 1


def test_pictures_of_a_report_show_every_line_and_overlap_nothing(tmp_path: Path) -> None:
    tasks = tuple(
        (name, task.name) for name in suites.BENCHMARKS for task in suites.suite(name).tasks
    )
    runs = load_runs([run(tmp_path / "run", tasks)])
    lines, compared = results(runs), compare(runs.table, runs.methods)
    for figure, count in ((forest(lines), len(lines) // 2), (differences(compared), len(compared))):
        figure.savefig(tmp_path / "drawn.png")
        (axes,) = figure.axes
        tracks = len(lines[["suite", "split"]].drop_duplicates())
        assert len(axes.get_yticks()) == count + tracks
        texts = (*axes.get_yticklabels(), *figure.legends[0].get_texts(), axes.xaxis.label)
        boxes = [text.get_window_extent() for text in texts]
        assert not any(a.overlaps(b) for i, a in enumerate(boxes) for b in boxes[:i])
        assert all(text.get_fontsize() >= 8 for text in texts)


def test_methods_are_told_apart_by_colour_and_by_marker() -> None:
    found = method_marks(["generic", "vap", "mask-only", "rewrite-only", "vap-associated"])
    assert len({colour for colour, _ in found.values()}) == 5
    assert len({marker for _, marker in found.values()}) == 5
    assert found["vap"] == METHODS["vap"]


def test_policies_of_one_method_are_told_apart() -> None:
    table = marks(task=["t"] * 8, method=["vap", "generic"] * 4, policy=list("aabbccdd"))
    axes = dots(table, "task", series="method", policy="policy").axes[0]
    drawn = {}
    for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
        line = handle[0]
        drawn[label] = (line.get_color(), line.get_marker(), line.get_markerfacecolor())
    assert len(drawn) == len(set(drawn.values())) == 8
    colour, marker = METHODS["vap"]
    assert drawn["vap, a policy"] == (colour, marker, colour)
    assert drawn["vap, b policy"] == (colour, marker, "white")


def test_a_mark_is_filled_or_hollow_and_the_papers_is_a_diamond() -> None:
    table = marks(task=["t", "u"]).assign(filled=[True, False], paper=[0.25, np.nan])
    axes = dots(table, "task").axes[0]
    faces = [container.lines[0].get_markerfacecolor() for container in axes.containers]
    assert faces[1] == "white" != faces[0]
    (diamond,) = (line for line in axes.lines if line.get_marker() == "D")
    assert diamond.get_xdata() == [25]


def test_a_rate_is_drawn_with_the_interval_over_layouts(tmp_path: Path) -> None:
    shaver = (("simpler-bridge", "pick-shaver"),)
    sources = [run(tmp_path / str(seed), shaver, seed=seed, methods=["vap"]) for seed in range(2)]
    lines = results(load_runs(sources))
    (container,) = forest(lines).axes[0].containers
    ((low, _), (high, _)) = container.lines[2][0].get_segments()[0]
    assert low == pytest.approx(100 * lines["sr_layout_low"][0])
    assert high == pytest.approx(100 * lines["sr_layout_high"][0])
    assert low != pytest.approx(100 * lines["sr_low"][0])


def test_panels_share_their_lines_where_they_are_the_same() -> None:
    table = marks(suite=["a", "a", "b", "b"], method=["vap", "soft"] * 2)
    figure = dots(table, "method", panel="suite", series="method", title="a finding")
    assert figure.get_suptitle() == "a finding"
    labels = [[text.get_text() for text in axes.get_yticklabels()] for axes in figure.axes]
    assert labels == [["vap", "soft"], ["", ""]]


def test_the_funnel_has_a_panel_per_suite_and_a_line_per_method() -> None:
    several = pd.concat(
        [TABLE, TABLE.assign(suite="tabletop"), TABLE.assign(suite="simpler-bridge")]
    )
    figure = funnel(funnel_table(several))
    # Of each method the stages, and success apart from them, to which no line leads.
    assert [len(axes.lines) for axes in figure.axes if axes.axison] == [4, 4, 4]
    assert [len(line.get_xdata()) for line in figure.axes[0].lines][1::2] == [1, 1]
    _, success, generic, _ = figure.axes[1].lines
    assert list(success.get_ydata()) == pytest.approx([100 * 4 / 9]), "SR has a place of its own"
    assert list(generic.get_xdata()) == [4, 5, 6], (
        "nothing is said of stages that a method does not have"
    )


def test_a_bar_of_cases_is_as_long_as_the_share_of_failures() -> None:
    counts = breakdown(TABLE)
    axes = stacked(counts, "method", list(CASES)).axes[0]
    ends: dict[float, float] = {}
    for patch in axes.patches:
        middle = round(patch.get_y() + patch.get_height() / 2, 6)
        ends[middle] = max(ends.get(middle, 0.0), patch.get_x() + patch.get_width())
    labels = [label.get_text() for label in axes.get_yticklabels()]
    assert labels == ["vlabench", "vap, n 9", "generic, n 2"]
    for place, line in zip((1, 2), counts.itertuples(), strict=True):
        assert ends[place] == pytest.approx(100 * line.failed / line.n)


def test_a_curve_goes_through_its_values_and_its_band_to_their_ends() -> None:
    table = pd.concat([marks(k=[1, 3, 5]).assign(rule=name) for name in ("vote", "average")])
    figure = curves(table.assign(paper=0.4), "k", series="rule")
    (axes,) = figure.axes
    vote, theirs, average, _ = axes.lines
    assert list(vote.get_xdata()) == [1, 3, 5]
    assert list(average.get_ydata()) == [50, 50, 50]
    assert (theirs.get_marker(), list(theirs.get_ydata())) == ("D", [40, 40, 40])
    band = axes.collections[0].get_paths()[0].vertices[:, 1]
    assert (band.min(), band.max()) == pytest.approx((100 * HALF.low, 100 * HALF.high))
    words = curves(marks(stage=["a", "b"]), "stage").axes[0]
    assert [tick.get_text() for tick in words.get_xticklabels()] == ["a", "b"]


def test_a_series_of_a_suite_has_its_colour_whatever_stands_behind_it() -> None:
    found = colours_of(["vlabench", "vlabench (last training)", "tabletop (last training)"])
    assert list(found.values()) == [
        SUITES["vlabench"][0],
        SUITES["vlabench"][0],
        THIN_LINES["tabletop"],
    ]
    assert list(colours_of(["generic", "VAP"]).values()) == [
        METHODS["generic"][0],
        METHODS["vap"][0],
    ]


def test_rates_are_bars_as_high_as_they_are_with_their_intervals() -> None:
    table = pd.DataFrame(
        {"way": ["tinted", "plain"], "succeeds": [HALF, ALL], "touches": [ALL] * 2}
    )
    rows = tidy(table, ["succeeds", "touches"])
    figure = bars(rows, "way", series="measure", label="%", label_x="instruction")
    (axes,) = figure.axes
    FigureCanvasAgg(figure).draw()
    (legend,) = figure.legends
    assert axes.get_xlabel() == "instruction"
    assert axes.xaxis.label.get_window_extent().y0 >= legend.get_window_extent().y1, "no overlap"
    assert [round(patch.get_height()) for patch in axes.patches] == [50, 100, 100, 100]
    spread = [segment[:, 1] for held in axes.collections for segment in held.get_segments()]
    assert {(round(low, 6), round(high, 6)) for low, high in spread} == {
        (round(100 * r.low, 6), round(100 * r.high, 6)) for r in (HALF, ALL)
    }


def test_groups_and_colours_have_one_order_in_every_panel() -> None:
    table = marks(
        suite=["a"] * 2 + ["b"] * 2, what=["cup", "shoe", "shoe", "cup"], method=["vap"] * 4
    )
    figure = bars(table, "what", panel="suite", series="method")
    for axes in figure.axes:
        assert [tick.get_text() for tick in axes.get_xticklabels()] == ["cup", "shoe"]
        assert {to_hex(patch.get_facecolor()) for patch in axes.patches} == {METHODS["vap"][0]}
    assert names_in(table, "") == [""]


def test_what_a_sheet_says_is_dark_and_beside_its_picture(tmp_path: Path) -> None:
    tiles = [Tile(LINE, "easy, 6", "#a5cde8"), Tile(LINE, "one\ntwo\nthree\nfour")]
    for size in (7.0, 11.0):
        figure = sheet({"cup": tiles}, side_in=1.0, label_in=0.5, title_pt=size)
        (axes,) = figure.axes
        FigureCanvasAgg(figure).draw()
        said = [text for text in axes.texts if text.get_text() != "cup"]
        assert all(max(to_rgb(text.get_color())) < 0.35 for text in said)
        boxes = [text.get_window_extent() for text in said]
        assert boxes[0].y1 == pytest.approx(boxes[1].y1, abs=2), "captions begin at one height"
        assert min(box.y0 for box in boxes) >= 0, "nothing is cut"
        assert {text.get_fontsize() for text in said} == {size}
    (strip,) = film({"raw": [LINE, LINE]}, ["a", "b"]).axes
    assert len(strip.images) == 2
    write_png(figure, tmp_path / "a.png")
    write_png(sheet({"cup": tiles}, side_in=1.0, label_in=0.5, title_pt=11.0), tmp_path / "b.png")
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()
