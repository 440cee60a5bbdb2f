"""A report's page in a real Chromium: nothing is missing, and a failure's link gives its recording."""

from io import BytesIO
from pathlib import Path

import pandas as pd
import pytest
from PIL import Image

from tests import browser
from vap_core.recording import read_summary, recording_file_name
from vap_core.study import engine
from vap_core.study.report import report
from vap_core.study.trials import Study

pytestmark = [
    pytest.mark.sweep,
    pytest.mark.skipif(not browser.available(), reason=browser.MISSING),
]


def test_the_page_is_whole_and_a_click_gives_the_recording_of_a_failure(tmp_path: Path) -> None:
    run, out = tmp_path / "run", tmp_path / "report"
    study = Study((("widowx-pick", "pick-straw-cup"),), ("generic", "vap"), episodes=2)
    table = engine.run(study, run, workers=1, record="failures", progress=False)
    report([run], out)
    failed = table[table["outcome"].eq("failure")]
    assert len(failed)
    with browser.browser(tmp_path) as page:
        page.open((out / "report.html").as_uri())
        broken = page.script(
            "return [...document.images].filter((image) => !image.naturalWidth).length"
        )
        assert broken == 0
        assert page.errors() == []
        text = page.text()
        for title in ("Report", "Where episodes are lost", f"Failures ({len(failed)})"):
            assert title in text
        (tmp_path / "page.png").write_bytes(page.screenshot())
        link = page.find(".failures article a")[0]
        words = page.script(
            'return arguments[0].closest("article").innerText', {browser.ELEMENT: link}
        )
        page.click(link)
        (got,) = page.wait(
            lambda: list((tmp_path / browser.DOWNLOADS).glob("*.rrd")), "the recording"
        )
    row = next(_named(row, words) for _, row in failed.iterrows() if _named(row, words) is not None)
    name = recording_file_name(row.suite, row.task, row.episode, row.seed, row.method)
    assert got.read_bytes() == (run / "recordings" / name).read_bytes()
    frame = max(0, int(row.deciding_frame))
    assert f"frame {frame}:" in words
    assert f"view {run / 'recordings' / name} --frame {frame}" in words
    assert read_summary(got)["deciding_frame"] == row.deciding_frame
    assert Image.open(BytesIO((tmp_path / "page.png").read_bytes())).size == browser.SIZE


def _named(row: pd.Series, words: str) -> pd.Series | None:
    """The row, if the card's words name its episode and method."""
    about = f"{row.suite} · {row.task} · episode {row.episode} · {row.method}"
    return row if about in words else None
