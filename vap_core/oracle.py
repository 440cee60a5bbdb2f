"""Bounding arms: one stage of the method, or all of them, replaced by the simulator's truth. What they reach bounds what a better stage could; no
result of theirs is a result of the method.

Truth comes in by one door: the `masks` that rollout hands to a `Revealed`, and to nothing else.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from vap_core import embed
from vap_core.associate import overrule
from vap_core.attend import Attender, AttendState, Prompting, Seen
from vap_core.errors import BadInstruction, BadStudy
from vap_core.segment import bounds
from vap_core.values import Attended, Boxes, EpisodeRow, Event, Grounding, Mask, PersonalObject, Rgb, Track, Views

Masks = Mapping[str, Mapping[str, Mask]]
"""`masks[camera][object]`: visible pixels, as in Truth."""


@dataclass(frozen=True)
class Oracle:
    """What the simulator tells, and what follows as usual: the true boxes and who is meant (then segment, track), true masks at t = 0 (then
    track), or the true mask at every step. `of` is the object that is prompted: the target, or the first look-alike that the episode places."""

    reveal: Literal["box", "mask", "track"]
    of: Literal["target", "rival"] = "target"
    prompting: Prompting = field(default_factory=Prompting)


class Revealed:
    """An Attender whose grounding is told; `alike` are the objects of the target's category that the scene holds.

    Every visible object of the category is a candidate, as if detected; the vote is held and kept, and then overruled. A view in which the meant
    object is invisible passes unmodified.
    """

    def __init__(self, attender: Attender, oracle: Oracle, alike: frozenset[str]) -> None:
        self.attender = attender
        self.oracle = oracle
        self.alike = alike

    @property
    def memory(self) -> Mapping[str, PersonalObject]:
        return self.attender.memory

    @property
    def highlights(self) -> bool:
        return self.attender.highlights

    @property
    def always(self) -> bool:
        """Whether the truth is wanted at every step, not only at t = 0."""
        return self.oracle.reveal == "track"

    def meant(self, row: EpisodeRow) -> str:
        """The object that is prompted. Raises: BadStudy when the episode places no look-alike."""
        if self.oracle.of == "target":
            return row.target
        for place in row.placements[1:]:
            if place.model != row.goal and place.model in self.alike:
                return place.model
        raise BadStudy(f"Revealed: {row.key} places no look-alike of {row.target!r}; leave wrong-mask out.")

    def start(self, views: Views, instruction: str, row: EpisodeRow, masks: Masks) -> tuple[AttendState, Attended]:
        """Ground by truth (t = 0). Raises: BadInstruction, unless the instruction has one target."""
        parsed, wanted = self.attender.understand(instruction)
        if len(wanted) != 1:
            raise BadInstruction(f"Revealed.start: {len(wanted)} targets in {instruction!r}, but the truth is about one; name one.")
        phrase, meant = parsed.targets[0].category, self.meant(row)
        seen: dict[str, dict[str, Seen]] = {}
        groundings: dict[str, tuple[Grounding, ...]] = {}
        for camera, rgb in views.items():
            shown = {name: mask for name, mask in masks[camera].items() if name in self.alike and mask.any()}
            part = self._look(rgb, phrase, list(shown.values()))
            told = self.attender.ground(camera, wanted[0], part)
            seen[camera], groundings[camera] = {phrase: part}, (overrule(told, list(shown).index(meant) if meant in shown else None),)
        state, attended = self.attender.begin(parsed, views, seen, groundings, by="the simulator")
        return state, _marked(attended, f"the simulator's {self.oracle.reveal} of {meant} is read: a bound, not a result")

    def steps(
        self, states: Sequence[AttendState], views: Sequence[Views], rows: Sequence[EpisodeRow], masks: Sequence[Masks]
    ) -> list[tuple[AttendState, Attended]]:
        """A step of every episode of a batch; `masks` are looked at only when the truth is wanted always."""
        if not self.always:
            return self.attender.steps(states, views)
        return [
            self.attender.follow(state, seen, {camera: (_track(now[camera].get(self.meant(row))),) for camera in seen}, state.trackers)
            for state, seen, row, now in zip(states, views, rows, masks, strict=True)
        ]

    def _look(self, rgb: Rgb, phrase: str, shown: Sequence[Mask]) -> Seen:
        """The candidates of one view: true boxes, and true masks unless these are for the segmenter to find."""
        xyxy = np.array([bounds(mask) for mask in shown], np.float32).reshape(-1, 4)
        boxes = Boxes(xyxy, np.ones(len(xyxy), np.float32), phrase)
        drawn = self.attender.stack.segmenter(rgb, boxes) if self.oracle.reveal == "box" else np.array(shown, bool).reshape(-1, *rgb.shape[:2])
        embeddings = self.attender.stack.encoder([embed.crop(rgb, box) for box in xyxy])
        return Seen(boxes, embeddings, drawn, tuple(range(len(xyxy))))


def _track(mask: Mask | None) -> Track:
    return Track(None, 0.0) if mask is None or not mask.any() else Track(mask, 1.0)


def _marked(attended: Attended, text: str) -> Attended:
    return replace(attended, events=(Event(0, "WARN", text), *attended.events))
