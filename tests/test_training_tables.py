"""What the pages say of a training is what its published episodes hold."""

import re
from pathlib import Path

import pandas as pd
import pytest

from tests.pages import PAGES, PROSE, table
from tests.published import RESULTS, episodes_of, in_percent, method_of, of_way, over_layouts
from vap_core.evaluation.ablations.arms import ABLATIONS, TINT_SHARES
from vap_core.evaluation.metrics import rate
from vap_core.evaluation.policy_names import shipped
from vap_core.evaluation.statistics import (
    compare,
    holm,
    mcnemar,
)
from vap_core.policies.lerobot.checkpoints import fingerprint
from vap_core.policies.names import checkpoint_of

BOUNDS = ("oracle-mask", "oracle-track", "wrong-mask")
SHARES = {
    label.removeprefix("share-"): Path(checkpoint).name for label, checkpoint in TINT_SHARES.items()
}


def test_what_policies_of_other_tint_shares_reach() -> None:
    shares = ABLATIONS["tint-share"]
    played = episodes_of("tint_share")
    listed = played[played.seed == 0]
    held = {}
    for share, name in SHARES.items():
        of_share = listed[listed.policy.map(checkpoint_of) == name]
        assert set(of_share.groupby("method").size()) == {96}
        held[share] = [of_way(of_share, method) for method in shares.names]
    head, *body = table("| tint share | generic")
    assert [cell.strip("*").lower() for cell in head[1:]] == list(shares.names)
    assert {cells[0]: [cell.strip("*") for cell in cells[1:]] for cells in body} == held
    (_, *ways), *body = table("| tint share | tinted")
    told = pd.read_parquet(RESULTS / "tint_share_generic.parquet")
    for share, *cells in body:
        of_share = told[told.policy.map(checkpoint_of) == SHARES[share]]
        assert cells == [of_way(of_share, way) for way in ways]


def test_what_a_second_training_of_a_tint_share_reaches() -> None:
    shares = ABLATIONS["tint-share"]
    again, listed = episodes_of("tint_share_again"), episodes_of("tint_share").query("seed == 0")
    head, *body = table("| tint share, seed 2 | generic")
    assert [cell.strip("*").lower() for cell in head[1:]] == list(shares.names)
    for share, *cells in body:
        of_share = again[
            again.policy.map(checkpoint_of).str.endswith(f"-seed-2-tint-share-{share}")
        ]
        assert set(of_share.groupby("method").size()) == {96}
        assert [cell.strip("*") for cell in cells] == [
            of_way(of_share, way) for way in shares.names
        ]
    assert len(body) == again.policy.nunique()
    counts, missed = [], []
    for share in SHARES:
        first, second = (
            rows[(rows.method == "vap") & rows.policy.map(checkpoint_of).str.endswith(name)]
            for rows, name in ((listed, SHARES[share]), (again, f"-seed-2-tint-share-{share}"))
        )
        pairs = first.merge(second, on=["task", "episode"])
        won = pairs.success_y.astype(bool) & ~pairs.success_x.astype(bool)
        lost = pairs.success_x.astype(bool) & ~pairs.success_y.astype(bool)
        counts.append(f"({won.sum()} won, {lost.sum()} lost;")
        failed = second[~second.success.astype(bool)]
        missed.append(f"{failed.sub_case.eq('missed grasp').sum()} of {len(failed)}")
    assert all(count in PROSE for count in counts)
    assert f"{', '.join(missed[:-1])} and {missed[-1]} failures are missed grasps." in PROSE


def test_no_effect_of_tints_is_beyond_chance_and_the_nearest_is_told() -> None:
    """Of every share and arm against the share 0, in both seeds."""
    tables = {1: episodes_of("tint_share").query("seed == 0"), 2: episodes_of("tint_share_again")}
    exact = {}
    for seed, rows in tables.items():
        share = rows.policy.map(checkpoint_of).str.extract(r"tint-share-([\d.]+)$")[0].fillna("0")
        for name in sorted(set(share) - {"0"}):
            for arm in ABLATIONS["tint-share"].names:
                none, some = (rows[(rows.method == arm) & (share == of)] for of in ("0", name))
                pairs = none.merge(some, on=["task", "episode"])
                assert len(pairs) == 96
                before, after = pairs.success_x.astype(bool), pairs.success_y.astype(bool)
                counts = int((after & ~before).sum()), int((before & ~after).sum())
                exact[seed, arm, name] = mcnemar(*counts)
    corrected = dict(zip(exact, holm(list(exact.values())), strict=True))
    assert min(corrected.values()) > 0.05
    nearest = min(corrected, key=lambda key: exact[key])
    assert nearest == (2, "mask-only", "0.5")
    assert (
        f"Of the {len(exact)} comparisons with the share 0 of both seeds none is beyond chance when "
        "corrected; the least p, of the tint alone at half, becomes "
        f"{_short(corrected[nearest])}."
    ) in PROSE
    for arm in ("vap", "mask-only"):
        *first, last = (_short(exact[2, arm, name]) for name in ("0.1", "0.2", "0.5"))
        assert f"p {', '.join(first)} and {last})" in PROSE


