"""The p values and the zeros of docs/benchmarks.md are those of the tables that its sections name."""

import re
from functools import cache

import pandas as pd
import pytest

from tests.pages import PAGES, ROOT, table
from vap_core.evaluation.ablations.arms import ABLATIONS
from vap_core.evaluation.ablations.table import policy_results
from vap_core.evaluation.metrics import rate
from vap_core.evaluation.publish import read_published, read_runs
from vap_core.evaluation.report.runs import load_runs
from vap_core.evaluation.statistics import ALL_TASKS, compare, rate_over_layouts
from vap_core.policies.names import shipped_checkpoint
from vap_make.recipe import RECIPES
from vap_make.words import PAINTS

RESULTS = ROOT / "data" / "results"
BENCHMARKS = PAGES["docs/benchmarks.md"]
VALUE = r"(?:< )?(?:1|0?\.\d+)"
HOLM = re.compile(rf"Holm's p ({VALUE}(?:(?:, | and ){VALUE})*)")
Told = tuple[str, str, str]
"""The task and the two methods of one comparison."""
BRIDGE, VLABENCH = "mini-pi0-simpler-bridge", "mini-pi0-vlabench"
REPORTED: dict[tuple[str, str, str], tuple[tuple[Told, ...], ...]] = {
    ("A policy that never saw a tint", "tint_free", f"{BRIDGE}-tint-free"): (
        ((ALL_TASKS, "generic", "vap"), (ALL_TASKS, "vap", "hard-short")),
        (("put-owl-figurine", "generic", "vap"),),
        ((ALL_TASKS, "generic", "hard-short"), (ALL_TASKS, "generic", "hard-long")),
    ),
    ("The defaults of simpler-bridge and vlabench", "mini_pi0", f"{BRIDGE}-wide-seed-0"): (
        (
            (ALL_TASKS, "generic", "hard-short"),
            (ALL_TASKS, "generic", "hard-long"),
            (ALL_TASKS, "generic", "soft"),
        ),
        ((ALL_TASKS, "hard-long", "vap"),),
    ),
    ("The defaults of simpler-bridge and vlabench", "mini_pi0", f"{VLABENCH}-wide"): (
        ((ALL_TASKS, "generic", "vap"), (ALL_TASKS, "soft", "vap")),
        ((ALL_TASKS, "generic", "soft"),),
        ((ALL_TASKS, "generic", "hard-short"), (ALL_TASKS, "generic", "hard-long")),
    ),
    ("The default of tabletop", "mini_pi0", "mini-pi0-tabletop-longer"): (
        (
            (ALL_TASKS, "generic", "hard-short"),
            (ALL_TASKS, "generic", "hard-long"),
            (ALL_TASKS, "generic", "soft"),
        ),
    ),
    ("The default of tabletop", "tabletop_by_recipe", "mini-pi0-tabletop-wide"): (
        (
            (ALL_TASKS, "generic", "vap"),
            (ALL_TASKS, "hard-short", "vap"),
            (ALL_TASKS, "soft", "vap"),
        ),
        (
            (ALL_TASKS, "generic", "hard-short"),
            (ALL_TASKS, "generic", "hard-long"),
            (ALL_TASKS, "generic", "soft"),
        ),
    ),
    ("vlabench without a tint", "tint_free", f"{VLABENCH}-tint-free"): (
        ((ALL_TASKS, "generic", "vap"), (ALL_TASKS, "vap", "soft")),
        ((ALL_TASKS, "generic", "hard-short"), (ALL_TASKS, "generic", "hard-long")),
        ((ALL_TASKS, "generic", "soft"),),
    ),
}
"""By section, table and policy: what each "Holm's p" of the section is of, in its order."""
OF_ARMS = (
    ("0", "0.1", "0.2", "0.5"),
    ("0", "0.5"),
    ("0.1",),
)
"""The shares of tinted scenes of the dose's groups: of VAP, then twice of the tint alone."""


def section(title: str) -> str:
    """A section of the page without its line breaks."""
    start = BENCHMARKS.index(f"\n## {title}\n")
    return " ".join(BENCHMARKS[start : BENCHMARKS.index("\n## ", start + 1)].split())


def quoted(title: str) -> list[str]:
    """The values behind each "Holm's p" of a section."""
    return HOLM.findall(section(title))


