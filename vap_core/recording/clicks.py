"""A recording in a notebook that answers clicks: a candidate's box shows its crops and cosines.

    inspect_votes(Path("one.rrd"))

Another box, another row; a click beside all boxes shows the whole vote again.
"""

import re
from html import escape
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vap_core.base.errors import BadRecording
from vap_core.base.types import Boxes, Rgb, best_of_references, election_scores
from vap_core.recording.entities.comparison import vote_picture_entity
from vap_core.recording.entities.paths import image_root
from vap_core.recording.reading import read_chunks, read_summary
from vap_core.recording.stored_pictures import read_pictures
from vap_core.recording.viewer import view

if TYPE_CHECKING:
    from ipywidgets import VBox

CANDIDATES = re.compile(
    rf"^{re.escape(image_root(''))}(?P<camera>[^/]+)/candidates(?:_(?P<j>\d+))?(?P<label>/labels)?$"
)


class Votes:
    """The votes of a recording, read once: `answer` says what a click on an entity is about.

    Raises: BadRecording, when it cannot be read or has no vote.
    """

    def __init__(self, recording: Path) -> None:
        read_summary(recording)
        self._numbers: dict[str, dict[str, Any]] = {}
        self._labelled: dict[str, list[int]] = {}
        prefix = "/vap/candidates/"
        for chunk in read_chunks(recording):
            if chunk.entity_path.startswith(prefix):
                batch = chunk.to_record_batch()
                cells = {name: batch[name][0].as_py() for name in batch.schema.names}
                # The first vote, as its picture: sub-goals hold one each.
                self._numbers.setdefault(chunk.entity_path.removeprefix(prefix), cells)
            elif chunk.entity_path.endswith("/labels") and CANDIDATES.match(chunk.entity_path):
                batch = chunk.to_record_batch()
                if "candidate" in batch.schema.names:
                    self._labelled.setdefault(chunk.entity_path, batch["candidate"][0].as_py())
        if not self._numbers:
            raise BadRecording(
                f"inspect_votes: {recording} has no vote; take one of a vap episode."
            )
        entities = {vote_picture_entity(name) for name in self._numbers}
        self._pictures = read_pictures(recording, entities)

    @property
    def views(self) -> list[str]:
        """The views in which a vote was held; further targets end in `_j`."""
        return list(self._numbers)

    def picture(self, name: str) -> Rgb | None:
        """The whole vote of a view."""
        of_view = self._pictures[vote_picture_entity(name)]
        return next(iter(of_view.values()), None)

    def answer(self, entity: str, instance: int | None) -> tuple[str, str] | None:
        """The view that a click is about, and one candidate in words; None for another entity.

        Boxes are drawn with the elected one last: `instance` counts in that order, or the labels
        that have room.
        """
        match = CANDIDATES.match(entity)
        if match is None:
            return None
        name = match["camera"] + (f"_{match['j']}" if match["j"] else "")
        if name not in self._numbers:
            return None
        numbers = self._numbers[name]
        n = len(numbers.get("score") or [])
        order = self._drawing_order(numbers, n)
        if match["label"]:
            order = self._labelled.get(entity, [])
        if instance is None or not 0 <= instance < len(order):
            return name, f"{name}: {n} candidates; click a box for its cosines"
        return name, self._candidate(name, numbers, order[instance])

    @staticmethod
    def _drawing_order(numbers: dict[str, Any], n: int) -> list[int]:
        order = list(range(n))
        # As entities.votes draws them: a chosen one that is not like enough is `rejected`.
        named = [numbers[name][0] for name in ("winner", "rejected", "elected") if name in numbers]
        top = next((int(i) for i in named if i >= 0), -1)
        if top >= 0:
            order.remove(top)
            order.append(top)
        return order

    @staticmethod
    def _candidate(name: str, numbers: dict[str, Any], i: int) -> str:
        k = int(numbers["references"][0])
        cosines = np.reshape(np.asarray(numbers["similarity"], np.float32), (-1, k))
        best = best_of_references(election_scores(cosines, _boxes(numbers)))
        parts = []
        for j in range(k):
            mark = " (its vote)" if best[j] == i else ""
            parts.append(f"photo {j}: {cosines[i, j]:.3f}{mark}")
        role = "elected" if numbers["winner"][0] == i else "not elected"
        return (
            f"{name}, candidate #{i}, {role}: {numbers['votes'][i]} of {k} votes, mean cosine "
            f"{cosines[i].mean():.3f}, detector {numbers['score'][i]:.2f}. {'; '.join(parts)}"
        )


def _boxes(numbers: dict[str, Any]) -> Boxes:
    """The candidates as they were voted on."""

    def single(name: str) -> np.ndarray | None:
        stored = numbers.get(name)
        return None if stored is None else np.asarray(stored, np.float32)

    return Boxes(
        xyxy=np.asarray(numbers["xyxy"], np.float32).reshape(-1, 4),
        score=np.asarray(numbers["score"], np.float32),
        phrase=numbers["phrase"][0],
        prior=single("prior"),
        proof=single("proof"),
    )


def inspect_votes(recording: Path, *, width: int = 1100, height: int = 680) -> "VBox":
    """The viewer, and below it the vote of the view that was clicked last.

    Raises: BadRecording; MissingPart.
    """
    import ipywidgets

    votes = Votes(recording)
    shown = ipywidgets.Image(format="png", layout={"max_width": "100%"})
    words = ipywidgets.HTML()

    def show(name: str, text: str) -> None:
        words.value = escape(text)
        picture = votes.picture(name)
        if picture is not None:
            shown.value = _png(picture)

    def on_event(event: Any) -> None:
        if event.type != "selection_change":
            return
        for item in event.items:
            entity = getattr(item, "entity_path", None)
            found = None
            if entity is not None:
                found = votes.answer(entity, getattr(item, "instance_id", None))
            if found is not None:
                show(*found)

    viewer = view(recording, width=width, height=height)
    viewer.on_event(on_event)
    show(votes.views[0], "click a candidate's box to see its cosines")
    return ipywidgets.VBox([viewer, words, shown])


def _png(picture: Rgb) -> bytes:
    from PIL import Image

    data = BytesIO()
    Image.fromarray(picture).save(data, "PNG")
    return data.getvalue()
