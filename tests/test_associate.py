"""Cross-view association against brute force, by hand-made cameras, and on a rendered scene of three cameras."""

from dataclasses import replace
from itertools import combinations, product

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from vap_core.associate import (
    PAIRINGS,
    Pairing,
    Sighting,
    associate,
    compare_views,
    geometry,
    ray_distance_m,
    references,
)
from vap_core.base.errors import BadStudy, BadViews
from vap_core.base.types import Camera
from vap_core.vote import vote

NAMES = ("front", "side", "wrist", "top")
OF_OBJECTS = replace(PAIRINGS["objects"], decisive=0.0)
"""An object that fewer views show has no disadvantage."""
RULES = {**PAIRINGS, "objects": OF_OBJECTS}
PAIRED = sorted(RULES)


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


def slow(views: dict[str, Sighting], pairing: Pairing) -> dict[tuple[int | None, ...], float]:
    """The score of every combination, written out."""
    sights = list(views.values())

    def distance(row: np.ndarray) -> float:
        to_all, to_likest = 1 - float(np.float64(row).mean()), 1 - float(np.float64(row).max())
        share = pairing.likest
        return max(to_all, 1e-3) ** (1 - share) * max(to_likest, 1e-3) ** share

    away = [[distance(row) for row in view.cosine] for view in sights]
    least = min(min(of_view) for of_view in away if of_view)

    def single(v: int, i: int | None) -> float:
        if pairing.hidden is not None and i is None:
            of_view = [single(v, j) for j in range(len(away[v]))]
            return pairing.hidden * float(np.mean(of_view)) - 0.1 if of_view else 0.0
        if i is None:
            return 0.0
        best = min(away[v])
        trust = (least / best) ** pairing.reliance
        visible = 0.0
        if pairing.hidden is None:
            visible = max(np.log(least / best) + pairing.absent, 0)
        return pairing.evidence * (trust * np.log(best / away[v][i]) + visible)

    def pair(a: Sighting, i: int | None, b: Sighting, j: int | None) -> float:
        if i is None or j is None:
            return 0.0
        return float(geometry(a, b, pairing)[i, j])

    return {
        choice: sum(single(v, i) for v, i in enumerate(choice))
        + sum(
            pair(sights[v], choice[v], sights[w], choice[w])
            for v, w in combinations(range(len(sights)), 2)
        )
        for choice in product(*[[*range(len(view.xyxy)), None] for view in sights])
    }


@pytest.mark.parametrize("name", PAIRED)
@settings(max_examples=25)
@given(views=scenes.filter(two_sighted))
def test_equals_brute_force(name: str, views: dict[str, Sighting]) -> None:
    every = slow(views, RULES[name])
    best = max(every, key=lambda choice: every[choice])
    found = associate(views, RULES[name])
    assert tuple(found.chosen.values()) == best
    assert found.total == pytest.approx(every[best], abs=1e-9)
    rivals = [choice for choice in every if choice != best]
    if RULES[name].hidden is not None:  # other objects: no candidate of the best choice
        rivals = [
            choice
            for choice in every
            if all(i != j or i is None for i, j in zip(choice, best, strict=True))
        ]
    assert found.margin == pytest.approx(
        every[best] - max(every[choice] for choice in rivals), abs=1e-9
    )
    assert sum(found.terms.values()) == pytest.approx(found.total, abs=1e-9)
    for v, (camera, view) in enumerate(views.items()):
        slots = [*range(len(view.xyxy)), None]
        assert found.support[camera].tolist() == pytest.approx(
            [max(s for c, s in every.items() if c[v] == i) for i in slots], abs=1e-9
        )
    assert any(i is not None for i in best)


@pytest.mark.parametrize("name", PAIRED)
@settings(max_examples=10)
@given(views=scenes.filter(two_sighted), seed=st.integers(0, 99))
def test_the_order_of_candidates_and_of_views_does_not_matter(
    name: str, views: dict[str, Sighting], seed: int
) -> None:
    rng = np.random.default_rng(seed)
    orders = {camera: rng.permutation(len(view.xyxy)) for camera, view in views.items()}
    mixed = {
        c: Sighting(views[c].cosine[o], views[c].xyxy[o], views[c].camera)
        for c, o in orders.items()
    }
    before, after = (
        associate(views, RULES[name]),
        associate({c: mixed[c] for c in rng.permutation(list(mixed)).tolist()}, RULES[name]),
    )
    assume(before.margin > 1e-9)  # equal choices go to what is listed first
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
    for one, other in zip(
        references(list(views.values()), Pairing()), references(closer, Pairing()), strict=True
    ):
        assert other == pytest.approx(one, abs=0.01)


