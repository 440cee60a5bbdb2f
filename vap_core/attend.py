"""ENTRY: turn what the user said and what the cameras saw into what a frozen policy can follow (P 3.2, 3.3).

    attender = Attender(load_stack("embedded"), memory)
    state, attended = attender.start({"front": rgb}, "bring my cup")       # t = 0: detect, vote, segment
    state, attended = attender.step(state, {"front": rgb})                 # t > 0: track only
    policy(attended.images, attended.text)

Views are grounded independently, or associated (Prompting.associate). A view without candidates, or whose tracker lost the target, passes unmodified.

Arrays: images are RGB, h x w x 3, uint8; boxes are n x 4 `x0 y0 x1 y1` in that image's pixels, far corner exclusive; masks are
n x h x w, bool; embeddings are n (candidates) or k (references) rows of d numbers, each row of length 1; cosines are n x k.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float32

from vap_core import detect, embed, segment, track
from vap_core import events as events_of
from vap_core.associate import Pairing, Sighting, associate, overrule
from vap_core.errors import BadInstruction, BadViews, one_of
from vap_core.instruction import Parser, parse, rewrite
from vap_core.memory import recall
from vap_core.prompt import ALPHA, PALETTE, choose_colours, tint
from vap_core.values import Association, Attended, Boxes, Camera, Colour, Event, Grounding, Instruction, PersonalObject, Rgb, Track, Views, value
from vap_core.vote import Rule, similarity, vote

SAME_BOX = 0.7
"""Boxes of two phrases that overlap by more than this IoU are the same object."""


@dataclass(frozen=True)
class Stack:
    """The four frozen models of the method. `domain` says in words what the detector was trained on; empty: photos of anything."""

    name: str
    detector: detect.Detector
    encoder: embed.Encoder
    segmenter: segment.Segmenter
    tracker: track.Tracker
    domain: str


@dataclass(frozen=True)
class Prompting:
    """What is changed in the policy's inputs; the defaults are the paper's method, the switches its ablations.

    `associate` goes beyond it: views agree on one object each (module associate; its PAIRINGS by name); None grounds them one by one.
    """

    alpha: float = ALPHA
    palette: tuple[Colour, ...] = PALETTE
    highlight: bool = True
    rewrite: bool = True
    rule: Rule = "vote"
    associate: Pairing | None = None


@value
class Seen:
    """The candidates of one phrase in one view; candidate i has identity `ids[i]` in that view's tracker."""

    candidates: Boxes
    embeddings: Float32[np.ndarray, "n d"]
    masks: Bool[np.ndarray, "n h w"]
    ids: tuple[int, ...]


@value
class AttendState:
    """What one episode carries from step to step. `ids[camera][j]` is target j's identity in that view's tracker."""

    frame_index: int
    instruction: Instruction
    colours: tuple[Colour, ...]
    text: str
    groundings: Mapping[str, tuple[Grounding, ...]]
    associations: tuple[Association | None, ...]
    ids: Mapping[str, tuple[int | None, ...]]
    trackers: Mapping[str, Any]
    visible: frozenset[tuple[str, int]]