def _short(p: float) -> str:
    return f"{p:.3f}".removeprefix("0").replace("1.000", "1")


def test_what_more_steps_on_the_same_scenes_reach() -> None:
    (vap, elsewhere), (generic, generic_elsewhere) = _starts("more_steps", listed=4 * 96, others=2)
    assert f"reaches {vap} % with VAP on simpler-bridge" in PROSE
    assert f"and {elsewhere} % from other starts" in PROSE
    assert f"generic {generic} and {generic_elsewhere} %." in PROSE


def test_what_more_scenes_reach() -> None:
    (vap, elsewhere), (generic, generic_elsewhere) = _starts("more_scenes", listed=2 * 96, others=9)
    assert f"it reaches {vap} % with VAP as listed" in PROSE
    assert f"and {elsewhere} % from other starts (864" in PROSE
    assert f"generic {generic} and {generic_elsewhere} %. The paper" in PROSE
    _, *body = table("| policy | method | as listed (seed 0)")
    quoted = {tuple(row[:2]): row[3].replace("*", "").split(" of ")[0] for row in body}
    assert quoted["the other training, wide", "VAP"] == elsewhere
    assert quoted["the other training, wide", "generic"] == generic_elsewhere


def test_what_ten_seeds_reach() -> None:
    (vap, elsewhere), (generic, generic_elsewhere) = _starts("ten_seeds", listed=192, others=9)
    assert (
        f"has {vap} % with VAP as listed and {elsewhere} % from other starts, generic {generic} and "
        f"{generic_elsewhere} %"
    ) in PROSE
    digests = {label.rpartition("@")[2] for label in episodes_of("ten_seeds").policy}
    assert digests == {fingerprint(shipped("simpler-bridge"))[:8]}


def test_what_policies_reach_from_other_starts() -> None:
    """A row of several seeds has its interval over the layouts, which return under each."""
    digests = {
        "the default, wide-seed-0": "a3e5dd45",
        "the other training, wide": "c54c3c4e",
        "the first one": "00c47015",
        "the first one, three angles scaled by 0.1 rad": "dd729043",
        "tint-free": "2e02225c",
        "any-start: never saw a tint, angles with noise": "c657f21c",
        "any-start": "c657f21c",
    }
    at_home = {"tint-free": "a9ca87ac"}  # the same parameters, in the folder of their training
    played = pd.concat([episodes_of(name) for name in ("starts", "ten_seeds", "more_scenes")])
    played = played[played.suite == "simpler-bridge"]
    elsewhere = played[played.seed > 0]
    home = pd.concat([played, episodes_of("first_policy"), episodes_of("tint_free")])
    home = home[(home.suite == "simpler-bridge") & (home.seed == 0)]
    _, *body = table("| policy | method | as listed (seed 0)")
    assert {row[0] for row in body} == set(digests)
    for name, method, as_listed, cell in body:
        of_row = home[home.policy.str.endswith(at_home.get(name, digests[name]))]
        of_row = of_row.drop_duplicates(["policy", "method", "task", "episode"])
        assert as_listed == f"{of_way(of_row, method_of(method))} of 96", name
        rows = elsewhere[elsewhere.policy.str.endswith(digests[name])]
        quoted, n = re.fullmatch(r"(.+) of (\d+) \(.*", cell.replace("*", "")).groups()
        assert quoted == over_layouts(rows, method_of(method)), name
        assert int(n) == len(rows[rows.method == method_of(method)])