def test_the_likest_reference_alone_can_stand_for_all() -> None:
    """The first candidate is near to one reference only, the second to all by half."""
    cosine = np.array([[0.9, 0.1, 0.1], [0.5, 0.5, 0.5]], np.float32)
    empty = np.zeros((0, 3), np.float32)
    views = [
        Sighting(cosine, np.zeros((2, 4), np.float32)),
        Sighting(empty, np.zeros((0, 4), np.float32)),
    ]
    by_mean, nothing = references(views, Pairing())
    by_likest, _ = references(views, Pairing(likest=1.0))
    assert by_mean[1] > by_mean[0]
    assert by_likest[0] - by_likest[1] == pytest.approx(3.7 * np.log(0.5 / 0.1), abs=1e-4)
    assert nothing.tolist() == [0.0]


def test_the_likest_reference_can_weigh_as_much_as_all() -> None:
    """Distances .1 and .9 to two references: .5 on average; the geometric mean of .1 and .5."""
    cosine = np.array([[0.9, 0.1], [0.5, 0.5]], np.float32)
    views = [Sighting(cosine, np.zeros((2, 4), np.float32))]
    (scores,) = references(views, Pairing(likest=0.5))
    expected = 3.7 * np.log(0.5 / np.sqrt(0.1 * 0.5))
    assert scores[0] - scores[1] == pytest.approx(expected, abs=1e-4)


def test_an_object_that_one_view_hides_does_not_lose_to_one_that_all_show() -> None:
    """Two of three cameras show the target, a little likelier there; all show a look-alike."""
    both = np.array([[0.8], [0.7]], np.float32)
    views = {
        "front": replace(view(FRONT, 0.0, mine=MINE, other=OTHER), cosine=both),
        "side": replace(view(SIDE, 0.0, mine=MINE, other=OTHER), cosine=both),
        "wrist": replace(view(WRIST, 0.0, other=OTHER, third=THIRD), cosine=both - 0.1),
    }
    pairs_gain = Pairing()
    assert associate(views, pairs_gain).chosen == {"front": 1, "side": 1, "wrist": 0}
    even = replace(pairs_gain, hidden=0.5)
    assert associate(views, even).chosen == {"front": 0, "side": 0, "wrist": None}


def test_a_view_that_is_less_like_the_references_counts_less() -> None:
    """Distances .1 and .2 in the one view, .2 and .4 in the other: the ratio is the same."""
    near, far = (np.array([[1 - d], [1 - 2 * d]], np.float32) for d in (0.1, 0.2))
    views = [Sighting(cosine, np.zeros((2, 4), np.float32)) for cosine in (near, far)]
    for reliance, part in ((0.0, 1.0), (1.0, 0.5), (3.0, 0.125)):
        of_near, of_far = references(views, Pairing(reliance=reliance))
        assert of_near[0] - of_near[1] == pytest.approx(3.7 * np.log(2), abs=1e-4)
        assert of_far[0] - of_far[1] == pytest.approx(part * 3.7 * np.log(2), abs=1e-4)
        assert of_far[2] == of_near[2] == 0.0


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
    p = PAIRINGS["geometry"]
    near, far = (p.spread_m / p.sigma_m) ** 2 * np.exp([0.0, -0.5 * (0.144 / p.sigma_m) ** 2])
    assert geometry(a, b, p)[:, 0] == pytest.approx(
        np.log([p.astray + (1 - p.astray) * near, p.astray + (1 - p.astray) * far]), abs=1e-4
    )
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
    assert geometry(up, down, PAIRINGS["geometry"])[0, 0] == pytest.approx(
        np.log(PAIRINGS["geometry"].astray)
    )


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


@pytest.mark.parametrize("name", PAIRED)
def test_views_that_contradict_each_other_agree_when_asked_together(name: str) -> None:
    worse = {
        **CASE_2,
        "wrist": replace(
            CASE_2["wrist"],
            cosine=CASE_2["wrist"].cosine + np.array([[0.0], [0.0], [0.06]], np.float32),
        ),
    }
    alone = {camera: vote(one.cosine).winner for camera, one in worse.items()}
    assert alone == {**RIGHT, "wrist": 2}
    assert associate(worse, RULES[name]).chosen == RIGHT


@pytest.mark.parametrize("name", PAIRED)
def test_a_view_that_does_not_show_the_target_chooses_none(name: str) -> None:
    """The wrist sees the look-alikes only, and would have to choose one of them by itself."""
    absent = {**CASE_2, "wrist": view(WRIST, 0.6, third=THIRD, other=OTHER)}
    assert vote(absent["wrist"].cosine).winner is not None
    assert associate(absent, RULES[name]).chosen == {**RIGHT, "wrist": None}


@pytest.mark.parametrize("name", PAIRED)
def test_a_distractor_proposed_twice_in_every_view_changes_nothing(name: str) -> None:
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
    assert associate(twice, RULES[name]).chosen == RIGHT