def as_told(values: list[float]) -> str:
    """P values in the page's words; equal ones, such as "< .001", once."""
    texts = []
    for p in values:
        text = "< .001" if p < 0.001 else f"{p:.3f}".removeprefix("0").replace("1.000", "1")
        texts.append(text)
    if len(set(texts)) == 1:
        return texts[0]
    return " and ".join([", ".join(texts[:-1]), texts[-1]])


@cache
def reported(name: str) -> pd.DataFrame:
    """The comparisons that `report` prints of a published table."""
    runs = load_runs([RESULTS / f"{name}.parquet"])
    found = []
    for one in compare(runs.table, runs.methods):
        policy = one.policy.removeprefix("mini_pi0:").split("@")[0]
        names = frozenset((one.one, one.other))
        found.append((policy, one.split, one.task, names, one.other, one.difference, one.p_holm))
    columns = ["policy", "split", "task", "methods", "other", "difference", "p_holm"]
    return pd.DataFrame(found, columns=columns)


@pytest.mark.parametrize("title", list(dict.fromkeys(title for title, *_ in REPORTED)))
def test_every_holm_p_of_a_section_is_what_report_prints(title: str) -> None:
    held = []
    for (of_section, name, policy), groups in REPORTED.items():
        if of_section != title:
            continue
        found = reported(name)
        found = found[found.policy == policy].set_index(["task", "methods"]).p_holm
        for group in groups:
            held.append(as_told([found[task, frozenset(pair)] for task, *pair in group]))
    assert quoted(title) == held


def test_every_holm_p_of_the_main_table_is_what_report_prints() -> None:
    found = reported("mini_pi0")
    bounds = {"oracle-mask", "wrong-mask"}
    led = found[[("vap" in names) and not names & bounds for names in found.methods]]
    single = led[led.task != ALL_TASKS]
    assert led[led.task == ALL_TASKS].p_holm.max() < 0.001
    assert (len(single), (single.p_holm < 0.05).sum()) == (84, 44)
    descriptions = [{"generic", "hard-short"}, {"generic", "hard-long"}]
    words = found[[names in descriptions for names in found.methods]]
    assert (words[words.task == ALL_TASKS].difference > 0).all()
    assert quoted("What the shipped policies reach") == ["< .001", "< 0.05"]
    gain = single.difference * [1 if c == "vap" else -1 for c in single.other]
    assert (gain > 0).sum() == 83
    assert "83 comparisons of 84 (tabletop's select-cup, as the learned word); 44" in section(
        "What the shipped policies reach"
    )


def test_every_holm_p_of_the_dose_of_tints_is_what_its_commands_print() -> None:
    study = ABLATIONS["tint-share"]
    episodes = pd.concat([rows for _, rows in read_runs(RESULTS / "tint_share.parquet")])
    found = {}
    for label, results in policy_results(study, episodes).items():
        for one in results:
            if one.against is not None:
                found[label.removeprefix("share-"), one.arm] = one.against.p_holm
    held = []
    for arm, shares in zip(("vap", "mask-only", "mask-only"), OF_ARMS, strict=True):
        held.append(as_told([found[share, arm] for share in shares]))
    again = reported("tint_share_again")
    gains = again[[names == {"generic", "vap"} for names in again.methods]]
    held.append(as_told([gains[gains.task == ALL_TASKS].p_holm.max()]))
    assert quoted("A dose of tints") == held


def test_no_p_is_corrected_over_a_family_that_no_command_prints() -> None:
    """Each "Holm" of the page's prose is one of those above, or says that none is left."""
    prose = " ".join(BENCHMARKS.split())
    others = re.findall(r"Holm(?!'s p)", prose)
    assert len(others) == 1
    assert "none after Holm" in prose
    of_fractal = reported("mini_pi0")
    of_fractal = of_fractal[of_fractal.split == "variant aggregation"]
    of_fractal = of_fractal[of_fractal.task == ALL_TASKS].set_index("methods").p_holm
    for words in ("hard-short", "hard-long", "soft"):
        assert of_fractal[frozenset(("generic", words))] > 0.5


def test_the_held_out_tints_are_called_unseen_as_tints_alone() -> None:
    """Objects of the training are painted in both, and its commands name them."""
    held_out = {name for recipe in RECIPES.values() for name in recipe.held_out_tints}
    assert held_out == {"magenta", "yellow"}
    assert held_out <= {paint.name for paint in PAINTS}
    caveat = "held out as tints (as paint, and by name, they are in the training)"
    prose = " ".join(BENCHMARKS.split())
    assert prose.count(caveat) == 4
    assert "a test of unseen tints only" in prose
    for page, text in PAGES.items():
        if page == "CHANGELOG.md":
            continue
        prose = " ".join(text.split())
        for found in re.finditer(r"[Mm]agenta(?:,| and) yellow", prose):
            around = prose[found.start() : found.end() + 40]
            assert "tints" in around, f"{page}: {around}"


