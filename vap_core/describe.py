"""What a personal object looks like, in words: the short and the long description of a hard prompt (P appendix, textual descriptions).

A captioner is any function (reference crops, category) -> Description. `Attributes` counts colours, patterns and proportions, offline, always the
same, in words of `WORDS` alone; `Seer` asks a vision-language model through a chat endpoint, as the paper asks GPT-5.1.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Protocol, runtime_checkable

import cv2
import numpy as np
from jaxtyping import Bool, Int64

from vap_core import segment
from vap_core.chat import Chat, ask, endpoint
from vap_core.embed import MARGIN
from vap_core.errors import BadEndpoint
from vap_core.values import Boxes, Description, Mask, PersonalObject, Rgb, value

SIDE = 128
"""Pixels of a crop's longer side while it is described."""
HUES = ((5.0, "pink"), (48.0, "red"), (72.0, "orange"), (104.0, "yellow"), (168.0, "green"), (232.0, "teal"), (308.0, "blue"), (340.0, "purple"))
"""Upper ends of the hue angles of colours in CIE Lab, degrees; what is beyond the last is pink again."""
COLOURS = ("black", "white", "grey", "brown", "beige", *(name for _, name in HUES))
GREY, VIVID = 9.0, 38.0
"""Chroma below which a colour is a grey, and from which warm ones are neither brown nor beige."""
SOME, FEW = 0.06, 0.025
"""Shares of an object's pixels that a colour needs to be mentioned, and to be mentioned at length."""
SHADY = 0.3
"""Share that grey needs: less of it is shade, or table."""
HEART, WHITE = 0.5, 240.0
"""What is nearer to the middle of a crop than this, in half-sides, is the object; the level to which a picture's brightest parts are raised."""
SMALL = 0.0015
"""Share of an object's pixels that a patch needs to be counted."""
KINDS = ("stripes", "bands", "spots", "patches", "parts")
SHAPES = ("tall", "wide", "compact")
SHADES = ("light", "dark")
WORDS = (*COLOURS, *KINDS, *SHAPES, *SHADES, "mostly", "and", "with", "a", "little", "patterned", "plain", "all", "over")
"""Every word that `Attributes` says, besides the category's."""


@runtime_checkable
class Captioner(Protocol):
    """Describes one object from its reference crops; what it says can follow "my cup is"."""

    def __call__(self, crops: Sequence[Rgb], category: str) -> Description: ...


def described(obj: PersonalObject, captioner: Captioner) -> PersonalObject:
    """The object with its description, as the captioner gives it."""
    return replace(obj, description=captioner(obj.crops, obj.category))


@dataclass(frozen=True)
class Attributes:
    """The offline captioner: colours, patterns and proportions of the pixels that `segmenter` takes for the object.

    short: "white with blue spots"; long: "a tall vase, mostly white with blue spots and a little black, patterned all over".
    """

    segmenter: segment.Segmenter

    def __call__(self, crops: Sequence[Rgb], category: str) -> Description:
        looks = [_look(*_shown(rgb, self.segmenter)) for rgb in crops]
        share = {name: float(np.mean([look.share[name] for look in looks])) for name in COLOURS}
        share["grey"] *= share["grey"] >= SHADY
        first, *rest = sorted(COLOURS, key=lambda name: -share[name])
        others = {name: _usual([look.kinds[name] for look in looks if look.share[name] > FEW]) for name in rest if share[name] >= FEW}
        main = shaded(first, float(np.median([look.lightness[first] for look in looks if look.share[first] > FEW])))
        told = [f"{name} {kind}" for name, kind in others.items() if share[name] >= SOME][:2]
        hints = [name for name in others if share[name] < SOME][:2]
        short = " with ".join([main, *([" and ".join(told)] if told else [])])
        listed = " and ".join([*told, *(["a little " + " and ".join(hints)] if hints else [])])
        busy = sum(share[name] for name in others) > 1.5 * SOME and any(kind in ("stripes", "spots", "patches") for kind in others.values())
        long = (
            f"a {_usual([look.shape for look in looks])} {category}, mostly {main}"
            + (f" with {listed}" if listed else "")
            + (", patterned all over" if busy else ", plain" if not told else "")
        )
        return Description(short, long)


