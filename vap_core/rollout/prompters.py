"""What a prompter is, and the prompters: it decides what the frozen policy receives."""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any, Literal, Protocol, runtime_checkable

import cv2
import numpy as np

from vap_core.associate import overrule
from vap_core.attend import GROUNDING_PX, Attender, AttendState, Prompting
from vap_core.base.errors import BadInstruction, BadMemory, BadStudy, number_of
from vap_core.base.types import (
    Attended,
    Boxes,
    Camera,
    Event,
    Grounding,
    Mask,
    PersonalObject,
    Rgb,
    Track,
    Views,
    kind_of,
    value,
)
from vap_core.instruction import parse
from vap_core.perception.boxes import crop, mask_box
from vap_core.perception.candidates import Candidates, draw_masks
from vap_core.simulation.types import EpisodeRow, Observation

Masks = Mapping[str, Mapping[str, Mask]]
"""`masks[camera][object]`: visible pixels, as in simulation.types.Truth."""


@value
class SceneTruth:
    """Ground truth of one step, for prompters that declare `needs_truth`.

    `step` counts the control steps that were taken, `moved` names the objects that moved so far
    (simulation.suites.rules).
    """

    row: EpisodeRow
    masks: Masks
    step: int = 0
    moved: frozenset[str] = frozenset()


@value
class PromptContext:
    """What a prompter knows besides the observation.

    `cameras` are the calibrated cameras at this moment, by name. `look` takes the views of this
    moment again with a longer side of so many pixels; None where the cameras give no more. `truth`
    is there only for a prompter that declares it.
    """

    instruction: str
    cameras: Mapping[str, Camera] = field(default_factory=dict)
    truth: SceneTruth | None = None
    look: Callable[[int], Views] | None = None


@runtime_checkable
class Prompter[S](Protocol):
    """Turns observations into what the policy sees and reads.

    What one episode carries is state, an argument and a result. `needs_truth` says when it reads
    the simulator: "never", at the "start", or "always"; one that does is a bound on results, never
    a result. `highlights` says whether it changes pixels inside tracked masks, so that the masks'
    coverage is recorded. `references` are the remembered crops of its objects, by name, for
    recordings.
    """

    needs_truth: Literal["never", "start", "always"]

    @property
    def highlights(self) -> bool: ...

    @property
    def references(self) -> Mapping[str, tuple[Rgb, ...]]: ...

    def start(self, observation: Observation, context: PromptContext) -> tuple[S, Attended]:
        """The first step of an episode."""
        ...

    def steps(
        self,
        states: Sequence[S],
        observations: Sequence[Observation],
        contexts: Sequence[PromptContext],
    ) -> list[tuple[S, Attended]]:
        """The next step of every episode of a batch.

        The result for one does not depend on the others.
        """
        ...


def checked_steps(
    returned: object, prompter: object, observations: Sequence[Observation], call: str = "steps"
) -> list[tuple[Any, Attended]]:
    """What a prompter returned for these observations, of which each has pictures.

    Raises: ValueError when it is not a list of one state and one Attended for each, with pictures
        of the same cameras and sizes.
    """
    who = f"prompter {type(prompter).__name__}: {call} returned"
    n = len(observations)
    if not isinstance(returned, list | tuple) or len(returned) != n:
        what = len(returned) if isinstance(returned, list | tuple) else type(returned).__name__
        episodes = number_of(n, "episode")
        raise ValueError(f"{who} {what} results for {episodes}; return a list, one for each")
    for result, observation in zip(returned, observations, strict=True):
        is_pair = isinstance(result, list | tuple) and len(result) == 2
        if not is_pair or not isinstance(result[1], Attended) or type(result[1].text) is not str:
            raise ValueError(
                f"{who} {type(result).__name__} as a result; return the state and an Attended "
                "with a text"
            )
        seen, shown = (
            {name: kind_of(rgb) for name, rgb in of.images.items()}
            for of in (observation, result[1])
        )
        if shown != seen:
            raise ValueError(f"{who} pictures {shown}; return one for each of {seen}")
    return [(state, attended) for state, attended in returned]


def unchanged(images: Views, text: str) -> Attended:
    """Images as they are, with `text`."""
    return Attended(images, text, (), {}, {}, (), ())


@dataclass(frozen=True)
class HardPrompt:
    """The object's description, short or long, is appended to the instruction."""

    length: Literal["short", "long"]


@dataclass(frozen=True)
class SoftPrompt:
    """The personal span is replaced by a reserved, learned word (SPEC section 4).

    It is learned in the model that the policy was initialised from and copied, as the paper does;
    learned there and rotated into the policy's space; or learned in the policy's own weights.
    """

    space: Literal["copied", "aligned", "own"] = "copied"


