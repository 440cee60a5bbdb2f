"""JupyterLab in a real Chromium: the tour is run, its viewer draws, and a control answers."""

import os
import re
import secrets
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path

import httpx
import numpy as np
import pytest
from PIL import Image

from tests import browser
from vap_core.recording.show import free_port

ROOT = Path(__file__).resolve().parents[1]
pytestmark = [
    pytest.mark.sweep,
    pytest.mark.skipif(not browser.available(), reason=browser.MISSING),
]
NOTEBOOK = "jupyterapp.shell.currentWidget.content"
TOKEN = secrets.token_hex()
"""Whoever has it runs code as the one who runs the tests."""
CODE_CELLS = f"[...{NOTEBOOK}.model.cells].filter((cell) => cell.type === 'code')"


@pytest.fixture
def lab(tmp_path: Path) -> Iterator[str]:
    """JupyterLab over a copy of the tour, with `make lab`'s settings; its address."""
    (tmp_path / "notebooks").mkdir()
    shutil.copy(ROOT / "notebooks" / "00_tour.ipynb", tmp_path / "notebooks")
    shutil.copytree(ROOT / "figures", tmp_path / "figures")
    makefile = (ROOT / "Makefile").read_text()
    options = re.findall(r"^(?:QUIET_LAB|WHOLE) := (.*)$", makefile, re.MULTILINE)
    port = free_port()
    command = [sys.executable, "-m", "jupyter", "lab", "--ip", "127.0.0.1", f"--port={port}"]
    command += shlex.split(" ".join(options))
    command += ["--no-browser", "--allow-root"]
    command += ["--LabApp.expose_app_in_browser=True"]
    environment = {
        **os.environ,
        "HOME": str(tmp_path),
        "JUPYTER_TOKEN": TOKEN,
        "PYTHONPATH": str(ROOT),
        "OMP_NUM_THREADS": "1",
    }
    with subprocess.Popen(
        command,
        cwd=tmp_path,
        env=environment,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    ) as process:
        try:
            yield f"http://127.0.0.1:{port}"
        finally:
            process.terminate()


def answers(address: str) -> bool:
    try:
        return httpx.get(f"{address}/api/status?token={TOKEN}", timeout=2).status_code == 200
    except httpx.HTTPError:
        return False


def refuse_news(page: browser.Page) -> None:
    """JupyterLab asks once whether it may fetch news."""
    for button in page.find(".jp-toast-button"):
        if page.script("return arguments[0].innerText", {browser.ELEMENT: button}) == "No":
            page.click(button)


def drawn(page: browser.Page, css: str) -> np.ndarray:
    """The pixels of the first such element in the window; nothing is scrolled."""
    window = np.asarray(Image.open(BytesIO(page.screenshot())).convert("RGB"))
    corners = page.script(
        "const box = document.querySelector(arguments[0]).getBoundingClientRect();"
        "return [box.left, box.top, box.right, box.bottom]",
        css,
    )
    x0, y0, x1, y1 = (max(0, round(corner)) for corner in corners)
    return window[y0:y1, x0:x1]


def n_colours(picture: np.ndarray) -> int:
    return len(np.unique((picture // 8).reshape(-1, 3), axis=0))


def test_the_tour_runs_its_viewer_draws_and_a_control_answers(lab: str, tmp_path: Path) -> None:
    with browser.browser(tmp_path) as page:
        page.wait(lambda: answers(lab), "JupyterLab", 60)
        page.open(f"{lab}/lab/tree/notebooks/00_tour.ipynb?token={TOKEN}")
        page.wait(lambda: page.find(".jp-Notebook .jp-Cell"), "the notebook", 120)
        page.wait(
            lambda: (
                page.script(
                    "return jupyterapp.shell.currentWidget?.sessionContext?.session?.kernel?.status"
                )
                == "idle"
            ),
            "the kernel",
            120,
        )

        refuse_news(page)
        # Run > Run All Cells, as a person does.
        (run_menu,) = page.find("#jp-MainMenu li[aria-label='Run'], #jp-mainmenu-run") or page.find(
            "#jp-MainMenu li:nth-child(4)"
        )
        page.click(run_menu)
        (run_all,) = page.wait(
            lambda: page.find(".lm-Menu-item[data-command='runmenu:run-all']"), "the menu"
        )
        page.click(run_all)
        page.wait(
            lambda: page.script(
                f"return {CODE_CELLS}.every((cell) => cell.executionState === 'idle' "
                "&& cell.executionCount !== null)"
            ),
            "the last cell",
            300,
        )
        failed = page.script(
            f"return {CODE_CELLS}.flatMap((cell) => cell.outputs.toJSON())"
            ".filter((output) => output.output_type === 'error')"
        )
        assert failed == []

        # A control: another suite has other tasks, which the kernel names.
        index = page.script(
            f"return [...{NOTEBOOK}.model.cells].findIndex("
            "(cell) => cell.sharedModel.getSource().includes('EpisodeChoice('))"
        )
        page.script(f"{NOTEBOOK}.scrollToItem(arguments[0], 'center')", index)
        selects = page.wait(lambda: page.find(".widget-dropdown select"), "the control")
        tasks = "return [...document.querySelectorAll('.widget-dropdown select')[1].options]"
        before = page.script(f"{tasks}.map((option) => option.text)")
        page.type(selects[0], "tabletop")
        page.wait(
            lambda: "put-pouch" in page.script(f"{tasks}.map((option) => option.text)"),
            "the tasks of tabletop",
        )
        assert "put-pouch" not in before

        # Rerun's viewer draws the recording.
        index = page.script(
            f"return [...{NOTEBOOK}.model.cells].findIndex("
            "(cell) => cell.sharedModel.getSource().includes('view(recording)'))"
        )
        page.script(f"{NOTEBOOK}.scrollToItem(arguments[0], 'start')", index)
        canvas = ".rerun_notebook canvas"
        page.wait(lambda: page.find(canvas), "the viewer", 120)
        page.wait(lambda: n_colours(drawn(page, canvas)) > 800, "the viewer's picture", 180)
        refuse_news(page)
        shot = page.screenshot()
    picture = Image.open(BytesIO(shot)).convert("RGB")
    assert picture.size == browser.SIZE
