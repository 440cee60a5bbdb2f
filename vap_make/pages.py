"""Every notebook as an HTML page that needs no network and no Python; the links between them.

    make links
    make html
    python -m http.server --bind 127.0.0.1 --directory build/html

A cell whose metadata name a `recording` becomes Rerun's viewer, for which the pages must be served;
read from files they show the still picture alone. Cells whose source JupyterLab hides are folded.
"""

import html
import json
import os
import re
import shutil
import sys
from base64 import b64encode
from functools import cache
from mimetypes import guess_type
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

from vap_core.base.errors import BadOutput, require
from vap_core.base.files import parse_json, write_atomic, writing

if TYPE_CHECKING:
    from nbformat import NotebookNode

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


HEADING_OR_NAMELESS = re.compile(
    r"<h[1-6][^>]*>(?P<heading>.*?)</h[1-6]>|"
    r'alt="No description has been provided for this image"',
    re.DOTALL,
)
"""A heading of a page, or the words that nbconvert gives a picture without any."""
OUT = Path("build/html")
"""Where pages are written; git ignores it."""
WIDGET = "application/vnd.jupyter.widget-view+json"
FOLDED = """\
{%- extends 'lab/index.html.j2' -%}
{%- block html_head_js -%}{%- endblock -%}
{%- block html_head_js_mathjax -%}{%- endblock -%}
{%- block html_head_js_mermaidjs -%}{%- endblock -%}
{%- block input_group -%}
{%- if cell.metadata.get('jupyter', {}).get('source_hidden') -%}
<details class="folded"><summary>the assertions behind this</summary>{{ super() }}</details>
{%- else -%}{{ super() }}{%- endif -%}
{%- endblock -%}
"""
"""The template of a page: JupyterLab's, with hidden sources folded and nothing from the network."""
STYLE = """<link rel="icon" href="data:,"><style>
.folded summary{margin:4px 0 4px 80px;color:#555;cursor:pointer;font-size:13px}
iframe.recording{width:100%;height:720px;border:1px solid #ccc}
main{max-width:1280px;margin:0 auto}
.jp-RenderedHTMLCommon table{font-size:13px}
.jp-InputArea pre,.jp-RenderedText pre{white-space:pre-wrap;word-break:normal;
overflow-wrap:anywhere}
</style>"""
VIEWER_PAGE = """<!doctype html><html lang="en"><head><meta charset="utf-8"><title>Recording</title>
<link rel="stylesheet" href="widget.css">
<style>html,body{margin:0;height:100%;background:#111;color:#ddd;font:15px system-ui}</style>
</head><body><div id="viewer"></div><script type="module">
import widget from "./widget.js";
const named = new URLSearchParams(location.search).get("url");
const values = {
  _url: new URL(named, location.href).href, _width: "auto", _height: window.innerHeight,
  _panel_states: {}, _fallback_token: "", _theme: null,
};
const model = {get: (name) => values[name], on() {}, send() {}};
widget.render({model, el: document.getElementById("viewer")});
</script></body></html>
"""
"""Rerun's notebook widget without a notebook: it opens the recording that the address names."""


def write_pages(notebooks: Path, out: Path) -> list[Path]:
    """Write a page per notebook, an index, and the viewer; returns the pages.

    Raises: BadOutput where there is no notebook or `out` cannot be written; MissingPart.
    """
    pages = []
    listed = []
    with writing(out, "notebook_pages", "choose another folder"):
        _write_viewer(out / "viewer")
        for path in notebook_files(notebooks):
            page = out / f"{path.stem}.html"
            write_atomic(page, page_of(path, out).encode())
            pages.append(page)
            title = notebook_title(read_notebook(path))
            listed.append(f'<li><a href="{page.name}">{html.escape(title)}</a></li>')
        index = f"<!doctype html><meta charset='utf-8'><title>Notebooks</title>{STYLE}"
        index += f"<main><h1>Notebooks</h1><ul>{''.join(listed)}</ul></main>\n"
        write_atomic(out / "index.html", index.encode())
    return pages


def page_of(path: Path, out: Path) -> str:
    """A notebook as the HTML page that stands in `out`; its recordings are copied there.

    Raises: MissingPart: the extra `notebooks` is not installed.
    """
    require("notebooks", "notebooks as pages")
    import nbformat

    notebook = nbformat.read(path, as_version=4)
    notebook.metadata.pop("widgets", None)
    for cell in notebook.cells:
        if cell.cell_type != "code":
            continue
        recording = cell.metadata.get("recording")
        if recording is not None:
            cell.outputs = [_viewer_output(path.parent.parent / recording, out)]
        for output in cell.outputs:
            _drop_widget(output)
    resources = {"metadata": {"path": str(path.parent)}}
    body, _ = _exporter().from_notebook_node(notebook, resources)
    title = html.escape(notebook_title(notebook))
    body = re.sub(r"<title>.*?</title>", lambda _: f"<title>{title}</title>", body, count=1)
    body = body.replace("</head>", f"{STYLE}</head>", 1)
    body = _name_pictures(body)
    body = re.sub(r'src="(\.\./[^":]+)"', lambda picture: _embedded(picture, path), body)
    return re.sub(r'href="([^"#:]+)(#[^"]*)?"', lambda link: _link(link, path, out), body)


