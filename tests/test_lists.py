"""Episode lists on disk: as many as promised, made again by their builders, laid out with room; damage is said by row and field."""

import hashlib
import json
import math
from collections import Counter
from dataclasses import asdict, replace
from functools import cache
from itertools import combinations

import numpy as np
import pytest

from vap_core.base.errors import BadSuite
from vap_core.environments import libero
from vap_core.instruction import parse
from vap_core.simulation import suites
from vap_core.simulation.assets import objects
from vap_core.simulation.grasps import points_world
from vap_core.simulation.suites import BENCHMARKS, SHARED, VARIANTS, lists
from vap_core.simulation.suites.suite import AGGREGATION, MATCHING
from vap_core.simulation.types import AS_LISTED
from vap_make.lists import benchmarks

BUILDERS = {
    "simpler-fractal": benchmarks.fractal_rows,
    "simpler-bridge": benchmarks.bridge_rows,
    "vlabench": benchmarks.vlabench_rows,
    "tabletop": benchmarks.tabletop_rows,
}
PER_TASK = {
    ("simpler-fractal", "pick-pen-holder", "visual matching"): 300,
    ("simpler-fractal", "move-bottle-near-coke-can", "visual matching"): 160,
    ("simpler-fractal", "pick-pen-holder", "variant aggregation"): 825,
    ("simpler-fractal", "move-bottle-near-coke-can", "variant aggregation"): 400,
    **{
        ("simpler-bridge", task, ""): 24
        for task in ("pick-shaver", "put-camera", "put-owl-figurine", "put-straw-cup")
    },
    **{
        ("vlabench", f"select-{what}", ""): 50
        for what in ("leather-bag", "shoe", "cat-figurine", "miniature-house", "cup")
    },
    **{("tabletop", f"select-{what}", ""): 20 for what in ("vase", "plushie", "cup", "slipper")},
    **{
        ("tabletop", f"put-{what}", ""): 20
        for what in ("plant", "stuffed-toy", "pouch", "scrubber")
    },
}
TOTALS = {"simpler-fractal": 460 + 1225, "simpler-bridge": 96, "vlabench": 250, "tabletop": 160}
LEAST_GAP_M = 0.03
DIRECTIONS = np.linspace(0, 2 * np.pi, 120, endpoint=False)
NORMALS = np.stack([np.cos(DIRECTIONS), np.sin(DIRECTIONS)])


@pytest.fixture(scope="module", params=sorted(BENCHMARKS))
def name(request):
    return request.param


@pytest.fixture(scope="module")
def rows(name):
    return lists.read(name)


def test_the_counts_are_the_promised_ones(name, rows):
    assert len(rows) == TOTALS[name]
    counted = Counter((row.suite, row.task, row.split) for row in rows)
    assert counted == {key: count for key, count in PER_TASK.items() if key[0] == name}
    assert sorted({row.task for row in rows}) == sorted(
        task.name for task in BENCHMARKS[name].tasks
    )


def test_fractal_has_every_layout_under_every_variant_as_often():
    pick, near = (task.name for task in BENCHMARKS["simpler-fractal"].tasks)
    counted = Counter((row.task, row.split, row.variant) for row in lists.read("simpler-fractal"))
    few = tuple(name for name in AGGREGATION if name != "distractors-many")
    expected = {(pick, "visual matching", variant): 75 for variant in MATCHING} | {
        (pick, "variant aggregation", v): 75 for v in AGGREGATION
    }
    expected |= {(near, "visual matching", variant): 40 for variant in MATCHING} | {
        (near, "variant aggregation", v): 40 for v in few
    }
    assert counted == expected
    assert len(MATCHING) == 4
    assert len(AGGREGATION) == 11


def test_the_manifest_holds_hash_and_length_of_the_file(name, rows):
    data = (lists.FOLDER / f"{name}.jsonl").read_bytes()
    assert hashlib.sha256(data).hexdigest() == lists.digest(name)
    manifest = json.loads((lists.FOLDER / "manifest.json").read_text())
    assert manifest[name]["episodes"] == len(rows) == len(data.splitlines())
    assert set(manifest) == {
        *BENCHMARKS,
        *(f"{each}-dev" for each in BENCHMARKS),
        *SHARED,
        *libero.SUITES,
    }


def test_the_builder_gives_the_committed_file(name, rows, tmp_path):
    np.random.seed(5)  # noqa: NPY002
    built = BUILDERS[name]()
    assert [asdict(row) for row in built] == [asdict(row) for row in rows]
    assert lists.write(name, built, tmp_path) == lists.digest(name)