@dataclass(frozen=True)
class Seer:
    """The captioner of a vision-language model: all reference crops at once, asked once for each length (P appendix)."""

    chat: Chat

    def __call__(self, crops: Sequence[Rgb], category: str) -> Description:
        return Description(*(_phrase(self.chat, ask(self.chat, wanted.format(category=category), crops)) for wanted in (BRIEFLY, FULLY)))


BRIEFLY = (
    "All pictures show one and the same {category}. Say in one short English noun phrase what distinguishes it from others of its kind: form, "
    "colour, material. No sentence. Leave out where it stands, how it is turned, and what is around it."
)
FULLY = (
    "All pictures show one and the same {category}. Describe it in one long English noun phrase, so exactly that it could be picked out among "
    "similar ones: form and proportions, material and finish, every colour, pattern and decoration, rims, openings and other parts. No sentence. "
    "Leave out where it stands, how it is turned, and what is around it."
)
"""What the paper asks for, in our words."""
LONGEST = 1000
"""Characters of a description."""


def captioner(segmenter: segment.Segmenter, where: str = "offline") -> Captioner:
    """The offline one; else the model behind the chat endpoint `where`, or, by the name "chat", behind the environment's. Raises: BadEndpoint."""
    return Attributes(segmenter) if where == "offline" else Seer(endpoint("" if where == "chat" else where))


def _phrase(chat: Chat, text: str) -> str:
    """One line without quotes or a full stop."""
    phrase = " ".join(text.split()).strip(" \"'`.“”")
    if not phrase or len(phrase) > LONGEST or not phrase.isprintable():
        raise BadEndpoint(
            f"describe: {chat.model} at {chat.url} gives no phrase of 1 to {LONGEST} characters, but {phrase[:60]!r}; try another model."
        )
    return phrase


@value
class Look:
    """One crop: of every colour its share of the object, its lightness (0..100) and how it is spread; and the object's proportions."""

    share: Mapping[str, float]
    lightness: Mapping[str, float]
    kinds: Mapping[str, str]
    shape: str


