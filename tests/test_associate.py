"""Cross-view association against brute force, by hand-made cameras, and on a rendered scene of three cameras."""

from dataclasses import replace
from itertools import combinations, product

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from vap_core.associate import (
    ASTRAY,
    EVIDENCE,
    HIDDEN,
    RELIANCE,
    SIGMA_M,
    SLACK,
    SPREAD_M,
    Sighting,
    associate,
    compare_views,
    geometry,
    ray_distance_m,
    references,
)
from vap_core.base.errors import BadViews
from vap_core.base.types import Camera
from vap_core.vote import vote

NAMES = ("front", "side", "wrist", "top")


def overhead(name: str, x: float, y: float = 0.0) -> Camera:
    """Looks straight down from 1 m above (x, y): the picture's right is the world's x, its top the world's y; 1 px is 1 cm on the table."""
    pose = np.diag([1.0, -1.0, -1.0, 1.0])
    pose[:3, 3] = x, y, 1.0
    return Camera(name, 200, 200, np.array([[100.0, 0, 100], [0, 100.0, 100], [0, 0, 1]]), pose)


def boxes(camera: Camera, points_m: list[tuple[float, float, float]]) -> np.ndarray:
    """10 px boxes whose middles are the pixels of world points."""
    local = (
        np.array(points_m, np.float64).reshape(-1, 3) - camera.pose_world[:3, 3]
    ) @ camera.pose_world[:3, :3]
    middle = (local @ camera.k.T)[:, :2] / local[:, 2:]
    return np.concatenate([middle - 5, middle + 5], axis=1).astype(np.float32)


def unit(rows: np.ndarray) -> np.ndarray:
    return (rows / np.linalg.norm(rows, axis=1, keepdims=True)).astype(np.float32)


def sighting(rng: np.random.Generator, name: str, n: int) -> Sighting:
    embeddings, memory = (
        unit(rng.normal(size=(n, 4)).reshape(n, 4)) if n else np.zeros((0, 4), np.float32),
        unit(rng.normal(size=(3, 4))),
    )
    camera = overhead(name, *rng.uniform(-0.3, 0.3, 2))
    return Sighting(
        embeddings @ memory.T,
        boxes(camera, [tuple(rng.uniform((-0.3, -0.3, 0), (0.3, 0.3, 0.08))) for _ in range(n)]),
        camera,
    )


scenes = st.tuples(st.integers(0, 2**31), st.lists(st.integers(0, 3), min_size=2, max_size=4)).map(
    lambda drawn: {
        name: sighting(rng, name, n)
        for rng in [np.random.default_rng(drawn[0])]
        for name, n in zip(NAMES, drawn[1], strict=False)
    }
)


def two_sighted(views: dict[str, Sighting]) -> bool:
    return sum(len(view.xyxy) > 0 for view in views.values()) >= 2


def slow(views: dict[str, Sighting]) -> dict[tuple[int | None, ...], float]:
    """The score of every combination, written out."""
    sights = list(views.values())

    def distance(row: np.ndarray) -> float:
        to_all, to_likest = 1 - float(np.float64(row).mean()), 1 - float(np.float64(row).max())
        return (max(to_all, 1e-3) * max(to_likest, 1e-3)) ** 0.5

    away = [[distance(row) for row in view.cosine] for view in sights]
    least = min(min(of_view) for of_view in away if of_view)

    def single(v: int, i: int | None) -> float:
        if i is None:
            of_view = [single(v, j) for j in range(len(away[v]))]
            return HIDDEN * float(np.mean(of_view)) - SLACK if of_view else 0.0
        best = min(away[v])
        return EVIDENCE * (least / best) ** RELIANCE * np.log(best / away[v][i])

    def pair(a: Sighting, i: int | None, b: Sighting, j: int | None) -> float:
        return 0.0 if i is None or j is None else float(geometry(a, b)[i, j])

    return {
        choice: sum(single(v, i) for v, i in enumerate(choice))
        + sum(
            pair(sights[v], choice[v], sights[w], choice[w])
            for v, w in combinations(range(len(sights)), 2)
        )
        for choice in product(*[[*range(len(view.xyxy)), None] for view in sights])
    }


