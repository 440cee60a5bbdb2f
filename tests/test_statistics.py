"""Comparisons against hand counts, SciPy and closed forms; what must not change when rows are shuffled or methods renamed."""

import math
from itertools import product
from typing import Any

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import norm, permutation_test
from statsmodels.stats.multitest import multipletests

from vap_core.simulation import suites
from vap_core.study.stats import (
    ALL_TASKS,
    COMPARED,
    bootstrap_interval,
    compare,
    detectable_effect_text,
    holm,
    layout_name,
    layout_names,
    mcnemar,
    minimum_detectable_effect,
    power,
    sign_flip,
)


def test_mcnemar_by_hand() -> None:
    """Nine discordant pairs, one of them the other way: 2 (C(9, 0) + C(9, 1)) / 2^9."""
    assert mcnemar(1, 8) == pytest.approx(2 * (1 + 9) / 512)
    assert mcnemar(8, 1) == mcnemar(1, 8)
    assert mcnemar(3, 3) == mcnemar(0, 0) == 1.0


@given(st.lists(st.floats(0, 1), max_size=8))
def test_holm_by_its_definition(p: list[float]) -> None:
    order, worst = sorted(range(len(p)), key=p.__getitem__), 0.0
    wanted = dict.fromkeys(order, 0.0)
    for rank, i in enumerate(order):
        worst = max(worst, min(1.0, (len(p) - rank) * p[i]))
        wanted[i] = worst
    assert holm(p) == pytest.approx([wanted[i] for i in range(len(p))])


def test_holm_is_that_of_statsmodels() -> None:
    p = [0.04, 0.001, 0.3, 0.02, 0.02, 1.0, 0.0]
    assert holm(p) == pytest.approx(multipletests(p, method="holm")[1].tolist())


def test_the_bootstrap_of_many_even_clusters_is_the_normal_interval_of_their_mean() -> None:
    gain = np.random.default_rng(1).choice([-1.0, 0.0, 1.0], size=600, p=[0.1, 0.6, 0.3])
    low, high = bootstrap_interval(gain, np.ones(600))
    half = norm.ppf(0.975) * gain.std() / math.sqrt(600)
    assert (low, high) == (
        pytest.approx(gain.mean() - half, abs=0.005),
        pytest.approx(gain.mean() + half, abs=0.005),
    )


def test_the_bootstrap_covers_the_truth_about_as_often_as_it_says() -> None:
    rng, draws = np.random.default_rng(7), 150
    gains = rng.choice([-1.0, 0.0, 1.0], size=(draws, 60), p=[0.05, 0.7, 0.25])
    inside = [
        low <= 0.2 <= high
        for low, high in (bootstrap_interval(gain, np.ones(60)) for gain in gains)
    ]
    assert 0.89 <= np.mean(inside) <= 0.99


def test_repeating_every_episode_of_a_cluster_adds_no_certainty() -> None:
    gain, ones = np.random.default_rng(2).choice([-1.0, 0.0, 1.0], size=40), np.ones(40)
    assert bootstrap_interval(10 * gain, 10 * ones) == pytest.approx(bootstrap_interval(gain, ones))


@pytest.mark.parametrize(
    ("gain", "least"), [(0.0, -1.0), (1.0, -1.0), (-1.0, -1.0), (0.0, 0.0), (1.0, 0.0)]
)
def test_clusters_that_are_all_alike_are_not_certain(gain: float, least: float) -> None:
    unseen = 1 - 0.025 ** (1 / 20)  # the largest share that 20 draws miss in one of forty cases
    low, high = bootstrap_interval(np.full(20, gain), np.ones(20), least)
    assert (low, high) == (
        pytest.approx(gain - unseen * (gain - least)),
        pytest.approx(gain + unseen * (1 - gain)),
    )
    assert high - low > 0.15


def test_the_sign_test_of_few_clusters_counts_every_pattern_of_signs() -> None:
    gain = np.array([3.0, 1.0, -2.0, 4.0, 5.0])
    totals = [abs(float(np.dot(signs, gain))) for signs in product((-1, 1), repeat=5)]
    assert sign_flip(gain) == pytest.approx(sum(total >= abs(gain.sum()) for total in totals) / 32)
    assert sign_flip(np.array([0.0, 2.0, 2.0, -2.0, 2.0])) == pytest.approx(mcnemar(1, 3))
    assert sign_flip(np.zeros(4)) == 1.0


