"""Stills of recordings say what they show, and none that is committed shows something else than what ships."""

import json
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from vap_core.base.errors import BadOutput
from vap_core.notebook import keep_png
from vap_core.study import failures, store
from vap_core.study.results import EXECUTED
from vap_core.study.trials import Study

FIGURES = Path(__file__).parents[1] / "figures"
COMMITTED = {
    "00_tour_recording.png",
    "08_error_taxonomy_beside.png",
    "08_error_taxonomy_case1.png",
    "08_error_taxonomy_case2.png",
    "08_error_taxonomy_case3.png",
}
STUDY = Study((("widowx-pick", "pick-straw-cup"),), ("vap",), episodes=1)


@pytest.fixture
def still(tmp_path: Path) -> Path:
    path = tmp_path / "still.png"
    Image.fromarray(np.zeros((8, 8, 3), np.uint8)).save(path)
    failures.write_provenance(path, STUDY)
    return path


def read_provenance(png: Path) -> dict[str, Any]:
    """What `write_provenance` kept in a PNG; empty for any other picture."""
    with Image.open(png) as picture:
        return dict(json.loads(picture.info.get(failures.CHUNK, "{}")))


def stale(png: Path) -> str:
    """How what a still shows differs from what is here now, "" where it does not.

    Nothing is executed that the picture names.
    """
    about = read_provenance(png)
    if about["recorder"] != failures.recorder_digest():
        return "the recorder shows episodes otherwise now"
    settings = {name: value for name, value in about["study"].items() if name != EXECUTED}
    settings["tasks"] = tuple(tuple(task) for task in settings["tasks"])
    settings["methods"] = tuple(settings["methods"])
    if about["configuration"] != store.digest(Study(**settings).configuration()):
        return "weights, episode lists or objects are others now"
    return ""


def test_every_committed_still_shows_what_ships() -> None:
    about = {path.name: read_provenance(path) for path in FIGURES.glob("*.png")}
    assert {name for name, provenance in about.items() if provenance} == COMMITTED
    for name in COMMITTED:
        assert not Path(about[name]["study"]["policy"]).is_absolute(), (
            f"{name} names a folder of one machine: take the picture with a policy that ships"
        )
    differences = {name: stale(FIGURES / name) for name in sorted(COMMITTED)}
    assert not any(differences.values()), (
        f"{differences}; set RECOMPUTE in the notebook and execute it again"
    )


def test_another_world_or_recorder_makes_a_still_stale(
    still: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert stale(still) == ""
    with monkeypatch.context() as patch:
        patch.setattr(failures, "recorder_digest", lambda: "another")
        assert "recorder" in stale(still)
    monkeypatch.setattr(Study, "configuration", lambda study: {"weights": "another"})
    assert "weights" in stale(still)


def test_a_smaller_copy_keeps_what_it_shows(still: Path) -> None:
    before = read_provenance(still)
    jpeg = keep_png(still.read_bytes(), still)
    assert read_provenance(still) == before
    assert Image.open(BytesIO(jpeg)).format == "JPEG"


def test_what_is_no_picture_is_named(tmp_path: Path) -> None:
    path = tmp_path / "plain.png"
    path.write_bytes(b"no picture")
    with pytest.raises(BadOutput, match="is no PNG"):
        failures.write_provenance(path, STUDY)


def test_no_file_is_executed_that_a_picture_names(still: Path, tmp_path: Path) -> None:
    marker, code = tmp_path / "executed", tmp_path / "code.py"
    code.write_text(f"open({str(marker)!r}, 'w')\n")
    about = read_provenance(still)
    about["study"]["suite_files"] = [str(code)]
    info = PngInfo()
    info.add_text(failures.CHUNK, json.dumps(about))
    with Image.open(still) as picture:
        picture.save(still, pnginfo=info)
    assert stale(still) == ""
    assert not marker.exists()
