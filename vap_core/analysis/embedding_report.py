"""A vision-language model's embedding space against policies', as a table beside the paper's."""

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vap_core.analysis.embedding_search import Watch
from vap_core.analysis.embedding_space import compare, compare_tokens
from vap_core.base.errors import BadOutput, BadPolicy
from vap_core.base.files import make_folder, write_atomic, writing
from vap_core.base.tables import align
from vap_core.evaluation.paper import ledger
from vap_core.policies.embedding_table import open_table
from vap_core.policies.mini_pi0.teach_token import model_of_policy
from vap_core.policies.token_groups import token_groups
from vap_core.simulation.suites import BENCHMARKS

if TYPE_CHECKING:
    import pandas as pd

WHOLE = "whole table"
HEADER = ["policy", "tokens", "n", "cosine", "least", "CKA", "debiased", "kNN@1"]
MEASURES = {
    "cosine_mean": "cosine mean",
    "cosine_std": "cosine standard deviation",
    "cka": "CKA",
    "nearest": "kNN@1",
}
"""Our names of the paper's measures, and their names in its table."""
NOTE = (
    "n tokens, all of them, so there is no interval: mean and standard deviation of the cosine, "
    "its least value, linear CKA (plain, which is the paper's, and debiased), and the share whose "
    "nearest row in the policy's whole table is their own. Plain CKA nears 1 by itself where there "
    "are fewer tokens than features."
)


def spaces(
    vlm: Path | None, policies: Sequence[Path], suite: str = "", watch: Watch | None = None
) -> "pd.DataFrame":
    """A row per policy and group of tokens: the whole table, the suite's words, reserved ones.

    Without `vlm` each is compared with the shipped model that it grew from. The words are those of
    the instructions of `suite`, or of the benchmark in the policy's name, or of all.

    Raises: BadPolicy.
    """
    import pandas as pd

    rows = []
    for policy in policies:
        model = vlm or model_of_policy(policy)
        ours, theirs = open_table(model), open_table(policy)
        found = {WHOLE: compare(ours, theirs, watch)}
        names = _suites_of(policy, suite)
        n = found[WHOLE].tokens
        label = f"words of {names[0]}" if len(names) == 1 else "words of all suites"
        for group, tokens in token_groups((policy, model), _instructions(names)).items():
            shared = tokens[tokens < n]
            if len(shared):
                name = label if group == "words" else group
                found[name] = compare_tokens(ours, theirs, shared)
        for group, comparison in found.items():
            about: dict[str, Any] = {"vlm": model.name, "policy": policy.name, "group": group}
            rows.append({**about, "features": ours.shape[1], **asdict(comparison)})
    return pd.DataFrame(rows)


def paper_spaces() -> "pd.DataFrame":
    """The paper's rows (tab:embedding_comparison), under our names.

    Raises: BadOutput, as `paper.ledger`.
    """
    import pandas as pd

    table = ledger()
    table = table[table.table == "embedding_comparison"]
    rows = []
    for policy, part in table.groupby("row", sort=False):
        values = dict(zip(part.metric, part.value.astype(float), strict=True))
        row: dict[str, Any] = {"policy": policy, "group": WHOLE}
        row["tokens"] = int(values["vocabulary"])
        for name, metric in MEASURES.items():
            row[name] = values[metric]
        rows.append(row)
    return pd.DataFrame(rows)


def report(table: "pd.DataFrame") -> str:
    """The table as text, with the paper's below it. Raises: BadOutput, as `paper.ledger`."""
    rows = [HEADER]
    for row in table.to_dict("records"):
        rows.append(_cells(row))
    for row in paper_spaces().to_dict("records"):
        rows.append(_cells({**row, "policy": f"paper: {row['policy']}"}))
    left_out = table[table.without_direction > 0]
    note = f"{NOTE} {_compared(table)}"
    if len(left_out):
        note += f" Without rows of zeros, at most {left_out.without_direction.max()} a group."
    return f"{align(rows)}\n\n{note}"


def check_output(path: Path) -> None:
    """Make the folder of a file that `keep` will write, before the work.

    Raises: BadOutput when the name ends otherwise than .parquet or .csv, or the folder cannot be
        written.
    """
    if path.suffix not in (".parquet", ".csv"):
        raise BadOutput(
            f"embeddings: {path} ends with neither .parquet nor .csv; choose another --out."
        )
    make_folder(path.parent, "embeddings", "choose another --out")


def keep(table: "pd.DataFrame", path: Path) -> None:
    """Write the rows as Parquet or CSV, by the name's ending. Raises: BadOutput."""
    check_output(path)
    if path.suffix == ".csv":
        data = table.to_csv(index=False).encode()
    else:
        data = table.to_parquet(index=False, compression="zstd")
    with writing(path, "embeddings", "choose another --out"):
        write_atomic(path, data)


def _compared(table: "pd.DataFrame") -> str:
    """Which policies stand beside which model."""
    parts = []
    for vlm, part in table.groupby("vlm", sort=False):
        parts.append(f"{', '.join(part.policy.unique())} with {vlm}")
    return f"Compared: {'; '.join(parts)}."


def _cells(row: dict[str, Any]) -> list[str]:
    cells = [str(row["policy"]), str(row["group"]), str(row["tokens"])]
    cells.append(f"{row['cosine_mean']:.6f} ± {row['cosine_std']:.6f}")
    for name in ("cosine_min", "cka", "cka_debiased", "nearest"):
        number = row.get(name, float("nan"))
        cells.append("-" if number != number else f"{number:.4f}")
    return cells


def _suites_of(policy: Path, suite: str) -> list[str]:
    if suite:
        if suite not in BENCHMARKS:
            raise BadPolicy(f"embeddings: no suite {suite!r}; known: {', '.join(BENCHMARKS)}.")
        return [suite]
    for name in BENCHMARKS:
        if name in policy.name:
            return [name]
    return list(BENCHMARKS)


def _instructions(names: Sequence[str]) -> list[str]:
    texts = []
    for name in names:
        for task in BENCHMARKS[name].tasks:
            texts.append(task.instruction)
    return texts
