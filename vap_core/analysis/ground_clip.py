"""Ground a clip, track through it, and write it as a recording and as a video."""

import os.path
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack
from itertools import chain
from pathlib import Path

from vap_core.analysis.ground import claimed_paths, shared_targets
from vap_core.attend import Attender, AttendState, Prompting
from vap_core.base import media
from vap_core.base.errors import BadPhoto
from vap_core.base.files import file_fault
from vap_core.base.media import load_photo, photos_in
from vap_core.base.types import Attended, PersonalObject, Rgb, Track, value
from vap_core.instruction.parsers import Parsing
from vap_core.memory import load_bank
from vap_core.perception.stacks import load_own

CAMERA = "clip"
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

    `always_tint` is Prompting's.

    Raises: BadPhoto, BadInstruction, UnknownName, BadOutput.
    """
    frames, hz = _open(path)
    first = next(frames, None)
    if first is None:
        raise BadPhoto(f"ground: {path} has no frame; film for some seconds.")
    models = load_own(stack)
    bank = load_bank(memory, models.encoder.name)
    parsing = parsing or Parsing()
    parser = parsing.load(memory, bank)
    prompting = Prompting(always_tint=always_tint)
    attender = Attender(models, bank, prompting, parser=parser, speaker=parsing.speaker)
    _, (obj, *_) = attender.understand(instruction, objects)
    with claimed_paths(out, path.stem, ".mp4") as (mp4, rrd):
        summary = _follow(
            attender=attender,
            frames=chain([first], frames),
            hz=hz,
            instruction=instruction,
            objects=objects,
            obj=obj,
            mp4=mp4,
            rrd=rrd,
        )
    return summary, rrd, mp4


def _follow(
    *,
    attender: Attender,
    frames: Iterable[Rgb],
    hz: float,
    instruction: str,
    objects: Sequence[str] | None,
    obj: PersonalObject,
    mp4: Path,
    rrd: Path,
) -> ClipSummary:
    """Ground, track, and write every frame."""
    from vap_core.recording import ClipRecorder, ClipStep

    grounded, visible, text = None, [], instruction
    notes: tuple[str, ...] = ()
    with ExitStack() as files:
        recorder = files.enter_context(ClipRecorder(rrd, CAMERA, obj.name, hz))
        film = files.enter_context(media.Mp4(mp4, hz))
        state: AttendState | None = None
        for number, rgb in enumerate(frames):
            at = number / hz
            state, attended = _attend(attender, state, rgb, instruction, number, objects)
            track, prompted = Track(None, 0.0), rgb
            if attended is not None:
                track = attended.tracks[CAMERA][0]
                if state is not None:
                    prompted = attended.images[CAMERA]
                grounding = attended.groundings[CAMERA][0]
                is_first = grounded is None and state is not None
                if is_first or number == 0:
                    recorder.ground(number, at, rgb, grounding, obj, instruction, attended.text)
                if is_first:
                    grounded, text = number, attended.text
                    notes = shared_targets(attended)
            visible.append(track.mask is not None)
            recorder.add(ClipStep(number, at, rgb, prompted, track))
            film.add(prompted)
    return ClipSummary(
        frames=len(visible),
        grounded=grounded,
        tracked=sum(visible),
        lost=_spans(visible, grounded),
        text=text,
        object=obj.name,
        notes=notes,
    )


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


def _attend(
    attender: Attender,
    state: AttendState | None,
    rgb: Rgb,
    instruction: str,
    number: int,
    objects: Sequence[str] | None,
) -> tuple[AttendState | None, Attended | None]:
    """Track; where nothing is tracked yet, ground every RETRY-th frame.

    The state stays None until the object was found.
    """
    views = {CAMERA: rgb}
    if state is not None:
        return attender.step(state, views)
    if number % RETRY:
        return None, None
    started, attended = attender.start(views, instruction, objects=objects)
    if attended.groundings[CAMERA][0].winner is None:
        return None, attended
    return started, attended


def _spans(visible: Sequence[bool], grounded: int | None) -> tuple[tuple[int, int], ...]:
    """First and last frame of every stretch without the object, once it was grounded."""
    spans: list[tuple[int, int]] = []
    if grounded is None:
        return ()
    for number in range(grounded, len(visible)):
        if visible[number]:
            continue
        if spans and spans[-1][1] == number - 1:
            spans[-1] = (spans[-1][0], number)
        else:
            spans.append((number, number))
    return tuple(spans)