def test_the_policy_of_more_scenes_came_out_the_same_again() -> None:
    folder = RESULTS.parent / "policies" / "mini-pi0-simpler-bridge-wide"
    again, main = episodes_of("more_scenes"), episodes_of("by_recipe")
    assert set(main.policy.map(checkpoint_of)) == {folder.name}
    digests = {label.rpartition("@")[2] for label in (*again.policy, *main.policy)}
    assert digests == {fingerprint(folder)[:8]}
    one, other = (
        rows[rows.seed == 0].set_index(["method", "task", "episode"]).success
        for rows in (again, main)
    )
    assert (other.reindex(one.index) == one).all()
    assert len(one) == 192


def test_what_simpler_fractals_policies_of_todays_recipe_reach() -> None:
    by_recipe = ("mini-pi0-simpler-fractal-wide", "mini-pi0-simpler-fractal-tint-free")
    names = ("mini_pi0", "oracle_track", "fractal_today", "tint_free_fractal")
    published = pd.concat([episodes_of(name) for name in names])
    published = published[published.policy.map(checkpoint_of).isin(by_recipe)]
    played = published[published.split == "visual matching"].copy()
    played["name"] = played.policy.map(checkpoint_of).str.removeprefix("mini-pi0-simpler-fractal-")
    head, *body = table("| policy | method | pick-pen-holder")
    assert len(body) == len(played[played.seed == 0].groupby(["name", "method"]))
    for name, method, *cells in body:
        method = method_of(method)
        of_row = played[(played.name == name) & (played.method == method)]
        listed = of_row[of_row.seed == 0]
        tasks = [listed[listed.task == task] for task in (head[2], "move-bottle-near-coke-can")]
        assert [len(part) for part in tasks] == [300, 160]
        parts = [*tasks, listed, of_row[of_row.seed == 1]]
        assert cells == [over_layouts(part, method) for part in parts]
    other_looks = published[published.split == "variant aggregation"]
    assert set(other_looks.policy) == set(played.policy[played.name == "wide"])
    pens = other_looks[other_looks.task == "pick-pen-holder"]
    bottles = other_looks[other_looks.task == "move-bottle-near-coke-can"]
    assert set(pens.groupby("method").size()) == {825}
    assert set(bottles.groupby("method").size()) == {400}
    assert (
        f"with wide VAP reaches {of_way(other_looks, 'vap')} % (pen holder {of_way(pens, 'vap')} "
        f"of 825, bottle {of_way(bottles, 'vap')} of 400;"
    ) in PROSE
    assert (
        f"has {of_way(other_looks, 'generic')} % there (pen holder {of_way(pens, 'generic')}, "
        f"bottle {of_way(bottles, 'generic')})"
    ) in PROSE


def test_what_the_defaults_by_todays_recipe_reach() -> None:
    unseen = {
        "simpler-bridge-wide-seed-0": "put-owl-figurine",
        "simpler-bridge-wide": "put-owl-figurine",
        "vlabench-wide": "select-cat-figurine",
    }
    listed = pd.concat([episodes_of(name) for name in ("mini_pi0", "oracle_track", "by_recipe")])
    others = pd.concat([episodes_of(name) for name in ("ten_seeds", "more_scenes")])
    played = pd.concat([listed, others[others.seed > 0]])
    played["name"] = played.policy.map(checkpoint_of).str.removeprefix("mini-pi0-")
    played["name"] = played.name.replace("wide", "simpler-bridge-wide")
    played = played[played.name.isin(unseen)]
    _, *body = table("| policy by the recipe | method")
    assert len(body) == len(played[played.seed == 0].groupby(["name", "method"]))
    for name, method, *cells in body:
        method = method_of(method)
        of_row = played[(played.name == name) & (played.method == method)]
        listed = of_row[of_row.seed == 0]
        assert len(listed) == (96 if "bridge" in name else 250)
        parts = [listed, listed[listed.task == unseen[name]], of_row[of_row.seed > 0]]
        assert cells == [over_layouts(part, method) for part in parts]


@pytest.mark.parametrize(
    ("suite", "name"),
    [
        ("simpler-fractal", "mini-pi0-simpler-fractal-wide"),
        ("simpler-bridge", "mini-pi0-simpler-bridge-wide-seed-0"),
        ("vlabench", "mini-pi0-vlabench-wide"),
        ("tabletop", "mini-pi0-tabletop-longer"),
    ],
)
def test_what_a_policy_of_todays_recipe_does_with_generic_objects(suite: str, name: str) -> None:
    (_, *ways), (_, *cells) = table(f"| policy of {suite}")
    told = pd.read_parquet(RESULTS / f"{suite.removeprefix('simpler-')}_generic.parquet")
    assert set(told.policy.map(checkpoint_of)) == {name}
    assert cells == [of_way(told, way) for way in ways]
    assert set(ways) == set(told.method)


