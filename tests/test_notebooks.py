"""Notebooks: one map, links that lead somewhere, and what a page of one holds."""

import base64
import json
import os
import re
import secrets
import shlex
import shutil
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from PIL import Image

from vap_core.base.errors import BadOutput
from vap_core.recording.show import free_port
from vap_make import pages as notebook_links
from vap_make import pages as notebook_pages

ROOT = Path(__file__).resolve().parents[1]
NOTEBOOKS = ROOT / "notebooks"
FILES = notebook_links.notebook_files(NOTEBOOKS)
READ = {path: notebook_links.read_notebook(path) for path in FILES}
TITLES = {path: notebook_links.notebook_title(notebook) for path, notebook in READ.items()}
LINK = re.compile(r"(?<!!)\[[^\]]+\]\(([^)\s]+)\)")
INTERVAL = re.compile(r"(-?\d*\.?\d+)(?: %)?(?: points?)? \[(-?\d*\.?\d+), (-?\d*\.?\d+)\]")
"""A value with its interval: 54 % [44, 64], 7 points [-6, 22], .74 [.52, .94]."""
ANSWERED_FROM_TABLES = ("05_learned_token.ipynb", "06_attention_maps.ipynb")
"""The notebooks whose first cell quotes what their cells print."""
WITHOUT_CONSOLE_TEXT = (
    "02_grounding_inspection.ipynb",
    *ANSWERED_FROM_TABLES,
    "09_shared_scenes.ipynb",
)
"""The notebooks whose conclusions are Markdown, and whose long outputs are tables."""
STREAM_LIMIT = 112
"""A page of 1,100 pixels has so many characters in a line of code."""


def markdown(path: Path) -> dict[str, str]:
    """Every Markdown cell by its id."""
    found = {}
    for cell in READ[path]["cells"]:
        if cell["cell_type"] == "markdown":
            found[cell["id"]] = "".join(cell["source"])
    return found


def anchors(path: Path) -> set[str]:
    """What a link into a notebook or a page may name after its #."""
    if path.suffix == ".ipynb":
        headings = re.findall(r"^#+ (.+)$", "\n".join(markdown(path).values()), re.MULTILINE)
        return {heading.replace(" ", "-") for heading in headings}
    headings = re.findall(r"^#+ (.+)$", path.read_text(), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", each.lower()).replace(" ", "-") for each in headings}


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.name)
def test_every_link_of_a_notebook_leads_somewhere(path: Path) -> None:
    for text in markdown(path).values():
        for link in LINK.findall(text):
            if link.startswith(("http://", "https://")):
                continue
            name, _, anchor = link.partition("#")
            target = (NOTEBOOKS / name).resolve() if name else path
            assert target.exists(), link
            assert not anchor or anchor in anchors(target), link


@pytest.mark.slow
def test_make_lab_serves_every_picture_and_link_of_a_notebook(tmp_path: Path) -> None:
    """It served notebooks/ alone: the tour's first picture and 15 links were 404."""
    makefile = (ROOT / "Makefile").read_text()
    options = re.findall(r"^(?:QUIET_LAB|WHOLE) := (.*)$", makefile, re.MULTILINE)
    address = f"http://127.0.0.1:{(port := free_port())}"
    command = [sys.executable, "-m", "jupyter", "lab", "--ip", "127.0.0.1", f"--port={port}"]
    command += [*shlex.split(" ".join(options)), "--no-browser", "--allow-root"]
    token = secrets.token_hex()
    asking = {"headers": {"Authorization": f"token {token}"}, "timeout": 30}
    environment = {**os.environ, "HOME": str(tmp_path), "JUPYTER_TOKEN": token}
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    with subprocess.Popen(command, cwd=ROOT, env=environment, **quiet) as process:
        try:
            deadline = time.monotonic() + 120
            while time.monotonic() < deadline:
                with suppress(httpx.HTTPError):
                    if httpx.get(f"{address}/api/status", **asking).status_code == 200:
                        break
                time.sleep(0.5)
            for of_a_stranger in ({}, {"Authorization": "token 0"}):
                for path in ("api/contents", "api/kernels", "api/terminals"):
                    refused = httpx.get(f"{address}/{path}", headers=of_a_stranger, timeout=30)
                    assert refused.status_code == 403
            rebound = {**asking["headers"], "Host": "a.page.of.a.stranger"}
            assert httpx.get(f"{address}/api/contents", headers=rebound).status_code == 403
            first = httpx.get(f"{address}/", follow_redirects=True, **asking)
            assert first.url.path == "/lab/tree/notebooks/00_tour.ipynb"
            asked = 0
            for path in FILES:
                for text in markdown(path).values():
                    for link in re.findall(r"\]\(([^)\s]+)\)", text):
                        name = link.partition("#")[0]
                        if name and not link.startswith(("http", "attachment:")):
                            inside = (NOTEBOOKS / name).resolve().relative_to(ROOT).as_posix()
                            # Lab opens folders and notebooks by its own interface.
                            opened = (ROOT / inside).is_dir() or inside.endswith(".ipynb")
                            at = f"api/contents/{inside}?content=0" if opened else f"files/{inside}"
                            answer = httpx.get(f"{address}/{at}", **asking)
                            assert answer.status_code == 200, (path.name, link)
                            asked += 1
            assert asked > 50
        finally:
            process.terminate()


