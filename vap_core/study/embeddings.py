"""A model's table of word embeddings against policies' (P tab:embedding_comparison).

Row i of both tables is token i. Three measures: the cosine of each token's two embeddings; linear
centred kernel alignment (CKA), which no rotation changes; and kNN@1, the share of the first table's
tokens whose nearest row of the second, by cosine, is their own.
"""

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float32, Float64, Int64

from vap_core.base.errors import BadOutput, BadPolicy
from vap_core.base.files import make_folder, write_atomic, writing
from vap_core.base.types import value
from vap_core.policies.mini_pi0.learned_token import model_of_policy
from vap_core.policies.tables import open_table, token_groups
from vap_core.simulation.suites import BENCHMARKS
from vap_core.study.paper import ledger
from vap_core.study.table import printed

if TYPE_CHECKING:
    import pandas as pd

BLOCK = 1024
"""Rows whose cosines with the whole other table are in memory at once."""
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


@value
class Comparison:
    """What two tables have in common over `tokens` tokens.

    `cka` is the plain estimate, which the paper prints; it nears 1 when there are fewer tokens than
    features, whatever they are. `cka_debiased` (Song et al. 2012) does not; it is nan for fewer
    than four tokens, or where the tables have no structure. A token whose row is zero in a table
    has no direction: cosine and kNN@1 (`nearest`) leave `without_direction` of them out.
    """

    tokens: int
    without_direction: int
    cosine_mean: float
    cosine_std: float
    cosine_min: float
    cka: float
    cka_debiased: float
    nearest: float


def compare(
    one: Float32[np.ndarray, "v d"],
    other: Float32[np.ndarray, "w e"],
    tokens: Int64[np.ndarray, " t"] | None = None,
) -> Comparison:
    """Compare some tokens, or the first ones, which both tables have: cosine and CKA among them,
    kNN@1 in the whole second table.

    Raises: BadPolicy: other widths, or every row of a table is zero.
    """
    if one.shape[1] != other.shape[1]:
        raise BadPolicy(
            f"embeddings: the tables have {one.shape[1]} and {other.shape[1]} features; compare a "
            "policy with the model that it was initialised from."
        )
    n = min(len(one), len(other))
    asked = np.arange(n) if tokens is None else tokens
    ours, theirs = one[asked], other[asked]
    cosines = paired_cosines(ours, theirs)
    known = np.flatnonzero(~np.isnan(cosines))
    if not len(known):
        raise BadPolicy("embeddings: every row of a table is zero; give trained models.")
    every = _unit_rows(other[:n])
    nearest = 0
    for first in range(0, len(known), BLOCK):
        rows = known[first : first + BLOCK]
        found = _unit_rows(ours[rows]) @ every.T
        found[np.arange(len(rows)), asked[rows]] = -np.inf
        nearest += int((found.max(axis=1, initial=-np.inf) <= cosines[rows] + 1e-12).sum())
    x, y = (
        part - part.mean(axis=0) for part in (ours.astype(np.float64), theirs.astype(np.float64))
    )
    cross, of_one, of_other = (np.square(a.T @ b).sum() for a, b in ((x, y), (x, x), (y, y)))
    scale = np.sqrt(of_one * of_other)
    return Comparison(
        tokens=len(asked),
        without_direction=len(asked) - len(known),
        cosine_mean=float(cosines[known].mean()),
        cosine_std=float(cosines[known].std()),
        cosine_min=float(cosines[known].min()),
        cka=float(cross / scale) if scale else float("nan"),
        cka_debiased=_cka_debiased(x, y),
        nearest=nearest / len(known),
    )


def paired_cosines(
    ours: Float32[np.ndarray, "r d"], theirs: Float32[np.ndarray, "r d"]
) -> Float64[np.ndarray, " r"]:
    """The cosine of every pair of rows in float64; nan where one is zero."""
    a, b = ours.astype(np.float64), theirs.astype(np.float64)
    norms = np.sqrt(np.square(a).sum(1) * np.square(b).sum(1))
    return np.divide((a * b).sum(1), norms, out=np.full(len(a), np.nan), where=norms > 0)


