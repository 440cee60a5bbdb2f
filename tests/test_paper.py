"""The ledger of the paper's tables: every number is there, averages and shares agree or are footnoted, and k of n is what the footnotes say."""

import re
from collections import Counter
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from vap_core.base.errors import BadOutput
from vap_core.simulation import suites
from vap_core.study import paper
from vap_core.study.paper import (
    BRIDGE,
    FRACTAL,
    REAL,
    TASKS,
    VLABENCH,
    ledger,
    main_results,
)

FOOTNOTES = (
    "Weighted by episodes (300 + 160 and 825 + 400, a split inferred from SIMPLER's scripts "
    "and not given), the Google Robot table has VAP at SR 61.2 and CMR 83.7. The ablation "
    "tables give SR 62.7 and CMR 83.7, the failure table 37.6 % failures, which is SR 62.4.",
    "With 300 and 160 episodes most visual-matching rates are no k of n; those of variant "
    "aggregation are, but two of twenty.",
    "All 16 numbers of the soft and the short hard prompt are k of 24, as from single runs, "
    "not means of 10 runs. Ten numbers of the other rows are no k of 240, which ten runs of "
    "24 would give.",
    "VAP's mean CMR over the four WidowX tasks is 93.75; the ablation tables give 93.6. Its "
    "mean SR 83.5 agrees; the failure table's 16.6 % is 0.1 more than 100 - 83.5.",
    "All 25 success rates are multiples of 0.4, as 250 episodes a task give; 10 runs of 50 "
    "would be 500, and multiples of 0.2. The failure table counts 125 x 10 episodes for five "
    "tasks.",
    "Real arm: 80.0 % of 80 selections and 58.8 % of 80 placings are 111 of 160, 30.6 % "
    "failures; the failure table gives 31.9 %, 51 of 160.",
)
"""What a reader should know of the paper's tables before relying on them."""
TEX = Path(__file__).parents[2] / "shared" / "paper" / "vap-paper.tex"
PICKS, NEARS = (
    {"visual matching": 300, "variant aggregation": 825},
    {"visual matching": 160, "variant aggregation": 400},
)


def attainable(percent: float, n: int, decimals: int = 1) -> bool:
    """Whether some k of n, rounded either way at the half, reads `percent`."""
    off = np.abs(100 * np.arange(n + 1) / n - percent)
    return bool((off <= 0.5 * 10.0**-decimals + 1e-9).any())


def values(**where: str) -> list[float]:
    facts = ledger()
    for name, wanted in where.items():
        facts = facts[facts[name] == wanted]
    assert len(facts), where
    return facts["value"].tolist()


def one(**where: str) -> float:
    (only,) = values(**where)
    return only


def said(*words: str) -> bool:
    """Whether one footnote has all of these words."""
    return any(all(word in odd for word in words) for odd in FOOTNOTES)


def test_every_table_of_the_paper_is_there_once() -> None:
    facts = ledger()
    assert Counter(facts["table"]) == {
        "benchmark_stats": 16, FRACTAL: 40, BRIDGE: 40, VLABENCH: 25, "runtime": 4, "error_case_breakdown_simple": 12, "llm_parser": 18,
        "benchmark_overview": 19, "object_specs": 19, "embedding_comparison": 20, "error_case_breakdown": 20, "ablation_rewrite": 12,
        "ablation_vote": 8, "ablation_k": 16, "ablation_prompt": 44, "occlusion_sweep": 42, "mask_quality": 10, "multiuser_seq": 3, "multi_object": 5,
        REAL: 8,
    }  # fmt: skip
    assert not facts.duplicated(["table", "row", "column", "metric", "note"]).any()
    assert facts.loc[facts["unit"] == "%", "value"].between(0, 100).all()
    assert set(facts["unit"]) == {"%", "1", "s", "Hz"}


