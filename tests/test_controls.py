"""The notebooks' controls: defaults, what a choice changes, and what is kept."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
from PIL import Image

from vap_core import notebook
from vap_core.base.errors import UnknownName
from vap_core.base.media import load_photo

WIDGET = "application/vnd.jupyter.widget-view+json"


def test_an_episode_has_the_tasks_and_cameras_of_its_suite() -> None:
    choice = notebook.EpisodeChoice("vlabench", "select-cup", 3, "wrist")
    assert choice.chosen == ("vlabench", "select-cup", 3, "wrist")
    choice.suite.value = "simpler-bridge"
    suite, task, number, camera = choice.chosen
    assert (suite, number, camera) == ("simpler-bridge", 3, "front")
    assert task in choice.task.options
    assert "select-cup" not in choice.task.options
    choice.task.value = "put-camera"
    assert choice.chosen[1] == "put-camera"


def test_a_control_has_words_where_there_is_no_kernel() -> None:
    data = notebook.EpisodeChoice("tabletop", "put-pouch", 0, "side")._repr_mimebundle_()
    assert WIDGET in data
    assert "suite tabletop · task put-pouch · episode 0 · camera side" in data["text/html"]
    assert data["text/plain"] in data["text/html"]


def test_a_default_that_is_not_there_is_named() -> None:
    with pytest.raises(UnknownName, match="camera of simpler-bridge"):
        notebook.EpisodeChoice("simpler-bridge", "put-camera", 0, "side")
    with pytest.raises(UnknownName, match="task"):
        notebook.EpisodeChoice("simpler-bridge", "put-nothing", 0, "front")


def test_own_photos_are_kept_as_they_were_chosen(tmp_path: Path) -> None:
    photos = notebook.OwnPhotos(tmp_path / "own", "cup")
    assert photos.chosen == (None, None, "cup")
    Image.fromarray(np.full((9, 12, 3), 200, np.uint8)).save(tmp_path / "a.png")
    upload = SimpleNamespace(name="A.PNG", content=memoryview((tmp_path / "a.png").read_bytes()))
    photos.photo = SimpleNamespace(value=(upload,))
    assert photos.chosen[0] is None
    for n in (2, 1):
        photos.references = SimpleNamespace(value=(upload,) * n)
        photo, references, kind = photos.chosen
        assert photo is not None
        assert references is not None
        assert load_photo(photo).shape == (9, 12, 3)
        assert [path.name for path in sorted(references.iterdir())] == [
            f"{i}.png" for i in range(n)
        ]
        assert kind == "cup"


def choices() -> pd.DataFrame:
    rows = []
    for k in (1, 5):
        for i in range(10):
            rows.append(
                {
                    "suite": "vlabench" if i < 6 else "tabletop",
                    "k": k,
                    "rule": "vote",
                    "elected": "" if i == 9 else "cup",
                    "margin": 1.0 if i < 5 else 0.2,
                    "right": i not in (4, 9) if k == 5 else i < 2,
                }
            )
    return pd.DataFrame(rows)


def test_the_least_lead_says_what_is_answered_and_rightly() -> None:
    table = choices()
    control = notebook.Abstention(table)
    before = control.answer.value
    assert "0.60: 50 % [24, 76] of 10 views are answered" in before
    assert ", 80 % [38, 96] of 5 of these rightly." in before
    control.threshold.value = 0.0
    assert ": 90 % [60, 98] of 10 views are answered" in control.answer.value
    control.k.value = 1
    assert "K = 1" in control.answer.value
    assert control.answer.value != before
    control.suite.value = "tabletop"
    control.threshold.value = 0.0
    assert ": 75 % [30, 95] of 4 views are answered" in control.answer.value
    with pytest.raises(UnknownName, match="number of photos '2' is unknown; known: 1, 5"):
        notebook.Abstention(table, k=2)
