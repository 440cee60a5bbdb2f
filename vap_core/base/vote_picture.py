"""One picture of a vote: candidates as rows, reference photos as columns, cosines in the cells.

    picture = vote_picture(grounding, rgb, obj.crops)

Each photo votes for the candidate with the highest cosine in its column, a box's prior added where
there is one: a dot marks that cell.
"""

from collections.abc import Sequence
from functools import cache
from typing import TYPE_CHECKING

import numpy as np

from vap_core.base.events import describe_ballot, describe_rejection
from vap_core.base.palette import ELECTED, LOOKALIKES, TARGET, Rgb8, rgb8
from vap_core.base.types import Grounding, Rgb

if TYPE_CHECKING:
    from PIL import ImageDraw
    from PIL.Image import Image as Picture
    from PIL.ImageFont import FreeTypeFont

    type Draw = ImageDraw.ImageDraw

Number = float | int
Place = tuple[Number, Number]
"""x and y, or width and height, pixels."""
Text = tuple[str, Place, Rgb8, bool]
"""Words, the middle of their height at their left end or, where true, their centre; colour."""
LEAST_EVIDENCE = 0.005
"""Smaller priors are not shown; they would read 0.00."""
MOST_ROWS = 6
"""Candidates that are shown, best first; a last line counts the others."""
PAPERS = {True: ("#181c24", "#e6e6e6", "#3a404c"), False: ("#ffffff", "#222222", "#d0d0d0")}
"""Ground, ink and lines, of a dark picture and of a light one."""
DARKEST, BRIGHTEST = 30, 235
"""Grey of the lowest and the highest cosine."""
FONT_SHARE = 0.19
"""Height of the text in a cell, as a share of the cell's side."""


def vote_picture(
    grounding: Grounding,
    rgb: Rgb,
    references: Sequence[Rgb],
    *,
    right: bool | None = None,
    cell_px: int = 88,
    dark: bool = True,
) -> Rgb:
    """The vote of one target in one view, over the picture `rgb` that it was held on.

    `references` are the remembered crops, in the order of the columns; without them a column has
    its number alone. `right` says whether the elected candidate is the target, where that is known.
    """
    from PIL import Image, ImageDraw

    rows = shown_candidates(grounding)
    n_photos = grounding.similarity.shape[1]
    left, beside = cell_px, round(2.3 * cell_px)
    top = round(0.45 * cell_px)
    header = cell_px if references else round(0.4 * cell_px)
    width = left + n_photos * cell_px + beside
    height = top + header + max(len(rows), 1) * cell_px + round(0.5 * cell_px)
    paper, ink, line = PAPERS[dark]
    picture = Image.new("RGB", (width, height), paper)
    draw = ImageDraw.Draw(picture)
    font = _font(round(FONT_SHARE * cell_px))
    bold = _font(round(1.15 * FONT_SHARE * cell_px))
    title = f"{grounding.camera}: which {grounding.candidates.phrase} is {grounding.object}?"
    draw.text((6, top / 2), title, fill=ink, font=bold, anchor="lm")

    y = top
    draw.text((6, y + header / 2), "photos:", fill=ink, font=font, anchor="lm")
    for j in range(n_photos):
        x = left + j * cell_px
        if j < len(references):
            picture.paste(_fitted(references[j], cell_px - 8), (x + 4, y + 4))
            _frame(draw, (x + 4, y + 4), cell_px - 8, TARGET)
        else:
            place = (x + cell_px / 2, y + header / 2)
            draw.text(place, str(j), fill=ink, font=font, anchor="mm")
    y += header

    least = float(grounding.similarity.min()) if grounding.similarity.size else 0.0
    texts: list[Text] = []
    best = grounding.voted
    for i in rows:
        picture.paste(_fitted(_crop(rgb, grounding.candidates.xyxy[i]), cell_px - 8), (4, y + 4))
        for j in range(n_photos):
            cosine = float(grounding.similarity[i, j])
            place = (left + j * cell_px, y)
            share = (cosine - least) / max(1 - least, 1e-6)
            grey = round(DARKEST + share * (BRIGHTEST - DARKEST))
            _cell(draw, place, cell_px, grey)
            middle = (place[0] + cell_px / 2, y + cell_px / 2)
            contrast = (0, 0, 0) if grey > 120 else (255, 255, 255)
            texts.append((f"{cosine:.2f}", middle, contrast, True))
            if best[j] == i:
                _dot(draw, place, cell_px)
        beside_cells = (left + n_photos * cell_px + 8, y)
        texts += _row_words(grounding, i, beside_cells, cell_px, rgb8(ink))
        if i == grounding.winner:
            _elected(draw, (0, y), (width - 3, cell_px), right)
        else:
            draw.line((0, y + cell_px, width, y + cell_px), fill=line)
        y += cell_px
    if not rows:
        text = f"no {grounding.candidates.phrase} found"
        draw.text((width / 2, y + cell_px / 2), text, fill=ink, font=bold, anchor="mm")
        y += cell_px
    draw.text((6, y + cell_px / 4), result_line(grounding), fill=ink, font=bold, anchor="lm")
    drawn = np.array(picture)
    _write(drawn, texts, cell_px)
    return drawn


def shown_candidates(grounding: Grounding) -> list[int]:
    """The candidates of the picture's rows: the elected one, then by votes and mean cosine."""
    if len(grounding.similarity) == 0:
        return []
    cosines = grounding.similarity.mean(axis=1).astype(np.float64)
    order: list[int] = np.lexsort((-cosines, -grounding.ballot.votes)).tolist()
    if grounding.winner is not None:
        order.remove(grounding.winner)
        order.insert(0, grounding.winner)
    return order[:MOST_ROWS]