@given(st.lists(st.integers(-6, 6), min_size=2, max_size=40))
@settings(max_examples=15)
def test_the_sign_test_of_more_clusters_is_scipys_permutation_test(gain: list[int]) -> None:
    def total(g: np.ndarray, axis: int = -1) -> np.ndarray:
        return g.sum(axis=axis)

    drawn = permutation_test(
        (np.array(gain, float),),
        total,
        permutation_type="samples",
        n_resamples=4000,
        rng=np.random.default_rng(6),
    )
    assert sign_flip(np.array(gain, float)) == pytest.approx(
        min(1.0, float(drawn.pvalue)), abs=0.035
    )


def test_the_sign_test_is_fine_enough_for_many_comparisons() -> None:
    assert sign_flip(np.full(40, 3.0)) == pytest.approx(2 * 0.5**40)


def episodes(
    won: dict[str, list[int]],
    task: str = "pick-shaver",
    suite: str = "simpler-bridge",
    **more: object,
) -> pd.DataFrame:
    """The first episodes of a list under each method, won or not."""
    rows = [
        {"suite": suite, "task": task, "split": "", "variant": "base", "episode": i, "seed": 0, "policy": "scripted", "method": method,
         "outcome": "success" if one else "failure", "success": bool(one), **more}
        for method, each in won.items() for i, one in enumerate(each)
    ]  # fmt: skip
    return pd.DataFrame(rows)


WON = {"generic": [1, 1, 0, 0, 0, 0, 0, 0, 0, 1], "vap": [1, 1, 1, 1, 1, 1, 1, 1, 0, 0]}


def compared(*given: Any, **more: Any) -> list[Any]:
    return list(compare(*given, **more).itertuples(index=False))


def told(c: Any) -> tuple[object, ...]:
    return tuple(getattr(c, name) for name in COMPARED)


def test_a_pair_of_methods_is_counted_by_hand() -> None:
    (c,) = compared(episodes(WON))
    assert (c.one, c.other, c.pairs, c.layouts) == ("generic", "vap", 10, 10)
    assert (c.both, c.only_one, c.only_other, c.neither) == (2, 1, 6, 1)
    assert c.difference == pytest.approx(0.5)
    assert c.p == c.p_mcnemar == c.p_holm == mcnemar(1, 6)
    assert c.low < 0.5 < c.high


def test_an_error_is_no_success() -> None:
    table = episodes(WON)
    table.loc[table.method.eq("vap") & table.episode.eq(0), "outcome"] = (
        "error"  # its success was already seen
    )
    (c,) = compared(table)
    assert (c.both, c.only_one, c.pairs) == (1, 2, 10)


def test_what_one_method_did_not_run_is_no_pair() -> None:
    table = episodes(WON)
    (c,) = compared(table[~(table.method.eq("vap") & (table.episode >= 7))])
    assert (c.pairs, c.only_other, c.only_one) == (7, 5, 0)
    assert compared(table[table.method == "vap"]) == []
    apart = table[(table.method == "vap") ^ (table.episode < 5)]
    assert compared(apart) == []


def test_policies_are_never_mixed() -> None:
    assert (
        compared(
            pd.concat(
                [episodes({"generic": [1, 0]}), episodes({"vap": [1, 0]}).assign(policy="other")]
            )
        )
        == []
    )


def test_order_of_rows_and_names_of_methods_change_nothing() -> None:
    table = pd.concat(
        [episodes(WON), episodes({"generic": [0, 1, 0], "vap": [1, 0, 1]}, task="put-camera")],
        ignore_index=True,
    )
    plain = [told(c) for c in compared(table, ["generic", "vap"])]
    shuffled = sorted(
        told(c) for c in compared(table.sample(frac=1, random_state=3), ["generic", "vap"])
    )
    assert shuffled == sorted(plain)
    (whole,) = compared(table, ["generic", "vap"], by_task=False)
    assert told(whole) == plain[-1], "all tasks together, without the comparisons of each"
    renamed = compared(table.replace({"vap": "zzz", "generic": "yyy"}), ["yyy", "zzz"])
    assert [told(c)[6:] for c in renamed] == [line[6:] for line in plain]


def test_turning_the_comparison_round_turns_its_sign() -> None:
    (c,), (back,) = (
        compared(episodes(WON), ["generic", "vap"]),
        compared(episodes(WON), ["vap", "generic"]),
    )
    assert (back.one, back.other, back.difference, back.p) == ("vap", "generic", -c.difference, c.p)
    assert (back.low, back.high) == (
        pytest.approx(-c.high, abs=0.11),
        pytest.approx(-c.low, abs=0.11),
    )  # a tenth is one episode