@pytest.mark.skipif(not TEX.exists(), reason="the paper's source is not beside this checkout")
def test_the_ledger_is_the_papers_source() -> None:
    """Number by number: each decimal in a table's body stands in the ledger as often as there."""
    source, facts = TEX.read_text(), ledger()
    for block in re.findall(r"\\begin\{table\*?\}.*?\\end\{table\*?\}", source, re.DOTALL):
        label = re.findall(r"\\label\{tab:(.*?)\}", block)[0]
        body = block[block.index(r"\midrule") : block.index(r"\bottomrule")]
        body = re.sub(r"\\pi_?\{?0(\.5)?\}?|\\alpha=[\d.]+|\[\dpt\]", "", body)
        rows = [
            line.split("&", 1)[1] for line in body.replace(r"\%", "").split(r"\\") if "&" in line
        ]
        decimals = Counter(
            number for row in rows for number in map(float, re.findall(r"(?<![\d.])\d+\.\d+", row))
        )
        held = facts[
            (facts["table"] == label)
            & ((facts["unit"] != "1") | (facts["table"] == "embedding_comparison"))
        ]
        held = held[~held["metric"].isin(["rate", "vocabulary"])]
        assert decimals == Counter(held["value"]), label


def test_averages_of_the_main_tables_are_the_ablations() -> None:
    rewrite = {(column, metric): one(table="ablation_rewrite", row="VAP (mask + rewrite)", column=column, metric=metric)
               for column in ("Google Robot", "WidowX") for metric in ("CMR", "SR")}  # fmt: skip
    weighted = {}
    for metric in ("CMR", "SR"):
        picks = {
            s: one(table=FRACTAL, row="pi0 + VAP", column=f"{s} / pick pen holder", metric=metric)
            for s in PICKS
        }
        nears = {
            s: one(
                table=FRACTAL,
                row="pi0 + VAP",
                column=f"{s} / move bottle near coke can",
                metric=metric,
            )
            for s in NEARS
        }
        weighted[metric] = sum(PICKS[s] * picks[s] + NEARS[s] * nears[s] for s in PICKS) / 1685
    assert weighted["CMR"] == pytest.approx(rewrite["Google Robot", "CMR"], abs=0.05)
    assert weighted["SR"] == pytest.approx(61.2, abs=0.05)
    assert rewrite["Google Robot", "SR"] == 62.7
    assert said("61.2", "62.7", "62.4", "83.7")
    widowx = {
        metric: sum(values(table=BRIDGE, row="pi0 + VAP", metric=metric)) / 4
        for metric in ("CMR", "SR")
    }
    assert widowx["SR"] == pytest.approx(rewrite["WidowX", "SR"], abs=0.05)
    assert widowx["CMR"] == pytest.approx(93.75)
    assert rewrite["WidowX", "CMR"] == 93.6
    assert said("93.75", "93.6", "83.5")


def test_every_repetition_of_the_default_is_the_same() -> None:
    rows = [
        ("ablation_rewrite", "VAP (mask + rewrite)"),
        ("ablation_vote", "voting (VAP)"),
        ("ablation_k", "K = 5"),
    ]
    told = {tuple(values(table=table, row=row)) for table, row in rows}
    both = values(table="ablation_prompt", row="mask, alpha 0.5 (VAP)")
    assert told == {tuple(both[:4])} == {tuple(both[4:])}
    assert (
        values(table="occlusion_sweep", row="0 frames", metric="SR")
        == values(table="mask_quality", row="ratio 1.0")
        == [62.7, 83.5]
    )
    named = {"explicit": [60.3, 75.0, 71.3, 92.1, 95.0, 75.6]}
    assert values(table="llm_parser", column="explicit") == named["explicit"]
    assert named["explicit"][2:] == values(table=BRIDGE, row="pi0 + VAP", metric="SR")


