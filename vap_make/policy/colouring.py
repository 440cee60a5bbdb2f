"""Tint and paint in training scenes: which objects carry them is independent of which is meant.

Whether a scene is tinted, and by which object, is drawn before anything else and by equal odds for
every object that may be meant and for none. Paint is drawn for every object alike. Where a command
will call its target by a colour, colourings are drawn until *every* object has a colour of its own:
a condition on all of them, which favours none.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Bool, Float32, UInt8

from vap_core.base.types import Colour, Description, value
from vap_core.perception.describe import COLOURS
from vap_core.prompt import PALETTE
from vap_make.recipe import Recipe
from vap_make.words import PAINTS, similar_colours

COAT = (0.7, 0.95)
"""Range of the opacity of paint."""
UNPAINTED = 0.5
"""Share of scenes in which nothing is painted, unless that takes paint for colours of their own."""
PAINTED = (0.5, 0.5, 0.75, 0.75)
"""How often an object is painted, by the number of the try; after these all of them are."""
TRIES = 64
LOST = 0.12
"""How often a view's tint is missing (a tracker that lost its target); one view keeps it."""
Images = UInt8[np.ndarray, "c s s 3"]
"""The views of one frame."""


@value
class Colouring:
    """The colours that objects are given: object number to colour.

    `tinted` holds one at most, of a pair's scene two. `nothing` is whether a tinted scene's tint
    lies on no object.
    """

    tinted: Mapping[int, Colour]
    painted: Mapping[int, Colour]
    nothing: bool = False


def tints(recipe: Recipe) -> list[Colour]:
    """The tints of training."""
    return [colour for colour in PALETTE if colour.name not in recipe.held_out_tints]


def draw_colouring(
    looks: Sequence[Description],
    recipe: Recipe,
    rng: np.random.Generator,
    *,
    may_paint: bool,
    distinct: bool,
    at_once: int = 1,
) -> Colouring | None:
    """Colours for objects that look like `looks` says; a tinted scene has `at_once` tints.

    With `distinct`, every object's colour is one that no other shows; None when none is found.
    """
    carriers: list[int] = []
    is_tinted = bool(rng.random() < recipe.tint_share)
    if is_tinted:
        carriers = _draw_carriers(len(looks), at_once, rng)
    bare = rng.random() < UNPAINTED or not may_paint
    for attempt in range(TRIES):
        share = 0.0
        if not bare:
            share = PAINTED[attempt] if attempt < len(PAINTED) else 1.0
        drawn = _draw(looks, carriers, tints(recipe), share, rng)
        if not distinct or is_distinct(looks, drawn):
            nothing = is_tinted and not carriers
            return Colouring(tinted=drawn.tinted, painted=drawn.painted, nothing=nothing)
        bare = not may_paint
    return None


def colour_of(i: int, looks: Sequence[Description], colouring: Colouring) -> str:
    """What object i is called by its colour: that of its tint, its paint or, without, its main."""
    given = {**colouring.painted, **colouring.tinted}
    if i in given:
        return given[i].name
    return natural_colours(looks[i])[0]


def natural_colours(look: Description) -> list[str]:
    """The colours of a short description, the main one first."""
    return [word for word in look.short.split() if word in COLOURS]


def is_distinct(looks: Sequence[Description], colouring: Colouring) -> bool:
    """Whether nobody takes the colour of an object for one that another shows."""
    shown = [_shown(i, look, colouring) for i, look in enumerate(looks)]
    for i in range(len(looks)):
        similar = similar_colours(colour_of(i, looks, colouring))
        for j in range(len(looks)):
            if i != j and not similar.isdisjoint(shown[j]):
                return False
    return True


def colour_views(
    images: Images,
    ids: UInt8[np.ndarray, "c s s"],
    things: Sequence[int],
    colouring: Colouring,
    recipe: Recipe,
    rng: np.random.Generator,
) -> Images:
    """The views with their objects coloured; object i of the colouring is things[i] of `ids`."""
    for i, colour in colouring.painted.items():
        images = painted(images, ids == things[i] + 1, colour, float(rng.uniform(*COAT)))
    for i, colour in colouring.tinted.items():
        low, high = recipe.opacities[int(rng.integers(len(recipe.opacities)))]
        masks = _track(ids == things[i] + 1, rng)
        images = tinted(images, masks, colour, float(rng.uniform(low, high)))
    return images