def test_what_policies_reach_that_never_saw_a_tint() -> None:
    played = episodes_of("tint_free")
    for heading, suite, apart in (
        ("| method | SR | CMR | wrong object moved", "simpler-bridge", "cmr"),
        ("| vlabench, tint-free | SR", "vlabench", "select-cat-figurine"),
    ):
        of_suite = played[played.suite == suite]
        _, *body = table(heading)
        assert {method_of(method) for method, *_ in body} == set(of_suite.method)
        for method, *cells in body:
            rows = of_suite[of_suite.method == method_of(method)]
            assert len(rows) == (96 if suite == "simpler-bridge" else 250)
            one = rows.cmr if apart == "cmr" else rows[rows.task == apart].success
            columns = (rows.success, one, rows.wrong_object, rows.first_object_correct)
            shares = [in_percent(rate(int(column.sum()), len(column))) for column in columns]
            assert [cell.strip("*") for cell in cells] == shares


def _starts(name: str, listed: int, others: int) -> list[tuple[str, str]]:
    """Of VAP and of generic: what it reaches as listed, and from so many other seeds."""
    played = episodes_of(name)
    at_home, elsewhere = played[played.seed == 0], played[played.seed > 0]
    assert (len(at_home), len(elsewhere)) == (listed, others * 192)
    return [(of_way(at_home, way), over_layouts(elsewhere, way)) for way in ("vap", "generic")]


def test_what_a_policy_reaches_that_was_made_again() -> None:
    again, ships = episodes_of("second_machine"), episodes_of("mini_pi0")
    ships = ships[(ships.suite == "vlabench") & ships.method.isin(["generic", "vap"])]
    assert again.groupby("method").size().to_dict() == {"generic": 250, "vap": 250}
    assert set(again.policy).isdisjoint(set(ships.policy))
    page = PAGES["docs/policy.md"]
    differing = []
    for name, rows in (("that ships, made beside a GPU", ships), ("made again", again)):
        assert f"| {name} | {of_way(rows, 'generic')} | {of_way(rows, 'vap')} |" in page
    for method in ("generic", "vap"):
        pair = [
            rows[rows.method == method].set_index(["task", "episode"]).success
            for rows in (again, ships)
        ]
        differing.append(int((pair[0] != pair[1]).sum()))
    assert f"{differing[0]} of generic's episodes and {differing[1]} of VAP's end otherwise" in page
    assert f"{of_way(again, 'vap')} % with VAP and {of_way(again, 'generic')} without" in PROSE


def test_what_a_policy_that_never_saw_a_tint_does_with_either_half() -> None:
    halves, whole = episodes_of("tint_free_halves"), episodes_of("tint_free")
    assert set(halves.policy) < set(whole.policy)
    assert halves.groupby("method").size().to_dict() == {"mask-only": 250, "rewrite-only": 250}
    tint, words = (of_way(halves, way) for way in ("mask-only", "rewrite-only"))
    assert f"the tint alone has {tint} %, the words alone {words} (" in PROSE
    generic = whole[(whole.suite == "vlabench") & (whole.method == "generic")]
    generic = generic.set_index(["task", "episode"]).success.astype(bool)
    for way, won, lost in (("mask-only", 11, 3), ("rewrite-only", 37, 34)):
        one = halves[halves.method == way].set_index(["task", "episode"]).success.astype(bool)
        one, other = one.align(generic, join="inner")
        assert ((one & ~other).sum(), (~one & other).sum()) == (won, lost)
    assert "(11 won and 3 lost, 37 and 34; exact p .06 and .81, uncorrected)" in PROSE


