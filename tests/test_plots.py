"""Figures show what they were given; tables against ground truth are exact."""

import numpy as np
import pandas as pd
import pytest

from tests.test_breakdown import TABLE, row
from tests.toys import TOYS, personal, scene
from vap_core.analysis.inspection import grounding_table
from vap_core.analysis.plots import (
    Tile,
    candidates,
    film,
    grounding_figure,
    learning_figure,
    rates_figure,
    sheet,
)
from vap_core.attend import Attender
from vap_core.base.pictures import METHODS, SUITES, THIN_LINES, write_png
from vap_core.perception.boxes import mask_iou
from vap_core.study.charts import (
    cases_figure,
    forest_figure,
    funnel_figure,
    scores_table,
    suites_figure,
    tasks_figure,
)
from vap_core.study.failures import breakdown, funnel_table
from vap_core.study.stats import rate, score

TEAL, GREY = (40, 120, 110), (90, 90, 90)
LINE = scene([(4, 20, GREY), (24, 20, TEAL)])


def test_iou_is_exact() -> None:
    one, other = np.zeros((4, 4), bool), np.zeros((4, 4), bool)
    one[:2], other[1:3] = True, True
    assert mask_iou(one, other) == pytest.approx(1 / 3)
    assert mask_iou(one & False, other & False) == 1.0
    assert mask_iou(one, one) == 1.0


def test_grounding_table_names_what_is_under_each_candidate() -> None:
    _, attended = Attender(TOYS, {"mug": personal("mug", "cup", TEAL)}).start(
        {"front": LINE}, "bring my cup"
    )
    truth = {"mug": (LINE == TEAL).all(axis=2), "other": (LINE == GREY).all(axis=2)}
    table = grounding_table(attended.groundings["front"][0], truth)
    assert table["is"].tolist() == ["other", "mug"]
    assert table.winner.tolist() == [False, True]
    assert table.iou.tolist() == [1.0, 1.0]
    nowhere = {"mug": np.eye(*LINE.shape[:2], dtype=bool)}
    table = grounding_table(attended.groundings["front"][0], nowhere)
    assert table["is"].tolist() == ["-", "-"]
    assert (table.iou < 0.1).all()


def test_grounding_figure_has_a_row_per_target_and_survives_no_candidate(tmp_path) -> None:
    objects = (personal("mug", "cup", TEAL), personal("ming", "nothing", GREY))
    _, attended = Attender(TOYS, {o.name: o for o in objects}).start(
        {"front": LINE}, "put my cup near my nothing"
    )
    figure = grounding_figure(LINE, attended, objects, "front")
    assert len(figure.subfigs) == 2
    write_png(figure, tmp_path / "a.png")
    write_png(grounding_figure(LINE, attended, objects, "front"), tmp_path / "b.png")
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()


def test_the_winner_is_drawn_apart() -> None:
    from matplotlib.figure import Figure

    _, attended = Attender(TOYS, {"mug": personal("mug", "cup", TEAL)}).start(
        {"front": LINE}, "bring my cup"
    )
    axes = Figure().subplots()
    candidates(axes, LINE, attended.groundings["front"][0])
    assert len({patch.get_edgecolor() for patch in axes.patches}) == 2


def test_the_number_of_a_box_at_the_top_stays_inside_the_picture() -> None:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    line = scene([(4, 0, GREY), (24, 20, TEAL)])
    _, attended = Attender(TOYS, {"mug": personal("mug", "cup", TEAL)}).start(
        {"front": line}, "bring my cup"
    )
    figure = Figure(figsize=(3, 3))
    FigureCanvasAgg(figure).draw()
    axes = figure.subplots()
    candidates(axes, line, attended.groundings["front"][0])
    figure.canvas.draw()
    assert min(axes.patches, key=lambda box: box.get_y()).get_y() == 0
    top = axes.get_window_extent().y1
    assert len(axes.texts) == 2
    assert all(text.get_window_extent().y1 <= top for text in axes.texts)


def test_what_a_sheet_says_is_dark_and_beside_its_picture() -> None:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.colors import to_rgb

    tiles = [Tile(LINE, "easy, 6", "#a5cde8"), Tile(LINE, "one\ntwo\nthree\nfour")]
    figure = sheet({"cup": tiles}, side_in=1.0, label_in=0.5)
    (axes,) = figure.axes
    FigureCanvasAgg(figure).draw()
    said = [text for text in axes.texts if text.get_text() != "cup"]
    assert all(max(to_rgb(text.get_color())) < 0.35 for text in said)
    boxes = [text.get_window_extent() for text in said]
    assert boxes[0].y1 == pytest.approx(boxes[1].y1, abs=2), "captions begin at one height"
    assert min(box.y0 for box in boxes) >= 0, "nothing is cut"
    large = sheet({"cup": tiles}, side_in=1.0, label_in=0.5, title_pt=11.0)
    FigureCanvasAgg(large).draw()
    said = [text for text in large.axes[0].texts if text.get_text() != "cup"]
    assert {text.get_fontsize() for text in said} == {11}
    assert min(text.get_window_extent().y0 for text in said) >= 0, "nothing is cut"