def test_rows_agree_with_their_task_and_are_numbered(name, rows):
    for task in BENCHMARKS[name].tasks:
        mine = [row for row in rows if row.task == task.name]
        assert [row.episode for row in mine] == list(range(len(mine)))
        for row in mine:
            assert (row.suite, row.instruction, row.category, row.max_steps) == (
                name,
                task.instruction,
                task.category,
                task.max_steps,
            )
            assert (row.rule, row.goal, row.cameras, row.seed) == (
                task.rule,
                task.goal,
                BENCHMARKS[name].cameras,
                0,
            )


def test_the_target_stands_first_beside_two_lookalikes_of_its_family(name, rows):
    for row in rows:
        target, *others = (place.model for place in row.placements)
        stem = BENCHMARKS[name].task(row.task).stem
        assert target == f"{stem}-personal"
        assert objects.get_object(target).split == "personal"
        assert objects.get_object(target).category == row.category
        rivals = [other for other in others if objects.get_object(other).split == "lookalike"]
        assert len(rivals) == 2
        assert set(rivals) < {model.name for model in objects.lookalikes(stem)}
        assert [other for other in others if objects.get_object(other).split == "prop"] == [
            row.goal
        ] * bool(row.goal)
        crowd = [
            objects.get_object(other)
            for other in others
            if objects.get_object(other).split == "generic"
        ]
        assert len(crowd) == VARIANTS[row.variant].distractors
        assert row.category not in {model.category for model in crowd}


def test_every_lookalike_is_met(name, rows):
    """Two of a family's look-alikes, drawn evenly: none is left out of a whole list."""
    for task in BENCHMARKS[name].tasks:
        met = {
            place.model
            for row in rows
            if row.task == task.name
            for place in row.placements
            if "-lookalike-" in place.model
        }
        assert met == {model.name for model in objects.lookalikes(task.stem)}


@cache
def support_m(model, yaw):
    """How far the object's collision outline reaches from its origin in every one of DIRECTIONS, metres."""
    pose = np.array([0.0, 0.0, 0.0, np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)])
    return (points_world(model, pose)[:, :2] @ NORMALS).max(axis=0)