def test_failures_and_their_shares() -> None:
    for table in ("error_case_breakdown_simple", "error_case_breakdown"):
        for row in ("P-SIMPLER (Fractal)", "P-SIMPLER (Bridge)", "P-VLABench", "Real-world"):
            facts = ledger()[(ledger()["table"] == table) & (ledger()["row"] == row)]
            assert facts.loc[
                facts["metric"].str.startswith("case"), "value"
            ].sum() == pytest.approx(100, abs=1e-9)
    fail = {
        row: one(table="error_case_breakdown", row=row, metric="fail")
        for row in ("P-SIMPLER (Bridge)", "P-VLABench", "Real-world")
    }
    assert fail["P-VLABench"] == pytest.approx(
        100 - sum(values(table=VLABENCH, row="pi0.5 + VAP")) / 5
    )
    bridge = 100 - sum(values(table=BRIDGE, row="pi0 + VAP", metric="SR")) / 4
    assert fail["P-SIMPLER (Bridge)"] - bridge == pytest.approx(0.1)
    assert said("16.6", "0.1 more")
    select, put = values(table=REAL, row="pi0.5 + VAP")
    won = round(0.8 * select) + round(0.8 * put)
    assert (won, round(100 * (160 - won) / 160, 1), fail["Real-world"]) == (111, 30.6, 31.9)
    assert attainable(31.9, 160)
    assert said("111 of 160", "30.6", "31.9")


def test_what_k_of_n_can_give() -> None:
    assert attainable(33.3, 3)
    assert attainable(12.5, 8)
    assert not attainable(33.4, 3)
    vlabench = values(table=VLABENCH)
    assert all(attainable(v, 250) for v in vlabench)
    assert all((10 * v) % 4 == pytest.approx(0) for v in vlabench)
    assert said("multiples of 0.4")
    table = ledger()[ledger()["table"] == BRIDGE]
    short = table["row"].isin(["pi0 + soft prompt", "pi0 + hard prompt (short)"])
    assert short.sum() == 16
    assert all(attainable(v, 24) for v in table.loc[short, "value"])
    assert sum(not attainable(v, 240) for v in table.loc[~short, "value"]) == 10
    assert said("16 numbers", "k of 24", "Ten numbers", "240")
    off = Counter()
    for column, part in ledger()[ledger()["table"] == FRACTAL].groupby("column"):
        split, task = str(column).split(" / ")
        off[split] += sum(
            not attainable(v, (PICKS if "pick" in task else NEARS)[split]) for v in part["value"]
        )
    assert off == {"visual matching": 13, "variant aggregation": 2}
    assert said("two of twenty")


def test_it_stands_beside_our_tasks_and_methods() -> None:
    for suite, split, task in TASKS.values():
        assert split in {row.split for row in suites.lists.read(suite) if row.task == task}
    told = main_results()
    assert len(told) == 65
    (line,) = told[(told["task"] == "put-owl-figurine") & (told["method"] == "vap")].to_dict(
        "records"
    )
    assert (line["paper_method"], line["sr"], line["cmr"]) == ("pi0 + VAP", 0.95, 1.0)
    assert told["cmr"].isna().equals(told["suite"] == "vlabench")
    assert paper.real_arm().endswith(
        "selection: pi0.5 30.0, pi0.5 + VAP 80.0; pick and place: pi0.5 18.8, pi0.5 + VAP 58.8."
    )


def test_a_damaged_ledger_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    broken = tmp_path / "paper_tables.csv"
    monkeypatch.setattr(paper, "LEDGER", broken)
    for text in (None, "", "table,row\na,b\n"):
        if text is not None:
            broken.write_text(text)
        with pytest.raises(
            BadOutput, match=r"paper_tables.csv is absent or damaged .*; restore it: git checkout"
        ):
            ledger.__wrapped__()
    whole = pd.DataFrame([["t", "r", "c", "SR", "much", "%", "", ""]], columns=paper.COLUMNS)
    whole.to_csv(broken, index=False)
    with pytest.raises(BadOutput, match="a value that is no number"):
        ledger.__wrapped__()


def test_the_papers_cases_sum_to_one() -> None:
    cases = paper.failure_cases()
    assert list(cases.index) == list(paper.FAILURES.values())
    assert cases[["case 1", "case 2", "case 3"]].sum(axis=1).round(6).tolist() == [1.0] * 4
    assert cases.loc["vlabench", "fail"] == pytest.approx(0.384)
