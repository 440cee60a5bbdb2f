"""Ground one picture, and give the answer as text, JSON, a picture and a recording.

The answer is the candidates, the votes, the margin and the rewritten instruction.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from vap_core.attend import Attender, Prompting, are_shown
from vap_core.base.errors import BadInstruction
from vap_core.base.events import describe_rejection, is_shared
from vap_core.base.files import writing
from vap_core.base.types import Attended, Boxes, Grounding, PersonalObject, Rgb, value
from vap_core.instruction.parsers import Parsing

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
    rows = [_parse_box(text, width, height) for text in boxes]
    scores = np.ones(len(rows), np.float32)
    return Boxes(np.asarray(rows, np.float32), scores, "by hand")


def ground_image(
    rgb: Rgb,
    instruction: str,
    memory: Path,
    stack: str,
    *,
    objects: Sequence[str] | None = None,
    boxes: Boxes | None = None,
    tiles: bool = False,
    always_tint: bool = False,
    parsing: Parsing | None = None,
) -> Found:
    """Run the method's first step on one picture with the remembered objects of a bank.

    With `tiles` the detector also looks at nine overlapping tiles; boxes that are given are taken
    as they are. Without `parsing` the rule parses.

    Raises: as `load_own`, `Parsing.load` and `Attender.start`; BadMemory for a memory that is
        damaged or of another encoder.
    """
    from vap_core.memory import load_bank
    from vap_core.perception.boxes import TiledDetector
    from vap_core.perception.stacks import load_own

    models = load_own(stack)
    if tiles and boxes is None:
        models = replace(models, detector=TiledDetector(models.detector))
    bank = load_bank(memory, models.encoder.name)
    parsing = parsing or Parsing()
    attender = Attender(
        models,
        bank,
        Prompting(always_tint=always_tint),
        parser=parsing.load(memory, bank),
        speaker=parsing.speaker,
    )
    boxes_by_camera = None if boxes is None else {CAMERA: boxes}
    _, attended = attender.start({CAMERA: rgb}, instruction, objects=objects, boxes=boxes_by_camera)
    matched = tuple(bank[grounding.object] for grounding in attended.groundings[CAMERA])
    return Found(
        rgb=rgb,
        instruction=instruction,
        objects=matched,
        attended=attended,
    )


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
    targets = []
    for grounding in found.attended.groundings[CAMERA]:
        targets.append(_grounding_to_json(grounding))
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
    from vap_core.analysis.plots import grounding_figure
    from vap_core.base.pictures import write_png
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


def _parse_box(text: str, width: int, height: int) -> list[float]:
    """One box "x0,y0,x1,y1", inside a picture of `width` x `height` pixels."""
    try:
        x0, y0, x1, y1 = map(float, text.split(","))
    except ValueError as error:
        raise BadInstruction(
            f"--box {text!r} is not x0,y0,x1,y1; for example --box 40,60,180,220."
        ) from error
    inside = x0 >= 0 and y0 >= 0 and x1 <= width and y1 <= height
    if not (inside and x1 - x0 >= 1 and y1 - y0 >= 1):
        raise BadInstruction(
            f"--box {text!r} is no box inside the picture, which has {width}x{height} pixels when "
            "upright; x to the right, y down, far corner last."
        )
    return [x0, y0, x1, y1]


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
    lines = [f"{grounding.object} against {len(candidates)} candidates, {k} references vote:"]
    for i, (box, score) in enumerate(zip(candidates.xyxy, candidates.score, strict=True)):
        mark = "->" if i == grounding.winner else "  "
        x0, y0, x1, y1 = box
        cosine = grounding.similarity[i].mean()
        points = ""
        if candidates.verified is not None:
            points = f"  points {candidates.verified[i]}"
        lines.append(
            f" {mark} #{i}  box {x0:4.0f} {y0:4.0f} {x1:4.0f} {y1:4.0f}  score {score:.2f}  "
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
    if candidates.prior is not None or candidates.proof is not None:
        measure = "score, which is the cosine and what phrase and points add"
    lines.append(
        f"winner #{winner}, margin {ballot.margin:.2f} of the votes{tie}, "
        f"{ballot.cosine_margin:.3f} in {measure}"
    )
    return lines