def tinted(images: Images, masks: np.ndarray, colour: Colour, alpha: float) -> Images:
    """As prompt.tint does it."""
    rgb = np.asarray(colour.rgb, np.float32)
    return _blend(images, masks, np.broadcast_to(rgb, images.shape), alpha)


def painted(images: Images, masks: np.ndarray, colour: Colour, coat: float) -> Images:
    """Coloured by nature: light and shade of the object stay."""
    light = images.astype(np.float32).mean(axis=-1, keepdims=True) / 255.0
    rgb = np.asarray(colour.rgb, np.float32)
    paint = rgb * (0.25 + 0.75 * light) + 40.0 * light
    return _blend(images, masks, paint, coat)


def roughen_mask(mask: Bool[np.ndarray, "s s"], rng: np.random.Generator) -> np.ndarray:
    """A mask as a tracker draws it: now and then a little off, swollen or shrunk."""
    import cv2

    kind = rng.random()
    if kind < 0.5 or not mask.any():
        return mask
    if kind < 0.7:
        return np.roll(mask, rng.integers(-2, 3, 2), axis=(0, 1))
    change = cv2.dilate if kind < 0.85 else cv2.erode
    return change(mask.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0


def _draw_carriers(n: int, at_once: int, rng: np.random.Generator) -> list[int]:
    """Which of `n` objects carry the tints of a scene, each on any of them or on none."""
    carriers: list[int] = []
    for _ in range(at_once):
        carrier = int(rng.integers(n + 1)) - 1
        if carrier >= 0 and carrier not in carriers:
            carriers.append(carrier)
    return carriers


def _draw(
    looks: Sequence[Description],
    carriers: Sequence[int],
    palette: Sequence[Colour],
    share: float,
    rng: np.random.Generator,
) -> Colouring:
    """A tint on every carrier, and paint on a share of the others."""
    is_painted = rng.random(len(looks)) < share
    taken: set[str] = set()
    for i, look in enumerate(looks):
        if not is_painted[i] or i in carriers:
            taken.update(natural_colours(look))
    tinted_things: dict[int, Colour] = {}
    for carrier in carriers:
        left = [colour for colour in palette if colour not in tinted_things.values()]
        tinted_things[carrier] = _draw_colour(left, taken, rng)
        taken.add(tinted_things[carrier].name)
    painted_things = {}
    for i in rng.permutation(len(looks)).tolist():
        if is_painted[i] and i not in carriers:
            painted_things[i] = _draw_colour(PAINTS, taken, rng)
            taken.add(painted_things[i].name)
    return Colouring(tinted=tinted_things, painted=painted_things)


def _draw_colour(palette: Sequence[Colour], taken: set[str], rng: np.random.Generator) -> Colour:
    """A colour that nobody takes for one of those taken; any where there is none."""
    usable = [colour for colour in palette if similar_colours(colour.name).isdisjoint(taken)]
    usable = usable or list(palette)
    return usable[int(rng.integers(len(usable)))]


def _shown(i: int, look: Description, colouring: Colouring) -> set[str]:
    """The colours that an object shows; a tint hides none of its own, paint all."""
    if i in colouring.painted:
        return {colouring.painted[i].name}
    shown = set(natural_colours(look))
    if i in colouring.tinted:
        shown.add(colouring.tinted[i].name)
    return shown


def _track(masks: Bool[np.ndarray, "c s s"], rng: np.random.Generator) -> np.ndarray:
    """Masks as a tracker draws them, at least one view's."""
    kept = rng.random(len(masks)) > LOST
    kept[rng.integers(len(masks))] = True
    tracked = []
    for mask, keep in zip(masks, kept, strict=True):
        tracked.append(roughen_mask(mask, rng) & bool(keep))
    return np.stack(tracked)


def _blend(
    images: Images, masks: np.ndarray, paint: Float32[np.ndarray, "c s s 3"], share: float
) -> Images:
    """Mix paint into the masked pixels."""
    mixed = images.astype(np.float32)
    mixed[masks] = (1 - share) * mixed[masks] + share * paint[masks]
    return np.clip(np.rint(mixed), 0, 255).astype(np.uint8)