@settings(max_examples=40)
@given(views=scenes.filter(two_sighted))
def test_equals_brute_force(views: dict[str, Sighting]) -> None:
    every = slow(views)
    best = max(every, key=lambda choice: every[choice])
    rival = max(  # another object: no candidate of the best choice
        score
        for choice, score in every.items()
        if all(i != j or i is None for i, j in zip(choice, best, strict=True))
    )
    found = associate(views)
    if every[best] - rival < 1e-5:
        assert found is None or every[best] - rival > 0
        return
    assert tuple(found.chosen.values()) == best
    assert found.total == pytest.approx(every[best], abs=1e-9)
    assert found.margin == pytest.approx(every[best] - rival, abs=1e-9)
    assert sum(found.terms.values()) == pytest.approx(found.total, abs=1e-9)
    for v, (camera, view) in enumerate(views.items()):
        slots = [*range(len(view.xyxy)), None]
        assert found.support[camera].tolist() == pytest.approx(
            [max(s for c, s in every.items() if c[v] == i) for i in slots], abs=1e-9
        )
    assert any(i is not None for i in best)


@settings(max_examples=20)
@given(views=scenes.filter(two_sighted), seed=st.integers(0, 99))
def test_the_order_of_candidates_and_of_views_does_not_matter(
    views: dict[str, Sighting], seed: int
) -> None:
    rng = np.random.default_rng(seed)
    orders = {camera: rng.permutation(len(view.xyxy)) for camera, view in views.items()}
    mixed = {
        c: Sighting(views[c].cosine[o], views[c].xyxy[o], views[c].camera)
        for c, o in orders.items()
    }
    every = sorted(slow(views).values())
    assume(every[-1] - every[-2] > 1e-6)  # equal choices go to what is listed first
    before = associate(views)
    after = associate({c: mixed[c] for c in rng.permutation(list(mixed)).tolist()})
    assume(before is not None)
    assert {
        c: None if i is None else int(orders[c][i]) for c, i in after.chosen.items()
    } == before.chosen
    assert after.margin == pytest.approx(before.margin, abs=1e-9)


@settings(max_examples=30)
@given(views=scenes.filter(two_sighted), scale=st.floats(0.1, 1.0))
def test_references_count_ratios_of_distances_only(
    views: dict[str, Sighting], scale: float
) -> None:
    """An encoder that finds everything `scale` times as far apart says the same."""
    assume(all((1 - view.cosine.mean(axis=1) > 0.02).all() for view in views.values()))
    closer = [
        replace(view, cosine=(1 - scale * (1 - view.cosine)).astype(np.float32))
        for view in views.values()
    ]
    for one, other in zip(references(list(views.values())), references(closer), strict=True):
        assert other == pytest.approx(one, abs=0.01)


def test_the_likest_reference_weighs_as_much_as_all() -> None:
    """Distances .1 and .9 to two references: .5 on average; the geometric mean of .1 and .5."""
    cosine = np.array([[0.9, 0.1], [0.5, 0.5]], np.float32)
    empty = Sighting(np.zeros((0, 2), np.float32), np.zeros((0, 4), np.float32))
    scores, nothing = references([Sighting(cosine, np.zeros((2, 4), np.float32)), empty])
    expected = EVIDENCE * np.log(0.5 / np.sqrt(0.1 * 0.5))
    assert scores[0] - scores[1] == pytest.approx(expected, abs=1e-4)
    assert nothing.tolist() == [0.0]


def test_an_object_that_one_view_hides_does_not_lose_to_one_that_all_show() -> None:
    """Two of three cameras show the target, a little likelier there; all show a look-alike."""
    both = np.array([[0.8], [0.7]], np.float32)
    views = {
        "front": replace(view(FRONT, 0.0, mine=MINE, other=OTHER), cosine=both),
        "side": replace(view(SIDE, 0.0, mine=MINE, other=OTHER), cosine=both),
        "wrist": replace(view(WRIST, 0.0, other=OTHER, third=THIRD), cosine=both - 0.1),
    }
    assert associate(views).chosen == {"front": 0, "side": 0, "wrist": None}


def test_a_view_that_is_less_like_the_references_counts_less() -> None:
    """Distances .1 and .2 in the one view, .2 and .4 in the other: the ratio is the same."""
    near, far = (np.array([[1 - d], [1 - 2 * d]], np.float32) for d in (0.1, 0.2))
    views = [Sighting(cosine, np.zeros((2, 4), np.float32)) for cosine in (near, far)]
    of_near, of_far = references(views)
    assert of_near[0] - of_near[1] == pytest.approx(EVIDENCE * np.log(2), abs=1e-4)
    assert of_far[0] - of_far[1] == pytest.approx(0.5**RELIANCE * EVIDENCE * np.log(2), abs=1e-4)