def test_seeds_of_one_layout_are_one_cluster() -> None:
    one = episodes(WON)
    (once,), (ten,) = (
        compared(one),
        compared(pd.concat([one.assign(seed=seed) for seed in range(10)])),
    )
    assert (ten.pairs, ten.layouts, ten.only_other) == (100, 10, 60)
    assert (ten.low, ten.high) == (pytest.approx(once.low), pytest.approx(once.high))
    assert ten.p == pytest.approx(once.p), "the same episodes ten times over prove no more"
    assert ten.p_mcnemar < 1e-9 < ten.p


def test_a_warm_ups_seeds_are_other_layouts() -> None:
    one = episodes(WON, task="pick-cup", suite="widowx-pick")
    (c,) = compared(pd.concat([one, one.assign(seed=1)]))
    assert (c.pairs, c.layouts) == (20, 20)


def test_holm_takes_single_tasks_and_all_of_them_apart() -> None:
    methods = {**WON, "mask-only": [0] * 10}
    table = pd.concat([episodes(methods), episodes(methods, task="put-camera")])
    found = compared(table)
    single, whole = (
        [c for c in found if c.task != ALL_TASKS],
        [c for c in found if c.task == ALL_TASKS],
    )
    assert (len(single), len(whole)) == (6, 3)
    assert [c.p_holm for c in single] == pytest.approx(holm([c.p for c in single]))
    assert [c.p_holm for c in whole] == pytest.approx(holm([c.p for c in whole]))
    assert whole[0].pairs == 20


def test_holm_does_not_depend_on_what_else_a_table_holds() -> None:
    methods = {**WON, "mask-only": [0] * 10}
    alone = episodes(methods)
    others = [episodes(methods, suite="vlabench"), episodes(methods).assign(policy="another")]
    by_itself, *beside = (
        [c.p_holm for c in compared(pd.concat([alone, one]))[:3]] for one in (None, *others)
    )
    assert min(by_itself) > min(c.p for c in compared(alone))
    assert all(one == by_itself for one in beside)


def test_a_layout_of_simpler_returns_under_every_look() -> None:
    fractal = suites.lists.read("simpler-fractal")
    known = pd.DataFrame(
        [{"suite": r.suite, "task": r.task, "episode": r.episode, "seed": 0} for r in fractal]
    ).assign(layout=lambda t: layout_names(t))
    assert known.groupby("task").layout.nunique().to_dict() == {
        "pick-pen-holder": 75,
        "move-bottle-near-coke-can": 40,
    }
    assert known.groupby("layout").size().value_counts().to_dict() == {
        15: 75,
        14: 40,
    }  # robot colours and variants
    for name in ("simpler-bridge", "vlabench", "tabletop"):
        listed = suites.lists.read(name)
        assert len({(row.task, layout_name(row)) for row in listed}) == len(listed)


def test_power_is_what_playing_it_gives() -> None:
    pairs, effect, discordant = 40, 0.3, 0.5
    rng = np.random.default_rng(5)
    better = rng.multinomial(
        pairs, [(discordant + effect) / 2, (discordant - effect) / 2, 1 - discordant], size=4000
    )
    found = np.mean([mcnemar(int(b), int(a)) <= 0.05 for a, b, _ in better])
    assert power(pairs, effect) == pytest.approx(found, abs=0.03)
    assert power(pairs, 0.0) <= 0.05


def test_what_can_be_detected() -> None:
    for pairs in (20, 24, 96, 300):
        effect = minimum_detectable_effect(pairs)
        assert power(pairs, effect) == pytest.approx(0.8, abs=2e-3)
        assert effect == pytest.approx(
            (norm.ppf(0.975) + norm.ppf(0.8)) * math.sqrt(0.5 / pairs), rel=0.2
        ), "the normal approximation"
    assert minimum_detectable_effect(96, discordant=0.2) < minimum_detectable_effect(96)
    assert math.isnan(minimum_detectable_effect(5)), "five discordant pairs give p = 0.0625 at best"


def test_what_is_said_before_a_run() -> None:
    assert detectable_effect_text(suites.rows("simpler-bridge", "pick-shaver")) == (
        "24 paired episodes: differences of 40 points or more are detected with 80 % power (alpha 5 %, exact McNemar, half of the pairs discordant)"
    )
    assert detectable_effect_text(suites.rows("simpler-fractal", "pick-pen-holder")).startswith(
        "1125 paired episodes on 75 layouts: differences of 23 points"
    )
    assert "too few to detect" in detectable_effect_text(suites.rows("widowx-pick", "pick-cup", 4))
