"""Notebooks: one map, links that lead somewhere, and what a page of one holds."""

import json
import re
import shutil
from pathlib import Path

import pytest

from vap_core.analysis import notebook_links
from vap_core.base.errors import BadOutput

ROOT = Path(__file__).resolve().parents[1]
NOTEBOOKS = ROOT / "notebooks"
FILES = notebook_links.notebook_files(NOTEBOOKS)
READ = {path: notebook_links.read_notebook(path) for path in FILES}
TITLES = {path: notebook_links.notebook_title(notebook) for path, notebook in READ.items()}
LINK = re.compile(r"(?<!!)\[[^\]]+\]\(([^)\s]+)\)")


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


def test_the_map_holds_every_notebook() -> None:
    table = markdown(FILES[0])[notebook_links.MAP_ID]
    for path, title in TITLES.items():
        assert f"[{title}]({path.name})" in table
        assert notebook_links.question(READ[path]), f"{path.name} asks no question"
    assert len(LINK.findall(table)) == len(FILES)


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.name)
def test_a_notebook_leads_to_its_neighbours(path: Path) -> None:
    cells = markdown(path)
    if path.name[:2] in ("05", "06", "07") and notebook_links.TOP_ID not in cells:
        pytest.skip("its links are still to be written")
    line = notebook_links.links_text(path, TITLES)
    assert cells[notebook_links.TOP_ID] == cells[notebook_links.END_ID] == line, (
        "python -m vap_core.analysis.notebook_links"
    )
    assert READ[path]["cells"][1]["id"] == notebook_links.TOP_ID


def test_a_notebook_is_titled_by_its_number() -> None:
    for path, title in TITLES.items():
        assert title.startswith(f"{path.name[:2]} · ")


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
