"""Parts and tables of measurements: what cannot be read or written is one line with a remedy."""

from pathlib import Path

import pandas as pd
import pytest

from vap_core.base.errors import BadOutput
from vap_core.study.store import (
    add_rows,
    publish_tables,
    read_json_part,
    write_json_part,
)


def test_a_part_comes_back_and_a_damaged_one_is_named(tmp_path: Path) -> None:
    path = tmp_path / "parts" / "one.json"
    write_json_part(path, {"rows": [1, None]}, caller="survey")
    assert read_json_part(path, caller="survey") == {"rows": [1, None]}
    path.write_text("{")
    with pytest.raises(BadOutput, match="survey: .* is damaged; delete it and run the same"):
        read_json_part(path, caller="survey")


def test_tables_that_cannot_be_published_are_one_line(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("no folder")
    with pytest.raises(BadOutput, match="survey: .* choose another folder with --publish"):
        publish_tables({"a.parquet": b"a"}, tmp_path / "file", caller="survey")


def test_rows_are_not_added_to_a_damaged_table(tmp_path: Path) -> None:
    (tmp_path / "kept.parquet").write_bytes(b"PAR1")
    with pytest.raises(BadOutput, match="is damaged; restore it, or delete it and publish again"):
        add_rows(tmp_path / "kept.parquet", pd.DataFrame({"n": [1]}), ["n"], {b"runs": "a"})