@dataclass(frozen=True)
class OtherCommand:
    """The policy reads another command than the episode's.

    None at all, or that of the suite's next task.
    """

    command: Literal["blank", "next task"]


class TextPrompter:
    """Passes images unchanged; the policy reads `rewrite(instruction)` in every step."""

    needs_truth: Literal["never", "start", "always"] = "never"
    highlights = False
    references: Mapping[str, tuple[Rgb, ...]] = MappingProxyType({})

    def __init__(self, rewrite: Callable[[str], str]) -> None:
        self.rewrite = rewrite

    def start(self, observation: Observation, context: PromptContext) -> tuple[str, Attended]:
        """The state of an episode is its text."""
        text = self.rewrite(context.instruction)
        return text, unchanged(observation.images, text)

    def steps(
        self,
        states: Sequence[str],
        observations: Sequence[Observation],
        contexts: Sequence[PromptContext],
    ) -> list[tuple[str, Attended]]:
        return [
            (text, unchanged(observation.images, text))
            for text, observation in zip(states, observations, strict=True)
        ]


def generic() -> TextPrompter:
    """The generic policy: raw images, raw instruction."""
    return TextPrompter(str)


def say(text: str) -> TextPrompter:
    """Raw images and `text`, whatever the instruction is."""
    return TextPrompter(lambda instruction: text)


def hard_prompt(obj: PersonalObject, how: HardPrompt) -> TextPrompter:
    """The object's description is appended to the instruction.

    "pick up my cup" -> "pick up my cup. My cup is white with blue spots."

    Raises: BadMemory when the object was never described.
    """
    if obj.description is None:
        raise BadMemory(
            f"hard_prompt: {obj.name!r} has no description; register it again with --replace, or "
            "delete its file."
        )
    phrase = obj.description.short if how.length == "short" else obj.description.long
    said = f". My {obj.category} is {phrase}."
    return TextPrompter(lambda instruction: instruction.rstrip(" .") + said)


def soft_prompt(word: str, categories: Collection[str] = ()) -> TextPrompter:
    """The personal span is replaced: "pick up my cup" -> "pick up <my_0>" for `word` "<my_0>".

    With the objects' `categories` it is the span that the method replaces; without, it is all words
    up to the first stop word.
    """

    def replace_span(instruction: str) -> str:
        target = parse(instruction, categories).targets[0]
        return instruction[: target.start] + word + instruction[target.stop :]

    return TextPrompter(replace_span)


class TintPrompter:
    """Grounds, tracks and tints by an `Attender`; it reads nothing of the simulator."""

    needs_truth: Literal["never", "start", "always"] = "never"

    def __init__(self, attender: Attender) -> None:
        self.attender = attender

    @property
    def highlights(self) -> bool:
        return self.attender.prompting.highlight

    @property
    def references(self) -> Mapping[str, tuple[Rgb, ...]]:
        return self.attender.references

    def start(
        self, observation: Observation, context: PromptContext
    ) -> tuple[AttendState, Attended]:
        views = observation.images
        longest = max(max(rgb.shape[:2]) for rgb in views.values())
        larger = None
        if context.look is not None and longest < GROUNDING_PX:
            larger = context.look(GROUNDING_PX)
        return self.attender.start(
            views, context.instruction, cameras=context.cameras, larger=larger
        )

    def steps(
        self,
        states: Sequence[AttendState],
        observations: Sequence[Observation],
        contexts: Sequence[PromptContext],
    ) -> list[tuple[AttendState, Attended]]:
        views = [observation.images for observation in observations]
        results = self.attender.steps(states, views)
        for i, before in enumerate(states):
            n, lacks = before.frame_index + 1, len(before.trackers) < len(before.ids)
            if self.attender.prompting.relook and lacks and n & (n - 1) == 0:
                results[i] = self._look_again(before, results[i], observations[i], contexts[i])
        return results

    def _look_again(
        self,
        before: AttendState,
        followed: tuple[AttendState, Attended],
        observation: Observation,
        context: PromptContext,
    ) -> tuple[AttendState, Attended]:
        """The step with what is found now in views that had nothing."""
        state, attended = followed
        fresh, again = self.start(observation, context)
        found = [camera for camera in fresh.trackers if camera not in before.trackers]
        if not found:
            return followed
        ids, tracks, trackers = (
            {**old, **{camera: new[camera] for camera in found}}
            for old, new in (
                (before.ids, fresh.ids),
                (attended.tracks, again.tracks),
                (state.trackers, fresh.trackers),
            )
        )
        told = replace(
            before if before.trackers else fresh,  # Its colours and its text.
            frame_index=before.frame_index,
            ids=ids,
            visible=before.visible,
        )
        return self.attender.follow(told, observation.images, tracks, trackers)


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