def test_the_bounds_are_those_of_their_table() -> None:
    _, *body = table("| suite | expert (reads the simulator), SR [95 %]")
    played = pd.concat([rows for _, rows in read_runs(RESULTS / "bounds.parquet")])
    assert {suite for suite, *_ in body} == set(played.suite)
    for suite, *cells in body:
        for policy, cell in zip(("expert", "random"), cells, strict=True):
            rows = played[(played.suite == suite) & (played.policy == policy)]
            k, n, errors = rows.success.sum(), len(rows), rows.outcome.eq("error").sum()
            told = f" ({errors} error)" if errors else ""
            assert cell == f"{k} of {n}{told}, {rate(int(k), n)}"


def test_a_rate_over_several_seeds_has_its_interval_over_layouts() -> None:
    prose = " ".join(BENCHMARKS.split())
    ten = pd.concat([rows for _, rows in read_runs(RESULTS / "ten_seeds.parquet")])
    elsewhere = ten[(ten.method == "vap") & (ten.seed > 0)]
    assert f"CMR is {rate_over_layouts(elsewhere, 'cmr')};" in prose
    starts = pd.concat([rows for _, rows in read_runs(RESULTS / "starts.parquet")])
    first = starts[starts.policy.str.endswith("00c47015") & (starts.method == "vap")]
    wrong = rate_over_layouts(first[first.seed > 0], "wrong_object")
    assert f"is moved in {wrong} of VAP's {len(first)} episodes" in prose


def test_a_column_of_selections_says_that_a_touch_counts() -> None:
    heads = [line for line in BENCHMARKS.splitlines() if "| wrong object moved" in line]
    assert [head.split("|")[1].strip() for head in heads if "moved or touched" not in head] == [
        "method"
    ]
    assert len(heads) == 4


def test_the_runs_of_a_policy_are_counted_as_its_table_holds_them() -> None:
    prose = " ".join(BENCHMARKS.split())
    counts = set()
    for name in ("mini_pi0", "by_recipe"):
        runs: dict[str, set[str]] = {}
        for manifest, rows in read_published(RESULTS / f"{name}.parquet"):
            for label in set(rows.policy[rows.suite.isin(("simpler-bridge", "vlabench"))]):
                runs.setdefault(label, set()).add(manifest["digest"])
        counts |= {len(digests) for digests in runs.values()}
    assert counts == {2, 3}
    assert "It was run, in two or three runs a policy, by" in prose


def test_no_zero_of_the_shared_scenes_hides_a_success() -> None:
    """0 in the table is 0 episodes: a rate of 1 of 72 has a bound above it."""
    _, *body = table("| suite | method | n | both steps, or SR")
    played = pd.concat([rows for _, rows in read_runs(RESULTS / "shared.parquet")])
    defaults = tuple(
        f"mini_pi0:{shipped_checkpoint(suite).name}" for suite in ("tabletop", "simpler-bridge")
    )
    policies = {
        "generic": defaults,
        "VAP": defaults,
        "VAP, scripted policy": ("scripted",),
        "VAP, taught pairs": ("mini_pi0:mini-pi0-shared-pair",),
    }
    suite = ""
    for named, cell, n, success, *_ in body:
        suite = named.strip("`") or suite
        method = cell.strip("*")
        rows = played[(played.suite == suite) & (played.method == method.split(",")[0].lower())]
        rows = rows[rows.policy.str.split("@").str[0].isin(policies[method])]
        assert len(rows) == int(n)
        told = str(rate(int(rows.success.sum()), len(rows))).replace(" %", "")
        assert success.split(" · ")[0].strip("*") == told


def test_the_first_policy_of_fractal_places_as_many_bottles_as_its_table_holds() -> None:
    rows = pd.read_parquet(RESULTS / "first_policy.parquet")
    rows = rows[(rows.task == "move-bottle-near-coke-can") & (rows.method == "vap")]
    held = f"in {rows.success.sum()} of {len(rows)} episodes of `data/results/first_policy.parquet`"
    assert held in " ".join(PAGES["docs/policy.md"].split())