class Attender:
    """Grounds personal objects at t = 0, follows them after, and prompts every image; holds models, no episode state."""

    def __init__(self, stack: Stack, memory: Mapping[str, PersonalObject], prompting: Prompting | None = None, parser: Parser = parse) -> None:
        self.stack = stack
        self.memory = memory
        self.prompting = prompting or Prompting()
        self.parser = parser

    @property
    def highlights(self) -> bool:
        """Whether pixels are changed, so that it can be asked which."""
        return self.prompting.highlight

    def start(
        self,
        views: Views,
        instruction: str,
        *,
        objects: Sequence[str] | None = None,
        boxes: Mapping[str, Boxes] | None = None,
        cameras: Mapping[str, Camera] | None = None,
    ) -> tuple[AttendState, Attended]:
        """Ground every target of `instruction` in every view (t = 0).

        `objects` names the remembered object of each target in turn, where its category alone does not decide;
        `boxes` replaces the detector by candidates given by hand, per camera; `cameras` are the calibrated cameras as they stand now,
        which only association by geometry needs.

        Raises:
            BadInstruction, UnknownName: what was said cannot be matched with the memory.
            BadViews: the views cannot be associated.
        """
        parsed, wanted = self.understand(instruction, objects)
        seen: dict[str, dict[str, Seen]] = {camera: {} for camera in views}
        for phrase in dict.fromkeys(target.category for target in parsed.targets):
            found = [boxes[camera] for camera in views] if boxes is not None else self.stack.detector(list(views.values()), phrase)
            for (camera, rgb), candidates in zip(views.items(), found, strict=True):
                seen[camera][phrase] = self._look(rgb, candidates, tuple(seen[camera].values()))

        phrases = [target.category for target in parsed.targets]
        groundings = {
            camera: tuple(self.ground(camera, obj, seen[camera][phrase]) for phrase, obj in zip(phrases, wanted, strict=True)) for camera in views
        }
        groundings, associations = self._associate(groundings, [{c: seen[c][phrase] for c in views} for phrase in phrases], views, cameras or {})
        return self.begin(parsed, views, seen, groundings, associations)

    def understand(self, instruction: str, objects: Sequence[str] | None = None) -> tuple[Instruction, list[PersonalObject]]:
        """What is said, and the remembered object of each of its targets. Raises: BadInstruction, UnknownName."""
        parsed = self.parser(instruction, {obj.category for obj in self.memory.values()})
        if objects is not None and len(objects) != len(parsed.targets):
            raise BadInstruction(f"Attender.start: {len(objects)} objects named for {len(parsed.targets)} targets in {instruction!r}; one each.")
        names: Sequence[str | None] = objects or [None] * len(parsed.targets)
        return parsed, [recall(self.memory, target, name) for target, name in zip(parsed.targets, names, strict=True)]

    def begin(
        self,
        parsed: Instruction,
        views: Views,
        seen: Mapping[str, Mapping[str, Seen]],
        groundings: Mapping[str, tuple[Grounding, ...]],
        associations: tuple[Association | None, ...] = (),
        by: str = "association",
    ) -> tuple[AttendState, Attended]:
        """Start tracking and prompt the first images, whoever grounded the targets: `seen[camera][phrase]` are the candidates of each view, and
        `by` says what overruled the vote where something did."""
        phrases = [target.category for target in parsed.targets]
        ids = {
            camera: tuple(
                None if g.winner is None else seen[camera][phrase].ids[g.winner] for phrase, g in zip(phrases, groundings[camera], strict=True)
            )
            for camera in views
        }
        masks = {camera: _masks_by_id(tuple(seen[camera].values())) for camera in views}

        colours = choose_colours(len(phrases), [(views[camera], list(masks[camera])) for camera in views], self.prompting.palette)
        named = [colour if any(ids[camera][j] is not None for camera in views) else None for j, colour in enumerate(colours)]
        text = rewrite(parsed, named) if self.prompting.rewrite else parsed.text
        tracked = [camera for camera in views if len(masks[camera])]
        trackers = dict(zip(tracked, self.stack.tracker.start([views[c] for c in tracked], [masks[c] for c in tracked]), strict=True))
        tracks = {camera: tuple(Track(g.mask, 0.0 if g.mask is None else 1.0) for g in groundings[camera]) for camera in views}
        state = AttendState(0, parsed, colours, text, groundings, associations, ids, trackers, _visible(tracks))
        return state, self._prompt(state, views, tracks, events_of.grounded(groundings, associations, ids, by))

    def step(self, state: AttendState, views: Views) -> tuple[AttendState, Attended]:
        """Follow every target by the tracker alone and prompt the new images (t > 0). Consumes `state`.

        Raises:
            ValueError: `views` are not of the cameras that the episode started with.
        """
        return self.steps([state], [views])[0]

    def steps(self, states: Sequence[AttendState], views: Sequence[Views]) -> list[tuple[AttendState, Attended]]:
        """`step` for a batch of episodes, whose views reach the tracker in one call; what one gets does not depend on the others."""
        for state, seen in zip(states, views, strict=True):
            if set(seen) != set(state.groundings):
                raise ValueError(
                    f"Attender.step: views of {sorted(seen)}, but the episode started with {sorted(state.groundings)}; give the same cameras."
                )
        where = [(i, camera) for i, state in enumerate(states) for camera in state.trackers]
        trackers, found = self.stack.tracker.step([states[i].trackers[c] for i, c in where], [views[i][c] for i, c in where])
        after: list[dict[str, tuple[Any, tuple[Track, ...]]]] = [{} for _ in states]
        for (i, camera), tracker, tracks in zip(where, trackers, found, strict=True):
            after[i][camera] = tracker, tracks
        return [self._stepped(state, seen, parts) for state, seen, parts in zip(states, views, after, strict=True)]

    def _stepped(self, state: AttendState, views: Views, parts: Mapping[str, tuple[Any, tuple[Track, ...]]]) -> tuple[AttendState, Attended]:
        tracks = {
            camera: tuple(Track(None, 0.0) if i is None else parts[camera][1][i] for i in state.ids[camera]) for camera in views
        }  # fmt: skip
        return self.follow(state, views, tracks, {camera: tracker for camera, (tracker, _) in parts.items()})

    def follow(
        self, state: AttendState, views: Views, tracks: Mapping[str, tuple[Track, ...]], trackers: Mapping[str, Any]
    ) -> tuple[AttendState, Attended]:
        """One step on and prompted, with every target where `tracks` says it is, whoever found it there."""
        index, visible = state.frame_index + 1, _visible(tracks)
        events = events_of.changed(index, state.visible, visible)
        state = replace(state, frame_index=index, trackers=trackers, visible=visible)
        return state, self._prompt(state, views, tracks, events)

    def _look(self, rgb: Rgb, candidates: Boxes, before: tuple[Seen, ...]) -> Seen:
        """Embed and segment every candidate of one view; what an earlier phrase proposed too keeps its identity."""
        embeddings = self.stack.encoder([embed.crop(rgb, box) for box in candidates.xyxy])
        known = np.concatenate([np.zeros((0, 4), np.float32), *(part.candidates.xyxy for part in before)])
        known_ids = [i for part in before for i in part.ids]
        ids, fresh = [], 1 + max(known_ids, default=-1)
        for overlap in detect.box_iou(candidates.xyxy, known):
            if len(known) and overlap.max() > SAME_BOX:
                ids.append(known_ids[int(overlap.argmax())])
            else:
                ids.append(fresh)
                fresh += 1
        return Seen(candidates, embeddings, self.stack.segmenter(rgb, candidates), tuple(ids))

    def ground(self, camera: str, obj: PersonalObject, seen: Seen) -> Grounding:
        """The vote of one view."""
        cosine = similarity(seen.embeddings, obj.embeddings)
        b = vote(cosine, self.prompting.rule)
        return Grounding(camera, obj.name, seen.candidates, cosine, b.votes, b.tied, b.winner, b.margin, b.cosine_margin, seen.masks)

    def _associate(
        self,
        groundings: Mapping[str, tuple[Grounding, ...]],
        seen: Sequence[Mapping[str, Seen]],
        views: Views,
        cameras: Mapping[str, Camera],
    ) -> tuple[dict[str, tuple[Grounding, ...]], tuple[Association | None, ...]]:
        """Let the views agree on each target by itself; `seen[j]` are target j's candidates by camera. Switched off, nothing changes."""
        pairing = self.prompting.associate
        if pairing is None:
            return dict(groundings), ()
        for name, rgb in views.items():
            if name in cameras and (cameras[name].height, cameras[name].width) != rgb.shape[:2]:
                raise BadViews(
                    f"Attender.start: camera {name!r} is calibrated for {cameras[name].width}x{cameras[name].height} pixels, but its view has "
                    f"{rgb.shape[1]}x{rgb.shape[0]}; scale its k, or the view."
                )
        found = [
            associate(
                {c: Sighting(groundings[c][j].similarity, s.embeddings, s.candidates.xyxy, cameras.get(c)) for c, s in by_camera.items()}, pairing
            )
            for j, by_camera in enumerate(seen)
        ]
        return {
            camera: tuple(g if a is None else overrule(g, a.chosen[camera]) for g, a in zip(per_view, found, strict=True))
            for camera, per_view in groundings.items()
        }, tuple(found)

    def _prompt(self, state: AttendState, views: Views, tracks: Mapping[str, tuple[Track, ...]], events: tuple[Event, ...]) -> Attended:
        images = dict(views)
        if self.prompting.highlight:
            for camera, per_target in tracks.items():
                free = np.ones(views[camera].shape[:2], bool)  # a pixel that two targets claim is tinted once
                for track, colour in zip(per_target, state.colours, strict=True):
                    if track.mask is not None:
                        images[camera] = tint(images[camera], track.mask & free, colour, self.prompting.alpha)
                        free &= ~track.mask
        return Attended(images, state.text, state.colours, tracks, state.groundings, events, state.associations)


