"""Ground one picture, or a clip, and give the answer as text, JSON, pictures and a recording.

The answer is the candidates, the votes, the margin and the rewritten instruction.
"""

import os.path
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vap_core.attend import Attender, AttendState, Prompting, are_shown
from vap_core.base import media
from vap_core.base.errors import BadInstruction, BadPhoto, number_of
from vap_core.base.events import describe_rejection, is_shared
from vap_core.base.files import file_fault, writing
from vap_core.base.media import load_photo, photos_in
from vap_core.base.pictures import (
    ELECTED,
    ELECTED_CASING,
    FRAME,
    empty_figure,
    vote_picture,
    write_png,
)
from vap_core.base.types import Attended, Boxes, Grounding, PersonalObject, Rgb, Track, value
from vap_core.instruction.parsers import Parsing
from vap_core.memory import load_bank
from vap_core.perception.boxes import parse_box
from vap_core.perception.protocols import Stack
from vap_core.perception.stacks import load_own
from vap_core.study.cases import true_runs

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

CAMERA = "image"
GROUND_SIDE = 2560
"""The longer side to which a larger picture is shrunk: every candidate has a mask of its size."""


@value
class Found:
    """An instruction for one picture, and the method's answer.

    `objects[j]` is the object that target j was matched with.
    """

    rgb: Rgb
    instruction: str
    objects: tuple[PersonalObject, ...]
    attended: Attended

    @property
    def used(self) -> tuple[str, ...]:
        """Names of the objects that are highlighted."""
        shown = are_shown(self.attended.tracks[CAMERA])
        found = zip(self.attended.groundings[CAMERA], shown, strict=True)
        return tuple(grounding.object for grounding, is_shown in found if is_shown)

    @property
    def notes(self) -> tuple[str, ...]:
        """What is said of two targets that are one object, or one in the other."""
        return shared_targets(self.attended)

    def __str__(self) -> str:
        lines = []
        for grounding in self.attended.groundings[CAMERA]:
            lines.extend(_format_grounding(grounding))
        lines.append(f"instruction: {self.attended.text}")
        return "\n".join(lines)


def shared_targets(attended: Attended) -> tuple[str, ...]:
    """The warnings about two targets that are one object, or one in the other."""
    return tuple(event.text for event in attended.events if is_shared(event))


def parse_boxes(boxes: Sequence[str], rgb: Rgb) -> Boxes:
    """Candidates given by hand as "x0,y0,x1,y1" in pixels.

    Raises: BadInstruction for a text without four numbers, or that are no box inside the picture.
    """
    height, width = rgb.shape[:2]
    rows = [parse_box(text, "--box", BadInstruction) for text in boxes]
    for text, row in zip(boxes, rows, strict=True):
        if row.min() < 0 or row[2] > width or row[3] > height:
            raise BadInstruction(
                f"--box {text!r} is no box inside the picture, which has {width}x{height} pixels "
                "when upright."
            )
    return Boxes(np.array(rows, np.float32), np.ones(len(rows), np.float32), "by hand")


def ground_image(
    rgb: Rgb,
    instruction: str,
    memory: Path,
    stack: str,
    *,
    objects: Sequence[str] | None = None,
    boxes: Boxes | None = None,
    always_tint: bool = False,
    parsing: Parsing | None = None,
) -> Found:
    """Run the method's first step on one picture with the remembered objects of a bank.

    Boxes that are given are taken as they are. Without `parsing` the rule parses.

    Raises: as `load_own`, `Parsing.load` and `Attender.start`; BadMemory for a memory that is
        damaged or of another encoder.
    """
    from vap_core.perception.stacks import load_own

    models = load_own(stack)
    attender, bank = _attender(memory, models, parsing, always_tint)
    boxes_by_camera = None if boxes is None else {CAMERA: boxes}
    _, attended = attender.start({CAMERA: rgb}, instruction, objects=objects, boxes=boxes_by_camera)
    matched = tuple(bank[grounding.object] for grounding in attended.groundings[CAMERA])
    return Found(
        rgb=rgb,
        instruction=instruction,
        objects=matched,
        attended=attended,
    )


def _attender(
    memory: Path, models: Stack, parsing: Parsing | None, always_tint: bool
) -> tuple[Attender, Mapping[str, PersonalObject]]:
    """The method with the remembered objects of a bank, and those."""
    bank = load_bank(memory, models.encoder.name, "ground")
    parsing = parsing or Parsing()
    prompting = Prompting(always_tint=always_tint)
    parser = parsing.load(memory, bank)
    return Attender(models, bank, prompting, parser=parser, speaker=parsing.speaker), bank