def test_geometry_recovers_true_correspondences() -> None:
    """Two overhead cameras 0.5 m apart; every distance can be reckoned by hand."""
    left, right = overhead("left", 0.0), overhead("right", 0.5)
    spots = [(0.1, 0.2, 0.0), (0.3, 0.2, 0.0)]
    a, b = (
        Sighting(np.zeros((2, 1), np.float32), boxes(camera, spots), camera)
        for camera in (left, right)
    )
    # The first ray of `left` leans -0.1 m per metre up, the second of `right` 0.2: apart 0.2 m on the table, more above it. The other pair
    # leans towards each other by 0.7: 0.2 - 0.08 * 0.7 at the greatest height.
    assert ray_distance_m(a, b) == pytest.approx(np.array([[0.0, 0.2], [0.144, 0.0]]), abs=1e-6)
    near, far = (SPREAD_M / SIGMA_M) ** 2 * np.exp([0.0, -0.5 * (0.144 / SIGMA_M) ** 2])
    same, apart = ASTRAY + (1 - ASTRAY) * near, ASTRAY + (1 - ASTRAY) * far
    assert geometry(a, b)[:, 0] == pytest.approx([0.0, np.log(apart / same)], abs=1e-4)
    lifted = replace(b, xyxy=boxes(right, [(0.1, 0.2, 0.05), (0.3, 0.2, 0.2)]))
    over = replace(a, xyxy=boxes(left, [(0.1, 0.2, 0.05), (0.3, 0.2, 0.2)]))
    # At 0.2 m the middle is above anything that stands on a table: both rays pass 0.08 m high 0.12 m short of where they meet.
    assert np.diag(ray_distance_m(over, lifted)) == pytest.approx([0.0, 0.12 * 0.5 / 0.8], abs=1e-6)


def test_a_ray_above_the_horizon_meets_nothing() -> None:
    level = np.eye(4)
    level[:3, :3], level[:3, 3] = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]), (-1.0, 0.0, 0.5)
    ahead = Camera("ahead", 200, 200, overhead("", 0).k, level)
    up = Sighting(
        np.zeros((2, 1), np.float32),
        np.array([[95, 20, 105, 30], [95, 145, 105, 155]], np.float32),
        ahead,
    )
    down = Sighting(
        np.zeros((1, 1), np.float32),
        boxes(overhead("", 0), [(0.0, 0.0, 0.0)]),
        overhead("", 0),
    )
    assert ray_distance_m(up, down).ravel().tolist() == [np.inf, pytest.approx(0.0, abs=1e-6)]
    same = ASTRAY + (1 - ASTRAY) * (SPREAD_M / SIGMA_M) ** 2
    assert geometry(up, down)[0, 0] == pytest.approx(np.log(ASTRAY / same))


MINE, OTHER, THIRD = np.eye(6)[0], np.eye(6)[1], np.eye(6)[2]
SHARED = 2.0 * np.eye(6)[3]
"""What all of one category have in common."""
SPOT = {"mine": (0.0, 0.05, 0.02), "other": (0.15, -0.1, 0.03), "third": (-0.15, -0.1, 0.02)}


def view(camera: Camera, light: float, **seen: np.ndarray) -> Sighting:
    """Objects by name with their looks; `light` shifts every look alike."""
    looks = unit(np.stack([look + SHARED + light * np.eye(6)[4] for look in seen.values()]))
    return Sighting(
        looks @ unit(np.stack([MINE + SHARED])).T,
        boxes(camera, [SPOT[name.removesuffix("_again")] for name in seen]),
        camera,
    )


FRONT, SIDE, WRIST = (
    overhead("front", 0.3),
    overhead("side", 0.0, -0.3),
    overhead("wrist", -0.1, 0.1),
)
CASE_2 = {
    "front": view(FRONT, 0.0, other=OTHER, mine=MINE, third=THIRD),
    "side": view(SIDE, 0.3, mine=0.7 * MINE + 0.3 * THIRD, other=OTHER, third=THIRD + 0.1 * MINE),
    "wrist": view(
        WRIST, 0.6, third=THIRD, mine=0.5 * MINE + 0.1 * OTHER, other=0.55 * MINE + 0.8 * OTHER
    ),
}
RIGHT = {"front": 1, "side": 0, "wrist": 1}