def test_scores_and_film_draw() -> None:
    episode = {
        "suite": "s",
        "task": "t",
        "split": "",
        "policy": "scripted",
        "outcome": "success",
        "success": True,
        "cmr": True,
        "wrong_object": False,
    }
    rows = [
        {**episode, "method": m, "first_object_correct": True, "steps": 3}
        for m in ("generic", "vap")
    ]
    (axes,) = forest_figure(scores_table(score(rows))).axes
    assert [tick.get_text() for tick in axes.get_yticklabels()] == ["t"]
    assert len(axes.containers) == 2
    assert len(film({"raw": [LINE, LINE]}, ["a", "b"]).axes) == 2


def test_the_funnel_has_a_panel_per_suite_and_a_line_per_method() -> None:
    table = pd.concat([TABLE, pd.DataFrame([row(stages=2, outcome="success")])])
    several = pd.concat(
        [table, table.assign(suite="tabletop"), table.assign(suite="simpler-bridge")]
    )
    figure = funnel_figure(funnel_table(several), {"vap": "red", "generic": "grey"})
    assert [len(axes.lines) for axes in figure.axes] == [5, 4, 4, 0]
    every_stage, success, _, generic_success = figure.axes[1].lines[:4]
    assert every_stage.get_ydata()[-1] == pytest.approx(40.0)
    assert list(success.get_ydata()) == pytest.approx([50.0]), "SR has a mark of its own"
    assert list(generic_success.get_ydata()) == [0.0]
    assert list(figure.axes[1].lines[2].get_xdata()) == [4, 5, 6], (
        "nothing is said of stages that a method does not have"
    )


def test_a_bar_of_cases_is_as_long_as_the_share_of_failures_and_vap_is_on_top() -> None:
    counts = breakdown(TABLE).set_index("method")
    axes = cases_figure(breakdown(TABLE)).axes[0]
    assert axes.get_xlabel() == "failures, % of episodes"
    ends: dict[float, float] = {}
    for patch in axes.patches:
        middle = patch.get_y() + patch.get_height() / 2
        ends[middle] = max(ends.get(middle, 0.0), patch.get_x() + patch.get_width())
    labels = [label.get_text() for label in axes.get_yticklabels()]
    assert labels[0] == "vap"
    for place, method in zip(axes.get_yticks(), labels, strict=True):
        percent = 100 * counts.loc[method, "failed"] / counts.loc[method, "n"]
        assert ends[place] == pytest.approx(percent)


def result(method: str, sr: float, bound: bool = False) -> dict[str, object]:
    """A line of `results.results`."""
    return {
        "suite": "tabletop",
        "split": "",
        "task": "put-plant",
        "method": method,
        "n": 20,
        "sr": sr,
        "sr_low": sr - 0.1,
        "sr_high": sr + 0.1,
        "sr_layout_low": float("nan"),
        "sr_layout_high": float("nan"),
        "bound": bound,
    }


def test_results_show_every_rate_and_put_bounds_last() -> None:
    lines = pd.DataFrame(
        [
            result("generic", sr=0.25),
            result("oracle-mask", sr=0.9, bound=True),
            result("vap", sr=0.75),
        ]
    )
    figure = suites_figure(lines, title="a finding")
    assert figure.get_suptitle() == "a finding"
    panel = figure.axes[0]
    assert [label.get_text() for label in panel.get_yticklabels()] == [
        "generic",
        "vap",
        "oracle-mask (bound)",
    ]
    assert [text.get_text() for text in panel.texts] == ["25", "75", "90"]
    matrix = tasks_figure(lines).axes[0]
    assert matrix.get_title().startswith("% of episodes that succeed")
    areas = [dots.get_sizes()[0] for dots in matrix.collections]
    assert areas[1] == pytest.approx(3 * areas[0]), "the area of a dot is the rate"
    bold = [text.get_text() for text in matrix.texts if text.get_fontweight() == "bold"]
    assert "75" in bold
    assert "90" not in bold, "a bound is never the highest"


