"""Colours that everybody can tell apart, figures saved whole, and the picture of a vote."""

from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from vap_core.base.events import describe_ballot, describe_rejection
from vap_core.base.files import replacing
from vap_core.base.types import Grounding, Rgb

if TYPE_CHECKING:
    from matplotlib.figure import Figure


type Rgb8 = tuple[int, int, int]
"""Red, green and blue, 0 to 255."""

TARGET = "#f28e2b"
"""The user's object."""
ELECTED, ELECTED_CASING = "#ffffff", "#000000"
"""A line of what the method elected, and the wider line below it, so that it shows on white."""
LOOKALIKES = ("#2f5fd0", "#6ee0b8", "#a78bfa", "#2f9a86", "#c9d8ff")
"""Look-alikes and other objects, one colour each."""
GOAL = "#c2185b"
"""Where the target goes."""
CAMERAS = ("#e8e8e8", "#a3a3a3", "#6b6b6b")
"""The cameras, in their order."""
FRAME, GRID, TEXT = "#9aa0a6", "#e6e6e6", "#333333"
"""What stands beside the question (bars of a baseline, marks of no role), grid lines, words."""
RIGHT_MARK, WRONG_MARK = "✓", "✗"
"""Beside the words "success" and "failure", and at what was elected."""
ROLES = {"target": TARGET, "look-alike": LOOKALIKES[0], "goal": GOAL, "other objects": "#c9ccd1"}
"""The objects of a layout, by role."""
TIERS = {"personal": TARGET, "hard": "#1f3a93", "medium": "#4f86c6", "easy": "#a5cde8"}
"""The personal object, and its look-alikes by hardness."""
LEGEND = (
    "orange: the target · white: elected, ✓ right, ✗ wrong · blue to green: look-alikes · "
    "rose: goal · grey: cameras"
)
"""The meaning of the colours, in one line."""

METHODS = {
    "generic": ("#92999d", "o"),
    "hard-short": ("#7ad7a0", "^"),
    "hard-long": ("#096c60", "v"),
    "soft": ("#9666b2", "D"),
    "vap": ("#9e001a", "s"),
    "oracle-mask": ("#04216f", "P"),
    "wrong-mask": ("#050506", "X"),
}
"""Colour and marker of the methods that are compared."""
FURTHER_METHODS = (
    ("#5f6b00", "p"),
    ("#c77fa8", "h"),
    ("#4f86c6", "*"),
    ("#7a4b1f", "<"),
    ("#b7c27a", ">"),
)
"""Colours and markers of any other method, in the order of appearance; they repeat."""
SUITES = {
    "simpler-fractal": ("#232f7e", "o"),
    "simpler-bridge": ("#157a6b", "s"),
    "vlabench": ("#b06ab3", "^"),
    "tabletop": ("#9fd0e0", "D"),
}
"""Colour and marker of the four benchmarks."""
THIN_LINES = {"tabletop": "#3f8db0"}
"""A darker shade of a suite's colour, for a thin line on white."""
CASES = {
    "case 1": "#4a2a6b",
    "case 2": "#9b6bb5",
    "case 3": "#dcc3ea",
    "unprompted": "#6f7479",
    "unlabelled": "#e4e7e9",
}
"""The cases of failure: hues for those of the paper, greys for the others."""


def method_marks(methods: Sequence[str]) -> dict[str, tuple[str, str]]:
    """Colour and marker of every method, each its own for up to twelve of them."""
    marks = {}
    n_further = 0
    for method in methods:
        if method in METHODS:
            marks[method] = METHODS[method]
        else:
            marks[method] = FURTHER_METHODS[n_further % len(FURTHER_METHODS)]
            n_further += 1
    return marks


def object_colours(names: Sequence[str], target: str, goal: str | None = None) -> dict[str, str]:
    """The colour of every object of a scene, by its part in the task."""
    colours = {}
    n_others = 0
    for name in names:
        if name == target:
            colours[name] = TARGET
        elif name == goal:
            colours[name] = GOAL
        else:
            colours[name] = LOOKALIKES[n_others % len(LOOKALIKES)]
            n_others += 1
    return colours


def object_labels(names: Sequence[str], target: str) -> dict[str, str]:
    """What every object of a scene is called where a user reads: "yours", "look-alike 3"."""
    labels = {}
    for name in names:
        kind, _, number = name.rpartition("-lookalike-")
        words = f"look-alike {number}"
        if not kind or not target.startswith(kind):
            words = name.removesuffix("-prop").replace("-", " ")
        labels[name] = "yours" if name == target else words
    return labels


