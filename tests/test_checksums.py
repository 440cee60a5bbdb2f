"""A run's folder belongs to the weights and thresholds of its stack, those that do not ship too."""

import json
import runpy
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from vap_core.base.errors import BadOutput, MissingWeights
from vap_core.base.files import DATA
from vap_core.base.types import Boxes, Rgb
from vap_core.perception.embedded.networks import weights_sha256
from vap_core.perception.foundation.weights import LOCK, MODELS, TENSORS, VARIABLE
from vap_core.perception.protocols import Encoder, Stack, Thresholds, Tracker, keep_thresholds
from vap_core.perception.stacks import STACKS, checksums, describe_parts
from vap_core.study import objects as own_objects
from vap_core.study import photos as photos
from vap_core.study.objects import Source
from vap_core.study.store import digest, open_run
from vap_core.study.survey import Survey
from vap_core.study.trials import Study
from vap_make.calibration import run as calibration

from .test_photo_set import folder  # noqa: F401
from .toys import MeanColour, SameColour, detector, segmenter

MIXED, MODEL = "embedded:encoder=dinov2-small", "dinov2-small"
TASKS = (("simpler-bridge", "put-camera"),)


def of_study(stack: str) -> dict[str, Any]:
    return Study(TASKS, ("vap",), stack=stack).configuration()


def of_survey(stack: str) -> dict[str, Any]:
    return Survey(stack, ("simpler-bridge",)).settings()


def of_photos(stack: str) -> dict[str, Any]:
    return photos.PhotoMeasurement(DATA / "photo-set", stack).settings()