def missing_threshold(stack: str) -> str:
    """One line where a stack cannot say "not in view", with the remedy; else "".

    Raises: as `load_own`.
    """
    from vap_core.perception.protocols import FamiliarityJudge, keep_command
    from vap_core.perception.stacks import load_own

    models = load_own(stack)
    if models.thresholds is not None:
        return ""
    command = keep_command(stack, photos=isinstance(models.detector, FamiliarityJudge))
    return (
        f'the stack {stack} has no threshold of "not in view": the best candidate is highlighted, '
        f"however unlike it is; measure one: {command}"
    )


def to_json(found: Found) -> dict[str, Any]:
    """The evidence of the first target at the top level, that of every target under "targets".

    `instruction` is the rewritten one, `said` the given one. Boxes are pixels of a picture of
    `size`, width and height.
    """
    targets = [_grounding_to_json(grounding) for grounding in found.attended.groundings[CAMERA]]
    return {
        **targets[0],
        "instruction": found.attended.text,
        "said": found.instruction,
        "size": [found.rgb.shape[1], found.rgb.shape[0]],
        "targets": targets,
    }


def write_evidence(folder: Path, stem: str, found: Found) -> tuple[Path, Path]:
    """Write the overlay PNG of every target and the .rrd of the first one; return their paths.

    An earlier answer is kept, and the new one gets a number. Raises: BadOutput.
    """
    from vap_core.recording import record_grounding

    first = found.attended.groundings[CAMERA][0]
    figure = grounding_figure(found.rgb, found.attended, found.objects, CAMERA)
    with claimed_paths(folder, stem, ".png") as (png, rrd):
        write_png(figure, png)
        record_grounding(
            path=rrd,
            image=found.rgb,
            grounding=first,
            obj=found.objects[0],
            instruction=found.instruction,
            rewritten=found.attended.text,
            prompted=found.attended.images[CAMERA],
        )
    return png, rrd


def _grounding_to_json(grounding: Grounding) -> dict[str, Any]:
    ballot = grounding.ballot
    candidates = grounding.candidates
    return {
        "object": grounding.object,
        "winner": grounding.winner,
        "votes": ballot.votes.tolist(),
        "similarity": np.round(grounding.similarity, 6).tolist(),
        "margin": ballot.margin,
        "cosine_margin": ballot.cosine_margin if len(candidates) > 1 else None,
        "likeness": np.round(grounding.likeness, 6).tolist(),
        "threshold": grounding.threshold,
        "rejected": grounding.rejected,
        "tied": ballot.tied.tolist(),
        "candidates": np.round(candidates.xyxy, 2).tolist(),
        "scores": np.round(candidates.score, 4).tolist(),
        "verified": None if candidates.verified is None else candidates.verified.tolist(),
    }


@contextmanager
def claimed_paths(folder: Path, stem: str, suffix: str) -> Iterator[tuple[Path, Path]]:
    """A picture or film and a recording of the same name and number, of which neither exists.

    A claim stands there until the block ends, so that another process takes another number.

    Raises: BadOutput, also for an OSError inside.
    """
    with writing(folder, "ground", "choose another folder with --out"):
        shown, recording = _claim(folder, stem, suffix)
        try:
            yield shown, recording
        finally:
            _claim_path(recording).unlink(missing_ok=True)


def _claim(folder: Path, stem: str, suffix: str) -> tuple[Path, Path]:
    folder.mkdir(parents=True, exist_ok=True)
    number = 1
    while True:
        name = stem if number == 1 else f"{stem}-{number}"
        shown, recording = folder / f"{name}{suffix}", folder / f"{name}.rrd"
        if not (shown.exists() or recording.exists()):
            with suppress(FileExistsError):
                _claim_path(recording).touch(exist_ok=False)
                return shown, recording
        number += 1


def _claim_path(recording: Path) -> Path:
    return recording.with_name(f".{recording.stem}.claim")


