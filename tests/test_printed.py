"""Text from files is escaped where it leaves: terminal, Markdown, CSV."""

import shlex
import subprocess
import sys
from io import StringIO
from pathlib import Path

import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tqdm import tqdm

from tests.command import refused, vap
from vap_core.base.errors import printable
from vap_core.cli import Terminal
from vap_core.study.table import printed

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "data" / "results"
ESCAPES = (
    "\x1b[2J",
    "\x1b]0;title\x07",
    "\x9b31m",
    "\x08\x08",
    "\u202egnp.exe",
    "a\x00b",
    "one\rtwo",
)


@given(st.text())
def test_what_is_printed_holds_no_control_characters(text: str) -> None:
    shown = printable(text, "")
    assert not [c for c in shown if ord(c) < 32 or 0x7F <= ord(c) < 0xA0]
    if text.isprintable():
        assert shown == text


@pytest.mark.parametrize("text", ESCAPES)
def test_a_terminal_gets_no_commands_of_a_file(text: str) -> None:
    for stream in (Terminal(StringIO()), Terminal(StringIO(), "\n\t")):
        stream.write(f"before {text} after\n")
        shown = stream.getvalue()
        assert shown == f"before {printable(text)} after\n"
        assert not set(shown) & set("\x1b\x07\x9b\x08\u202e\x00\r")
    for style in ("text", "markdown", "html", "csv"):
        shown = printed([["name"], [text]], style)
        assert not set(shown) & set("\x1b\x07\x9b\x08\u202e\x00\r") or style == "csv"


def test_the_bars_of_long_work_still_move() -> None:
    out = Terminal(StringIO(), "\n\t\r")
    for _ in tqdm(range(3), file=out, leave=False, desc="outer"):
        for _ in tqdm(range(2), file=out, position=1, desc="inner"):
            pass
    assert "\r" in out.getvalue()
    assert "\x1b[A" in out.getvalue()
    assert "\\x1b" not in out.getvalue()


def test_text_in_a_table_of_markdown_is_no_html() -> None:
    rows = [["a|b"], ["<img src=x onerror=alert(1)> & <b> &lt; p < 0.1"], ["![i](http://x/y)"]]
    table = printed([*rows, ["one\\|cell"]], "markdown")
    assert "![i]\\(http://x/y)" in table  # a picture that is fetched where the report is read
    assert "one\\\\\\|cell" in table
    assert "<img" not in table
    assert "&lt;img src=x onerror=alert(1)> & &lt;b> &amp;lt; p < 0.1" in table


@pytest.mark.parametrize(
    "text",
    ["=1+1", "+A1", "-2+3", "@SUM(A1)", "\t=1", "\r=1", '=HYPERLINK("x")', "\n=1", "\uff1d1+1"],
)
def test_text_in_a_csv_file_is_no_formula(text: str) -> None:
    table = pd.DataFrame({"text": [text], "number": [-2.5]})
    written = printed(table, "csv")
    assert written == printed(table.astype({"text": "category"}), "csv")
    assert written.splitlines()[0] == "text,number"
    assert written.split("\n", 1)[1].lstrip('"').startswith("'")
    assert written.rstrip().endswith("-2.5")


def test_commands_print_a_strangers_text_escaped(tmp_path: Path) -> None:
    table = pd.read_parquet(RESULTS / "mini_pi0.parquet")
    failed = table[table["case_sentence"].notna()].head(3).copy()
    failed["case_sentence"] = "\x1b[2J\x1b]0;mine\x07 <script>"
    import pyarrow.parquet as pq

    notes = pq.read_schema(RESULTS / "mini_pi0.parquet").metadata
    import pyarrow as pa

    whole = pa.Table.from_pandas(failed, preserve_index=False).replace_schema_metadata(notes)
    pq.write_table(whole, tmp_path / "strange.parquet")
    done = vap("diagnose", tmp_path / "strange.parquet")
    assert "\x1b" not in done.stdout + done.stderr
    assert "\\x1b[2J" in done.stdout + done.stderr
    line = refused("diagnose", tmp_path / "strange.parquet", "--method", "\x1b[2Jvap")
    assert "\x1b" not in line


@pytest.mark.parametrize(
    ("words", "status", "said"),
    [
        ("ablate >&-", 0, ""),
        ("ablate > /dev/full", 2, "cannot be printed (No space left on device)"),
        ("ablate nothing 2>&-", 2, ""),
        ("ablate nothing 2> /dev/full", 2, ""),
        ("ablate >&- 2>&-", 0, ""),
    ],
)
def test_where_nothing_can_be_printed_is_no_traceback(words: str, status: int, said: str) -> None:
    line = f"{shlex.quote(sys.executable)} -m vap_core {words}"
    done = subprocess.run(line, shell=True, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == status
    assert said in done.stderr
    assert "Traceback" not in done.stderr