@cache
def _exporter() -> Any:
    from nbconvert import HTMLExporter

    return HTMLExporter(
        raw_template=FOLDED,
        embed_images=True,
        exclude_input_prompt=True,
        exclude_output_prompt=True,
        mathjax_url="",
        require_js_url="",
        mermaid_js_url="",
        widget_renderer_url="",
    )


def _drop_widget(output: "NotebookNode") -> None:
    """A widget needs a kernel: leave what the output shows without one."""
    data = output.get("data", {})
    if WIDGET in data:
        del data[WIDGET]
        if "text/html" not in data and "text/markdown" not in data:
            data["text/html"] = "<p><em>A control: open the notebook in JupyterLab.</em></p>"


def _name_pictures(body: str) -> str:
    """Every picture without words of its own gets those of its section, for who cannot see it."""
    section = ""
    n_pictures = 0

    def named(found: re.Match[str]) -> str:
        nonlocal section, n_pictures
        if found["heading"] is not None:
            section = re.sub(r"<a class=.anchor-link.*?</a>|<[^>]+>", "", found["heading"])
            n_pictures = 0
            return found[0]
        n_pictures += 1
        return f'alt="{section.strip()}, picture {n_pictures}"'

    return HEADING_OR_NAMELESS.sub(named, body)


def _embedded(picture: re.Match[str], path: Path) -> str:
    """A picture of another folder, inside the page; nbconvert embeds those beside a notebook."""
    file = path.parent / picture[1]
    if not file.is_file():
        return picture[0]
    kind, _ = guess_type(file.name)
    return f'src="data:{kind};base64,{b64encode(file.read_bytes()).decode()}"'


def _viewer_output(recording: Path, out: Path) -> "NotebookNode":
    """The viewer with a recording, or what makes the recording where it is missing."""
    from nbformat.v4 import new_output

    if recording.is_file():
        copy = out / "viewer" / recording.name
        shutil.copyfile(recording, copy)
        where = f"viewer/index.html?url={quote(recording.name)}"
        text = (
            f'<iframe class="recording" src="{where}" title="recording"></iframe>'
            f'<p><a href="{where}">the recording alone</a>; the viewer needs this folder served: '
            f"<code>python -m http.server --bind 127.0.0.1 --directory {out}</code></p>"
        )
    else:
        text = "<p><em>Run this notebook, then <code>make html</code>, for the viewer.</em></p>"
    return new_output("display_data", data={"text/html": text})


def _link(link: re.Match[str], path: Path, out: Path) -> str:
    """A link between notebooks leads to their pages, one to another file to that file."""
    target, anchor = link[1], link[2] or ""
    if target.endswith(".ipynb"):
        return f'href="{target.removesuffix(".ipynb")}.html{anchor}"'
    if target.startswith("../"):
        moved = os.path.relpath((path.parent / target).resolve(), out.resolve())
        return f'href="{moved}{anchor}"'
    return link[0]


def _write_viewer(folder: Path) -> None:
    """Rerun's web viewer, from the package of its notebook widget."""
    require("notebooks", "the viewer in a page")
    from importlib.util import find_spec

    spec = find_spec("rerun_notebook")
    assert spec is not None
    assert spec.origin is not None
    static = Path(spec.origin).parent / "static"
    folder.mkdir(parents=True, exist_ok=True)
    for name in ("widget.js", "widget.css", "re_viewer_bg.wasm"):
        source, target = static / name, folder / name
        if not target.exists() or target.stat().st_size != source.stat().st_size:
            shutil.copyfile(source, target)
    write_atomic(folder / "index.html", VIEWER_PAGE.encode())


def main() -> None:
    """Write the links in ./notebooks, or their pages."""
    if sys.argv[1:] == ["links"]:
        for path in write_links(Path("notebooks")):
            print(f"links of {path}")
        return
    for page in write_pages(Path("notebooks"), OUT):
        print(page)
    serve = f"python -m http.server --bind 127.0.0.1 --directory {OUT}"
    print(f"open {OUT}/index.html; for the viewer: {serve}")


if __name__ == "__main__":
    main()
