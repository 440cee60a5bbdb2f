"""Pictures of the benchmarks: the stage is the studio, sheets are complete, tables are exact."""

from dataclasses import replace
from io import BytesIO

import numpy as np
import pandas as pd
import pytest
from PIL import Image

from vap_core import notebook as gallery
from vap_core.base.pictures import empty_figure
from vap_core.notebook import GOALS, STEMS, keep, layouts_figure
from vap_core.perception.references import crop
from vap_core.simulation.assets.objects import TIERS, lookalikes, personal_instance
from vap_core.simulation.studio import PORTRAIT, Shot, Stage, photograph
from vap_core.simulation.suites import BENCHMARKS, VARIANTS, lists
from vap_core.study.charts import Tile, sheet
from vap_make.objects import generic_instance

CUP, PLANT = personal_instance("cup"), personal_instance("plant")
ASIDE = Shot(1.1, 0.7, 0.6, -0.9, 0.55, (0.5, 0.6, 0.7))
FRACTAL = lists.read("simpler-fractal")


@pytest.fixture(scope="module")
def stage():
    with Stage([PLANT, CUP, *lookalikes("cup")[:2]], 96) as made:
        yield made


class Mean:
    """An encoder that sees the mean colour alone."""

    name = "mean"

    def __call__(self, crops):
        rows = np.array([crop.reshape(-1, 3).mean(axis=0) for crop in crops], np.float32)
        return rows / np.linalg.norm(rows, axis=1, keepdims=True)


def test_the_stage_takes_the_studio_s_pictures(stage):
    for shot in (PORTRAIT, ASIDE, PORTRAIT):
        assert np.array_equal(stage.picture(CUP.name, shot), photograph(CUP, [shot], 96)[0])


def test_every_personal_object_has_a_row_from_hard_to_easy():
    assert len(STEMS) == len(set(STEMS)) == 19
    for stem in STEMS:
        ranks = [TIERS.index(gallery.tier(model)) for model in gallery.lookalikes_by_tier(stem)]
        assert ranks == sorted(ranks)
        assert {model.name for model in gallery.lookalikes_by_tier(stem)} == {
            model.name for model in lookalikes(stem)
        }
    assert {model.name for model in GOALS} >= {
        row.goal for name in BENCHMARKS for row in lists.read(name) if row.goal
    }


def test_generics_are_in_rows():
    kinds = {kind: [generic_instance(kind, i) for i in range(2)] for kind in ("cup", "toy bus")}
    rows = gallery.object_sheet(kinds, size=48)
    assert list(rows) == ["cup", "toy\nbus"]
    assert [tile.picture.shape for tile in rows["cup"]] == [(48, 48, 3)] * 2
    assert not np.array_equal(rows["cup"][0].picture, rows["cup"][1].picture)


def test_hardness_is_the_mean_cosine(stage, monkeypatch):
    monkeypatch.setattr(gallery, "STEMS", ("cup",))
    monkeypatch.setattr(gallery, "lookalikes_by_tier", lambda stem: lookalikes(stem)[:2])
    table = gallery.hardness(stage, Mean())
    references = Mean()(
        [
            crop(stage.picture(CUP.name, shot), stage.box(CUP.name, shot))
            for shot in gallery.REFERENCES
        ]
    )
    one = Mean()(
        [
            crop(stage.picture(table.lookalike[0], shot), stage.box(table.lookalike[0], shot))
            for shot in gallery.QUERIES
        ]
    )
    assert table.cosine[0] == pytest.approx(float((one @ references.T).mean()))
    assert table.own.nunique() == 1
    assert table.fooled.between(0, 1).all()


def test_pairs_out_of_order_are_found():
    table = pd.DataFrame(
        {
            "object": ["cup"] * 3,
            "lookalike": list("abc"),
            "tier": ["hard", "medium", "easy"],
            "cosine": [0.6, 0.8, 0.7],
        }
    )
    wrong = gallery.out_of_order(table)
    assert list(zip(wrong.lookalike, wrong.lookalike_easier, wrong.gap.round(6), strict=True)) == [
        ("a", "b", 0.2),
        ("a", "c", 0.1),
    ]
    assert not len(gallery.out_of_order(table.assign(cosine=[0.9, 0.8, 0.7])))