def _shown(rgb: Rgb, segmenter: segment.Segmenter) -> tuple[Rgb, Mask]:
    """The crop at a common size, evenly exposed, and the object in it, without holes."""
    from scipy.ndimage import binary_fill_holes

    scale = SIDE / max(rgb.shape[:2])
    h, w = (max(8, round(scale * side)) for side in rgb.shape[:2])
    small = cv2.resize(rgb, (w, h), interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR)
    margin = MARGIN * SIDE / (1 + 2 * MARGIN)
    box = Boxes(np.array([[margin, margin, w - margin, h - margin]], np.float32), np.ones(1, np.float32), "")
    mask = segmenter(small, box)[0].astype(np.uint8)
    mask = binary_fill_holes(cv2.morphologyEx(mask, cv2.MORPH_CLOSE, np.ones((9, 9), np.uint8)))
    y, x = (np.linspace(-1, 1, side) for side in (h, w))
    mask = (cv2.erode(mask.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0) | ((x[None] ** 2 + y[:, None] ** 2) < HEART**2)
    gain = float(np.clip(WHITE / max(float(np.percentile(small.max(axis=2), 98)), 1.0), 1.0, 1.4))
    return np.clip(small * gain, 0, 255).astype(np.uint8), mask


def _look(rgb: Rgb, mask: Mask) -> Look:
    lab = cv2.cvtColor(rgb.astype(np.float32) / 255, cv2.COLOR_RGB2LAB)
    names, size = colour_names(rgb, mask), int(mask.sum())
    of = {name: (names == i) & mask for i, name in enumerate(COLOURS)}
    rows, cols = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    ratio = (rows[-1] - rows[0] + 1) / (cols[-1] - cols[0] + 1)
    return Look(
        {name: float(part.sum() / size) for name, part in of.items()},
        {name: float(lab[part, 0].mean()) if part.any() else 0.0 for name, part in of.items()},
        {name: spread(part, mask) for name, part in of.items()},
        "tall" if ratio > 1.6 else "wide" if ratio < 0.9 else "compact",
    )


def colour_names(rgb: Rgb, mask: Mask) -> Int64[np.ndarray, "h w"]:
    """Of every pixel the index in `COLOURS` of what a person would call it: in the shade of an object that is white in the light, white."""
    lab = cv2.cvtColor(rgb.astype(np.float32) / 255, cv2.COLOR_RGB2LAB)
    light, chroma = lab[..., 0], np.hypot(lab[..., 1], lab[..., 2])
    angle = np.degrees(np.arctan2(lab[..., 2], lab[..., 1])) % 360.0
    hue = np.digitize(angle, [end for end, _ in HUES]) % len(HUES)
    found = np.array([COLOURS.index(name) for _, name in HUES])[hue]
    warm = (angle > 20) & (angle < 100) & (chroma < VIVID)
    found = np.where(warm, np.where(light < 55, COLOURS.index("brown"), COLOURS.index("beige")), found)
    found = np.where((angle < 20) & (chroma < VIVID) & (light < 40), COLOURS.index("brown"), found)
    found = np.where(((angle > 340) | (angle < 45)) & (light > 55) & (chroma < 1.5 * VIVID) & ~warm, COLOURS.index("pink"), found)
    faint = (chroma < np.where((angle > 232) & (angle < 300), 0.6 * GREY, GREY)) | (light < 14) | ((light > 80) & (chroma < 1.7 * GREY))
    brightest = float(np.percentile(light[faint & mask], 95)) if (faint & mask).any() else 0.0
    white = max(42.0, 0.55 * brightest) if brightest > 74 else 66.0
    pale = np.where(light < 26, COLOURS.index("black"), np.where(light < white, COLOURS.index("grey"), COLOURS.index("white")))
    return np.where(faint, pale, found).astype(np.int64)


def spread(part: Bool[np.ndarray, "h w"], whole: Mask) -> str:
    """How one colour lies on an object: upright "stripes", "bands" around it, "spots", larger "patches", or "parts" that are all of it."""
    size = int(whole.sum())
    count, _, stats, _ = cv2.connectedComponentsWithStats(part.astype(np.uint8), connectivity=8)
    pieces = [tuple(int(v) for v in row) for row in stats[1:count] if row[cv2.CC_STAT_AREA] >= max(3, SMALL * size)]
    if not pieces:
        return "parts"
    rows, cols = np.flatnonzero(whole.any(axis=1)), np.flatnonzero(whole.any(axis=0))
    high, wide = rows[-1] - rows[0] + 1, cols[-1] - cols[0] + 1
    across = sum(w > 0.6 * wide and h < 0.35 * high for _, _, w, h, _ in pieces)
    upright = sum(h > 2.2 * w and h > 0.25 * high for _, _, w, h, _ in pieces)
    blobs = sorted((area for *_, area in pieces), reverse=True)
    if across and across >= upright:
        return "bands"
    if upright >= 2:
        return "stripes"
    if len(blobs) >= 4 and blobs[0] < 0.08 * size:
        return "spots"
    return "patches" if len(blobs) >= 2 and blobs[0] < 0.2 * size else "parts"


def shaded(name: str, lightness: float) -> str:
    """A colour with its shade, where it has one that is worth a word."""
    if name in ("black", "white"):
        return name
    return f"{SHADES[1]} {name}" if lightness < 38 else f"{SHADES[0]} {name}" if lightness > 74 else name


def _usual(names: Sequence[str]) -> str:
    """What is said most often, the first of those that tie; "parts" where nothing is."""
    return Counter(names).most_common(1)[0][0] if names else "parts"
