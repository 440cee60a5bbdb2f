"""Pictures of a grounding show what they were given; the table against ground truth is exact."""

import numpy as np
import pytest

from tests.toys import TOYS, personal, scene
from vap_core.attend import Attender
from vap_core.base.pictures import write_png
from vap_core.perception.boxes import mask_iou
from vap_core.study.grounding import candidates, grounding_figure
from vap_core.study.inspection import grounding_table

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