def _format_grounding(grounding: Grounding) -> list[str]:
    """One line per candidate, and one for the winner and its margin."""
    candidates = grounding.candidates
    ballot = grounding.ballot
    winner = grounding.chosen
    if winner is None:
        return [
            f"no {candidates.phrase} found for {grounding.object}; nothing is highlighted. "
            "Give candidates with --box, or another picture."
        ]
    k = grounding.similarity.shape[1]
    among, voters = number_of(len(candidates), "candidate"), number_of(k, "reference")
    lines = [f"{grounding.object} against {among}; the vote of {voters}:"]
    for i, (box, score) in enumerate(zip(candidates.xyxy, candidates.score, strict=True)):
        mark = "->" if i == grounding.winner else "  "
        x0, y0, x1, y1 = box
        cosine = grounding.similarity[i].mean()
        points = f"  points {candidates.verified[i]}" if candidates.verified is not None else ""
        lines.append(
            f" {mark} #{i}  box {x0:4.0f} {y0:4.0f} {x1:4.0f} {y1:4.0f}  detector {score:.2f}  "
            f"votes {ballot.votes[i]}/{k}  mean cosine {cosine:.3f}{points}"
        )
    if grounding.rejected is not None:
        lines.append(
            f"{grounding.object}: {describe_rejection(grounding)} (best candidate #{winner}); "
            "nothing is highlighted. --always-tint highlights it nevertheless"
        )
        return lines
    if len(candidates) == 1:
        lines.append(
            f"winner #{winner}, the only candidate: no margin; only its cosine says how alike it is"
        )
        return lines
    tie = ", tie broken by mean cosine" if ballot.tied[winner] else ""
    measure = "cosine"
    if candidates.proof is not None:
        measure = "cosine and what points add"
    lines.append(
        f"winner #{winner}, margin {ballot.margin:.2f} of the votes{tie}, "
        f"{ballot.cosine_margin:.3f} in {measure}"
    )
    return lines


LABEL_ROOM = 0.07
"""Share of a picture's height that the number of a candidate takes."""
VOTE_CELL_PX = 110
"""Side of a cell of the vote's picture in a figure."""


def grounding_figure(
    rgb: Rgb, attended: Attended, objects: Sequence[PersonalObject], camera: str
) -> "Figure":
    """One row per target: the candidates, the policy's image, and the picture of the vote."""
    votes = [
        vote_picture(grounding, rgb, obj.crops, cell_px=VOTE_CELL_PX, dark=False)
        for grounding, obj in zip(attended.groundings[camera], objects, strict=True)
    ]
    aspects = [vote.shape[1] / vote.shape[0] for vote in votes]
    figure = empty_figure(7.8 + 3.9 * max(aspects), 3.9 * len(objects))
    rows = figure.subfigures(len(objects), 1, squeeze=False)[:, 0]
    for row, grounding, vote in zip(rows, attended.groundings[camera], votes, strict=True):
        left, middle, right = row.subplots(1, 3, width_ratios=[1, 1, max(aspects)])
        candidates(left, rgb, grounding)
        left.set_title(f'candidates for "{grounding.candidates.phrase}"', pad=14)
        middle.imshow(attended.images[camera])
        middle.set_title(f'shown to the policy\n"{attended.text}"')
        right.imshow(vote)
        for axes in (left, middle, right):
            axes.set_axis_off()
    return figure


def candidates(axes: "Axes", rgb: Rgb, grounding: Grounding) -> None:
    """Draw every candidate box over the picture, the elected one in white."""
    from matplotlib.patches import Rectangle
    from matplotlib.patheffects import withStroke

    axes.imshow(rgb)
    for i, (x0, y0, x1, y1) in enumerate(grounding.candidates.xyxy):
        colour = FRAME
        box = Rectangle((x0, y0), x1 - x0, y1 - y0, fill=False, edgecolor=colour, linewidth=1.5)
        if i == grounding.winner:
            colour = ELECTED
            box.set(edgecolor=colour, linewidth=2.5)
            box.set_path_effects([withStroke(linewidth=5, foreground=ELECTED_CASING)])
        axes.add_patch(box)
        above = y0 > LABEL_ROOM * len(rgb)  # else the number would cover the title
        axes.text(
            x0 if above else x0 + 2,
            y0 - 2 if above else y0 + 2,
            f"#{i}",
            color="black",
            fontsize=8,
            va="bottom" if above else "top",
            bbox={"facecolor": colour, "edgecolor": "none", "pad": 1.5},
        )


CLIP = "clip"
SIDE = 640
"""The longer side to which frames are shrunk."""
FOLDER_HZ = 10.0
"""Frames a second that a folder of pictures is taken for."""
RETRY = 5
"""While the object is not in view, every so many frames are grounded."""
SPANS = 6
"""A summary names as many stretches without the object; of others it gives the number."""


