"""Words for what is seen: colour names, and what distinguishes an object from its neighbours."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Protocol, runtime_checkable

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Int64

from vap_core.base.errors import BadEndpoint
from vap_core.base.types import Boxes, Description, Mask, PersonalObject, Rgb, value
from vap_core.perception.boxes import MARGIN
from vap_core.perception.chat import (
    ChatEndpoint,
    endpoint_from_environment,
    question_message,
    request_answer,
)
from vap_core.perception.protocols import Segmenter

HUE_ENDS_DEG = (5.0, 48.0, 72.0, 104.0, 168.0, 232.0, 308.0, 340.0)
HUE_NAMES = ("pink", "red", "orange", "yellow", "green", "teal", "blue", "purple")
"""Hue angles in CIE Lab up to each end have that name; what is beyond the last is pink again."""
NEUTRALS = ("black", "white", "grey", "brown", "beige")
COLOURS = (*NEUTRALS, *HUE_NAMES)
BLACK, WHITE, GREY, BROWN, BEIGE, PINK = range(6)
"""Indices in `COLOURS`."""
SHADES = ("light", "dark")
GREY_CHROMA = 9.0
"""Chroma below which a colour is a grey."""
VIVID_CHROMA = 38.0
"""Chroma from which warm colours are neither brown nor beige."""


def colour_indices(
    rgb: Rgb, mask: Mask
) -> tuple[Int64[np.ndarray, "h w"], Float32[np.ndarray, "h w"], Float32[np.ndarray, "h w"]]:
    """Of every pixel, the index of its colour in `COLOURS`, its hue in degrees and its chroma.

    What counts as white depends on the brightest grey pixels in `mask`, so that a white object is
    white in its shaded parts too.
    """
    lab = cv2.cvtColor(rgb.astype(np.float32) / 255, cv2.COLOR_RGB2LAB)
    light = lab[..., 0]
    chroma = np.hypot(lab[..., 1], lab[..., 2])
    angle = np.degrees(np.arctan2(lab[..., 2], lab[..., 1])) % 360.0
    hue = len(NEUTRALS) + np.digitize(angle, HUE_ENDS_DEG) % len(HUE_NAMES)

    warm = (angle > 20) & (angle < 100) & (chroma < VIVID_CHROMA)
    colour = np.where(warm, np.where(light < 55, BROWN, BEIGE), hue)
    dark_red = (angle < 20) & (chroma < VIVID_CHROMA) & (light < 40)
    colour = np.where(dark_red, BROWN, colour)
    reddish = (angle > 340) | (angle < 45)
    pale_red = reddish & (light > 55) & (chroma < 1.5 * VIVID_CHROMA) & ~warm
    colour = np.where(pale_red, PINK, colour)

    blue = (angle > 232) & (angle < 300)
    faint = chroma < np.where(blue, 0.6 * GREY_CHROMA, GREY_CHROMA)
    faint |= light < 14
    faint |= (light > 80) & (chroma < 1.7 * GREY_CHROMA)
    white_from = _white_lightness(light[faint & mask])
    neutral = np.where(light < 26, BLACK, np.where(light < white_from, GREY, WHITE))
    return np.where(faint, neutral, colour).astype(np.int64), angle, chroma


def add_shade(name: str, lightness: float) -> str:
    """The colour's name, after "light" or "dark" where its lightness (0..100) is extreme."""
    light, dark = SHADES
    if name in ("black", "white"):
        return name
    if lightness < 38:
        return f"{dark} {name}"
    if lightness > 74:
        return f"{light} {name}"
    return name


def _white_lightness(grey_lightness: np.ndarray) -> float:
    """The lightness from which a grey is white, given those of the object's grey pixels."""
    if len(grey_lightness) == 0:
        return 66.0
    brightest = float(np.percentile(grey_lightness, 95))
    if brightest <= 74:
        return 66.0
    return max(42.0, 0.55 * brightest)


PATTERNS = ("stripes", "bands", "spots", "patches", "parts")
SHAPES = ("tall", "wide", "compact")
SIDE = 128
"""Pixels of a crop's longer side while it is measured."""
CENTRE_RADIUS = 0.5
"""Pixels nearer to the middle of a crop than this, in half-sides, always belong to the object."""
BRIGHT_LEVEL = 240.0
"""The level to which an image's brightest parts are raised."""
MIN_PATCH_SHARE = 0.0015
"""Share of an object's pixels that a patch needs to be counted."""


@value
class CropAttributes:
    """One crop: every colour's share of the object, lightness (0..100) and pattern; its shape."""

    share: Mapping[str, float]
    lightness: Mapping[str, float]
    pattern: Mapping[str, str]
    shape: str