def gap_m(one, other):
    """Between the hulls of two collision outlines: the widest band that separates them, the exact distance but for the directions' grid."""
    away = np.array([other.x - one.x, other.y - one.y]) @ NORMALS
    return float(
        (
            away
            - support_m(one.model, one.yaw)
            - np.roll(support_m(other.model, other.yaw), len(DIRECTIONS) // 2)
        ).max()
    )


def test_collision_outlines_keep_three_centimetres_apart(name, rows):
    near = {
        f"{row.key} {a.model} {b.model}": gap_m(a, b)
        for row in rows
        for a, b in combinations(row.placements, 2)
    }
    closest = min(near, key=near.__getitem__)
    assert near[closest] >= LEAST_GAP_M, (
        f"{closest}: {1000 * near[closest]:.1f} mm; {sum(g < LEAST_GAP_M for g in near.values())} pairs too close"
    )


def test_everything_stands_on_the_table(name, rows):
    from vap_core.simulation import robots

    x0, y0, x1, y1 = robots.get(BENCHMARKS[name].robot).table_m
    for place in {(p.model, p.x, p.y, p.yaw): p for row in rows for p in row.placements}.values():
        reach = support_m(place.model, place.yaw)
        right, up, left, down = (reach[k * len(DIRECTIONS) // 4] for k in range(4))
        assert x0 < place.x - left < place.x + right < x1
        assert y0 < place.y - down < place.y + up < y1


def test_the_same_layout_returns_under_every_variant():
    for task, size in (("pick-pen-holder", 75), ("move-bottle-near-coke-can", 40)):
        mine = [row for row in lists.read("simpler-fractal") if row.task == task]
        usual = [[asdict(place) for place in row.placements] for row in mine[:size]]
        for row in mine:
            kept = usual[row.episode % size]
            assert [asdict(place) for place in row.placements[: len(kept)]] == kept
            assert len(row.placements) == len(kept) + VARIANTS[row.variant].distractors


def test_the_pick_grid_is_three_orientations_times_twenty_five_cells():
    rows = [row for row in lists.read("simpler-fractal") if row.task == "pick-pen-holder"][:75]
    at = Counter((row.placements[0].x, row.placements[0].y) for row in rows)
    xs, ys = (sorted({key[i] for key in at}) for i in range(2))
    assert (len(xs), len(ys), set(at.values())) == (5, 5, {3})
    for cell in at:
        turns = sorted(
            row.placements[0].yaw
            for row in rows
            if (row.placements[0].x, row.placements[0].y) == cell
        )
        assert np.diff(turns) == pytest.approx([2 * np.pi / 3] * 2, abs=2e-4)
    assert all({(p.x, p.y) for p in row.placements} <= set(at) for row in rows), (
        "the look-alikes stand on the grid, too"
    )
    assert np.diff(xs) == pytest.approx([0.23 / 4] * 4, abs=2e-4)
    assert np.diff(ys) == pytest.approx([0.44 / 4] * 4, abs=2e-4)


def test_bridge_swaps_target_and_goal_over_the_corners_of_a_square():
    side, (x, y) = 0.15, benchmarks.CENTRE
    corners = {
        (round(x + i * side / 2, 4), round(y + j * side / 2, 4)) for i in (-1, 1) for j in (-1, 1)
    }
    for task in BENCHMARKS["simpler-bridge"].tasks:
        mine = [row for row in lists.read("simpler-bridge") if row.task == task.name]
        assert all({(p.x, p.y) for p in row.placements} <= corners for row in mine)
        assert Counter((row.placements[0].x, row.placements[0].y) for row in mine) == dict.fromkeys(
            corners, 6
        )
        assert all(
            mine[i + 12].placements[0].yaw - mine[i].placements[0].yaw
            == pytest.approx(np.pi / 2, abs=2e-4)
            for i in range(12)
        )
        if task.goal:
            pairs = Counter(
                (
                    (row.placements[0].x, row.placements[0].y),
                    (row.placements[1].x, row.placements[1].y),
                )
                for row in mine
            )
            assert (len(pairs), set(pairs.values())) == (12, {2})


def test_instructions_parse_into_the_category_with_and_without_hints(rows):
    for row in {row.task: row for row in rows}.values():
        for hints in ((), objects.CATEGORIES):
            (target,) = parse(row.instruction, hints).targets
            assert target.category == row.category


def test_some_rows_are_spread_over_the_list_and_carry_the_seed():
    whole = suites.rows("vlabench", "select-shoe")
    some = suites.rows("vlabench", "select-shoe", 5, seed=3)
    assert [row.episode for row in some] == [0, 12, 24, 36, 49]
    assert [asdict(replace(row, start=AS_LISTED)) for row in some] == [
        asdict(replace(whole[row.episode], seed=3)) for row in some
    ]
    assert len(suites.rows("vlabench", "select-shoe", 500)) == 50
    assert len(suites.rows("vlabench", "select-shoe", 1)) == 1


GOOD = {
    "suite": "mine", "task": "put-cup", "episode": 0, "seed": 0, "instruction": "put my cup on the plate", "category": "cup", "max_steps": 60,
    "rule": "put", "goal": "plate-prop", "split": "", "variant": "base", "cameras": ["front"],
    "placements": [["cup-personal", 0.3, 0.0, 0.5], ["plate-prop", 0.3, 0.15, 0.0], ["cup-lookalike-1", 0.3, -0.15, 1]],
}  # fmt: skip
PLACED = GOOD["placements"]


def without(key):
    return {name: cell for name, cell in GOOD.items() if name != key}


def moved(x):
    return GOOD | {"placements": [["cup-personal", x, 0.0, 0.5], *PLACED[1:]]}


BROKEN = {
    "not JSON": ("{'suite': 'mine'}", "is not JSON"),
    "cut off": (json.dumps(GOOD)[:-20], "is not JSON"),
    "a list": ([1, 2], "missing or unknown"),
    "missing field": (without("rule"), "field 'rule': missing or unknown; a row has .*, variant"),
    "unknown field": (GOOD | {"colour": "red"}, "field 'colour': missing or unknown; a row has .*, variant"),
    "text for a count": (GOOD | {"episode": "0"}, "episode is '0'; it must be of type int"),
    "fraction for a count": (GOOD | {"episode": 0.0}, "episode is 0.0; it must be of type int"),
    "negative seed": (GOOD | {"seed": -1}, "field 'seed': -1 is less than 0"),
    "no steps": (GOOD | {"max_steps": 0}, "field 'max_steps': 0 is less than 1"),
    "number for text": (GOOD | {"instruction": 3}, "instruction is 3; it must be of type str"),
    "nothing for text": (GOOD | {"goal": None}, "goal is None; it must be of type str"),
    "unknown rule": (GOOD | {"rule": "thrown"}, "rule is 'thrown'; it must be of type Literal.'picked', 'near', 'put', 'selected'"),
    "unknown variant": (GOOD | {"variant": "night"}, "field 'variant': 'night' is unknown; known: base, robot-dark"),
    "cameras as text": (GOOD | {"cameras": "front"}, "field 'cameras': TypeError: 'front' is no list"),
    "camera as number": (GOOD | {"cameras": [1]}, "cameras is .1,.; it must be of type tuple"),
    "NaN": (moved(math.nan), "field 'placements': 'cup-personal' stands nan m away"),
    "infinite": (moved(math.inf), "field 'placements': 'cup-personal' stands inf m away"),
    "text for a place": (moved("here"), "field 'placements': ValueError: could not convert string to float: 'here'"),
    "five metres away": (moved(5.0), "field 'placements': 'cup-personal' stands 5 m away.* metres, within 2"),
    "millimetres": (moved(300), "field 'placements': 'cup-personal' stands 300 m away.* metres, within 2"),
    "no yaw": (GOOD | {"placements": [["cup-personal", 0.3, 0.0], *PLACED[1:]]}, "field 'placements': TypeError: missing a required argument: 'yaw'"),
    "nothing placed": (GOOD | {"placements": []}, "field 'placements': empty; the first one is the target"),
    "placed twice": (GOOD | {"placements": [*PLACED, PLACED[2]]}, "field 'placements': an object is placed twice in .*cup-lookalike-1"),
    "goal not placed": (GOOD | {"goal": "basket-prop"}, "field 'goal': 'basket-prop' for rule 'put'; near and put name a placed object"),
    "goal is the target": (GOOD | {"goal": "cup-personal"}, "field 'goal': 'cup-personal' for rule 'put'; .* other than the target"),
    "no goal to put": (GOOD | {"goal": ""}, "field 'goal': '' for rule 'put'"),
    "goal for a pick": (GOOD | {"rule": "picked"}, "field 'goal': 'plate-prop' for rule 'picked'; .* the others none"),
    "another suite": (GOOD | {"suite": "yours"}, "field 'suite': 'yours' in the list of 'mine'"),
    "the same episode": (GOOD | {"episode": 9}, "field 'episode': 9 of task 'put-cup' is already row 1"),
}  # fmt: skip


def listed(folder, *lines):
    """A list with a matching hash, whatever its lines are."""
    data = "".join(
        (line if isinstance(line, str) else json.dumps(line)) + "\n" for line in lines
    ).encode()
    (folder / "mine.jsonl").write_bytes(data)
    (folder / "manifest.json").write_text(
        json.dumps({"mine": {"sha256": hashlib.sha256(data).hexdigest(), "episodes": len(lines)}})
    )
    return folder


def test_a_sound_row_reads_back(tmp_path):
    (row,) = lists.read("mine", listed(tmp_path, GOOD))
    assert (row.target, row.goal, row.cameras, row.placements[2].yaw) == (
        "cup-personal",
        "plate-prop",
        ("front",),
        1.0,
    )


@pytest.mark.parametrize(("line", "said"), BROKEN.values(), ids=BROKEN)
def test_a_malformed_row_is_named_with_its_field(line, said, tmp_path):
    with pytest.raises(BadSuite, match=f"mine.jsonl row 2.*{said}"):
        lists.read("mine", listed(tmp_path, GOOD | {"episode": 9}, line))


def test_a_file_changed_by_one_byte_is_refused(tmp_path):
    path = listed(tmp_path, GOOD) / "mine.jsonl"
    wanted = lists.digest("mine", tmp_path)
    path.write_bytes(path.read_bytes().replace(b"0.5]", b"0.6]"))
    with pytest.raises(
        BadSuite, match=f"mine.jsonl changed since its hash {wanted[:12]}.*restore it"
    ):
        lists.read("mine", tmp_path)


def test_an_absent_file_names_what_makes_it(tmp_path):
    listed(tmp_path, GOOD)
    with pytest.raises(
        BadSuite, match="yours.jsonl cannot be read .No such file.*notebooks/01_benchmark_building"
    ):
        lists.read("yours", tmp_path)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("{", "manifest.json cannot be read"),
        ("[]", "manifest.json has no hash"),
        ("{}", "manifest.json has no hash of 'mine'"),
        ('{"mine": {}}', "manifest.json has no hash of 'mine'"),
        ('{"mine": "abc"}', "manifest.json has no hash of 'mine'"),
    ],
)
def test_a_damaged_manifest_is_named(text, said, tmp_path):
    (listed(tmp_path, GOOD) / "manifest.json").write_text(text)
    with pytest.raises(BadSuite, match=said):
        lists.read("mine", tmp_path)


def test_an_absent_manifest_is_named(tmp_path):
    (listed(tmp_path, GOOD) / "manifest.json").unlink()
    with pytest.raises(BadSuite, match="manifest.json cannot be read"):
        lists.read("mine", tmp_path)


def test_writing_enters_one_suite_and_keeps_the_others(tmp_path):
    (row,) = lists.read("mine", listed(tmp_path, GOOD))
    lists.write("yours", [replace(row, suite="yours")], tmp_path)
    assert set(json.loads((tmp_path / "manifest.json").read_text())) == {"mine", "yours"}
    assert asdict(lists.read("yours", tmp_path)[0]) == asdict(replace(row, suite="yours"))


def test_what_was_just_written_is_what_is_read(tmp_path):
    (row,) = lists.read("mine", listed(tmp_path, GOOD))
    lists.write("mine", [row, replace(row, episode=1)], tmp_path)
    assert [row.episode for row in lists.read("mine", tmp_path)] == [0, 1]


def test_check_refuses_a_row_made_in_memory():
    (row,) = suites.rows("simpler-bridge", "put-camera", 1)
    suite = suites.suite("simpler-bridge")
    lists.check([row], suite)
    with pytest.raises(BadSuite, match="row 2, field 'goal'"):
        lists.check([row, replace(row, goal="moon")], suite)


def test_check_refuses_a_start_and_cameras_that_do_not_fit():
    (row,) = suites.rows("simpler-bridge", "put-camera", 1, seed=3)
    suite = suites.suite("simpler-bridge")
    lists.check([row], suite)
    fewer = replace(row, placements=row.placements[:2], goal="", rule="picked")
    with pytest.raises(BadSuite, match=r"row 1, field 'start.offsets': 4 entries, and not 2"):
        lists.check([fewer], suite)
    five = replace(row, start=replace(row.start, joints_rad=(0.0,) * 5))
    with pytest.raises(BadSuite, match=r"field 'start.joints_rad': 5 entries, and not 6"):
        lists.check([five], suite)
    with pytest.raises(BadSuite, match="field 'cameras': 'nope' is none of front"):
        lists.check([replace(row, cameras=("nope",))], suite)


def test_neither_yaw_nor_place_tells_the_target():
    """Rules of thumb that know no picture find it no more often than chance allows (a third; 4 standard errors)."""
    for name in BENCHMARKS:
        rows = [
            row
            for row in lists.read(name)
            if row.variant == "base" and row.split in ("", "visual matching")
        ]
        spots, yaws = [], []
        for row in rows:
            alike = [place for place in row.placements if place.model != row.goal][:3]
            spots.append([(place.x, place.y) for place in alike])
            yaws.append([place.yaw for place in alike])
        spot, yaw = np.array(spots), np.array(yaws)
        middle = np.linalg.norm(spot - spot.mean(axis=(0, 1)), axis=2)
        rules = (
            middle,
            -middle,
            np.abs(np.sin(2 * yaw)),
            np.abs(np.sin(1.5 * yaw)),
            np.abs(np.sin(yaw)),
        )
        distinct = [
            rule for rule in rules if (np.ptp(np.sort(rule, axis=1), axis=1) > 1e-3).mean() > 0.9
        ]
        for rule in distinct:
            assert (rule.argmin(axis=1) == 0).mean() < 1 / 3 + 4 * np.sqrt(2 / 9 / len(rows)), name
    near = [row for row in lists.read("simpler-fractal") if row.rule == "near"][:40]
    away = [
        [
            np.hypot(p.x - row.placements[1].x, p.y - row.placements[1].y)
            for p in row.placements[:1] + row.placements[2:4]
        ]
        for row in near
    ]
    assert np.bincount(np.argsort(np.argsort(away, axis=1), axis=1)[:, 0]).tolist() == [14, 13, 13]
    assert np.min(away) > benchmarks.APART_M - 1e-3