def test_what_the_policy_of_the_other_robot_that_never_saw_a_tint_does() -> None:
    told = episodes_of("tint_free_fractal")
    before = episodes_of("fractal_today")
    before = before[before.policy.isin(set(told.policy))]
    assert told.groupby("method").size().to_dict() == dict.fromkeys(
        ("hard-short", "hard-long", "soft", "mask-only", "rewrite-only", *BOUNDS), 460
    )
    both = pd.concat([before, told])
    points, ps = {}, {}
    for one, sign in (("generic", 1), ("vap", 1), ("below", -1)):
        for other in set(told.method):
            (whole,) = compare(both, [one.replace("below", "generic"), other], by_task=False)
            low, high = sorted((sign * whole.low, sign * whole.high))
            middle, low, high = (f"{100 * x:.0f}" for x in (sign * whole.difference, low, high))
            points[one, other] = f"{middle} [{low}, {high}]"
            ps[one, other] = f"{whole.p:.2f}".lstrip("0")
    tint, words = ("below", "mask-only"), ("below", "rewrite-only")
    assert (
        f"the tint alone and the words alone are {points[tint]} and {points[words]} points below "
        f"generic (p {ps[tint]} and {ps[words]})"
    ) in PROSE
    short, long, soft = (("generic", way) for way in ("hard-short", "hard-long", "soft"))
    assert (
        f"are {points[short]}, {points[long]} and {points[soft]} points above generic "
        f"(p {ps[short]}, {ps[long]} and {ps[soft]}, uncorrected)"
    ) in PROSE
    start, always = (("vap", way) for way in BOUNDS[:2])
    assert (
        f"changes VAP by {points[start]} and {points[always]} points "
        f"(p {ps[start]} and {ps[always]})"
    ) in PROSE
    wrong = told[told.method == "wrong-mask"].wrong_object.mean()
    assert f"given a look-alike's it moves a wrong object in {100 * wrong:.0f} %" in PROSE


@pytest.mark.parametrize(
    ("heading", "names"),
    [
        ("| default | SR | selects, of 80 |", ("mini_pi0", "oracle_track")),
        ("| wide | SR | selects, of 80 |", ("tabletop_by_recipe",)),
    ],
)
def test_what_tabletops_policies_of_the_recipe_reach(heading: str, names: tuple[str, ...]) -> None:
    head, *body = table(heading)
    played = pd.concat([episodes_of(name) for name in names])
    played = played[played.suite == "tabletop"]
    assert played.outcome.isin(("success", "failure")).all()
    assert played.groupby("method").size().eq(160).all()
    assert played.method.nunique() == len(body)
    for method, *cells in body:
        rows = played[played.method == method_of(method)]
        placing = rows.task.str.startswith("put")
        parts = [rows.success, rows.success[~placing], rows.success[placing], rows.wrong_object]
        held = [in_percent(rate(int(part.sum()), len(part))) for part in parts]
        assert [cell.strip("*") for cell in cells] == held, (head, method)
    assert _failures_by_case(played) in PROSE


def test_what_tabletops_policy_with_noisier_angles_reaches() -> None:
    played = episodes_of("tabletop_trained_on")
    assert played.groupby("method").size().eq(160).all()
    of_vap = played[played.method == "vap"]
    placing = of_vap.task.str.startswith("put")
    selects, places = (round(100 * of_vap.success[each].mean()) for each in (~placing, placing))
    assert (
        f"it has {of_way(played, 'vap').replace(' [', ' % [')} with VAP, selects {selects} and "
        f"places {places} (`python -m vap_core report data/results/tabletop_trained_on.parquet`"
    ) in PROSE
    assert _failures_by_case(played) in PROSE


def _failures_by_case(played: pd.DataFrame) -> str:
    failed = played[(played.method == "vap") & ~played.success.astype(bool)]
    counts = [len(failed), *(failed.case.eq(f"case {i}").sum() for i in (3, 2))]
    text = "of VAP's {} failures {} are Case 3, {} are views that contradict each other"
    return text.format(*counts)


def test_what_another_seed_of_vlabench_reaches() -> None:
    other, ships = episodes_of("another_seed"), episodes_of("mini_pi0")
    ships = ships[ships.suite == "vlabench"]
    ways = ("generic", "hard-short", "hard-long", "soft", "vap")
    assert other.groupby("method").size().to_dict() == dict.fromkeys(ways, 250)
    assert set(other.policy).isdisjoint(set(ships.policy))
    page = PAGES["docs/policy.md"]
    for name, rows in (("seed 0, the default", ships), ("seed 1", other)):
        assert f"| {name} | {' | '.join(of_way(rows, way) for way in ways)} |" in page
    assert f"{of_way(other, 'vap')} % with VAP and {of_way(other, 'generic')} without" in PROSE