class OraclePrompter(TintPrompter):
    """An Attender whose grounding is the simulator's.

    `alike` are the scene's objects of the target's category. Every visible object of the category
    is a candidate, as if detected; the vote is held and kept, and then overruled. A view in which
    the prompted object is invisible passes unmodified.
    """

    def __init__(self, attender: Attender, oracle: Oracle, alike: frozenset[str]) -> None:
        super().__init__(attender)
        self.oracle = oracle
        self.alike = alike
        self.needs_truth = "always" if oracle.reveal == "track" else "start"

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
            visible = {
                name: mask
                for name, mask in truth.masks[camera].items()
                if name in self.alike and mask.any()
            }
            found = self._describe(rgb, phrase, list(visible.values()))
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
            return super().steps(states, observations, contexts)
        results = []
        for state, observation, context in zip(states, observations, contexts, strict=True):
            truth = _truth(context)
            prompted = self.prompted_object(truth.row)
            tracks = {}
            for camera in observation.images:
                mask = truth.masks[camera].get(prompted)
                if mask is not None:
                    mask = spoil(mask, self.oracle.area, self.oracle.shift)
                seen = mask is not None and bool(mask.any())
                tracks[camera] = (Track(mask, 1.0) if seen else Track(None, 0.0),)
            results.append(self.attender.follow(state, observation.images, tracks, state.trackers))
        return results

    def _describe(self, rgb: Rgb, phrase: str, masks: Sequence[Mask]) -> Candidates:
        """The candidates of one view: true boxes, and true masks.

        The masks are the segmenter's where only the boxes are revealed.
        """
        xyxy = np.array([mask_box(mask) for mask in masks], np.float32).reshape(-1, 4)
        boxes = Boxes(xyxy, np.ones(len(xyxy), np.float32), phrase)
        if self.oracle.reveal == "box":
            drawn = draw_masks(self.attender.stack.segmenter, rgb, boxes)
        else:
            spoiled = [spoil(mask, self.oracle.area, self.oracle.shift) for mask in masks]
            drawn = np.array(spoiled, bool).reshape(-1, *rgb.shape[:2])
        embeddings = self.attender.stack.encoder([crop(rgb, box) for box in xyxy])
        return Candidates(boxes, embeddings, drawn, tuple(range(len(xyxy))))


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


EARLY = 0.1
"""The share of an episode's step limit after which an early switch happens."""
SWITCHED = "the tint is switched to "
"""Begins the event of a switch; the name of the object follows."""


@dataclass(frozen=True)
class Switch:
    """When the tint is switched: early, or once the target has moved, and so was grasped."""

    when: Literal["early", "moved"]


@value
class SwitchState:
    """One episode: the state of its prompting, and whether the tint was switched."""

    attend: AttendState
    switched: bool


class SwitchPrompter:
    """Two oracles that know the mask at every step: of the target, then of the look-alike."""

    needs_truth: Literal["never", "start", "always"] = "always"

    def __init__(self, attender: Attender, switch: Switch, alike: frozenset[str]) -> None:
        self.switch = switch
        self.before = OraclePrompter(attender, Oracle("track"), alike)
        self.after = OraclePrompter(attender, Oracle("track", of="look-alike"), alike)
        self.highlights, self.references = self.before.highlights, self.before.references

    def start(
        self, observation: Observation, context: PromptContext
    ) -> tuple[SwitchState, Attended]:
        """Prompt the target. Raises: BadStudy when the episode places no look-alike of it."""
        self.after.prompted_object(_truth(context).row)
        state, attended = self.before.start(observation, context)
        return SwitchState(state, switched=False), attended

    def steps(
        self,
        states: Sequence[SwitchState],
        observations: Sequence[Observation],
        contexts: Sequence[PromptContext],
    ) -> list[tuple[SwitchState, Attended]]:
        results = []
        for state, observation, context in zip(states, observations, contexts, strict=True):
            truth = _truth(context)
            if self.switch.when == "early":
                due = truth.step >= EARLY * truth.row.max_steps
            else:
                due = truth.row.target in truth.moved
            switched = state.switched or due
            oracle = self.after if switched else self.before
            ((attend, attended),) = oracle.steps([state.attend], [observation], [context])
            if switched and not state.switched:
                name = self.after.prompted_object(truth.row)
                event = Event(truth.step, "WARN", f"{SWITCHED}{name}")
                attended = replace(attended, events=(event, *attended.events))
            results.append((SwitchState(attend, switched), attended))
        return results
