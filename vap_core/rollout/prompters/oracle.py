"""Bounding arms: one stage of the method, or all of them, replaced by ground truth.

They bound what a better stage could reach; no result of theirs is a result of the method.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import cv2
import numpy as np

from vap_core.associate import overrule
from vap_core.attend import Attender, AttendState, Prompting
from vap_core.base.errors import BadInstruction, BadStudy
from vap_core.base.types import Attended, Boxes, Event, Grounding, Mask, Rgb, Track
from vap_core.perception.boxes import crop, mask_box
from vap_core.perception.candidates import Candidates
from vap_core.rollout.prompters.protocol import PromptContext, SceneTruth
from vap_core.simulation.types import EpisodeRow, Observation


@dataclass(frozen=True)
class Oracle:
    """Which stage is replaced by ground truth.

    "box": the boxes and the choice among them, then segment and track. "mask": the masks at t = 0,
    then track. "track": the mask at every step. `of` is the object that is prompted: the target, or
    the first look-alike that the episode places. With "track" the mask may be wrong on purpose: of
    `area` times its pixels, about its middle, and moved by `shift` times its width.
    """

    reveal: Literal["box", "mask", "track"]
    of: Literal["target", "look-alike"] = "target"
    area: float = 1.0
    shift: float = 0.0
    prompting: Prompting = field(default_factory=Prompting)


class OraclePrompter:
    """An Attender whose grounding is the simulator's.

    `alike` are the scene's objects of the target's category. Every visible object of the category
    is a candidate, as if detected; the vote is held and kept, and then overruled. A view in which
    the prompted object is invisible passes unmodified.
    """

    def __init__(self, attender: Attender, oracle: Oracle, alike: frozenset[str]) -> None:
        self.attender = attender
        self.oracle = oracle
        self.alike = alike
        every_step = oracle.reveal == "track"
        self.needs_truth: Literal["never", "start", "always"] = "always" if every_step else "start"

    @property
    def highlights(self) -> bool:
        return self.attender.prompting.highlight

    @property
    def references(self) -> Mapping[str, tuple[Rgb, ...]]:
        return self.attender.references

    def prompted_object(self, row: EpisodeRow) -> str:
        """The object that is prompted. Raises: BadStudy when the episode places no look-alike."""
        if self.oracle.of == "target":
            return row.target
        for place in row.placements[1:]:
            if place.model != row.goal and place.model in self.alike:
                return place.model
        raise BadStudy(
            f"OraclePrompter: {row.key} places no look-alike of {row.target!r}; leave wrong-mask "
            "out."
        )

    def start(
        self, observation: Observation, context: PromptContext
    ) -> tuple[AttendState, Attended]:
        """Ground by ground truth (t = 0).

        Raises: BadInstruction, unless the instruction has one target.
        """
        truth = _truth(context)
        text = context.instruction
        parsed, wanted = self.attender.understand(text)
        if len(wanted) != 1:
            raise BadInstruction(
                f"OraclePrompter.start: {len(wanted)} targets in {text!r}, but the truth is about "
                "one; name one."
            )
        phrase = parsed.targets[0].category
        prompted = self.prompted_object(truth.row)
        candidates: dict[str, tuple[Candidates, ...]] = {}
        groundings: dict[str, tuple[Grounding, ...]] = {}
        for camera, rgb in observation.images.items():
            visible = self._visible(truth.masks[camera])
            masks = list(visible.values())
            found = self._describe(rgb, phrase, masks)
            elected = self.attender.ground(camera, wanted[0], found)
            choice = list(visible).index(prompted) if prompted in visible else None
            candidates[camera] = (found,)
            groundings[camera] = (overrule(elected, choice),)
        state, attended = self.attender.begin(
            parsed, observation.images, candidates, groundings, chosen_by="the simulator"
        )
        reveal = self.oracle.reveal
        warning = f"the simulator's {reveal} of {prompted} is read: a bound, not a result"
        events = (Event(0, "WARN", warning), *attended.events)
        return state, replace(attended, events=events)

    def steps(
        self,
        states: Sequence[AttendState],
        observations: Sequence[Observation],
        contexts: Sequence[PromptContext],
    ) -> list[tuple[AttendState, Attended]]:
        if self.needs_truth == "start":
            views = [observation.images for observation in observations]
            return self.attender.steps(states, views)
        results = []
        for state, observation, context in zip(states, observations, contexts, strict=True):
            truth = _truth(context)
            prompted = self.prompted_object(truth.row)
            tracks = {}
            for camera in observation.images:
                mask = truth.masks[camera].get(prompted)
                if mask is not None:
                    mask = spoil(mask, self.oracle.area, self.oracle.shift)
                tracks[camera] = (_track(mask),)
            results.append(self.attender.follow(state, observation.images, tracks, state.trackers))
        return results

    def _visible(self, masks: Mapping[str, Mask]) -> dict[str, Mask]:
        """The visible objects of the category, by name."""
        visible = {}
        for name, mask in masks.items():
            if name in self.alike and mask.any():
                visible[name] = mask
        return visible

    def _describe(self, rgb: Rgb, phrase: str, masks: Sequence[Mask]) -> Candidates:
        """The candidates of one view: true boxes, and true masks.

        The masks are the segmenter's where only the boxes are revealed.
        """
        xyxy = np.array([mask_box(mask) for mask in masks], np.float32).reshape(-1, 4)
        scores = np.ones(len(xyxy), np.float32)
        boxes = Boxes(xyxy, scores, phrase)
        if self.oracle.reveal == "box":
            drawn = self.attender.stack.segmenter(rgb, boxes)
        else:
            spoiled = [spoil(mask, self.oracle.area, self.oracle.shift) for mask in masks]
            drawn = np.array(spoiled, bool).reshape(-1, *rgb.shape[:2])
        embeddings = self.attender.stack.encoder([crop(rgb, box) for box in xyxy])
        ids = tuple(range(len(xyxy)))
        return Candidates(boxes=boxes, embeddings=embeddings, masks=drawn, ids=ids)


def spoil(mask: Mask, area: float, shift: float) -> Mask:
    """The mask, of `area` times its pixels, and moved right by `shift` times its width."""
    box = mask_box(mask)
    if box is None or (area == 1.0 and shift == 0.0):
        return mask
    scale = area**0.5
    middle = (box[:2] + box[2:] - 1) / 2
    moved = middle + np.array([shift * (box[2] - box[0]), 0])
    warp = np.array(
        [[scale, 0, moved[0] - scale * middle[0]], [0, scale, moved[1] - scale * middle[1]]]
    )
    h, w = mask.shape
    spoiled = cv2.warpAffine(mask.astype(np.uint8), warp, (w, h), flags=cv2.INTER_NEAREST)
    return spoiled > 0


def _truth(context: PromptContext) -> SceneTruth:
    assert context.truth is not None, "a prompter that needs truth is given it"
    return context.truth


def _track(mask: Mask | None) -> Track:
    if mask is None or not mask.any():
        return Track(None, 0.0)
    return Track(mask, 1.0)