def measure_crop(rgb: Rgb, segmenter: Segmenter) -> CropAttributes:
    """The attributes of the object in a crop, whose outline `segmenter` finds."""
    scale = SIDE / max(rgb.shape[:2])
    size = max(8, round(scale * rgb.shape[1])), max(8, round(scale * rgb.shape[0]))
    how = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
    small = cv2.resize(rgb, size, interpolation=how)
    mask = _object_mask(small, segmenter)
    # The brightest parts are raised to `BRIGHT_LEVEL`, by a factor of 1.4 at most.
    brightest = float(np.percentile(small.max(axis=2), 98))
    gain = float(np.clip(BRIGHT_LEVEL / max(brightest, 1.0), 1.0, 1.4))
    lit = np.clip(small * gain, 0, 255).astype(np.uint8)
    lightness = cv2.cvtColor(lit.astype(np.float32) / 255, cv2.COLOR_RGB2LAB)[..., 0]
    indices, _, _ = colour_indices(lit, mask)
    parts = {name: (indices == index) & mask for index, name in enumerate(COLOURS)}
    height, width = _extent(mask)
    ratio = height / width
    return CropAttributes(
        share={name: float(part.sum() / int(mask.sum())) for name, part in parts.items()},
        lightness={
            name: float(lightness[part].mean()) if part.any() else 0.0
            for name, part in parts.items()
        },
        pattern={name: pattern_of(part, mask) for name, part in parts.items()},
        shape="tall" if ratio > 1.6 else "wide" if ratio < 0.9 else "compact",
    )


def pattern_of(part: Bool[np.ndarray, "h w"], whole: Mask) -> str:
    """How the pixels of one colour lie on an object.

    "stripes" are upright, "bands" go around it, "spots" are many and small, "patches" fewer and
    larger; everything else is "parts".
    """
    size = int(whole.sum())
    count, _, stats, _ = cv2.connectedComponentsWithStats(part.astype(np.uint8), connectivity=8)
    pieces = stats[1:count]
    pieces = pieces[pieces[:, cv2.CC_STAT_AREA] >= max(3, MIN_PATCH_SHARE * size)]
    if not len(pieces):
        return "parts"
    object_height, object_width = _extent(whole)
    width = pieces[:, cv2.CC_STAT_WIDTH]
    height = pieces[:, cv2.CC_STAT_HEIGHT]
    across = int(((width > 0.6 * object_width) & (height < 0.35 * object_height)).sum())
    upright = int(((height > 2.2 * width) & (height > 0.25 * object_height)).sum())
    largest = int(pieces[:, cv2.CC_STAT_AREA].max())
    if across and across >= upright:
        return "bands"
    if upright >= 2:
        return "stripes"
    if len(pieces) >= 4 and largest < 0.08 * size:
        return "spots"
    if len(pieces) >= 2 and largest < 0.2 * size:
        return "patches"
    return "parts"