def test_views_that_contradict_each_other_agree_when_asked_together() -> None:
    worse = {
        **CASE_2,
        "wrist": replace(
            CASE_2["wrist"],
            cosine=CASE_2["wrist"].cosine + np.array([[0.0], [0.0], [0.06]], np.float32),
        ),
    }
    alone = {camera: vote(one.cosine).winner for camera, one in worse.items()}
    assert alone == {**RIGHT, "wrist": 2}
    assert associate(worse).chosen == RIGHT


def test_a_view_that_does_not_show_the_target_chooses_none() -> None:
    """The wrist sees the look-alikes only, and would have to choose one of them by itself."""
    absent = {**CASE_2, "wrist": view(WRIST, 0.6, third=THIRD, other=OTHER)}
    assert vote(absent["wrist"].cosine).winner is not None
    assert associate(absent).chosen == {**RIGHT, "wrist": None}


def test_a_distractor_proposed_twice_in_every_view_changes_nothing() -> None:
    twice = {
        "front": view(FRONT, 0.0, other=OTHER, mine=MINE, third=THIRD, third_again=THIRD),
        "side": view(
            SIDE,
            0.3,
            mine=0.7 * MINE + 0.3 * THIRD,
            other=OTHER,
            third=THIRD + 0.1 * MINE,
            third_again=THIRD + 0.1 * MINE,
        ),
        "wrist": view(
            WRIST,
            0.6,
            third=THIRD,
            mine=0.5 * MINE + 0.1 * OTHER,
            other=0.55 * MINE + 0.8 * OTHER,
            third_again=THIRD,
        ),
    }
    assert associate(twice).chosen == RIGHT


def test_a_lone_view_has_nothing_to_associate() -> None:
    empty = Sighting(np.zeros((0, 1), np.float32), np.zeros((0, 4), np.float32), WRIST)
    assert associate({"front": CASE_2["front"]}) is None
    assert associate({"front": CASE_2["front"], "side": empty}) is None
    found = associate({**CASE_2, "wrist": empty})
    assert found.chosen == {"front": 1, "side": 0, "wrist": None}


def test_single_candidates_that_contradict_each_other_are_left_as_they_are() -> None:
    """The likest of each view scores 0: nothing says which of two objects is meant."""
    views = {
        "front": view(FRONT, 0.0, mine=MINE),
        "wrist": view(WRIST, 0.0, other=OTHER),
    }
    assert associate(views) is None


def test_the_margin_over_other_objects_ignores_what_one_view_shows() -> None:
    """A second box of the chosen object in one view takes the lead over any choice, not this one."""
    doubled = {
        **CASE_2,
        "front": view(FRONT, 0.0, other=OTHER, mine=MINE, third=THIRD, mine_again=MINE),
    }
    alone, twice = (associate(views).margin for views in (CASE_2, doubled))
    assert alone > 1.0
    assert twice > 0.1


def test_what_cannot_be_associated_is_said() -> None:
    five = {f"cam{i}": CASE_2["front"] for i in range(5)}
    with pytest.raises(
        BadViews,
        match=r"5 views with 1024 combinations; at most 4 views.*Prompting.associate=False",
    ):
        associate(five)
    many = Sighting(
        *(np.repeat(rows, 100, axis=0) for rows in (CASE_2["front"].cosine, CASE_2["front"].xyxy))
    )
    with pytest.raises(BadViews, match="3 views with 27270901 combinations"):
        associate({"a": many, "b": many, "c": many})
    with pytest.raises(
        BadViews, match=r"associate: needs calibrated cameras; give Attender.start cameras="
    ):
        associate({**CASE_2, "side": replace(CASE_2["side"], camera=None)})


@pytest.mark.parametrize(
    ("prompted", "expected"),
    [
        ({"front": "mine", "side": "mine", "wrist": None}, "right"),
        ({"front": None, "side": None}, "nothing"),
        ({"front": "other", "side": "other", "wrist": None}, "case 1"),
        ({"front": "mine", "side": "other"}, "case 2"),
        ({"front": "third", "side": "other"}, "case 2"),
        ({"head": "other"}, "case 1"),
    ],
)
def test_cases_of_the_paper(prompted: dict[str, str | None], expected: str) -> None:
    assert compare_views(prompted, "mine") == expected