def test_the_census_counts_every_row_once():
    counts = gallery.census({name: lists.read(name) for name in BENCHMARKS})
    assert counts.groupby("suite").episodes.sum().to_dict() == {
        "simpler-bridge": 96,
        "simpler-fractal": 1685,
        "tabletop": 160,
        "vlabench": 250,
    }
    assert counts[counts.suite == "simpler-fractal"].episodes.tolist() == [300, 825, 160, 400]


def test_all_variants_return_to_one_layout():
    held = gallery.same_layout(FRACTAL, FRACTAL[12])
    assert list(held) == list(VARIANTS)
    assert all(
        [p.model for p in row.placements[:3]] == [p.model for p in FRACTAL[12].placements]
        and row.variant == name
        for name, row in held.items()
    )
    assert {len(row.placements) for row in held.values()} == {3, 5, 6}


def test_what_is_seen_moves_with_the_expert():
    row = replace(
        lists.read("simpler-bridge")[0], placements=lists.read("simpler-bridge")[0].placements[:1]
    )
    before, again, after = (
        gallery.camera_images(row, size=64),
        gallery.camera_images(row, size=64),
        gallery.camera_images(row, steps=6, size=64),
    )
    assert list(before) == ["front"]
    assert np.array_equal(before["front"], again["front"])
    assert not np.array_equal(before["front"], after["front"])


def test_a_sheet_keeps_the_pictures_proportions():
    tall = Tile(np.zeros((20, 10, 3), np.uint8), "tall", "#c0392b")
    axes = sheet({"a": [tall, tall], "b": [tall]}, columns=2).axes[0]
    assert len(axes.images) == 3
    assert len(axes.patches) == 3
    for image in axes.images:
        x0, x1, y0, y1 = image.get_extent()
        assert abs(y1 - y0) == pytest.approx(2 * abs(x1 - x0))


def test_a_kept_figure_fits(tmp_path):
    noise = np.random.default_rng(0).integers(0, 256, (200, 200, 3), np.uint8)
    figure = sheet({"": [Tile(noise)] * 4})
    jpeg = keep(figure, tmp_path / "a.png", limit=60_000, small=20_000)
    keep(figure, tmp_path / "b.png", limit=60_000, small=20_000)
    assert (tmp_path / "a.png").stat().st_size <= 60_000
    assert len(jpeg) <= 20_000
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()
    assert Image.open(BytesIO(jpeg)).format == "JPEG"
    assert not (tmp_path / "a.svg").exists(), "a figure with pictures"


def test_a_plot_is_kept_as_an_svg_too_the_same_each_time(tmp_path):
    for name in ("a", "b"):
        figure = empty_figure(3.0, 2.0)
        figure.subplots().plot([1, 2], [3, 4], label="one")
        keep(figure, tmp_path / f"{name}.png")
    assert (tmp_path / "a.svg").read_bytes() == (tmp_path / "b.svg").read_bytes()
    figure.axes[0].scatter(range(9000), range(9000))
    keep(figure, tmp_path / "c.png")
    assert not (tmp_path / "c.svg").exists(), "too large"


def test_layouts_draw():
    built = {name: lists.read(name) for name in ("simpler-bridge", "tabletop")}
    figure = layouts_figure(built, dict.fromkeys(built, (0.0, -0.5, 0.8, 0.5)))
    assert len(figure.axes) == 2
    corners = {
        tuple(offset)
        for c in figure.axes[0].collections
        for offset in np.round(np.asarray(c.get_offsets()), 4)
    }
    assert corners == {(x, y) for x in (-0.075, 0.075) for y in (0.19, 0.34)}
    marks = [each for each in figure.legends[0].legend_handles if hasattr(each, "get_sizes")]
    assert len(marks) == 4
    assert min(mark.get_sizes()[0] for mark in marks) >= 30, "a legend's dots can be seen"
