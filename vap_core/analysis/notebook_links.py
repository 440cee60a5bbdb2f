"""The map of all notebooks, and the links from each to the one before and the one after it.

    write_links(Path("notebooks"))

Links are Markdown cells of their own, so they work on a code host, in JupyterLab and as HTML. Only
these cells are written; nothing is run.
"""

import json
import re
from pathlib import Path
from typing import Any

from vap_core.base.errors import BadOutput
from vap_core.base.files import parse_json, write_atomic

MAP_NOTEBOOK = "00"
"""The number of the notebook that holds the map."""
MAP_ID, TOP_ID, END_ID = "all-notebooks", "links-top", "links-end"
"""The ids of the cells that are written here."""
MAP_HEADING = "All notebooks"


def notebook_files(folder: Path) -> list[Path]:
    """The notebooks of a folder, in their order. Raises: BadOutput where there is none."""
    found = sorted(folder.glob("[0-9][0-9]_*.ipynb"))
    if not found:
        raise BadOutput(f"notebook_links: there is no notebook in {folder}; name their folder.")
    return found


def read_notebook(path: Path) -> dict[str, Any]:
    """A notebook's JSON. Raises: BadOutput for a file that is none."""
    try:
        return dict(parse_json(path.read_text()))
    except (OSError, ValueError) as error:
        raise BadOutput(
            f"notebook_links: {path} is no notebook ({error}); restore it from git."
        ) from error


def notebook_title(notebook: dict[str, Any]) -> str:
    """The heading of its first cell, without the sign."""
    return "".join(notebook["cells"][0]["source"]).splitlines()[0].removeprefix("# ").strip()


def question(notebook: dict[str, Any]) -> str:
    """What stands after **Question.** in its first cell, as one line."""
    first = "".join(notebook["cells"][0]["source"])
    found = re.search(r"\*\*Question\.\*\*\s*(.+)", first)
    return "" if found is None else found[1].strip()


def links_text(path: Path, titles: dict[Path, str]) -> str:
    """The line that leads from `path` to its neighbours and to the map; `titles` are in order."""
    paths = list(titles)
    at = paths.index(path)
    parts = []
    if at > 0:
        parts.append(f"← [{titles[paths[at - 1]]}]({paths[at - 1].name})")
    anchor = MAP_HEADING.replace(" ", "-")
    parts.append(f"[{MAP_HEADING.lower()}]({_map_file(paths).name}#{anchor})")
    if at + 1 < len(paths):
        parts.append(f"[{titles[paths[at + 1]]}]({paths[at + 1].name}) →")
    return " · ".join(parts)


def map_text(notebooks: dict[Path, dict[str, Any]]) -> str:
    """The table of all notebooks: each with the question that it answers."""
    lines = [f"## {MAP_HEADING}", "", "| notebook | question |", "| --- | --- |"]
    for path, notebook in notebooks.items():
        asked = question(notebook).replace("|", "\\|").replace("<", "&lt;")
        lines.append(f"| [{notebook_title(notebook)}]({path.name}) | {asked} |")
    return "\n".join(lines)


def write_links(folder: Path) -> list[Path]:
    """Write the map and every notebook's links; returns the notebooks that have changed.

    Raises: BadOutput where there is no notebook, or one is damaged.
    """
    notebooks = {path: read_notebook(path) for path in notebook_files(folder)}
    titles = {path: notebook_title(notebook) for path, notebook in notebooks.items()}
    table = map_text(notebooks)
    changed = []
    for path, notebook in notebooks.items():
        before = json.dumps(notebook)
        text = links_text(path, titles)
        _put_cell(notebook["cells"], TOP_ID, text, at=1)
        if path == _map_file(list(notebooks)):
            _put_cell(notebook["cells"], MAP_ID, table, at=len(notebook["cells"]))
        _put_cell(notebook["cells"], END_ID, text, at=len(notebook["cells"]))
        if json.dumps(notebook) != before:
            data = json.dumps(notebook, indent=1, ensure_ascii=False) + "\n"
            write_atomic(path, data.encode())
            changed.append(path)
    return changed


def _map_file(paths: list[Path]) -> Path:
    return next((path for path in paths if path.name.startswith(MAP_NOTEBOOK)), paths[0])


def _put_cell(cells: list[dict[str, Any]], name: str, text: str, at: int) -> None:
    """Write a Markdown cell by its id, at `at` where there is none yet."""
    source = text.splitlines(keepends=True)
    for cell in cells:
        if cell.get("id") == name:
            cell["source"] = source
            return
    cell = {"cell_type": "markdown", "id": name, "metadata": {}, "source": source}
    cells.insert(at, cell)


def main() -> None:
    """Write the links in ./notebooks: python -m vap_core.analysis.notebook_links."""
    for path in write_links(Path("notebooks")):
        print(f"links of {path}")


if __name__ == "__main__":
    main()