def _unit_rows(rows: Float32[np.ndarray, "r d"]) -> Float64[np.ndarray, "r d"]:
    norms = np.linalg.norm(rows.astype(np.float64), axis=1, keepdims=True)
    return rows.astype(np.float64) / np.where(norms > 0, norms, 1)


def _cka_debiased(x: Float64[np.ndarray, "n d"], y: Float64[np.ndarray, "n d"]) -> float:
    """CKA of Song et al.'s unbiased estimates of the dependence (HSIC); rows are centred."""
    n = len(x)
    if n < 4:
        return float("nan")

    def hsic(a: np.ndarray, b: np.ndarray) -> float:
        of_a, of_b = np.square(a).sum(1), np.square(b).sum(1)
        both = (of_a * of_b).sum()
        sums = of_a.sum() * of_b.sum() / ((n - 1) * (n - 2))
        trace = np.square(a.T @ b).sum() - both
        return float((trace + sums - 2 * both / (n - 2)) / (n * (n - 3)))

    of_x, of_y = hsic(x, x), hsic(y, y)
    return hsic(x, y) / float(np.sqrt(of_x * of_y)) if min(of_x, of_y) > 0 else float("nan")


def spaces(vlm: Path | None, policies: Sequence[Path], suite: str = "") -> "pd.DataFrame":
    """A row per policy and group of tokens: the whole table, the suite's words, reserved ones.

    Without `vlm` each is compared with the shipped model that it grew from. The words are those of
    the instructions of `suite`, or of the benchmark in the policy's name, or of all.

    Raises: BadPolicy.
    """
    import pandas as pd

    rows = []
    for policy in policies:
        model = vlm or model_of_policy(policy)
        ours, theirs = (open_table(folder).rows() for folder in (model, policy))
        found = {WHOLE: compare(ours, theirs)}
        names = _suites_of(policy, suite)
        n = found[WHOLE].tokens
        said = [task.instruction for name in names for task in BENCHMARKS[name].tasks]
        label = f"words of {names[0]}" if len(names) == 1 else "words of all suites"
        for group, tokens in token_groups((policy, model), said).items():
            shared = tokens[tokens < n]
            if len(shared):
                name = label if group == "words" else group
                found[name] = compare(ours, theirs, shared)
        for group, comparison in found.items():
            about = {"vlm": model.name, "policy": policy.name, "group": group}
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
        row = {"policy": policy, "group": WHOLE, "tokens": int(values["vocabulary"])}
        rows.append(row | {name: values[metric] for name, metric in MEASURES.items()})
    return pd.DataFrame(rows)


def report(table: "pd.DataFrame") -> str:
    """The table as text, with the paper's below it. Raises: BadOutput, as `paper.ledger`."""
    import pandas as pd

    theirs = paper_spaces()
    both = pd.concat([table, theirs.assign(policy="paper: " + theirs["policy"])], ignore_index=True)
    cosines = zip(both["cosine_mean"], both["cosine_std"], strict=True)
    shown = both[["policy", "group", "tokens"]].set_axis(HEADER[:3], axis=1)
    shown["cosine"] = [f"{mean:.6f} ± {deviation:.6f}" for mean, deviation in cosines]
    numbers = both[["cosine_min", "cka", "cka_debiased", "nearest"]].map("{:.4f}".format)
    shown[HEADER[4:]] = numbers.replace("nan", "-")
    left_out = table[table.without_direction > 0]
    policies = table.groupby("vlm", sort=False)["policy"].unique().items()
    compared = "; ".join(f"{', '.join(names)} with {vlm}" for vlm, names in policies)
    note = f"{NOTE} Compared: {compared}."
    if len(left_out):
        note += f" Without rows of zeros, at most {left_out.without_direction.max()} a group."
    return f"{printed(shown)}\n\n{note}"


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
        data = printed(table, "csv").encode()
    else:
        data = table.to_parquet(index=False, compression="zstd")
    with writing(path, "embeddings", "choose another --out"):
        write_atomic(path, data)


def _suites_of(policy: Path, suite: str) -> list[str]:
    if suite and suite not in BENCHMARKS:
        raise BadPolicy(f"embeddings: no suite {suite!r}; known: {', '.join(BENCHMARKS)}.")
    named = [name for name in BENCHMARKS if name in policy.name][:1]
    return [suite] if suite else named or list(BENCHMARKS)
