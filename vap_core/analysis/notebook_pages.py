"""Every notebook as an HTML page that needs no network and no Python.

    make html
    python -m http.server --bind 127.0.0.1 --directory build/html

A cell whose metadata name a `recording` becomes Rerun's viewer, for which the pages must be served;
read from files they show the still picture alone. Cells whose source JupyterLab hides are folded.
"""

import html
import os
import re
import shutil
from base64 import b64encode
from functools import cache
from mimetypes import guess_type
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

from vap_core.analysis.notebook_links import notebook_files, notebook_title, read_notebook
from vap_core.base.errors import require
from vap_core.base.files import write_atomic, writing

if TYPE_CHECKING:
    from nbformat import NotebookNode

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
    """Write the pages of ./notebooks: python -m vap_core.analysis.notebook_pages."""
    for page in write_pages(Path("notebooks"), OUT):
        print(page)
    serve = f"python -m http.server --bind 127.0.0.1 --directory {OUT}"
    print(f"open {OUT}/index.html; for the viewer: {serve}")


if __name__ == "__main__":
    main()
