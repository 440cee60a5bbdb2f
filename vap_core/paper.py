"""The paper's numbers as facts, for comparison only: its own simulators, objects, cameras and 3-billion-parameter policies.

`data/paper_tables.csv` holds every number of its tables, one a line; `table` is the paper's label without "tab:".
"""

from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from vap_core.errors import BadOutput
from vap_core.values import value

if TYPE_CHECKING:
    import pandas as pd

LEDGER = Path(__file__).resolve().parents[1] / "data" / "paper_tables.csv"
COLUMNS = ["table", "row", "column", "metric", "value", "unit", "n", "note"]
FRACTAL, BRIDGE, VLABENCH, REAL = "simpler-google-robot", "simpler-widowx", "vlabench", "real_world_results"
TASKS: dict[tuple[str, str], tuple[str, str, str]] = {
    **{
        (FRACTAL, f"{split} / {task}"): ("simpler-fractal", split, name)
        for split in ("visual matching", "variant aggregation")
        for task, name in (("pick pen holder", "pick-pen-holder"), ("move bottle near coke can", "move-bottle-near-coke-can"))
    },
    **{(BRIDGE, task): ("simpler-bridge", "", task.replace(" ", "-")) for task in ("pick shaver", "put camera", "put owl figurine", "put straw cup")},
    **{
        (VLABENCH, it): ("vlabench", "", f"select-{it.replace(' ', '-')}") for it in ("leather bag", "shoe", "cat figurine", "miniature house", "cup")
    },
}
"""Which of our suite, split and task stands where a column of the paper's main tables does."""
METHODS = {
    "generic": "{}",
    "soft": "{} + soft prompt",
    "hard-short": "{} + hard prompt (short)",
    "hard-long": "{} + hard prompt (long)",
    "vap": "{} + VAP",
}
"""Which row of the paper's main tables a method of ours stands beside, after the name of the policy."""
FAILURES = {"P-SIMPLER (Fractal)": "simpler-fractal", "P-SIMPLER (Bridge)": "simpler-bridge", "P-VLABench": "vlabench", "Real-world": "tabletop"}
"""Which of our suites stands where a row of the paper's failure table does; its real arm is the robot of our tabletop."""
OTHER_WORLD = (
    "another world. The paper's own simulators or real arm, objects, pictures and 3-billion-parameter policies; "
    "they show the shape of its tables and are no target for the numbers beside them."
)


@value
class Oddity:
    """Something in the paper's tables that a reader should know before relying on them; `suites` where it is shown."""

    suites: tuple[str, ...]
    text: str


ODDITIES = (
    Oddity(
        ("simpler-fractal",),
        "Weighted by episodes (300 + 160 and 825 + 400, a split inferred from SIMPLER's scripts and not given), the Google Robot table has VAP at "
        "SR 61.2 and CMR 83.7. The ablation tables give SR 62.7 and CMR 83.7, the failure table 37.6 % failures, which is SR 62.4.",
    ),
    Oddity(
        ("simpler-fractal",),
        "With 300 and 160 episodes most visual-matching rates are no k of n; those of variant aggregation are, but two of twenty.",
    ),
    Oddity(
        ("simpler-bridge",),
        "All 16 numbers of the soft and the short hard prompt are k of 24, as from single runs, not means of 10 runs. Ten numbers of the other rows "
        "are no k of 240, which ten runs of 24 would give.",
    ),
    Oddity(
        ("simpler-bridge",),
        "VAP's mean CMR over the four WidowX tasks is 93.75; the ablation tables give 93.6. Its mean SR 83.5 agrees; the failure table's 16.6 % is "
        "0.1 more than 100 - 83.5.",
    ),
    Oddity(
        ("vlabench",),
        "All 25 success rates are multiples of 0.4, as 250 episodes a task give; 10 runs of 50 would be 500, and multiples of 0.2. The failure table "
        "counts 125 x 10 episodes for five tasks.",
    ),
    Oddity(
        ("tabletop",),
        "Real arm: 80.0 % of 80 selections and 58.8 % of 80 placings are 111 of 160, 30.6 % failures; the failure table gives 31.9 %, 51 of 160.",
    ),
)


@cache
def ledger() -> "pd.DataFrame":
    """Every fact, in the order of the paper; `value` and `n` as numbers, n nan where the paper gives none. Raises: BadOutput."""
    import pandas as pd

    try:
        facts = pd.read_csv(LEDGER, dtype={name: str for name in COLUMNS if name not in ("value", "n")}, keep_default_na=False, na_values={"n": ""})
        if list(facts.columns) != COLUMNS or facts["value"].dtype.kind not in "if":
            raise ValueError("other columns, or a value that is no number")
    except (OSError, ValueError) as error:
        raise BadOutput(f"paper.ledger: {LEDGER} is absent or damaged ({error}); restore it: git checkout data/{LEDGER.name}.") from error
    return facts.astype({"value": float, "n": float})


@cache
def main_results() -> "pd.DataFrame":
    """The paper's main tables in our names: suite, split, task, method, paper_method, and `sr` and `cmr` in percent (nan where not given)."""
    facts = ledger()
    facts = facts[facts["table"].isin([FRACTAL, BRIDGE, VLABENCH])]
    place = [TASKS[key] for key in zip(facts["table"], facts["column"], strict=True)]
    ours = {form.format(policy): name for name, form in METHODS.items() for policy in ("pi0", "pi0.5")}
    named = facts.assign(
        suite=[p[0] for p in place], split=[p[1] for p in place], task=[p[2] for p in place], method=facts["row"].map(ours), paper_method=facts["row"]
    )
    keys = ["suite", "split", "task", "method", "paper_method"]
    first = {key: i for i, key in reversed(list(enumerate(named[keys].itertuples(index=False, name=None))))}
    wide = named.pivot(index=keys, columns="metric", values="value").rename(columns=str.lower).rename_axis(columns=None)
    return wide.loc[sorted(wide.index, key=lambda key: first[key])].reset_index()[[*keys, "sr", "cmr"]]


def failure_cases() -> "pd.DataFrame":
    """The paper's failures of VAP (P tab:error_case_breakdown_simple): one row per suite; `fail` in percent of episodes, each case in percent of
    failures, nan where the paper says that it does not apply."""
    facts = ledger()
    facts = facts[facts["table"] == "error_case_breakdown_simple"]
    wide = facts.assign(suite=facts["row"].map(FAILURES)).pivot(index="suite", columns="metric", values="value").rename_axis(columns=None)
    return wide.loc[list(FAILURES.values()), ["fail", "case 1", "case 2", "case 3"]]


def real_arm() -> str:
    """What the paper gives for its real arm, which it does not tell by task."""
    facts = ledger()
    facts = facts[(facts["table"] == REAL) & facts["row"].isin(["pi0.5", "pi0.5 + VAP"])]
    told = [
        f"{column}: {', '.join(f'{line.row} {line.value:.1f}' for line in part.itertuples())}" for column, part in facts.groupby("column", sort=False)
    ]
    return f"The paper's real arm, SR % as means of four tasks each: {'; '.join(told)}."


def attainable(percent: float, n: int, decimals: int = 1) -> bool:
    """Whether some k of n, rounded either way at the half, reads `percent`."""
    return bool((np.abs(100 * np.arange(n + 1) / n - percent) <= 0.5 * 10.0**-decimals + 1e-9).any())


def oddities(suite: str) -> list[str]:
    """What to say under a table that shows the paper's numbers of `suite`."""
    return [odd.text for odd in ODDITIES if suite in odd.suites]