def test_a_notebook_finds_the_repository_from_any_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Notebook 02, run from elsewhere, showed another survey in silence."""
    for path, notebook in READ.items():
        code = "".join("".join(c["source"]) for c in notebook["cells"] if c["cell_type"] == "code")
        assert "Path.cwd" not in code, path.name
        assert "from vap_core import WORKSPACE as ROOT" in code, path.name
    where = "import vap_core; print(vap_core.WORKSPACE)"
    done = subprocess.run(
        [sys.executable, "-c", where],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=True,
    )
    assert Path(done.stdout.strip()) == ROOT


def test_the_map_holds_every_notebook() -> None:
    table = markdown(FILES[0])[notebook_links.MAP_ID]
    for path, title in TITLES.items():
        assert f"[{title}]({path.name})" in table
        assert notebook_links.question(READ[path]), f"{path.name} asks no question"
    assert len(LINK.findall(table)) == len(FILES)
    assert table == notebook_links.map_text(READ), "python -m vap_make.pages links"


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.name)
def test_the_first_cell_answers_its_question(path: Path) -> None:
    """The map quotes the question, where "below the next cell" has no meaning."""
    first = "".join(READ[path]["cells"][0]["source"])
    assert "below the next cell" not in first
    answer = first.split("**Answer.**")[1].split("\n\n")[0]
    assert len(answer.split()) <= 60
    words = sum(len(text.split()) for text in markdown(path).values())
    assert words <= (1200 if path.name.startswith("07") else 900)


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.name)
def test_a_notebook_leads_to_its_neighbours(path: Path) -> None:
    cells = markdown(path)
    line = notebook_links.links_text(path, TITLES)
    assert cells[notebook_links.TOP_ID] == cells[notebook_links.END_ID] == line, (
        "python -m vap_make.pages links"
    )
    assert READ[path]["cells"][1]["id"] == notebook_links.TOP_ID


def test_a_notebook_is_titled_by_its_number() -> None:
    for path, title in TITLES.items():
        assert title.startswith(f"{path.name[:2]} · ")


def intervals(text: str) -> dict[str, list[tuple[float, float]]]:
    """Every value with an interval as it is written: three numbers with half of their last digit."""
    found = {}
    for match in INTERVAL.finditer(text):
        found[match[0]] = []
        for number in match.groups():
            digits = len(number.partition(".")[2])
            found[match[0]].append((float(number), 0.5 * 10**-digits))
    return found


def printed(notebook: dict[str, Any]) -> str:
    """The text of all outputs."""
    parts = []
    for cell in notebook["cells"]:
        for output in cell.get("outputs", []):
            parts += output.get("text", [])
            parts += output.get("data", {}).get("text/plain", [])
            parts += output.get("data", {}).get("text/markdown", [])
    return "".join(parts)


def unprinted(text: str, output: str) -> list[str]:
    """The values with intervals of a text that no output has, rounded as the text has them."""
    shown = list(intervals(output).values())
    missing = []
    for written, numbers in intervals(text).items():
        for others in shown:
            pairs = zip(numbers, others, strict=True)
            if all(abs(one - other) <= half + 1e-9 for (one, half), (other, _) in pairs):
                break
        else:
            missing.append(written)
    return missing


def test_what_is_quoted_is_compared_as_it_is_rounded() -> None:
    output = "success 48.4 [38.2, 57.8] 96, less -1.0 points [-9.4, 7.3]"
    assert unprinted("48 % [38, 58], -1 point [-9, 7]", output) == []
    assert unprinted("49 % [38, 58], .48 [.38, .58]", output) == ["49 % [38, 58]", ".48 [.38, .58]"]


@pytest.mark.parametrize("name", ANSWERED_FROM_TABLES)
def test_the_first_screen_quotes_what_the_cells_print(name: str) -> None:
    """Its intervals are written by hand and would stay when the tables change."""
    notebook = READ[NOTEBOOKS / name]
    answer = "".join(notebook["cells"][0]["source"])
    assert len(intervals(answer)) >= 4
    assert unprinted(answer, printed(notebook)) == []


@pytest.mark.parametrize("name", WITHOUT_CONSOLE_TEXT)
def test_no_printed_line_is_broken_on_a_page(name: str) -> None:
    for cell in READ[NOTEBOOKS / name]["cells"]:
        for output in cell.get("outputs", []):
            if output["output_type"] == "stream":
                for line in "".join(output["text"]).splitlines():
                    assert len(line) <= STREAM_LIMIT, (cell["id"], line)


def test_links_are_written_once_and_follow_a_new_notebook(tmp_path: Path) -> None:
    for path in FILES[:2]:
        shutil.copy(path, tmp_path)
    changed = notebook_links.write_links(tmp_path)
    assert changed[0].name == FILES[0].name
    assert notebook_links.write_links(tmp_path) == []
    new = {
        "cells": [{"cell_type": "markdown", "id": "t", "metadata": {}, "source": ["# 99 · New"]}],
        "metadata": {},
        "nbformat": 4,
        "nbformat_minor": 5,
    }
    (tmp_path / "99_new.ipynb").write_text(json.dumps(new))
    changed = notebook_links.write_links(tmp_path)
    assert [path.name for path in changed] == [FILES[0].name, FILES[1].name, "99_new.ipynb"]
    text = changed[1].read_text()
    assert "[99 · New](99_new.ipynb) →" in text
    assert f"← [{TITLES[FILES[0]]}]" in text


def test_a_folder_without_notebooks_and_a_broken_one_are_named(tmp_path: Path) -> None:
    with pytest.raises(BadOutput, match="no notebook in .*; name their folder"):
        notebook_links.write_links(tmp_path)
    (tmp_path / "00_tour.ipynb").write_text("{")
    with pytest.raises(BadOutput, match="00_tour.ipynb is no notebook"):
        notebook_links.write_links(tmp_path)


def notebook(folder: Path, *cells: dict) -> Path:
    """A notebook of these cells beside a folder with one figure."""
    (folder / "notebooks").mkdir()
    (folder / "figures").mkdir()
    Image.fromarray(np.zeros((4, 4, 3), np.uint8)).save(folder / "figures" / "a.png")
    first = {"cell_type": "markdown", "id": "t", "metadata": {}}
    first["source"] = (
        "# 00 · A <b>\n\n[next](01_b.ipynb#Here) [page](../a.md)\n\n![a](../figures/a.png)"
    )
    whole = {"cells": [first, *cells], "metadata": {}, "nbformat": 4, "nbformat_minor": 5}
    path = folder / "notebooks" / "00_a.ipynb"
    path.write_text(json.dumps(whole))
    return path


PIXEL = "iVBORw0KGgoAAAANSUhEUgAAAAEAAAABCAYAAAAfFcSJAAAADUlEQVR42mNk+M9QDwADhgGAWjR9awAAAABJRU5ErkJggg=="


def code(name: str, source: str, outputs: list, **metadata: object) -> dict:
    return {
        "cell_type": "code", "id": name, "metadata": metadata, "source": source,
        "outputs": outputs, "execution_count": 1,
    }  # fmt: skip


def shown(**data: str) -> dict:
    return {"output_type": "display_data", "metadata": {}, "data": data}


def test_a_page_needs_no_network_folds_its_assertions_and_leads_on(tmp_path: Path) -> None:
    widget = {notebook_pages.WIDGET: {"model_id": "a"}, "text/plain": "Box()"}
    path = notebook(
        tmp_path,
        code("c1", "assert two", [], jupyter={"source_hidden": True}),
        code("c2", "box", [shown(**widget)]),
        code("c3", "words", [shown(**widget, **{"text/html": "<em>the default</em>"})]),
        code("c4", "figure", [shown(**{"image/png": PIXEL})]),
    )
    page = notebook_pages.page_of(path, tmp_path / "build" / "html")
    assert "<title>00 · A &lt;b&gt;</title>" in page
    assert 'href="01_b.html#Here"' in page
    assert 'href="../../a.md"' in page
    figure = base64.b64encode((tmp_path / "figures" / "a.png").read_bytes()).decode()
    assert f'<img alt="a" src="data:image/png;base64,{figure}"' in page
    assert not re.findall(r'<img[^>]+src="(?!data:)', page)
    assert 'alt="00 · A, picture 1"' in page
    assert "No description" not in page
    assert page.count('<details class="folded">') == 1
    assert "A control: open the notebook in JupyterLab." in page
    assert "<em>the default</em>" in page
    scripts = re.findall(r"""<script[^>]*src=|import[^;\n]*https?://|@import url""", page)
    assert not scripts