@pytest.fixture(autouse=True)
def source(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(own_objects, "read_source", lambda _: Source({}, {}, "the objects'"))


def of_objects(stack: str) -> dict[str, Any]:
    return own_objects.ObjectMeasurement(Path(), stack=stack).settings()


def of_calibration(stack: str) -> dict[str, Any]:
    toy = Stack(stack, detector, MeanColour(), segmenter, SameColour())
    return calibration._configuration(toy)


def write_model(store: Path, tensors: str) -> None:
    """A model's files in a store, the tensors with such a checksum."""
    place = store / MODELS[MODEL].folder
    place.mkdir(exist_ok=True)
    for file in MODELS[MODEL].files:
        (place / file).touch()
    digests = {"config.json": "0" * 64, TENSORS: tensors}
    (place / LOCK).write_text(json.dumps({"sha256": digests}))


@pytest.fixture
def weights(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A store with one model."""
    store = tmp_path / "weights"
    store.mkdir()
    monkeypatch.setenv(VARIABLE, str(store))
    write_model(store, "a" * 64)
    return store


@pytest.mark.parametrize(
    "configuration", [of_study, of_survey, of_photos, of_objects, of_calibration]
)
def test_a_folder_never_mixes_models_or_kept_thresholds(
    tmp_path: Path, weights: Path, configuration: Callable[[str], dict[str, Any]]
) -> None:
    shipped = configuration("embedded")
    assert shipped["weights"] == weights_sha256()
    assert "thresholds" not in shipped
    run = open_run(tmp_path / "run", configuration(MIXED))
    keep_thresholds(weights, MIXED, "dino", Thresholds(0.6, 0.5))
    if configuration is of_calibration:  # which measures them
        open_run(run, configuration(MIXED))
    else:
        with pytest.raises(BadOutput, match="holds another run .thresholds unset there"):
            open_run(run, configuration(MIXED))
        open_run(tmp_path / "kept", configuration(MIXED))
        keep_thresholds(weights, MIXED, "dino", Thresholds(0.7, 0.5))
        with pytest.raises(BadOutput, match="holds another run .thresholds"):
            open_run(tmp_path / "kept", configuration(MIXED))
    before = configuration(MIXED)
    write_model(weights, "b" * 64)
    with pytest.raises(BadOutput, match="holds another run .other weights"):
        open_run(open_run(tmp_path / "third", before), configuration(MIXED))
    assert configuration("embedded") == shipped


def test_of_what_is_not_there_no_run_is_begun(weights: Path) -> None:
    """And a study that asks nothing of its stack does not need it."""
    with pytest.raises(MissingWeights, match="weights pull --stack foundation"):
        of_study("foundation")
    assert checksums("embedded:tracker=embedded") == {"weights": weights_sha256()}
    generic = Study(TASKS, ("generic",), policy="random", stack="foundation").configuration()
    assert generic["weights"] == weights_sha256()
    keep_thresholds(weights, "embedded", "lite0", Thresholds(0.6, 0.5))
    assert "thresholds" not in of_study("embedded"), "no run depends on them"


def test_calibration_measures_photos_without_the_thresholds_that_it_kept(
    folder: Path,  # noqa: F811
    tmp_path: Path,
    weights: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Nothing is as like as the kept threshold asks; the same calibration goes on after it."""
    strict = Stack(
        MIXED, detector, MeanColour(), segmenter, SameColour(), thresholds=Thresholds(2.0, 2.0)
    )
    monkeypatch.setattr(photos, "load_stack", lambda name: strict)
    monkeypatch.setattr(calibration, "load_stack", lambda name: strict)
    for _ in range(2):
        calibration.calibrate(
            MIXED, tmp_path / "calibrated", scenes=0, photos=[folder], progress=False
        )
        keep_thresholds(weights, MIXED, "dino", strict.thresholds)
    answers = pd.read_parquet(tmp_path / "calibrated" / "photos-set" / "questions.parquet")
    assert answers["tinted"].all()
    photos.measure_photos(folder, tmp_path / "photos", MIXED, progress=False)
    assert not pd.read_parquet(tmp_path / "photos" / "questions.parquet")["tinted"].any()


class Shifted(MeanColour):
    """An encoder with a number of its own."""

    def __init__(self, offset: Any) -> None:
        self.offset = offset


class Weighted(MeanColour):
    """An encoder with weights of its own."""

    def __init__(self, last: float) -> None:
        self.weights = np.zeros(2000, np.float32)
        self.weights[-1] = last


class Wrapped(SameColour):
    """A tracker that holds another, and a number in a slot."""

    __slots__ = ("inner", "least")

    def __init__(self, inner: Tracker, least: float) -> None:
        self.inner = inner
        self.least = least


class Renamed(MeanColour):
    """An encoder whose name is computed."""

    def __init__(self, name: str) -> None:
        self._words = {"name": name}

    @property
    def name(self) -> str:  # type: ignore[override]
        return self._words["name"]


class Nested:
    """A detector that calls another, and refers to itself."""

    def __init__(self, encoder: Encoder) -> None:
        self.encoder = encoder
        self.again = self

    def __call__(
        self, images: Sequence[Rgb], phrase: str, threshold: float | None = None
    ) -> list[Boxes]:
        return detector(images, phrase, threshold)


@pytest.mark.parametrize(
    "parts",
    [
        lambda n: {"encoder": Shifted(n)},
        lambda n: {"encoder": Weighted(n)},
        lambda n: {"encoder": Shifted(np.float32(n))},
        lambda n: {"encoder": Shifted(np.int64(n))},
        lambda n: {"encoder": Shifted(np.bool_(n == 1.0))},
        lambda n: {"encoder": Shifted(np.longdouble(n))},
        lambda n: {"encoder": Shifted([np.float16(n)])},
        lambda n: {"detector": Nested(Shifted(n))},
        lambda n: {"tracker": Wrapped(Wrapped(SameColour(), 0.0), n)},
        lambda n: {"tracker": Wrapped(Wrapped(SameColour(), n), 0.0)},
        lambda n: {"encoder": Renamed(f"colour-{n}")},
        lambda n: {"segmenter": segmenter, "encoder": Shifted(1.0) if n == 1.0 else MeanColour()},
    ],
    ids=[
        "number",
        "array",
        "float32",
        "int64",
        "bool",
        "longdouble",
        "list",
        "nested",
        "slots",
        "tracker",
        "name",
        "class",
    ],
)
def test_another_own_stack_of_the_same_name_is_another_run(
    parts: Callable[[float], dict[str, Any]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The same function makes them: only the parts differ."""
    toy = Stack("mine", detector, MeanColour(), segmenter, SameColour())
    digests = []
    for number in (1.0, 1.0, 100.0):

        def make(number: float = number) -> Stack:
            return replace(toy, **parts(number))

        monkeypatch.setitem(STACKS, "mine", make)
        digests.append(digest(of_study("mine")))
    assert digests[0] == digests[1] != digests[2]
    assert "parts" not in of_study("embedded"), "digests are those of versions without it"


def test_a_number_of_numpy_is_described_as_that_number() -> None:
    described = []
    for offset in (2.5, np.float32(2.5)):
        own = Stack("mine", detector, Shifted(offset), segmenter, SameColour())
        described.append(json.dumps(describe_parts(lambda own=own: own)))
    assert described[0] == described[1]
    assert "2.5" in described[0]


def test_another_code_of_an_own_part_is_another_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    toy = Stack("mine", detector, MeanColour(), segmenter, SameColour())
    digests = []
    for answer in ("[]", "[]", "None"):
        file = tmp_path / f"mine_{len(digests)}.py"
        file.write_text(f"def detect(images, phrase, threshold=None):\n    return {answer}\n")
        own = replace(toy, detector=runpy.run_path(str(file))["detect"])
        monkeypatch.setitem(STACKS, "mine", lambda own=own: own)
        digests.append(digest(of_study("mine")))
    assert digests[0] == digests[1] != digests[2]