@value
class ClipSummary:
    """What was found in a clip: the frame it was grounded in, and those in which it was tracked.

    `notes` are the warnings of that frame about two targets that are one object.
    """

    frames: int
    grounded: int | None
    tracked: int
    lost: tuple[tuple[int, int], ...]
    text: str
    object: str
    notes: tuple[str, ...] = ()

    def __str__(self) -> str:
        if self.grounded is None:
            return f"not in view in any of {self.frames} frames; nothing is highlighted"
        lines = [
            f"grounded in frame {self.grounded} of {self.frames}; tracked in {self.tracked} frames"
        ]
        if self.lost:
            spans = ", ".join(f"{first}-{last}" for first, last in self.lost[:SPANS])
            more = len(self.lost) - SPANS
            also = f" and {more} more" if more > 0 else ""
            lines.append(f"not visible in frames {spans}{also}")
        lines.append(f"instruction: {self.text}")
        return "\n".join(lines)


def is_clip(path: Path) -> bool:
    """Whether `ground` is asked to follow a clip: a video, or a folder of frames.

    What cannot be looked at is no folder.
    """
    return os.path.isdir(path) or media.is_video(path)


def ground_clip(
    path: Path,
    instruction: str,
    memory: Path,
    stack: str,
    out: Path,
    *,
    objects: Sequence[str] | None = None,
    parsing: Parsing | None = None,
    always_tint: bool = False,
) -> tuple[ClipSummary, Path, Path]:
    """Follow the first target of `instruction` through a clip; write an .rrd and an .mp4.

    Until something is highlighted, every RETRY-th frame is grounded. `always_tint` is Prompting's.

    Raises: BadPhoto, BadInstruction, UnknownName, BadOutput.
    """
    from vap_core.recording import ClipRecorder, ClipStep

    frames, hz = _open(path)
    first = next(frames, None)
    if first is None:
        raise BadPhoto(f"ground: {path} has no frame; film for some seconds.")
    attender, _ = _attender(memory, load_own(stack), parsing, always_tint)
    _, (obj, *_) = attender.understand(instruction, objects)
    grounded, visible, text = None, [], instruction
    notes: tuple[str, ...] = ()
    state: AttendState | None = None
    with (
        claimed_paths(out, path.stem, ".mp4") as (mp4, rrd),
        ClipRecorder(rrd, CLIP, obj.name, hz) as recorder,
        media.Mp4(mp4, hz) as film,
    ):
        for number, rgb in enumerate(chain([first], frames)):
            track, prompted = Track(None, 0.0), rgb
            attended: Attended | None = None
            if state is not None:
                state, attended = attender.step(state, {CLIP: rgb})
            elif number % RETRY == 0:
                started, attended = attender.start({CLIP: rgb}, instruction, objects=objects)
                is_first = attended.groundings[CLIP][0].winner is not None
                if is_first or number == 0:
                    about = (attended.groundings[CLIP][0], obj, instruction, attended.text)
                    recorder.ground(number, number / hz, rgb, *about)
                if is_first:
                    state, grounded, text = started, number, attended.text
                    notes = shared_targets(attended)
            if attended is not None:
                track = attended.tracks[CLIP][0]
                prompted = rgb if state is None else attended.images[CLIP]
            visible.append(track.mask is not None)
            recorder.add(ClipStep(number, number / hz, rgb, prompted, track))
            film.add(prompted)
    first_seen = len(visible) if grounded is None else grounded
    absent = true_runs([number >= first_seen and not seen for number, seen in enumerate(visible)])
    lost = tuple((start, stop - 1) for start, stop in absent)
    found = ClipSummary(len(visible), grounded, sum(visible), lost, text, obj.name, notes)
    return found, rrd, mp4


def _open(path: Path) -> tuple[Iterator[Rgb], float]:
    """The frames of a video or of a folder, and how many there are a second. Raises: BadPhoto."""
    if not os.path.isdir(path):
        hz = 1.0 if file_fault(path) else media.frame_rate(path)
        return media.frames(path, SIDE), hz
    photos = photos_in(path)
    if not photos:
        raise BadPhoto(f"ground: {path} holds no picture; name a folder of frames.")
    return _of_one_size(photos), FOLDER_HZ


def _of_one_size(photos: Sequence[Path]) -> Iterator[Rgb]:
    """The pictures of a folder. Raises: BadPhoto for one of another size than the first."""
    size: tuple[int, ...] = ()
    for photo in photos:
        rgb = load_photo(photo, SIDE)
        size = size or rgb.shape
        if rgb.shape != size:
            raise BadPhoto(
                f"ground: {photo} has another shape than the first frame "
                f"({rgb.shape[1]}x{rgb.shape[0]} and {size[1]}x{size[0]} pixels, shrunk); "
                "frames have one size. Name single pictures one by one."
            )
        yield rgb