def test_a_recording_becomes_the_viewer_where_there_is_one(tmp_path: Path) -> None:
    path = notebook(tmp_path, code("c", "view(x)", [], recording="data/runs/one.rrd"))
    out = tmp_path / "html"
    (out / "viewer").mkdir(parents=True)
    assert "Run this notebook, then <code>make html</code>" in notebook_pages.page_of(path, out)
    (tmp_path / "data" / "runs").mkdir(parents=True)
    (tmp_path / "data" / "runs" / "one.rrd").write_bytes(b"RRF2")
    page = notebook_pages.page_of(path, out)
    assert 'src="viewer/index.html?url=one.rrd"' in page
    assert (out / "viewer" / "one.rrd").read_bytes() == b"RRF2"


def test_pages_have_an_index_and_the_viewer_beside_them(tmp_path: Path) -> None:
    path = notebook(tmp_path)
    out = tmp_path / "html"
    notebook_pages.write_pages(path.parent, out)
    assert "<title>00 · A" in (out / "00_a.html").read_text()
    index = (out / "index.html").read_text()
    assert 'href="00_a.html"><img alt="" src="data:image/png;base64,' in index
    assert "<h2>00 · A &lt;b&gt;</h2>" in index
    assert (out / "viewer" / "re_viewer_bg.wasm").stat().st_size > 1_000_000
    with pytest.raises(BadOutput, match="choose another folder"):
        notebook_pages.write_pages(path.parent, path)


def test_the_papers_accuracy_of_implicit_instructions_stands_beside_ours_of_that_kind() -> None:
    notebook = READ[NOTEBOOKS / "09_shared_scenes.ipynb"]
    answer = "".join(notebook["cells"][0]["source"])
    assert "in 96 % of the 105 implicit ones (the paper's language model: 94.7 to 99.6 %" in answer
    assert "implicit ones in 96 % [91, 99] of 105 (the paper 94.7 to 99.6 %" in printed(notebook)


def test_forms_of_the_token_are_compared_over_tokens_and_the_copy_is_not_acquitted() -> None:
    """Four tokens, whose mean over tokens has an interval that holds none."""
    notebook = READ[NOTEBOOKS / "05_learned_token.ipynb"]
    output = printed(notebook)
    assert "pick-shaver -50, put-camera -4, put-owl-figurine -17, put-straw-cup -42" in output
    assert "over tokens -28 [-62, 6]" in output
    answer = "".join(notebook["cells"][0]["source"])
    for text in (answer, output):
        assert "what the copy costs is not measured" in text
        assert "copy is not what costs" not in text