def test_learning_has_a_panel_per_figure_and_a_line_per_training_that_logged_it() -> None:
    logs = {
        "one": [{"step": 1, "flow": 2.0, "hit": 0.5}, {"step": 2, "flow": 1.0, "hit": 0.75}],
        "other": [{"step": 1, "flow": 3.0}],
    }
    figure = learning_figure(logs, {"flow": "Flow", "hit": "Hit"})
    flow, hit = figure.axes
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["one", "other"]
    assert [axes.get_title() for axes in (flow, hit)] == ["Flow", "Hit"]
    assert [list(line.get_ydata()) for line in flow.lines] == [[2.0, 1.0], [3.0]]
    assert [list(line.get_ydata()) for line in hit.lines] == [[0.5, 0.75]]
    flow, hit = learning_figure(logs, {"flow": "Flow", "hit": "Hit"}, shares=["hit"]).axes
    assert 1 < hit.get_ylim()[1] < 1.1, "a share is read against the whole"
    assert flow.get_ylim()[1] > 2


def test_a_line_of_a_suite_has_its_colour_whatever_stands_behind_it() -> None:
    log = [{"step": 1, "flow": 2.0}, {"step": 2, "flow": 1.0}]
    named = {"vlabench": log, "vlabench (last training)": log, "tabletop (last training)": log}
    lines = learning_figure(named, {"flow": "Flow"}).axes[0].lines
    assert [line.get_color() for line in lines] == [
        SUITES["vlabench"][0],
        SUITES["vlabench"][0],
        THIN_LINES["tabletop"],
    ]


def test_rates_are_bars_as_high_as_they_are_with_their_intervals() -> None:
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    half, all_ = rate(2, 4), rate(4, 4)
    panels = {"suite": {"tinted": {"succeeds": half, "touches": all_}, "plain": {"succeeds": all_}}}
    figure = rates_figure(panels, "%", "instruction")
    (axes,) = figure.axes
    FigureCanvasAgg(figure).draw()
    (legend,) = figure.legends
    assert axes.get_xlabel() == "instruction"
    assert axes.xaxis.label.get_window_extent().y0 >= legend.get_window_extent().y1, "no overlap"
    assert [round(patch.get_height()) for patch in axes.patches] == [50, 100, 100]
    spread = [segment[:, 1] for held in axes.collections for segment in held.get_segments()]
    assert {(round(low, 6), round(high, 6)) for low, high in spread} == {
        (round(100 * r.low, 6), round(100 * r.high, 6)) for r in (half, all_)
    }


@pytest.mark.parametrize(("n", "rows", "columns"), [(1, 1, 1), (4, 1, 4), (5, 2, 3), (8, 2, 4)])
def test_many_panels_of_rates_are_in_several_rows(n: int, rows: int, columns: int) -> None:
    panels = {f"suite {i}": {"tinted": {"succeeds": rate(1, 2)}} for i in range(n)}
    figure = rates_figure(panels, "% of episodes", "instruction")
    drawn = [axes for axes in figure.axes if axes.axison]
    assert [axes.get_title() for axes in drawn] == list(panels)
    grid = drawn[0].get_gridspec()
    assert (grid.nrows, grid.ncols) == (rows, columns)
    first = [axes for axes in drawn if axes.get_subplotspec().is_first_col()]
    assert [axes.get_ylabel() for axes in first] == ["% of episodes"] * rows
    named = [axes for axes in drawn if axes.get_xlabel()]
    assert len(named) == 1
    assert named[0].get_subplotspec().is_last_row()
    assert figure.get_figwidth() < 13


def test_bars_of_methods_have_the_methods_colours() -> None:
    from matplotlib.colors import to_hex

    some = rate(1, 2)
    for names in (["generic", "VAP"], ["VAP", "soft"]):
        figure = rates_figure({"suite": {"cup": dict.fromkeys(names, some)}}, "%")
        drawn = [to_hex(patch.get_facecolor()) for patch in figure.axes[0].patches]
        assert drawn == [METHODS[name.lower()][0] for name in names]
    mixed = rates_figure({"suite": {"cup": {"succeeds": some, "vap": some}}}, "%").axes[0]
    assert to_hex(mixed.patches[1].get_facecolor()) != METHODS["vap"][0]


def test_groups_and_colours_have_one_order_in_every_panel() -> None:
    some = rate(1, 2)
    panels = {
        "first": {"cup": {"vap": some, "generic": some}, "shoe": {"vap": some, "generic": some}},
        "second": {"shoe": {"generic": some, "vap": some}, "cup": {"generic": some, "vap": some}},
    }
    figure = rates_figure(panels, "% of episodes")
    colours = []
    for axes in figure.axes:
        assert [tick.get_text() for tick in axes.get_xticklabels()] == ["cup", "shoe"]
        colours.append([patch.get_facecolor() for patch in axes.patches])
    assert colours[0] == colours[1]