@settings(max_examples=30)
@given(scenes.filter(two_sighted))
def test_by_geometry_no_doubled_loser_ever_changes_the_score(views: dict[str, Sighting]) -> None:
    before = associate(views, PAIRINGS["geometry"])
    doubled = {
        camera: Sighting(
            *(
                np.concatenate(
                    [rows, rows[[k for k in range(len(rows)) if k != before.chosen[camera]]]]
                )
                for rows in parts
            ),
            one.camera,
        )
        for camera, one in views.items()
        for parts in [(one.cosine, one.xyxy)]
    }
    after = associate(doubled, PAIRINGS["geometry"])
    assert (after.chosen, after.total) == (before.chosen, pytest.approx(before.total, abs=1e-9))


def test_a_lone_view_has_nothing_to_associate() -> None:
    empty = Sighting(np.zeros((0, 1), np.float32), np.zeros((0, 4), np.float32), WRIST)
    assert associate({"front": CASE_2["front"]}, PAIRINGS["geometry"]) is None
    assert associate({"front": CASE_2["front"], "side": empty}, PAIRINGS["geometry"]) is None
    found = associate({**CASE_2, "wrist": empty}, PAIRINGS["geometry"])
    assert found.chosen == {"front": 1, "side": 0, "wrist": None}


def test_views_keep_their_own_choices_where_none_is_decisive() -> None:
    found = associate(CASE_2, PAIRINGS["geometry"])
    assert found is not None
    below = replace(PAIRINGS["geometry"], decisive=found.margin - 0.01)
    again = associate(CASE_2, below)
    assert again is not None
    assert again.chosen == found.chosen
    assert associate(CASE_2, replace(below, decisive=found.margin + 0.01)) is None


def test_single_candidates_that_contradict_each_other_are_left_as_they_are() -> None:
    """The likest of each view scores 0: nothing says which of two objects is meant."""
    views = {
        "front": view(FRONT, 0.0, mine=MINE),
        "wrist": view(WRIST, 0.0, other=OTHER),
    }
    found = associate(views, OF_OBJECTS)
    assert found is not None
    assert found.margin < 0.5
    assert associate(views, replace(OF_OBJECTS, decisive=1.25)) is None


def test_the_margin_over_other_objects_ignores_what_one_view_shows() -> None:
    """A second box of the chosen object in one view takes the lead over any choice, not this one."""
    doubled = {
        **CASE_2,
        "front": view(FRONT, 0.0, other=OTHER, mine=MINE, third=THIRD, mine_again=MINE),
    }
    by_any = [associate(views, PAIRINGS["geometry"]).margin for views in (CASE_2, doubled)]
    by_object = [
        associate(views, replace(OF_OBJECTS, reliance=0.0)).margin for views in (CASE_2, doubled)
    ]
    assert by_any[0] > 1.0
    assert by_any[1] == pytest.approx(0.0, abs=1e-9)
    assert by_object[1] > 1.0


@pytest.mark.parametrize(
    ("field", "wrong", "error", "said"),
    [
        ("sigma_m", 0.0, BadStudy, "sigma_m is 0.0; give more than 0"),
        ("spread_m", float("nan"), BadStudy, "spread_m is nan; give more than 0"),
        ("astray", 1.5, BadStudy, "astray is 1.5; give a share, 0 to 1"),
        ("likest", -1.0, BadStudy, "likest is -1.0; give a share, 0 to 1"),
        ("evidence", -1.0, BadStudy, "evidence is -1.0; give 0 or more"),
        ("decisive", float("nan"), BadStudy, "decisive is nan; give 0 or more"),
        ("hidden", -0.5, BadStudy, "hidden is -0.5; give 0 or more"),
    ],
)
def test_what_is_no_pairing_is_refused(
    field: str, wrong: object, error: type[Exception], said: str
) -> None:
    """Set past the check of signatures, which users do not have."""
    pairing = Pairing()
    object.__setattr__(pairing, field, wrong)
    with pytest.raises(error, match=said):
        pairing.__post_init__()


def test_what_cannot_be_associated_is_said() -> None:
    five = {f"cam{i}": CASE_2["front"] for i in range(5)}
    with pytest.raises(
        BadViews, match=r"5 views with 1024 combinations; at most 4 views.*Prompting.associate=None"
    ):
        associate(five, PAIRINGS["geometry"])
    many = Sighting(
        *(np.repeat(rows, 100, axis=0) for rows in (CASE_2["front"].cosine, CASE_2["front"].xyxy))
    )
    with pytest.raises(BadViews, match="3 views with 27270901 combinations"):
        associate({"a": many, "b": many, "c": many}, PAIRINGS["geometry"])
    with pytest.raises(
        BadViews, match=r"associate: needs calibrated cameras; give Attender.start cameras="
    ):
        associate({**CASE_2, "side": replace(CASE_2["side"], camera=None)}, PAIRINGS["geometry"])


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
