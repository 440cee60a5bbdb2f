"""Figures and tables that are kept are made again when what they were made from has changed, and only then."""

from io import BytesIO
from pathlib import Path

import pandas as pd
import pyarrow.parquet as pq
import pytest
from matplotlib.figure import Figure
from PIL import Image

from vap_core import notebook
from vap_core.base.files import code_digest


def draw() -> Figure:
    return Figure(figsize=(2, 1))


def refuse() -> Figure:
    raise AssertionError("drawn again")


def test_a_figure_is_drawn_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "figure.png"
    first = notebook.kept_figure(path, draw)
    assert Image.open(BytesIO(first)).size == (220, 110)
    assert notebook.kept_figure(path, refuse) == first
    with pytest.raises(AssertionError, match="drawn again"):
        notebook.kept_figure(path, refuse, again=True)
    monkeypatch.setattr(notebook, "made_from", lambda: "other code")
    with pytest.raises(AssertionError, match="drawn again"):
        notebook.kept_figure(path, refuse)


def test_a_table_is_made_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "table.parquet"
    made = notebook.kept_table(path, lambda: pd.DataFrame({"n": [1, 2]}))
    assert notebook.kept_table(path, lambda: pd.DataFrame({"n": [3]})).equals(made)
    monkeypatch.setattr(notebook, "made_from", lambda: "other code")
    assert notebook.kept_table(path, lambda: pd.DataFrame({"n": [3]})).n.tolist() == [3]


def stamps() -> dict[str, str | None]:
    """What kept figures and tables were made from."""
    root, found = Path(__file__).parents[1], {}
    drawn = [f"01_benchmark_building_{name}" for name in ("objects", "generics", "references")]
    for name in (*drawn, "02_grounding_inspection_twins"):
        with Image.open(root / f"figures/{name}.png") as picture:
            found[name] = picture.info.get(notebook.KEY)
    for name in ("lookalike_hardness", "reference_crops"):
        about = pq.read_schema(root / f"data/results/{name}.parquet").metadata
        found[name] = about[notebook.KEY.encode()].decode()
    return found


COMMITTED = stamps()
"""Read while tests are collected, before any notebook makes again what is stale."""


def test_what_is_committed_was_made_from_what_ships() -> None:
    """Else notebooks 01 and 02 make it again wherever they run, which takes two minutes more."""
    now = notebook.made_from()
    assert [name for name, stamp in COMMITTED.items() if stamp != now] == [], (
        "execute notebooks 01 and 02"
    )


def test_a_comment_does_not_change_the_digest_of_code(tmp_path: Path) -> None:
    (tmp_path / "module.py").write_text("A = 1\n")
    before = code_digest(tmp_path)
    (tmp_path / "module.py").write_text('"""What it is."""\n\nA = 1  # one\n')
    assert code_digest(tmp_path) == before
    (tmp_path / "module.py").write_text("A = 2\n")
    assert code_digest(tmp_path) != before
    assert code_digest(tmp_path, without={"module"}) == code_digest(tmp_path / "nothing")
