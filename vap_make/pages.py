"""Every notebook as an HTML page that needs no network and no Python; the links between them.

    make links
    make html
    python -m http.server --bind 127.0.0.1 --directory build/html

A cell whose metadata name a `recording` becomes Rerun's viewer, for which the pages must be served;
read from files they show the still picture alone. Set-up, long cells and assertions are folded.
"""

import html
import json
import os
import re
import shutil
import sys
from base64 import b64encode
from functools import cache, partial
from mimetypes import guess_type
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

from vap_core.base.errors import BadOutput, require
from vap_core.base.files import parse_json, write_atomic, writing

if TYPE_CHECKING:
    from nbformat import NotebookNode

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
    """The line that leads from `path` to its neighbours and to the map, which the first one holds;
    `titles` are in order.
    """
    paths = list(titles)
    at = paths.index(path)
    parts = []
    if at > 0:
        parts.append(f"← [{titles[paths[at - 1]]}]({paths[at - 1].name})")
    anchor = MAP_HEADING.replace(" ", "-")
    parts.append(f"[{MAP_HEADING.lower()}]({paths[0].name}#{anchor})")
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
        if path == next(iter(notebooks)):
            _put_cell(notebook["cells"], MAP_ID, table, at=len(notebook["cells"]))
        _put_cell(notebook["cells"], END_ID, text, at=len(notebook["cells"]))
        if json.dumps(notebook) != before:
            data = json.dumps(notebook, indent=1, ensure_ascii=False) + "\n"
            write_atomic(path, data.encode())
            changed.append(path)
    return changed


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
SERVE = "python -m http.server --bind 127.0.0.1 --directory"
WIDGET = "application/vnd.jupyter.widget-view+json"
FOLDED = """\
{%- extends 'lab/index.html.j2' -%}
{%- block html_head_js -%}{%- endblock -%}
{%- block html_head_js_mathjax -%}{%- endblock -%}
{%- block html_head_js_mermaidjs -%}{%- endblock -%}
{%- block input_group -%}
{%- if cell.metadata.get('jupyter', {}).get('source_hidden') or 'plumbing' in cell.metadata.tags -%}
<details class="folded"><summary>code</summary>{{ super() }}</details>
{%- else -%}{{ super() }}{%- endif -%}
{%- endblock -%}
"""
"""The template of a page: JupyterLab's, with sources folded and nothing from the network."""
STYLE = """<link rel="icon" href="data:,"><style>
.folded summary{margin:4px 0 4px 80px;color:#555;cursor:pointer;font-size:13px}
iframe.recording{width:100%;height:720px;border:1px solid #ccc}
main{max-width:1180px;margin:0 auto}
.jp-RenderedHTMLCommon table{font-size:13px}
.jp-InputArea pre,.jp-RenderedText pre{white-space:pre-wrap;word-break:normal;
overflow-wrap:anywhere}
nav.outline{position:fixed;top:24px;left:16px;width:210px;font:13px/1.4 system-ui}
nav.outline a{display:block;padding:3px 8px;color:#555;text-decoration:none;
border-left:2px solid #ddd}
nav.outline a:hover{color:#000;border-color:#555}
@media (min-width:1000px){body.outlined main{margin-left:240px}}
@media (max-width:999px){nav.outline{position:static;width:auto;margin:16px}}
.cards{display:grid;grid-template-columns:repeat(auto-fill,minmax(330px,1fr));gap:20px;
padding:24px;font:15px/1.45 system-ui;color:#222}
.cards>*{grid-column:1/-1;margin:0}
.cards .card{grid-column:auto;border:1px solid #ddd;border-radius:8px;overflow:hidden;color:inherit;
text-decoration:none}
.card:hover{border-color:#555}
.card img{width:100%;height:190px;object-fit:cover;object-position:0 0;border-bottom:1px solid #eee}
.card h2{font-size:17px;margin:12px 16px 4px}.card p{margin:0 16px 14px;color:#444}
</style><script>
addEventListener("DOMContentLoaded", () => {
  const parts = [...document.querySelectorAll("main h2[id]")];
  const outline = document.createElement("nav");
  outline.className = "outline";
  const index = outline.appendChild(document.createElement("a"));
  index.href = "index.html";
  index.textContent = "all notebooks";
  for (const part of parts) {
    const link = outline.appendChild(document.createElement("a"));
    link.href = "#" + part.id;
    link.textContent = part.textContent.replace("\u00b6", "");
  }
  if (parts.length) document.body.classList.add("outlined"), document.body.prepend(outline);
});
</script>"""
CARD = """<a class="card" href="{page}"><img alt="" src="{picture}"><h2>{title}</h2>
<p>{question}</p></a>
"""
"""A notebook in the index: the picture of its answer, its title and its question."""
INDEX = """<!doctype html><html lang="en"><meta charset="utf-8"><title>Notebooks</title>
<meta name="viewport" content="width=device-width">{style}<main class="cards"><h1>Notebooks</h1>
<p>One question each, answered by a picture, a table and the code that made them.</p>
{cards}</main></html>
"""
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


def write_pages(notebooks: Path, out: Path) -> None:
    """Write a page per notebook, an index, and the viewer.

    Raises: BadOutput where there is no notebook or `out` cannot be written; MissingPart.
    """
    cards = ""
    with writing(out, "notebook_pages", "choose another folder"):
        _write_viewer(out / "viewer")
        for path in notebook_files(notebooks):
            page = f"{path.stem}.html"
            write_atomic(out / page, page_of(path, out).encode())
            shown = read_notebook(path)
            picture = re.search(r"!\[.*?\]\((.+?)\)", "".join(shown["cells"][0]["source"]))
            card = CARD.format(
                page=page,
                picture=picture[1] if picture else "data:,",
                title=html.escape(notebook_title(shown)),
                question=html.escape(question(shown).replace("*", "")),
            )
            cards += re.sub(PICTURE, partial(_embedded, path=path), card)
        write_atomic(out / "index.html", INDEX.format(style=STYLE, cards=cards).encode())


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
    body = re.sub(PICTURE, partial(_embedded, path=path), body)
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


PICTURE = r'src="(\.\./[^":]+)"'


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
            f"<code>{SERVE} {out}</code></p>"
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
        print("links of", *write_links(Path("notebooks")))
        return
    write_pages(Path("notebooks"), OUT)
    print(f"open {OUT}/index.html; for the viewer: {SERVE} {OUT}")


if __name__ == "__main__":
    main()