def rgb8(hex_colour: str) -> Rgb8:
    """The three numbers of "#rrggbb"."""
    digits = hex_colour.removeprefix("#")
    return int(digits[0:2], 16), int(digits[2:4], 16), int(digits[4:6], 16)


def on_dark(hex_colour: str) -> str:
    """A method's or suite's colour for a dark ground: half as far from white."""
    return "#" + "".join(f"{(value + 255) // 2:02x}" for value in rgb8(hex_colour))


WINNER, OTHER = TARGET, LOOKALIKES[0]
"""The elected candidate or the target; every other one."""
GENERIC, OURS = FRAME, METHODS["vap"][0]
TIER_COLOURS = TIERS
LINE_COLOURS = tuple(SUITES[name][0] for name in ("simpler-fractal", "vlabench", "simpler-bridge"))
"""The curves of what is no suite."""
BAR_COLOURS = (*LINE_COLOURS[:2], ROLES["other objects"], LINE_COLOURS[2])
"""The bars of a group, in their order; told apart in grey, too."""
POLICY_MARKERS = ("o", "^", "s", "v", "X")
"""Markers of a method's policies where its colour alone says the method, in the order of
appearance."""
FURTHER_POLICY_MARKERS = ("d", "*", "8")
"""Markers of a method's third policy and all further ones where the first two have the method's
own, filled and then hollow, as these are."""


def empty_figure(width: float, height: float) -> "Figure":
    """A figure of that size (inches) with constrained layout; matplotlib loads when this is
    called."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")


def write_png(figure: "Figure", path: Path, dpi: int = 110) -> None:
    """Save a figure; the file is whole or absent, and depends on nothing but the figure."""
    with replacing(path) as part:
        figure.savefig(part, dpi=dpi, format="png", metadata={"Software": None})


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
    yours: int | None = None,
    cell_px: int = 88,
    dark: bool = True,
) -> Rgb:
    """The vote of one target in one view, over the picture `rgb` that it was held on.

    `references` are the remembered crops, in the order of the columns; without them a column has
    its number alone. `yours` is the candidate that is the target, whose row is orange; -1 where
    none is, None where that is unknown.
    """
    from PIL import Image, ImageDraw

    rows = shown_candidates(grounding)
    if yours is not None and yours >= 0 and yours not in rows:
        rows[-1] = yours
    n_photos = grounding.similarity.shape[1]
    left, beside = cell_px, round(2.3 * cell_px)
    top = round(0.45 * cell_px)
    header = cell_px if references else round(0.4 * cell_px)
    width = left + n_photos * cell_px + beside
    height = top + header + max(len(rows), 1) * cell_px + cell_px
    paper, ink, line = PAPERS[dark]
    picture = Image.new("RGB", (width, height), paper)
    draw = ImageDraw.Draw(picture)
    font = _font(round(FONT_SHARE * cell_px))
    bold = _font(round(1.15 * FONT_SHARE * cell_px))
    whose = grounding.object if yours is None else "yours"
    title = f"{grounding.camera}: which {grounding.candidates.phrase} is {whose}?"
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
            right = None if yours is None else i == yours
            _elected(draw, (0, y), (width - 3, cell_px), right)
        else:
            draw.line((0, y + cell_px, width, y + cell_px), fill=line)
        if i == yours:
            draw.rectangle((4, y + 4, width - 8, y + cell_px - 4), outline=TARGET, width=3)
            place = (beside_cells[0] + 0.4 * cell_px, y + 0.25 * cell_px)
            draw.text(place, "yours", fill=TARGET, font=bold, anchor="lm")
        y += cell_px
    if not rows:
        text = f"no {grounding.candidates.phrase} found"
        draw.text((width / 2, y + cell_px / 2), text, fill=ink, font=bold, anchor="mm")
        y += cell_px
    words = result_line(grounding)
    if yours == -1 and rows:
        words += "; yours is none of them"
    draw.text((6, y + cell_px / 4), words, fill=ink, font=bold, anchor="lm")
    _dot(draw, (0, y + 0.55 * cell_px), cell_px)
    key = "a photo's vote; bright: more alike"
    draw.text((cell_px, y + 0.75 * cell_px), key, fill=ink, font=font, anchor="lm")
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