def result_line(grounding: Grounding) -> str:
    """What the vote ended in, and how many candidates are not among the rows."""
    elected = grounding.ballot.winner
    if elected is None:
        return "nothing is elected: the view passes unmodified"
    if grounding.rejected is not None:
        text = f"#{grounding.rejected} {describe_rejection(grounding)}"
    elif grounding.winner is None:
        text = f"none is chosen, against the vote for #{elected}: {describe_ballot(grounding)}"
    elif grounding.overruled:
        text = f"#{grounding.winner} is chosen, against the vote for #{elected}: "
        text += describe_ballot(grounding)
    else:
        text = f"#{elected} elected: {describe_ballot(grounding)}"
    left_out = len(grounding.candidates) - len(shown_candidates(grounding))
    if left_out:
        text += f"; {left_out} more candidates not shown"
    return text


def _row_words(grounding: Grounding, i: int, place: Place, cell_px: int, ink: Rgb8) -> list[Text]:
    """Number, votes and mean cosine of one candidate, and what the vote added to it."""
    x, y = place
    n_photos = grounding.similarity.shape[1]
    words = [
        f"#{i}",
        f"{grounding.ballot.votes[i]} of {n_photos} votes",
        f"mean {grounding.similarity[i].mean():.2f}",
    ]
    if np.abs(grounding.evidence).max() >= LEAST_EVIDENCE:
        words.append(f"prior {round(float(grounding.evidence[i]), 2) or 0.0:.2f}")
    height = cell_px / (len(words) + 1)
    return [(text, (x, y + (k + 1) * height), ink, False) for k, text in enumerate(words)]


def _cell(draw: "Draw", place: Place, cell_px: int, grey: int) -> None:
    """The ground of a cosine: a grey that is brighter the higher it is."""
    x, y = place
    draw.rectangle((x + 1, y + 1, x + cell_px - 2, y + cell_px - 2), fill=(grey, grey, grey))


def _write(picture: Rgb, texts: list[Text], cell_px: int) -> None:
    """Words in and beside the cells, by OpenCV: many times as fast as a font with outlines."""
    import cv2

    scale = cell_px / 165
    for text, (x, y), ink, centred in texts:
        (width, height), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, scale, 1)
        cv2.putText(
            picture,
            text,
            org=(int(x - width / 2 if centred else x), int(y + height / 2)),
            fontFace=cv2.FONT_HERSHEY_SIMPLEX,
            fontScale=scale,
            color=ink,
            thickness=1,
            lineType=cv2.LINE_AA,
        )


def _dot(draw: "Draw", place: Place, cell_px: int) -> None:
    """The mark of a vote, in the cell's upper right corner."""
    radius = cell_px / 11
    x, y = place[0] + 0.82 * cell_px, place[1] + 0.2 * cell_px
    box = (x - radius, y - radius, x + radius, y + radius)
    draw.ellipse(box, fill=LOOKALIKES[0], outline=ELECTED, width=2)


def _elected(draw: "Draw", place: Place, size: Place, right: bool | None) -> None:
    """The frame of the elected row; a tick or a cross at its end, where that is known."""
    x, y = place
    width, height = size
    draw.rectangle((x, y, x + width, y + height), outline="#000000", width=5)
    draw.rectangle((x + 1, y + 1, x + width - 1, y + height - 1), outline=ELECTED, width=3)
    if right is not None:
        s = height * 0.16
        _mark(draw, (x + width - 2 * s, y + height / 2), s, right)


def _mark(draw: "Draw", centre: Place, s: Number, right: bool) -> None:
    """A tick or a cross of half-width `s`."""
    x, y = centre
    strokes: list[tuple[Place, Place]] = [((-1, -1), (1, 1)), ((-1, 1), (1, -1))]
    if right:
        strokes = [((-1, 0), (-0.3, 0.8)), ((-0.3, 0.8), (1, -0.9))]
    for colour, width in (("#000000", 7), (ELECTED, 4)):
        for start, end in strokes:
            ends = (x + s * start[0], y + s * start[1], x + s * end[0], y + s * end[1])
            draw.line(ends, fill=colour, width=width)


def _frame(draw: "Draw", place: Place, side: int, colour: str) -> None:
    x, y = place
    draw.rectangle((x, y, x + side - 1, y + side - 1), outline=colour, width=3)


def _fitted(crop: Rgb, side: int) -> "Picture":
    """A crop fitted into a square, on grey."""
    from PIL import Image

    scale = side / max(crop.shape[:2])
    size = (max(1, round(crop.shape[1] * scale)), max(1, round(crop.shape[0] * scale)))
    square = Image.new("RGB", (side, side), (60, 64, 72))
    small = Image.fromarray(np.ascontiguousarray(crop)).resize(size, Image.Resampling.BILINEAR)
    square.paste(small, ((side - size[0]) // 2, (side - size[1]) // 2))
    return square


def _crop(rgb: Rgb, xyxy: np.ndarray) -> Rgb:
    """The box's pixels, at least one."""
    height, width = rgb.shape[:2]
    x0, y0, x1, y1 = np.clip(np.round(xyxy), 0, [width, height, width, height]).astype(int)
    x0, y0 = min(x0, width - 1), min(y0, height - 1)
    return rgb[y0 : max(y1, y0 + 1), x0 : max(x1, x0 + 1)]


@cache
def _font(size: int) -> "FreeTypeFont":
    """Pillow's own font."""
    from PIL import ImageFont

    font = ImageFont.load_default(size)
    assert isinstance(font, ImageFont.FreeTypeFont), "Pillow has FreeType"
    return font
