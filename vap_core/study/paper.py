"""The paper's numbers, for comparison only.

They come from its own simulators, objects, cameras and 3-billion-parameter policies.
`data/paper_tables.csv` holds every number of its tables as printed, one a line; `table` is the
paper's label without "tab:".
"""

from functools import cache
from typing import TYPE_CHECKING

from vap_core.base.errors import BadOutput
from vap_core.base.files import DATA

if TYPE_CHECKING:
    import pandas as pd

LEDGER = DATA / "paper_tables.csv"
COLUMNS = ["table", "row", "column", "metric", "value", "unit", "n", "note"]
FRACTAL = "simpler-google-robot"
BRIDGE = "simpler-widowx"
VLABENCH = "vlabench"
REAL = "real_world_results"
TASKS: dict[tuple[str, str], tuple[str, str, str]] = {
    (FRACTAL, "visual matching / pick pen holder"): (
        "simpler-fractal",
        "visual matching",
        "pick-pen-holder",
    ),
    (FRACTAL, "visual matching / move bottle near coke can"): (
        "simpler-fractal",
        "visual matching",
        "move-bottle-near-coke-can",
    ),
    (FRACTAL, "variant aggregation / pick pen holder"): (
        "simpler-fractal",
        "variant aggregation",
        "pick-pen-holder",
    ),
    (FRACTAL, "variant aggregation / move bottle near coke can"): (
        "simpler-fractal",
        "variant aggregation",
        "move-bottle-near-coke-can",
    ),
    (BRIDGE, "pick shaver"): ("simpler-bridge", "", "pick-shaver"),
    (BRIDGE, "put camera"): ("simpler-bridge", "", "put-camera"),
    (BRIDGE, "put owl figurine"): ("simpler-bridge", "", "put-owl-figurine"),
    (BRIDGE, "put straw cup"): ("simpler-bridge", "", "put-straw-cup"),
    (VLABENCH, "leather bag"): ("vlabench", "", "select-leather-bag"),
    (VLABENCH, "shoe"): ("vlabench", "", "select-shoe"),
    (VLABENCH, "cat figurine"): ("vlabench", "", "select-cat-figurine"),
    (VLABENCH, "miniature house"): ("vlabench", "", "select-miniature-house"),
    (VLABENCH, "cup"): ("vlabench", "", "select-cup"),
}
"""Our suite, split and task for each column of the paper's main tables."""
METHODS = {
    "generic": "{}",
    "soft": "{} + soft prompt",
    "hard-short": "{} + hard prompt (short)",
    "hard-long": "{} + hard prompt (long)",
    "vap": "{} + VAP",
}
"""The row of the paper's main tables for each of our methods; {} is the name of the policy."""
POLICIES = ("pi0", "pi0.5")
FAILURES = {
    "P-SIMPLER (Fractal)": "simpler-fractal",
    "P-SIMPLER (Bridge)": "simpler-bridge",
    "P-VLABench": "vlabench",
    "Real-world": "tabletop",
}
"""Our suite for each row of the paper's failure table; its real arm is our tabletop's robot."""
OTHER_WORLD = (
    "another world. The paper's own simulators or real arm, objects, pictures and "
    "3-billion-parameter policies; they show the shape of its tables and are no target for the "
    "numbers beside them."
)


@cache
def ledger() -> "pd.DataFrame":
    """Every number, in the order of the paper and in its units; `n` nan where it gives none.

    Raises: BadOutput when the file is absent or damaged.
    """
    import pandas as pd

    text_columns = dict.fromkeys(COLUMNS, str)
    del text_columns["value"], text_columns["n"]
    try:
        facts = pd.read_csv(LEDGER, dtype=text_columns, keep_default_na=False, na_values={"n": ""})
        if list(facts.columns) != COLUMNS or facts["value"].dtype.kind not in "if":
            raise ValueError("other columns, or a value that is no number")
    except (OSError, ValueError) as error:
        raise BadOutput(
            f"paper.ledger: {LEDGER} is absent or damaged ({error}); restore it: git checkout "
            f"data/{LEDGER.name}."
        ) from error
    return facts.astype({"value": float, "n": float})


@cache
def main_results() -> "pd.DataFrame":
    """The paper's main tables in our names, in its order.

    Columns: suite, split, task, method, paper_method; `sr` and `cmr` as fractions, nan where not
    given.

    Raises: BadOutput, as `ledger`.
    """
    import pandas as pd

    keys = ["suite", "split", "task", "method", "paper_method"]
    methods = {row.format(policy): method for method, row in METHODS.items() for policy in POLICIES}
    facts = ledger()
    facts = facts[facts["table"].isin([FRACTAL, BRIDGE, VLABENCH])]
    lines = []
    for fact in facts.itertuples():
        names = (*TASKS[fact.table, fact.column], methods[fact.row], fact.row)
        lines.append((*names, fact.metric.lower(), fact.value / 100))
    long = pd.DataFrame(lines, columns=[*keys, "metric", "value"])
    wide = long.pivot(index=keys, columns="metric", values="value").reset_index()
    return long[keys].drop_duplicates().merge(wide, on=keys)[[*keys, "sr", "cmr"]]


def failure_cases() -> "pd.DataFrame":
    """The paper's failures of VAP (P tab:error_case_breakdown_simple), one row per suite.

    `fail` is a fraction of the episodes, each case a fraction of the failures; nan where the paper
    says that a case does not apply.

    Raises: BadOutput, as `ledger`.
    """
    facts = ledger()
    facts = facts[facts["table"] == "error_case_breakdown_simple"]
    facts = facts.assign(suite=facts["row"].map(FAILURES), value=facts["value"] / 100)
    wide = facts.pivot(index="suite", columns="metric", values="value").rename_axis(columns=None)
    return wide.loc[list(FAILURES.values()), ["fail", "case 1", "case 2", "case 3"]]


def real_arm() -> str:
    """The paper's results on its real arm, which it does not give by task.

    Raises: BadOutput, as `ledger`.
    """
    facts = ledger()
    facts = facts[(facts["table"] == REAL) & facts["row"].isin(["pi0.5", "pi0.5 + VAP"])]
    parts = []
    for column, part in facts.groupby("column", sort=False):
        rates = [f"{line.row} {line.value:.1f}" for line in part.itertuples()]
        parts.append(f"{column}: {', '.join(rates)}")
    return f"The paper's real arm, SR % as means of four tasks each: {'; '.join(parts)}."
