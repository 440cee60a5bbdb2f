"""Ground one picture: candidates, votes, margin and the rewritten instruction, as text, JSON, a picture and a recording."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from vap_core.base.errors import BadInstruction, BadOutput
from vap_core.base.types import Attended, Boxes, PersonalObject, Rgb, value

CAMERA = "image"


@value
class Found:
    """What was asked of one picture, and what the method answered; `objects[j]` is what target j was matched with."""

    rgb: Rgb
    instruction: str
    objects: tuple[PersonalObject, ...]
    attended: Attended
    domain: str

    def __str__(self) -> str:
        return "\n".join(
            [
                *(line for g in self.attended.groundings[CAMERA] for line in _lines(g)),
                f"instruction: {self.attended.text}",
            ]
        )


def parse_boxes(boxes: Sequence[str], rgb: Rgb) -> Boxes:
    """Candidates given by hand as "x0,y0,x1,y1" in pixels, clipped to the picture.

    Raises:
        BadInstruction: not four numbers, or no area inside the picture.
    """
    height, width = rgb.shape[:2]
    rows = []
    for text in boxes:
        try:
            x0, y0, x1, y1 = (float(part) for part in text.split(","))
        except ValueError as error:
            raise BadInstruction(
                f"--box {text!r} is not x0,y0,x1,y1; for example --box 40,60,180,220."
            ) from error
        row = [max(x0, 0.0), max(y0, 0.0), min(x1, float(width)), min(y1, float(height))]
        if not (row[2] - row[0] >= 1 and row[3] - row[1] >= 1):
            raise BadInstruction(
                f"--box {text!r} has no area inside the {width}x{height} picture; x to the right, y down, far corner last."
            )
        rows.append(row)
    return Boxes(np.asarray(rows, np.float32), np.ones(len(rows), np.float32), "by hand")


def ground_image(
    rgb: Rgb,
    instruction: str,
    memory: Path,
    stack: str,
    *,
    objects: Sequence[str] | None = None,
    boxes: Boxes | None = None,
) -> Found:
    """Run the method's first step on one picture with the remembered objects of a bank."""
    from vap_core.attend import Attender
    from vap_core.memory import load_bank
    from vap_core.perception.stacks import load_stack

    models = load_stack(stack)
    bank = load_bank(memory, models.encoder.name)
    _, attended = Attender(models, bank).start(
        {CAMERA: rgb},
        instruction,
        objects=objects,
        boxes=None if boxes is None else {CAMERA: boxes},
    )
    return Found(
        rgb,
        instruction,
        tuple(bank[g.object] for g in attended.groundings[CAMERA]),
        attended,
        models.domain,
    )


def to_json(found: Found) -> dict[str, Any]:
    """The first target's evidence at the top level, every target's under "targets"; `instruction` is the rewritten one."""
    targets = [
        {
            "object": g.object,
            "winner": g.winner,
            "votes": g.ballot.votes.tolist(),
            "similarity": np.round(g.similarity, 6).tolist(),
            "margin": g.ballot.margin,
            "cosine_margin": g.ballot.cosine_margin if len(g.candidates) > 1 else None,
            "tied": g.ballot.tied.tolist(),
            "candidates": np.round(g.candidates.xyxy, 2).tolist(),
            "scores": np.round(g.candidates.score, 4).tolist(),
        }
        for g in found.attended.groundings[CAMERA]
    ]
    return {
        **targets[0],
        "instruction": found.attended.text,
        "said": found.instruction,
        "targets": targets,
    }


def write_evidence(folder: Path, stem: str, found: Found) -> tuple[Path, Path]:
    """Write the overlay PNG (every target) and the .rrd (the first one); an earlier answer is kept, the new one gets a number."""
    from vap_core.analysis.plots import grounding_figure
    from vap_core.base.figures import write_png
    from vap_core.recording import record_grounding

    try:
        folder.mkdir(parents=True, exist_ok=True)
        number = next(
            n
            for n in range(1, 100_000)
            if not any(
                (folder / f"{_numbered(stem, n)}.{kind}").exists() for kind in ("png", "rrd")
            )
        )
        png, rrd = (folder / f"{_numbered(stem, number)}.{suffix}" for suffix in ("png", "rrd"))
        write_png(grounding_figure(found.rgb, found.attended, found.objects, CAMERA), png)
    except OSError as error:
        raise BadOutput(
            f"write_evidence: {folder} cannot be written ({error.strerror}); choose another folder with --out."
        ) from error
    first = found.attended.groundings[CAMERA][0]
    record_grounding(
        rrd,
        found.rgb,
        first,
        found.objects[0],
        found.instruction,
        found.attended.text,
        found.attended.images[CAMERA],
    )
    return png, rrd


def _numbered(stem: str, number: int) -> str:
    return stem if number == 1 else f"{stem}-{number}"


def _lines(g: Any) -> list[str]:
    if g.winner is None:
        return [
            f"no {g.candidates.phrase} found for {g.object}; nothing is highlighted. Give candidates with --box, or another picture."
        ]
    k = g.similarity.shape[1]
    rows = [f"{g.object} against {len(g.candidates)} candidates, {k} references vote:"]
    for i, (box, score) in enumerate(zip(g.candidates.xyxy, g.candidates.score, strict=True)):
        mark = "->" if i == g.winner else "  "
        corner = " ".join(f"{v:4.0f}" for v in box)
        rows.append(
            f" {mark} #{i}  box {corner}  score {score:.2f}  votes {g.ballot.votes[i]}/{k}  mean cosine {g.similarity[i].mean():.3f}"
        )
    if len(g.candidates) == 1:
        return [
            *rows,
            f"winner #{g.winner}, the only candidate: no margin, it wins however unlike it is",
        ]
    tie = ", tie broken by mean cosine" if g.ballot.tied[g.winner] else ""
    return [
        *rows,
        f"winner #{g.winner}, margin {g.ballot.margin:.2f} of the votes, {g.ballot.cosine_margin:.3f} in cosine{tie}",
    ]