def _object_mask(rgb: Rgb, segmenter: Segmenter) -> Mask:
    """The object in a resized crop.

    It has no holes, lacks its outermost pixels, and always covers the crop's centre.
    """
    from scipy.ndimage import binary_fill_holes

    h, w = rgb.shape[:2]
    margin = MARGIN * SIDE / (1 + 2 * MARGIN)
    xyxy = np.array([[margin, margin, w - margin, h - margin]], np.float32)
    mask = segmenter(rgb, Boxes(xyxy, np.ones(1, np.float32), ""))[0].astype(np.uint8)
    mask = binary_fill_holes(cv2.morphologyEx(mask, cv2.MORPH_CLOSE, np.ones((9, 9), np.uint8)))
    inner = cv2.erode(mask.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    x = np.linspace(-1, 1, w)
    y = np.linspace(-1, 1, h)
    return inner | (x[None] ** 2 + y[:, None] ** 2 < CENTRE_RADIUS**2)


def _extent(mask: Mask) -> tuple[int, int]:
    """Height and width of a mask's box, pixels."""
    rows = np.flatnonzero(mask.any(axis=1))
    cols = np.flatnonzero(mask.any(axis=0))
    return int(rows[-1] - rows[0] + 1), int(cols[-1] - cols[0] + 1)


PROMINENT_SHARE = 0.06
"""Share of an object's pixels that a colour needs to be in the short description."""
MINOR_SHARE = 0.025
"""Share of an object's pixels that a colour needs to be in the long description."""
GREY_SHARE = 0.3
"""Share that grey needs: less of it is shade, or table."""
CONNECTIVES = ("mostly", "and", "with", "a", "little", "patterned", "plain", "all", "over")
WORDS = (*COLOURS, *PATTERNS, *SHAPES, *SHADES, *CONNECTIVES)
"""Every word of the descriptions of `AttributeCaptioner`, besides the category's."""
SHORT_QUESTION = (
    "All pictures show one and the same {category}. Say in one short English noun phrase what "
    "distinguishes it from others of its kind: form, colour, material. No sentence. Leave out "
    "where it stands, how it is turned, and what is around it."
)
LONG_QUESTION = (
    "All pictures show one and the same {category}. Describe it in one long English noun phrase, "
    "so exactly that it could be picked out among similar ones: form and proportions, material and "
    "finish, every colour, pattern and decoration, rims, openings and other parts. No sentence. "
    "Leave out where it stands, how it is turned, and what is around it."
)
"""What the paper asks its model, in other words."""
MAX_CHARACTERS = 1000
"""Length of a description."""


@runtime_checkable
class Captioner(Protocol):
    """Describes one object from its reference crops, in words that can follow "my cup is"."""

    def __call__(self, crops: Sequence[Rgb], category: str) -> Description: ...


def load_captioner(segmenter: Segmenter, where: str = "offline") -> Captioner:
    """The captioner called `where`.

    "offline" counts attributes; "chat" uses the chat endpoint of the environment's variables, and
    anything else is the address of one.

    Raises: BadEndpoint.
    """
    if where == "offline":
        return AttributeCaptioner(segmenter)
    return ChatCaptioner(endpoint_from_environment("" if where == "chat" else where))


def with_description(obj: PersonalObject, captioner: Captioner) -> PersonalObject:
    """The object with the captioner's description of it."""
    return replace(obj, description=captioner(obj.crops, obj.category))


@dataclass(frozen=True)
class AttributeCaptioner:
    """The offline captioner: colours, patterns and proportions of the segmented object.

    short: "white with blue spots"; long: "a tall vase, mostly white with blue spots and a little
    black, patterned all over".
    """

    segmenter: Segmenter

    def __call__(self, crops: Sequence[Rgb], category: str) -> Description:
        measured = [measure_crop(rgb, self.segmenter) for rgb in crops]
        return phrase_attributes(measured, category)


@dataclass(frozen=True)
class ChatCaptioner:
    """The captioner behind a chat endpoint: one question for each length, with all crops."""

    endpoint: ChatEndpoint

    def __call__(self, crops: Sequence[Rgb], category: str) -> Description:
        """Ask for the short description, then for the long one.

        Raises: BadEndpoint: the endpoint fails, or its answer is no short line of text.
        """
        return Description(
            short=self._request_phrase(SHORT_QUESTION.format(category=category), crops),
            long=self._request_phrase(LONG_QUESTION.format(category=category), crops),
        )

    def _request_phrase(self, question: str, crops: Sequence[Rgb]) -> str:
        """The model's answer as one line, without quotes or a full stop."""
        answer = request_answer(
            self.endpoint,
            [question_message(question, crops)],
            doing="describe",
            instead="another server whose model sees pictures",
        )
        phrase = " ".join(answer.split()).strip(" \"'`.“”")
        if not phrase or len(phrase) > MAX_CHARACTERS or not phrase.isprintable():
            raise BadEndpoint(
                f"describe: {self.endpoint.model} at {self.endpoint.url} gives no phrase of "
                f"1 to {MAX_CHARACTERS} characters, but {phrase[:60]!r}; try another model."
            )
        return phrase


def phrase_attributes(measured: Sequence[CropAttributes], category: str) -> Description:
    """Put what was measured of an object's crops into words."""
    share = {name: float(np.mean([crop.share[name] for crop in measured])) for name in COLOURS}
    if share["grey"] < GREY_SHARE:
        share["grey"] = 0.0
    main_colour, *others = sorted(COLOURS, key=share.__getitem__, reverse=True)
    shown = {
        name: [crop for crop in measured if crop.share[name] > MINOR_SHARE] for name in COLOURS
    }
    # The most frequent pattern of a colour; "parts" when no crop shows enough of it.
    patterns = {
        name: (Counter(crop.pattern[name] for crop in crops).most_common(1) or [("parts", 0)])[0][0]
        for name, crops in shown.items()
    }
    (shape, _), *_ = Counter(crop.shape for crop in measured).most_common(1) or [("parts", 0)]
    lightness = [crop.lightness[main_colour] for crop in shown[main_colour]]
    main = add_shade(main_colour, float(np.median(lightness)))
    seen = [name for name in others if share[name] >= MINOR_SHARE]
    busy_pattern = any(patterns[name] in ("stripes", "spots", "patches") for name in seen)
    prominent = [f"{name} {patterns[name]}" for name in seen if share[name] >= PROMINENT_SHARE]
    minor = [name for name in seen if share[name] < PROMINENT_SHARE]
    prominent = prominent[:2]

    short = main
    details = list(prominent)
    ending = ""
    if prominent:
        short = f"{main} with {' and '.join(prominent)}"
    if minor:
        details.append(f"a little {' and '.join(minor[:2])}")
    if busy_pattern and sum(share[name] for name in seen) > 1.5 * PROMINENT_SHARE:
        ending = ", patterned all over"
    elif not prominent:
        ending = ", plain"
    if details:
        main = f"{main} with {' and '.join(details)}"
    return Description(short, f"a {shape} {category}, mostly {main}{ending}")
