"""START HERE. The method: an instruction and camera views become what a policy can follow.

It is that of P 3.2 and 3.3; the policy stays frozen.

    attender = Attender(load_stack("embedded"), memory)
    state, attended = attender.start({"front": rgb}, "bring my cup")  # t = 0: detect, vote, segment
    state, attended = attender.step(state, {"front": rgb})            # t > 0: track only
    policy(attended.images, attended.text)

Views are grounded one by one, or associated (Prompting.associate). A view without candidates, or
whose tracker has lost the target, is passed on unmodified.

Images are RGB, h x w x 3, uint8. Boxes are n x 4, `x0 y0 x1 y1` in that image's pixels, far corner
exclusive. Masks are n x h x w, bool. Embeddings are n (candidates) or k (references) rows of d
numbers, each row of length 1. Cosines are n x k.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any
from unicodedata import normalize

import cv2
import numpy as np
from jaxtyping import Bool, Float32

from vap_core.associate import associate_targets
from vap_core.base.errors import BadInstruction, BadStudy, BadViews
from vap_core.base.events import Visible, grounding_events, visibility_events
from vap_core.base.types import (
    Association,
    Attended,
    Boxes,
    Camera,
    Colour,
    Event,
    Grounding,
    Instruction,
    Mask,
    PersonalObject,
    Rgb,
    Track,
    Views,
    election_scores,
    kind_of,
    value,
)
from vap_core.instruction import Parser, rewrite, unite
from vap_core.instruction.parsers import rule_parser
from vap_core.memory import recall, reference_rows
from vap_core.perception.candidates import (
    Candidates,
    Proposals,
    embed_views,
    follow,
    judge,
    masks_by_id,
    propose,
    segment,
)
from vap_core.perception.protocols import Stack, TargetTracker
from vap_core.prompt import PALETTE, PromptForm, Tint, choose_colours, has_colour
from vap_core.vote import VoteRule, check_rule, compare, nominate, vote

GROUNDING_PX = 448
"""The longer side of the views in which objects are looked for, where a camera can give more pixels
than the policy sees."""
LEAST_COVER = 0.4
"""Share of a pixel that a mask of a larger view covers, from which on it is of the mask."""
OF_AGREEMENT = 0.7
"""How much of their likeness to each other the references lend to an object that is in view: where
they are very alike, a look-alike is like them, too."""
MOST_ASKED = 0.74
"""No likeness above this is asked for: those of a thing that looks alike from all sides agree more
than any view of it, from another camera in other light, agrees with them."""
PerTarget = tuple[Grounding, ...]
"""One grounding per target of the instruction, in the order of its targets."""


@dataclass(frozen=True)
class Prompting:
    """What is changed in the policy's inputs: by default the paper's method.

    The switches are ablations. `associate` goes beyond the paper: calibrated views agree on one
    object; by default each is grounded by itself. So does `relook`: at steps 1, 2, 4, 8 and so on
    of a rollout, views in which nothing is tinted are looked at again. `always_tint` is the paper's
    rule: the best candidate wins, however unlike the references it is. Without it an object whose
    best candidate is below the stack's threshold is not in view. `references` is how many of an
    object's references are used, the first ones; None uses all.

    Raises: UnknownName, BadStudy, when it is built from what is no rule or count, or from
        a palette with a name twice or a colour without a hue.
    """

    form: PromptForm = field(default_factory=Tint)
    palette: tuple[Colour, ...] = PALETTE
    highlight: bool = True
    rewrite: bool = True
    rule: VoteRule = "vote"
    associate: bool = False
    relook: bool = False
    always_tint: bool = False
    references: int | None = None

    def __post_init__(self) -> None:
        check_rule(self.rule, "Prompting")
        names = [colour.name for colour in self.palette]
        for colour in self.palette:
            if not has_colour(np.array([colour.rgb], np.uint8), colour).all():
                raise BadStudy(
                    f"Prompting: the palette's {colour.name!r} {colour.rgb} is grey, pale or dark: "
                    "colours are told apart by their hue; take a vivid one, as in prompt.PALETTE."
                )
            if names.count(colour.name) > 1:
                raise BadStudy(
                    f"Prompting: the palette has {colour.name!r} twice; give every colour its own "
                    "name."
                )
        if self.references is not None and self.references < 1:
            raise BadStudy(
                f"Prompting: references is {self.references}; give 1 or more, or None for all."
            )


@value
class AttendState:
    """What one episode carries from step to step.

    `ids[camera][j]` is target j's identity in that view's tracker, None where it has none.
    `visible` holds (camera, j) of every target that has a mask now.
    """

    frame_index: int
    instruction: Instruction
    colours: tuple[Colour, ...]
    text: str
    groundings: Mapping[str, PerTarget]
    associations: tuple[Association | None, ...]
    ids: Mapping[str, tuple[int | None, ...]]
    trackers: Mapping[str, Any]
    visible: Visible


def check_views(views: Any) -> None:
    """Raises: BadViews: there is no view, or one is not RGB, height x width x 3, uint8."""
    if not isinstance(views, Mapping) or not views:
        raise BadViews("Attender: no views; give the picture of every camera, by its name.")
    for camera, rgb in views.items():
        if (
            isinstance(rgb, np.ndarray)
            and rgb.dtype == np.uint8
            and rgb.ndim == 3
            and rgb.shape[2] == 3
            and rgb.size
        ):
            continue
        raise BadViews(
            f"Attender: view {camera!r} is {kind_of(rgb)}; give RGB, height x width x 3, uint8."
        )


def _clip_to_views(boxes: Mapping[str, Boxes], views: Views) -> dict[str, Boxes]:
    """Boxes given by hand, each inside its view. Raises: BadViews."""
    unknown = sorted(set(boxes) - set(views))
    if unknown:
        raise BadViews(
            f"Attender.start: boxes of {', '.join(unknown)}, but the views are of "
            f"{', '.join(sorted(views))}; name the boxes after the views."
        )
    clipped = {}
    for camera, given in boxes.items():
        height, width = views[camera].shape[:2]
        far = np.array([width, height, width, height], np.float32)
        xyxy = np.clip(given.xyxy, np.float32(0), far)
        outside = np.flatnonzero((xyxy[:, 2:] - xyxy[:, :2] < 1).any(axis=1))
        if len(outside):
            raise BadViews(
                f"Attender.start: box {given.xyxy[outside[0]].tolist()} of view {camera!r} has "
                f"less than one pixel inside its {width}x{height} picture; give x0, y0, x1, y1 in "
                "its pixels, far corner last."
            )
        clipped[camera] = replace(given, xyxy=xyxy)
    return clipped


def _check_larger(views: Views, looked_at: Views) -> None:
    """Raises: BadViews: a larger view is no RGB picture, of no camera, or of another shape."""
    check_views(looked_at)
    for camera, rgb in looked_at.items():
        if camera not in views:
            raise BadViews(
                f"Attender.start: a larger view of {camera!r}, but the views are of "
                f"{', '.join(sorted(views))}; name it after one of them."
            )
        height, width = views[camera].shape[:2]
        tall, wide = rgb.shape[:2]
        if abs(wide * height - tall * width) > max(tall, wide):
            raise BadViews(
                f"Attender.start: the larger view of {camera!r} is {wide}x{tall}, but the view "
                f"{width}x{height}; give the same picture with more pixels."
            )


def _scaled(boxes: Boxes, of: Rgb, to: Rgb) -> Boxes:
    """The boxes of a picture in the pixels of another size of it."""
    scale = np.array([to.shape[1] / of.shape[1], to.shape[0] / of.shape[0]] * 2, np.float32)
    return replace(boxes, xyxy=boxes.xyxy * scale)


def _carry(found: Candidates, of: Rgb, to: Rgb) -> Candidates:
    """What was found in a view, in the pixels of another size of it."""
    h, w = to.shape[:2]
    if of.shape[:2] == (h, w):
        return found
    masks = np.zeros((len(found.masks), h, w), bool)
    for mask, large in zip(masks, found.masks, strict=True):
        cover = cv2.resize(large.astype(np.float32), (w, h), interpolation=cv2.INTER_AREA)
        mask[:] = cover >= min(LEAST_COVER, max(float(cover.max()), 1e-6))
    return replace(found, boxes=_scaled(found.boxes, of, to), masks=masks)


class Attender:
    """Grounds personal objects at t = 0, tracks them afterwards, and prompts every image.

    It holds models and the memory, and no state of an episode. `speaker` is whom "my" means
    (instruction.owners); without a `parser` the rule parses. What is added to `memory` later counts
    from the next start on; a `parser` that is given decides itself.
    """

    def __init__(
        self,
        stack: Stack,
        memory: Mapping[str, PersonalObject],
        prompting: Prompting | None = None,
        parser: Parser | None = None,
        speaker: str = "",
    ) -> None:
        self.stack = stack
        self.memory = memory
        self.prompting = prompting or Prompting()
        self._parser = parser
        self.speaker = speaker

    @property
    def parser(self) -> Parser:
        """The parser that was given; else the rule, for the owners that the memory has now."""
        return self._parser or rule_parser(self.memory)

    @property
    def references(self) -> Mapping[str, tuple[Rgb, ...]]:
        """The remembered crops of every object, by name."""
        return {name: obj.crops for name, obj in self.memory.items()}

    def start(
        self,
        views: Views,
        instruction: str,
        *,
        objects: Sequence[str] | None = None,
        boxes: Mapping[str, Boxes] | None = None,
        cameras: Mapping[str, Camera] | None = None,
        larger: Views | None = None,
    ) -> tuple[AttendState, Attended]:
        """Ground every target of `instruction` in every view (t = 0).

        `objects` names the remembered object of each "my cup" in turn, where its category alone
        does not decide. `boxes` replaces the detector by candidates given by hand, clipped to their
        view; a camera that it leaves out has none. `cameras` are the calibrated cameras at this
        moment, which association needs. `larger` are the same views with more pixels, in which
        objects are looked for instead: what is found is carried to the pixels of `views`.

        Raises:
            BadInstruction, UnknownName: the instruction does not match the memory.
            BadViews: a view is no RGB picture, there are boxes of a camera that gives none or
                outside its view, a larger view has another shape, or the views cannot be
                associated.
            BadEncoder: an encoder gives rows that are not finite or not of length 1.
        """
        check_views(views)
        if boxes is not None:
            boxes = _clip_to_views(boxes, views)
        parsed, wanted = self.understand(instruction, objects)
        phrases = [target.category for target in parsed.targets]
        looked_at = {**views, **(larger or {})}
        _check_larger(views, looked_at)
        if boxes is not None:
            boxes = {
                camera: _scaled(of_view, views[camera], looked_at[camera])
                for camera, of_view in boxes.items()
            }
        proposals = self._propose(looked_at, phrases, boxes)

        candidates: dict[str, tuple[Candidates, ...]] = {}
        groundings: dict[str, PerTarget] = {}
        for camera, rgb in looked_at.items():
            found: list[Candidates] = []
            carried: list[Candidates] = []
            per_target = []
            for phrase, obj in zip(phrases, wanted, strict=True):
                few, cosine = nominate(rgb, obj, proposals[camera][phrase], self.stack)
                found.append(segment(rgb, few, self.stack, known=found))
                carried.append(_carry(found[-1], rgb, views[camera]))
                per_target.append(self.ground(camera, obj, carried[-1], cosine))
            candidates[camera] = tuple(carried)
            groundings[camera] = tuple(per_target)

        associations: tuple[Association | None, ...] = ()
        if self.prompting.associate:
            groundings, associations = associate_targets(groundings, cameras or {})
        for j, obj in enumerate(wanted):
            judged = self.reject(obj, {camera: of[j] for camera, of in groundings.items()})
            for camera, of in groundings.items():
                groundings[camera] = (*of[:j], judged[camera], *of[j + 1 :])
        return self.begin(parsed, views, candidates, groundings, associations)

    def understand(
        self, instruction: str, objects: Sequence[str] | None = None
    ) -> tuple[Instruction, list[PersonalObject]]:
        """Parse an instruction, and recall the object of each of its targets.

        An object that is named several times is one target. A letter that is written as two
        characters, such as an umlaut, is made one (NFC).

        Raises: BadInstruction, UnknownName.
        """
        categories = {obj.category for obj in self.memory.values()}
        parsed = self.parser(normalize("NFC", instruction), categories)
        n = len(parsed.targets)
        if objects is not None and len(objects) != n:
            raise BadInstruction(
                f"Attender.start: {len(objects)} objects named for {n} targets in {instruction!r}; "
                "one each."
            )
        wanted = []
        for j, target in enumerate(parsed.targets):
            name = None if objects is None else objects[j]
            wanted.append(recall(self.memory, target, name, self.speaker))
        parsed = unite(parsed, [obj.name for obj in wanted])
        once = {obj.name: obj.first(self.prompting.references) for obj in wanted}
        return parsed, list(once.values())

    def ground(
        self,
        camera: str,
        obj: PersonalObject,
        candidates: Candidates,
        cosine: Float32[np.ndarray, "n k"] | None = None,
    ) -> Grounding:
        """The vote of one view for one object; `cosine` is `compare`'s, where that is known.

        Raises: BadEncoder, as `vote.compare` does.
        """
        boxes = candidates.boxes
        if cosine is None:
            cosine = compare(obj, candidates, self.stack)
        ballot = vote(election_scores(cosine, boxes), self.prompting.rule)
        return Grounding(
            camera, obj.name, boxes, cosine, ballot, winner=ballot.winner, masks=candidates.masks
        )

    def reject(
        self, obj: PersonalObject, of_views: Mapping[str, Grounding]
    ) -> dict[str, Grounding]:
        """One target's groundings, without winners too unlike the references to be the object."""
        thresholds = self.stack.thresholds
        if thresholds is None or self.prompting.always_tint:
            return dict(of_views)
        familiar = thresholds.familiar
        found = [
            float(g.likeness[g.winner])
            for g in of_views.values()
            if g.winner is not None and g.candidates.familiar
        ]
        k = len(obj.crops)
        if thresholds.together is not None and k > 1 and found:
            rows = reference_rows(obj, self.stack.encoder)
            agreement = (float((rows @ rows.T).sum()) - k) / (k * (k - 1))
            least = min(MOST_ASKED, thresholds.together + OF_AGREEMENT * agreement)
            if max(found) < least:
                familiar = max(familiar, least)
        judged = {}
        for camera, grounding in of_views.items():
            winner = grounding.winner
            threshold = familiar if grounding.candidates.familiar else thresholds.unfamiliar
            grounding = replace(grounding, threshold=threshold)
            if winner is not None and grounding.likeness[winner] < threshold:
                grounding = replace(grounding, winner=None, rejected=winner)
            judged[camera] = grounding
        return judged

    def begin(
        self,
        parsed: Instruction,
        views: Views,
        candidates: Mapping[str, Sequence[Candidates]],
        groundings: Mapping[str, PerTarget],
        associations: tuple[Association | None, ...] = (),
        chosen_by: str = "association",
    ) -> tuple[AttendState, Attended]:
        """Start tracking and prompt the first images, given the groundings.

        `candidates[camera][j]` are those of target j; `chosen_by` names what overruled the vote,
        where something did.

        Raises: BadInstruction for more targets than the palette has tints.
        """
        ids: dict[str, tuple[int | None, ...]] = {}
        masks: dict[str, Bool[np.ndarray, "n h w"]] = {}
        tracks: dict[str, tuple[Track, ...]] = {}
        for camera in views:
            elected = zip(candidates[camera], groundings[camera], strict=True)
            ids[camera] = tuple(
                None if grounding.winner is None else of_target.ids[grounding.winner]
                for of_target, grounding in elected
            )
            masks[camera] = masks_by_id(candidates[camera])
            tracks[camera] = _first_tracks(groundings[camera], ids[camera])

        scenes = [(rgb, list(masks[camera])) for camera, rgb in views.items()]
        colours = choose_colours(len(parsed.targets), scenes, self.prompting.palette)
        shown = {camera: are_shown(per_target) for camera, per_target in tracks.items()}
        text = parsed.text
        if self.prompting.rewrite:
            # What no view shows is not rewritten.
            named = [
                colour if any(of_view[j] for of_view in shown.values()) else None
                for j, colour in enumerate(colours)
            ]
            text = rewrite(parsed, named)
        state = AttendState(
            frame_index=0,
            instruction=parsed,
            colours=colours,
            text=text,
            groundings=groundings,
            associations=associations,
            ids=ids,
            trackers=self._start_trackers(views, masks, ids),
            visible=_visible(tracks),
        )
        events = grounding_events(groundings, associations, ids, shown, chosen_by)
        others: dict[str, list[Mask]] = {}
        if self._marks_others:
            for camera in views:
                others[camera] = _other_masks(list(masks[camera]), ids[camera])
        return state, self._prompt(state, views, tracks, others, events)

    def step(self, state: AttendState, views: Views) -> tuple[AttendState, Attended]:
        """Track every target and prompt the new images (t > 0).

        Raises:
            BadViews: a view is no RGB picture, `views` are not of the cameras that the episode
                started with, or a view has another size than it had there.
        """
        return self.steps([state], [views])[0]

    def steps(
        self, states: Sequence[AttendState], views: Sequence[Views]
    ) -> list[tuple[AttendState, Attended]]:
        """`step` for a batch of episodes, whose views reach the tracker in one call.

        The result for one episode does not depend on the others.

        Raises: BadViews, as `step`.
        """
        for state, images_now in zip(states, views, strict=True):
            check_views(images_now)
            if set(images_now) != set(state.groundings):
                raise BadViews(
                    f"Attender.step: views of {sorted(images_now)}, but the episode started with "
                    f"{sorted(state.groundings)}; give the same cameras."
                )
            for camera, of_targets in state.groundings.items():
                shape, began = images_now[camera].shape, of_targets[0].masks.shape[1:]
                if shape[:2] != began:
                    raise BadViews(
                        f"Attender.step: view {camera!r} is {shape[1]}x{shape[0]}, but the episode "
                        f"started with {began[1]}x{began[0]}; a view keeps its size."
                    )
        trackers = [tracker for state in states for tracker in state.trackers.values()]
        pairs = zip(states, views, strict=True)
        images = [images_now[camera] for state, images_now in pairs for camera in state.trackers]
        trackers, tracks = follow(self.stack.tracker, trackers, images)

        results = []
        first = 0
        for state, images_now in zip(states, views, strict=True):
            stop = first + len(state.trackers)
            next_trackers = dict(zip(state.trackers, trackers[first:stop], strict=True))
            by_camera = dict(zip(state.trackers, tracks[first:stop], strict=True))
            targets = _tracks_of_targets(state, by_camera)
            others = {}
            if self._marks_others:
                for camera, of_view in by_camera.items():
                    followed = [track.mask for track in of_view]
                    others[camera] = _other_masks(followed, state.ids[camera])
            results.append(self.follow(state, images_now, targets, next_trackers, others))
            first = stop
        return results

    def follow(
        self,
        state: AttendState,
        views: Views,
        tracks: Mapping[str, tuple[Track, ...]],
        trackers: Mapping[str, Any],
        others: Mapping[str, Sequence[Mask]] | None = None,
    ) -> tuple[AttendState, Attended]:
        """Advance one step and prompt, with every target where `tracks` has it.

        `others` are the masks of what else is followed, which some forms of a prompt need.
        """
        frame_index = state.frame_index + 1
        visible = _visible(tracks)
        events = visibility_events(frame_index, state.visible, visible)
        state = replace(state, frame_index=frame_index, trackers=trackers, visible=visible)
        return state, self._prompt(state, views, tracks, others or {}, events)

    def _propose(
        self, views: Views, phrases: Sequence[str], given: Mapping[str, Boxes] | None
    ) -> dict[str, dict[str, Proposals]]:
        """Proposals by camera and phrase; each phrase is detected once."""
        proposals: dict[str, dict[str, Proposals]] = {camera: {} for camera in views}
        for phrase in dict.fromkeys(phrases):
            if given is None:
                offered = propose(views, phrase, self.stack)
            else:
                boxes = {
                    camera: judge(rgb, given.get(camera, Boxes.empty(phrase)), phrase, self.stack)
                    for camera, rgb in views.items()
                }
                offered = embed_views(views, boxes, self.stack)
            for camera, of_view in offered.items():
                proposals[camera][phrase] = of_view
        return proposals

    @property
    def _marks_others(self) -> bool:
        """Whether the prompt's form marks the other candidates, too."""
        return bool(getattr(self.prompting.form, "marks_others", False))

    def _start_trackers(
        self,
        views: Views,
        masks: Mapping[str, Bool[np.ndarray, "n h w"]],
        ids: Mapping[str, tuple[int | None, ...]],
    ) -> dict[str, Any]:
        """One tracker state for every view with a mask that is going to be marked.

        Look-alikes, and a robot's hand among the candidates, are not marked: they are not followed.
        """
        targets: dict[str, list[int]] = {}
        for camera in views:
            wanted = sorted({identity for identity in ids[camera] if identity is not None})
            if self._marks_others:
                wanted = list(range(len(masks[camera])))
            if wanted:
                targets[camera] = wanted
        images, starts = [views[c] for c in targets], [masks[c] for c in targets]
        tracker = self.stack.tracker
        if isinstance(tracker, TargetTracker):
            states = tracker.start_targets(images, starts, list(targets.values()))
        else:
            states = tracker.start(images, starts)
        return dict(zip(targets, states, strict=True))

    def _prompt(
        self,
        state: AttendState,
        views: Views,
        tracks: Mapping[str, tuple[Track, ...]],
        others: Mapping[str, Sequence[Mask]],
        events: tuple[Event, ...],
    ) -> Attended:
        """The prompted images and text, and the evidence for them."""
        images = dict(views)
        if self.prompting.highlight:
            for camera, per_target in tracks.items():
                for mask, colour in zip(own_masks(per_target), state.colours, strict=True):
                    if mask is not None:
                        images[camera] = self.prompting.form(
                            images[camera], mask, colour, others.get(camera, ())
                        )
        return Attended(
            images=images,
            text=state.text,
            colours=state.colours,
            tracks=tracks,
            groundings=state.groundings,
            events=events,
            associations=state.associations,
        )


