"""What README and docs/ quote of the published tables is what they hold."""

import re

import pandas as pd
import pytest

from tests.pages import PAGES, PROSE, table
from tests.published import RESULTS, episodes_of, in_percent, method_of, of_way, over_layouts
from vap_core.policies.names import checkpoint_of
from vap_core.study.failures import breakdown, list_failures
from vap_core.study.results import load_runs, results
from vap_core.study.stats import ALL_TASKS, Estimate
from vap_core.study.trials import shipped

LIMITS = {"README.md": 800, "CHANGELOG.md": 1500, "docs": 10_000}
"""Words at most."""
RETIRED = (
    "first_policy_ablations", "by_recipe", "more_scenes", "more_steps", "horizon.parquet",
    "tabletop_older_engine", "tabletop_trained_on", "second_machine", "tint_share_again",
    "other_training_ablations", "mini-pi0-tabletop-wide", "mini-pi0-vlabench-tint-free",
    "mini-pi0-vlabench-wide", "tint_share.parquet", "oracle_track.parquet", "any-start",
)  # fmt: skip


def test_pages_keep_to_their_words() -> None:
    words = {name: len(text.split()) for name, text in PAGES.items()}
    found = {name: words[name] for name in ("README.md", "CHANGELOG.md")}
    found["docs"] = sum(n for name, n in words.items() if name.startswith("docs/"))
    assert {name: n for name, n in found.items() if n > LIMITS[name]} == {}


@pytest.mark.parametrize("name", RETIRED)
def test_no_page_names_what_is_retired(name: str) -> None:
    assert name not in PROSE


def test_success_rates() -> None:
    (head, *body), whole = (
        table("| method | simpler-fractal"),
        results(load_runs([RESULTS / "mini_pi0.parquet"])),
    )
    whole = whole[whole.task == ALL_TASKS]
    quoted = {}
    for method, *cells in body:
        for track, cell in zip(head[1:], cells, strict=True):
            if cell == "-":
                continue
            quoted[method_of(method), track] = cell.split("·")[0].strip(" *")
    held = {}
    for line in whole.itertuples():
        track = ", ".join(filter(None, (line.suite, line.split, f"n = {line.n} of {line.listed}")))
        held[line.method, track] = in_percent(Estimate(line.sr, line.sr_low, line.sr_high, line.n))
    assert quoted == held
    vap = whole[(whole.method == "vap") & (whole.suite == "simpler-fractal")]
    over = [
        f"[{100 * line.sr_layout_low:.0f}, {100 * line.sr_layout_high:.0f}]"
        for line in vap.itertuples()
    ]
    assert f"its VAP lies in {' and '.join(over)}" in PROSE


@pytest.mark.parametrize("suite", ["simpler-fractal", "simpler-bridge", "vlabench", "tabletop"])
def test_cases_of_failure(suite: str) -> None:
    counts = breakdown(
        list_failures(RESULTS / "mini_pi0.parquet", suite=suite, method="vap").episodes
    ).iloc[0]
    text = PROSE[PROSE.index("VAP's failures, by case") :]
    quoted = re.search(rf"{suite} (\d+), (\d+) and (\d+) % \((\d+) of (\d+)", text)
    shares = [
        f"{100 * counts[case] / counts.failed:.0f}" for case in ("case 1", "case 2", "case 3")
    ]
    assert quoted is not None
    assert quoted.groups() == (*shares, str(counts.failed), str(counts.n))
    if suite in ("vlabench", "tabletop"):
        short = " ".join(PAGES["README.md"].split())
        assert re.search(rf"\b{shares[1]} %( of VAP's failures)? on {suite}", short)


def test_no_hand_of_the_published_table_closes_after_the_last_action() -> None:
    """A terminal frame has no action: 65 time-outs were once missed grasps that it decided."""
    rows = pd.read_parquet(RESULTS / "mini_pi0.parquet")
    missed = rows[rows["sub_case"] == "missed grasp"]
    assert len(missed) == 1528
    assert (missed["deciding_frame"] < missed["steps"]).all()


def test_what_the_policy_without_an_overlay_shows() -> None:
    rows = episodes_of("mini_pi0").query("suite == 'vlabench'")
    vap = rows[rows.method.eq("vap") & rows.stage_voted & rows.stage_masked]
    assert f"VAP succeeds in {vap.success.sum()} of {len(vap)}." in PROSE
    unseen = episodes_of("ablations").query("suite == 'vlabench'")
    found = [of_way(unseen, f"only-{word}").split()[0] for word in ("magenta", "yellow")]
    assert f"neither show nor name: {' and '.join(found)} % of 250" in PROSE
    misled = rows[rows.method == "wrong-mask"]
    taken = f"in {misled.wrong_object.sum()} of {len(misled)}"
    assert f"it takes a wrong object {taken} episodes" in PROSE
    assert f"it takes a wrong object {taken}" in " ".join(PAGES["README.md"].split())


def test_what_other_starts_reach() -> None:
    seeds = episodes_of("ten_seeds")
    elsewhere = seeds[seeds.seed > 0]
    assert f"and {over_layouts(elsewhere, 'vap')} of 864 from seeds 1 to 9" in PROSE
    moved = episodes_of("starts")
    rates = {}
    for suite in ("vlabench", "tabletop"):
        rows = moved[moved.policy.map(checkpoint_of) == shipped(suite).name]
        rates[suite] = of_way(rows, "vap").split()[0]
    assert f"vlabench {rates['vlabench']} % of 250" in PROSE
    assert f"tabletop {rates['tabletop']} of 160" in PROSE


def test_what_shared_scenes_reach() -> None:
    played = pd.read_parquet(RESULTS / "shared.parquet")
    of_vap = played[played.method == "vap"]
    desk = of_vap[(of_vap.suite == "shared-sequence") & of_vap.policy.str.startswith("mini_pi0")]
    assert f"{of_way(desk, 'vap').replace(' [', ' % [')} of {len(desk)} on the desk" in PROSE
    pair = of_vap[of_vap.policy.str.contains("shared-pair@")]
    assert f"pairs {of_way(pair, 'vap').replace(' [', ' % [')} of {len(pair)}" in PROSE


def test_what_implicit_instructions_reach() -> None:
    found = []
    for _, told in episodes_of("implicit").groupby("suite"):
        found += [of_way(told, way).split()[0] for way in ("vap-implicit", "vap")]
    implicit, explicit, *more = found
    said = f'in {implicit} % of simpler-bridge\'s 96 episodes, and in {explicit} told "my"; '
    assert f"{said}of vlabench's 250 in {' and '.join(more)} (" in PROSE


def test_what_libero_reaches() -> None:
    found = results(load_runs([RESULTS / "libero.parquet"]))
    cells = []
    for line in found[found.task == ALL_TASKS].itertuples():
        assert (line.n, line.errors) == (33, 0)
        success = in_percent(Estimate(line.sr, line.sr_low, line.sr_high, 33))
        wrong = Estimate(line.wrong_object, line.wrong_object_low, line.wrong_object_high, 33)
        cells.append([line.method, f"{success} of 33", in_percent(wrong)])
    _, *rows = table("| method | success, % |")
    assert sorted([method_of(name), *rest] for name, *rest in rows) == sorted(cells)
