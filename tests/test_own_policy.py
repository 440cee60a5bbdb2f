"""A policy of one's own: the documented one runs when pasted, and its episodes are diagnosed without a recording."""

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.toys import MeanColour
from vap_core.base.errors import BadPolicy
from vap_core.base.files import DATA
from vap_core.base.media import load_photo, photos_in
from vap_core.base.types import Rgb
from vap_core.memory import remember, save
from vap_core.perception.stacks import load_stack
from vap_core.recording import Recorder
from vap_core.rollout.loop import rollout
from vap_core.study.diagnosis import diagnose, explain
from vap_core.study.trials import HIDDEN_FROM, Study, make_trial, register_personal

ROOT = Path(__file__).resolve().parents[1]


def documented(words: str) -> str:
    """The one Python block of README or docs/extend.md that has these words."""
    blocks = []
    for page in (ROOT / "README.md", ROOT / "docs" / "extend.md"):
        blocks += re.findall(r"```python\n(.*?)```", page.read_text(), re.DOTALL)
    (found,) = (block for block in blocks if words in block)
    return found


def test_the_documented_encoder_is_called_and_has_no_thresholds_of_another(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In a photo, where `dataclasses.replace` would leave the shipped encoder of photos in place."""
    monkeypatch.chdir(tmp_path)
    photos = DATA / "photo-set"
    crops = [load_photo(path) for path in photos_in(photos / "references" / "cookies")]
    shipped = load_stack("embedded")
    save(Path("data/memory"), remember("cookies", "cookies", crops, shipped.encoder))
    calls: list[int] = []

    class Counting(MeanColour):
        name = "own"

        def __call__(self, crops: Sequence[Rgb]) -> np.ndarray:
            calls.append(len(crops))
            return super().__call__(crops)

    names: dict[str, Any] = {"MeanColour": Counting}
    exec(compile(documented("with_parts("), "pasted", "exec"), names)
    scene = load_photo(photos / "scenes" / "box_in_scene.png", long_side=None)
    _, attended = names["attender"].start({"front": scene}, "bring my cookies")
    (grounding,) = attended.groundings["front"]
    assert sum(calls) >= len(crops) + len(grounding.candidates) > len(crops)
    assert grounding.threshold is None
    stack = names["stack"]
    assert (stack.name, stack.verifier, stack.detector) == ("mine", None, shipped.detector)
    again = shipped.with_parts("mine", segmenter=stack.segmenter)
    assert (again.thresholds, again.verifier) == (shipped.thresholds, shipped.verifier)


@pytest.mark.usefixtures("short_episodes")
def test_the_documented_policy_runs_when_pasted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {}
    exec(compile(documented("def plan("), "pasted", "exec"), names)
    printed = capsys.readouterr().out.splitlines()
    assert len(printed) == 2
    for line in printed:
        assert line.startswith("failure Diagnosis(case='case 3', sub_case='timeout'")
    exec(compile(documented("found +=").replace("=20", "=1"), "pasted", "exec"), names)
    printed = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in printed] == list(names["methods"])
    assert all(line.endswith("of 1") for line in printed)


def test_the_documented_way_hides_the_target_for_calls_of_that_policy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Not for those of the study's own, which does two actions a call."""
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {}
    exec(compile(documented("def plan(").replace('"vap"', '"hidden-2"'), "pasted", "exec"), names)
    still = names["Still"]
    occlusion = names["trial"].occlusion
    assert isinstance(names["trial"].policy, still)
    assert occlusion.frames == 2 * still.execute == 2
    assert occlusion.start == HIDDEN_FROM * still.execute
    own = make_trial(names["study"], names["rows"], "hidden-2", names["memory"])
    assert own.occlusion.frames == 2 * own.policy.execute == 4
    still.execute = None
    with pytest.raises(BadPolicy, match="Still.execute is None; it must be a whole number"):
        make_trial(names["study"], names["rows"], "hidden-2", names["memory"], still())


@pytest.mark.parametrize("method", ["generic", "vap"])
@pytest.mark.parametrize("follow", ["call", "step"])
def test_the_diagnosis_needs_no_recording(tmp_path: Path, method: str, follow: str) -> None:
    study = Study((("widowx-pick", "pick-straw-cup"),), (method,), episodes=1, follow=follow)
    (row,) = study.rows("widowx-pick", "pick-straw-cup")
    register_personal(study, tmp_path)
    trial = make_trial(study, [row], method, tmp_path)
    rows = [replace(row, max_steps=8)]

    (alone,) = rollout(trial, rows)
    (recorded,) = rollout(
        trial, rows, lambda header: Recorder(tmp_path / "one.rrd", header, explain=explain)
    )
    found = diagnose(alone)
    expected = diagnose(recorded)
    assert found is not None
    assert expected is not None
    assert found.columns() == expected.columns()