def own_masks(tracks: Sequence[Track]) -> list[Mask | None]:
    """The pixels of every target of a view that are no earlier target's; None without a mask."""
    own: list[Mask | None] = []
    taken: Mask | None = None
    for track in tracks:
        mask = track.mask
        if mask is None:
            own.append(None)
        elif taken is None:
            own.append(mask)
            taken = mask
        else:
            own.append(mask & ~taken)
            taken = taken | mask
    return own


def are_shown(tracks: Sequence[Track]) -> tuple[bool, ...]:
    """Which targets of a view have a pixel that is no earlier target's."""
    return tuple(mask is not None and bool(mask.any()) for mask in own_masks(tracks))


def _other_masks(followed: Sequence[Mask | None], ids: Sequence[int | None]) -> list[Mask]:
    """The masks of what is followed and is no target, where they are visible."""
    return [
        mask
        for identity, mask in enumerate(followed)
        if identity not in ids and mask is not None and mask.any()
    ]


def _first_tracks(per_target: PerTarget, ids: Sequence[int | None]) -> tuple[Track, ...]:
    """The tracks of a view at t = 0: the masks of the chosen candidates, one per identity."""
    firsts = [
        per_target[j if identity is None else ids.index(identity)] for j, identity in enumerate(ids)
    ]
    return tuple(Track(first.mask, float(first.mask is not None)) for first in firsts)


def _tracks_of_targets(
    state: AttendState, by_camera: Mapping[str, Sequence[Track]]
) -> dict[str, tuple[Track, ...]]:
    """From one track per identity to one per target, in every view."""
    return {
        camera: tuple(Track(None, 0.0) if i is None else by_camera[camera][i] for i in ids)
        for camera, ids in state.ids.items()
    }


def _visible(tracks: Mapping[str, tuple[Track, ...]]) -> Visible:
    return frozenset(
        (camera, j)
        for camera, per_target in tracks.items()
        for j, track in enumerate(per_target)
        if track.mask is not None
    )
