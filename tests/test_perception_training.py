"""Perception is trained on generic objects alone, its targets and scores mean what they say, and interrupted training goes on."""

from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from vap_core.simulation.assets import objects
from vap_core.simulation.assets.phrases import UNSEEN
from vap_make.films import scenes
from vap_make.objects import draw, fabrics, generic_instance, textures
from vap_make.perception import detector, evaluation, instance_head, phrases, segmenter
from vap_make.perception import train as perception


@given(st.integers(0, 10**6), st.booleans())
def test_no_evaluation_object_is_ever_cast(seed: int, held_out: bool) -> None:
    models, crew = scenes.draw_objects(np.random.default_rng(seed), held_out)
    assert {model.split for model in models} == {"generic"}
    assert not {model.name for model in models} & set(objects.OBJECTS)
    numbers = [int(model.name.partition("-generic-")[2].partition("-")[0]) for model in models]
    assert all((number >= scenes.HELD_OUT) == held_out for number in numbers)
    assert len(set(numbers[:crew])) == len({model.category for model in models[:crew]}) == 1
    assert len({model.name for model in models[:crew]}) == crew >= 2


@given(st.sampled_from(objects.CATEGORIES), st.integers(0, 10**6), st.integers(1, 6))
def test_twins_are_look_alikes_and_found_by_name(kind: str, index: int, number: int) -> None:
    first, twin = (
        generic_instance(kind, index),
        generic_instance(kind, index, number),
    )
    assert twin.name == f"{first.name}-{number}"
    assert repr(draw(twin.name)) == repr(twin)
    assert (twin.category, twin.split) == (first.category, "generic")
    assert repr(twin.texture) != repr(first.texture)
    assert {twin.texture.motif, first.texture.motif} <= {
        *textures.GENERIC_GLYPHS,
        *textures.GENERIC_FILLS,
        *fabrics.GENERIC_FABRICS,
        *fabrics.GENERIC_CRAFTS,
    }


def test_evaluation_objects_are_refused() -> None:
    with pytest.raises(ValueError, match="cup-personal belong to evaluation"):
        scenes.only_generic([generic_instance("cup", 0), objects.personal_instance("cup")])


def test_the_same_stage_has_the_same_pixels() -> None:
    one, two = scenes.stage(4, 1, views=2), scenes.stage(4, 1, views=2)
    assert np.array_equal(one.rgb, two.rgb)
    assert np.array_equal(one.ids, two.ids)
    assert one.ids.max() <= len(one.names)


def test_unseen_phrases_are_unseen() -> None:
    trained = {phrase for words in phrases.SYNONYMS.values() for phrase in words} | set(
        phrases.NEGATIVES
    )
    assert not trained & (
        {p for words in UNSEEN.values() for p in words} | set(phrases.UNSEEN_NEGATIVES)
    )
    assert all(
        phrases.training_phrases(category)[0] == category
        for category in objects.CATEGORIES + objects.CLUTTER
    )


def test_targets_peak_at_centres_and_spare_the_ambiguous() -> None:
    view = [("cup", np.array([2.0, 2, 6, 8])), ("straw cup", np.array([10.0, 10, 14, 14]))]
    heat, weight, owns, box = detector.targets([view], ["cup", "straw cup", None], 16)
    assert [int((heat[0, q] == 1).sum()) for q in range(3)] == [1, 1, 0]
    assert heat[0, 0, 5, 4] == 1
    assert weight[0, 0, 12, 12] == 0
    assert weight[0, 1].min() == 1
    assert owns[0, 5, 4] == 1
    assert box[0, :, 5, 4].tolist() == [2, 2, 6, 8]


def test_contrast_is_the_cross_entropy_of_every_pair_against_the_others() -> None:
    cosine, same = (
        torch.tensor([[0.9, 0.1, -0.2], [0.0, 0.5, 0.4]]),
        torch.tensor([[True, False, False], [False, True, True]]),
    )
    e = np.exp(cosine.numpy() / instance_head.TEMPERATURE)
    slow = [
        -np.log(e[0, 0] / (e[0, 0] + e[0, 1] + e[0, 2])),
        -np.log(e[1, 1] / (e[1, 1] + e[1, 0])),
        -np.log(e[1, 2] / (e[1, 2] + e[1, 0])),
    ]
    assert instance_head.contrastive_loss(cosine, same).item() == pytest.approx(
        np.mean(slow), rel=1e-4
    )


def test_losses_vanish_when_right() -> None:
    view = [("cup", np.array([2.0, 2, 6, 8]))]
    heat, weight, owns, box = detector.targets([view], ["cup"], 16)
    sure = torch.where(heat == 1, 20.0, -20.0)
    assert detector.focal_loss(sure, heat, weight) < 1e-6
    rows, cols = torch.meshgrid(torch.arange(16) + 0.5, torch.arange(16) + 0.5, indexing="ij")
    exact = torch.stack([cols - 2, rows - 2, 6 - cols, 8 - rows])[None]
    assert detector.giou_loss(exact, owns, box).abs() < 1e-6
    assert segmenter.mask_loss(torch.full((1, 8, 8), 20.0), torch.ones(1, 8, 8)) < 1e-3


def test_average_precision_of_known_rankings() -> None:
    wanted, far = np.array([[0.0, 0, 10, 10], [20, 20, 30, 30]]), np.array([50.0, 50, 60, 60])
    none = np.zeros((0, 4))
    right, one_wrong = np.stack([wanted[0], wanted[1]]), np.stack([far, wanted[0], wanted[1]])
    score = np.array([0.9, 0.8, 0.7])
    assert evaluation.precision_of_views([((right, score[:2]), wanted, none)], 0.5) == 1
    assert evaluation.precision_of_views(
        [((one_wrong, score), wanted, none)], 0.5
    ) == pytest.approx(2 / 3, abs=1e-4)
    assert evaluation.precision_of_views([((one_wrong, score), wanted, far[None])], 0.5) == 1
    assert evaluation.precision_of_views([((none, score[:0]), none, none)], 0.5) is None


@pytest.mark.sweep
def test_training_is_a_command_that_resumes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(perception, "EPOCHS", {"detector": 2, "segmenter": 1, "looks": 2})
    monkeypatch.setattr(perception, "CROPS_PER_EPOCH", 32)
    exported: list[Path] = []  # test_runtime exports: code whose shapes are checked is not traced
    monkeypatch.setattr(perception, "export_graphs", exported.append)
    cache = tmp_path / "cache"
    halted = perception.train(
        tmp_path / "halted", scenes=12, seed=1, minutes=0.0, cache=cache, jobs=1
    )
    assert halted is None
    assert not list((tmp_path / "halted").iterdir()), "heads that were not trained to the end"
    resumed = perception.train(tmp_path / "out", scenes=12, seed=1, cache=cache)
    straight = perception.train(tmp_path / "again", scenes=12, seed=1, resume=False, cache=cache)
    assert resumed is not None
    assert straight is not None
    assert exported == [tmp_path / name for name in ("out", "again")]
    assert resumed["measured"] == straight["measured"]
    assert resumed["views"] == 12
    assert (tmp_path / "out" / perception.PERCEPTION).read_bytes() == (
        tmp_path / "again" / perception.PERCEPTION
    ).read_bytes()
