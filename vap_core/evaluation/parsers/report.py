"""Accuracy of parsers by kind of instruction, as text and as a published table."""

import json
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from vap_core.base.tables import Rows, align
from vap_core.base.version import code_version
from vap_core.evaluation.measurements import encode_table, publish_tables
from vap_core.evaluation.metrics import rate
from vap_core.evaluation.parsers.measure import paraphrase_digest
from vap_core.evaluation.parsers.paraphrases import KINDS
from vap_core.evaluation.statistics import bootstrap_interval

if TYPE_CHECKING:
    import pandas as pd

TABLE = "parsers.parquet"
ALL = "all"


def text(table: "pd.DataFrame") -> str:
    """Accuracy by parser, part and kind, and what happens where no personal object is meant."""
    notes = (
        "right: the object that is meant is found, or none where none is meant; [95 %: Wilson; "
        "families resampled]. wrong object: another is found. kept: of those right, the rewrite "
        "keeps the rest of the command."
    )
    return f"{align(rows(table))}\n{notes}"


def rows(table: "pd.DataFrame") -> Rows:
    """A line per parser, part and kind; the header first."""
    lines = [
        ["parser", "part", "kind", "families", "n", "right", "abstains", "wrong object", "kept"]
    ]
    for (parser, part), group in table.groupby(["parser", "part"], sort=False):
        for kind in (*KINDS, ALL):
            of_kind = group if kind == ALL else group[group["kind"] == kind]
            if len(of_kind):
                lines.append([str(parser), str(part), kind, *_cells(of_kind)])
    return lines


def publish(table: "pd.DataFrame", to: Path) -> list[Path]:
    """Write every answer, with its provenance, as parsers.parquet. Raises: BadOutput."""
    import pyarrow as pa

    about = {"code": code_version(), "paraphrases": paraphrase_digest()}
    arrow = pa.Table.from_pandas(table, preserve_index=False)
    metadata = {**(arrow.schema.metadata or {}), b"about": json.dumps(about).encode()}
    data = encode_table(arrow.replace_schema_metadata(metadata))
    return publish_tables({TABLE: data}, to, "measure parsers")


def _cells(group: "pd.DataFrame") -> list[str]:
    families = group.groupby("family")["right"].agg(["sum", "count"])
    gain = families["sum"].to_numpy(float)
    n = families["count"].to_numpy(float)
    low, high = bootstrap_interval(gain, n, least=0.0)
    right = rate(int(group["right"].sum()), len(group))
    silent = group["found"] == ""
    wrong = ~silent & ~group["right"]
    kept = group[group["right"] & ~silent]["kept"]
    whole = np.round(100 * np.clip([low, high], 0, 1)).astype(int)
    return [
        str(len(families)),
        str(len(group)),
        f"{right} [{whole[0]}, {whole[1]}]",
        f"{100 * silent.mean():.0f} %",
        f"{100 * wrong.mean():.0f} %",
        f"{100 * kept.mean():.0f} %" if len(kept) else "-",
    ]