def embedded() -> Stack:
    """The offline stack: frozen EfficientNet-Lite0 features and small heads trained on rendered generic objects."""
    return Stack("embedded", detect.load(), embed.load(), segment.load(), track.load(), "rendered tabletop scenes")


def foundation(kind: str = "foundation") -> Stack:
    """Grounding DINO, DINOv2 and SAM 2.1 (P 5.1), on a GPU where there is one."""
    from vap_core import foundation

    parts = foundation.load(kind)
    return Stack(kind, parts.detector, parts.encoder, parts.segmenter, parts.tracker, "")


STACKS: dict[str, Callable[[], Stack]] = {
    "embedded": embedded,
    "foundation": foundation,
    "foundation-small": lambda: foundation("foundation-small"),
}


def load_stack(name: str) -> Stack:
    """Build a stack by name; loading weights takes about a second."""
    if name not in STACKS:
        raise one_of("load_stack: stack", name, STACKS)
    return STACKS[name]()


def _visible(tracks: Mapping[str, tuple[Track, ...]]) -> frozenset[tuple[str, int]]:
    return frozenset((camera, j) for camera, per_target in tracks.items() for j, track in enumerate(per_target) if track.mask is not None)


def _masks_by_id(parts: tuple[Seen, ...]) -> Bool[np.ndarray, "n h w"]:
    """One mask per identity, in the order of identities."""
    masks, ids = np.concatenate([part.masks for part in parts]), [i for part in parts for i in part.ids]
    return masks[[ids.index(i) for i in range(1 + max(ids, default=-1))]]
