"""Controls of the notebooks: an episode, photos of one's own, and how sure a vote must be.

What is chosen counts when the next cell runs, as with a box that is dragged. Every control begins
with a default, so a notebook that nobody touches shows the same each time; where there is no
kernel, its default stands as words.
"""

from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vap_core.base.errors import one_of, require
from vap_core.base.files import write_atomic
from vap_core.simulation.suites import BENCHMARKS, WARM_UPS, suite
from vap_core.study.stats import share

if TYPE_CHECKING:
    import pandas as pd
    from ipywidgets import Box

ALL = "all"
"""In a dropdown: nothing is left out."""


class Control:
    """Widgets in a box, and the words that stand for them where there is no kernel."""

    def __init__(self, box: "Box", words: str) -> None:
        self.box = box
        self._words = words

    def _repr_mimebundle_(self, **options: Any) -> dict[str, Any]:
        data = dict(self.box._repr_mimebundle_(**options))
        data["text/plain"] = self._words
        data["text/html"] = f"<p><em>{escape(self._words)}</em></p>"
        return data


class EpisodeChoice(Control):
    """One episode of a suite's task, and one of its cameras; shared scenes are left out.

        where = EpisodeChoice("vlabench", "select-cup", 0, "front")
        suite, task, number, camera = where.chosen

    Raises: UnknownName for a default that there is not; MissingPart: the extra `notebooks` is not
        installed.
    """

    def __init__(self, suite_name: str, task: str, number: int = 0, camera: str = "front") -> None:
        require("notebooks", "a control")
        import ipywidgets

        known = suite(suite_name)
        known.task(task)
        if camera not in known.cameras:
            raise one_of(f"EpisodeChoice: camera of {suite_name}", camera, known.cameras)
        names = list(dict.fromkeys([suite_name, *BENCHMARKS, *WARM_UPS]))
        self.suite = ipywidgets.Dropdown(options=names, value=suite_name, description="suite")
        self.task = ipywidgets.Dropdown(description="task")
        self.number = ipywidgets.BoundedIntText(
            value=number, min=0, max=10_000, description="episode"
        )
        self.camera = ipywidgets.Dropdown(description="camera")
        self._fill()
        self.task.value, self.camera.value = task, camera
        self.suite.observe(lambda _: self._fill(), names="value")
        words = f"suite {suite_name} · task {task} · episode {number} · camera {camera}"
        super().__init__(
            ipywidgets.HBox([self.suite, self.task, self.number, self.camera]),
            f"{words}: choose others in JupyterLab, then run on from the next cell.",
        )

    @property
    def chosen(self) -> tuple[str, str, int, str]:
        """Suite, task, number of the episode, camera."""
        return self.suite.value, self.task.value, self.number.value, self.camera.value

    def _fill(self) -> None:
        """The tasks and cameras of the chosen suite."""
        of_suite = suite(self.suite.value)
        self.task.options = [task.name for task in of_suite.tasks]
        self.camera.options = list(of_suite.cameras)
        self.task.index = self.camera.index = 0


class OwnPhotos(Control):
    """A photo of one's own, photos of the object alone, and what kind of thing it is.

    `folder` is where what is chosen is kept; nothing leaves this machine.

    Raises: MissingPart: the extra `notebooks` is not installed.
    """

    def __init__(self, folder: Path, category: str) -> None:
        require("notebooks", "a control")
        import ipywidgets

        self.photo = ipywidgets.FileUpload(accept="image/*", description="photo")
        self.references = ipywidgets.FileUpload(
            accept="image/*", multiple=True, description="its photos"
        )
        self.category = ipywidgets.Text(value=category, description="a kind of")
        self._folder = folder
        super().__init__(
            ipywidgets.HBox([self.photo, self.references, self.category]),
            "no photo of your own yet: choose a photo, and some of the object alone, in "
            "JupyterLab, then run on from the next cell.",
        )

    @property
    def chosen(self) -> tuple[Path | None, Path | None, str]:
        """The photo, the folder with photos of the object, its kind; None until both are there."""
        if not self.photo.value or not self.references.value:
            return None, None, self.category.value
        references = self._folder / "references"
        references.mkdir(parents=True, exist_ok=True)
        for old in references.iterdir():
            old.unlink()
        for i, upload in enumerate(self.references.value):
            write_atomic(references / f"{i}{_suffix(upload.name)}", bytes(upload.content))
        photo = self._folder / f"photo{_suffix(self.photo.value[0].name)}"
        write_atomic(photo, bytes(self.photo.value[0].content))
        return photo, references, self.category.value


class Abstention(Control):
    """How many references, and how large a lead of the vote: what is answered, and rightly.

    `choices` is the survey's table of that name.

    Raises: UnknownName for a `k` that it does not have; MissingPart: the extra `notebooks` is not
        installed.
    """

    def __init__(self, choices: "pd.DataFrame", k: int = 5, threshold: float = 0.6) -> None:
        require("notebooks", "a control")
        import ipywidgets

        self._choices = choices
        numbers = sorted({int(number) for number in choices.k})
        if k not in numbers:
            raise one_of("Abstention: number of photos", str(k), numbers)
        suites = [ALL, *dict.fromkeys(choices.suite)]
        self.suite = ipywidgets.Dropdown(options=suites, value=ALL, description="suite")
        self.k = ipywidgets.SelectionSlider(options=numbers, value=k, description="photos K")
        self.threshold = ipywidgets.FloatSlider(
            value=threshold, min=0.0, max=1.0, step=0.05, description="least lead"
        )
        self.answer = ipywidgets.HTML(value=self._text())
        for each in (self.suite, self.k, self.threshold):
            each.observe(self._show, names="value")
        controls = ipywidgets.HBox([self.suite, self.k, self.threshold])
        super().__init__(ipywidgets.VBox([controls, self.answer]), self._text())

    def _text(self) -> str:
        shown = self._choices
        if self.suite.value != ALL:
            shown = shown[shown.suite == self.suite.value]
        return answered_text(shown, self.k.value, self.threshold.value)

    def _show(self, _: Any) -> None:
        self.answer.value = self._text()


def answered_text(choices: "pd.DataFrame", k: int, threshold: float) -> str:
    """How many views are answered from a lead on, and how many of these rightly."""
    usual = choices[(choices.k == k) & (choices.rule == "vote")]
    answered = usual[(usual.elected != "") & (usual.margin >= threshold)]
    covered = share(usual.index.isin(answered.index))
    return (
        f"K = {k}, a lead of at least {threshold:.2f}: {covered.share_text()} views are answered "
        f"(95 % interval), {share(answered.right).share_text()} of these rightly."
    )


def _suffix(name: str) -> str:
    return Path(name).suffix.lower() or ".jpg"
