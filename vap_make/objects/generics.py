"""Generic textures at random, and look-alikes ("twins") of generic instances."""

from colorsys import hsv_to_rgb
from dataclasses import replace

import numpy as np

from vap_make.objects.families import Family, choose
from vap_make.objects.shapes import Shape
from vap_make.objects.textures import (
    GENERIC_FILL_LAYOUTS,
    GENERIC_FILLS,
    GENERIC_GLYPH_LAYOUTS,
    GENERIC_GLYPHS,
    Srgb,
    Texture,
)

SATURATION = (0.04, 0.4)
LIGHT_TONE, DARK_TONE, MIDDLE_TONE = (0.72, 0.93), (0.22, 0.45), (0.4, 0.85)
"""Ranges of brightness."""
LARGEST_SEED = 2**31
TWIN_ATTEMPTS = 20


def draw_texture(rng: np.random.Generator) -> Texture:
    """A texture of random colours, with a motif and a layout for generic instances."""
    light = _draw_colour(rng, LIGHT_TONE)
    dark = _draw_colour(rng, DARK_TONE)
    middle = _draw_colour(rng, MIDDLE_TONE)
    if rng.random() < 0.6:
        base, ink = light, dark
    elif rng.random() < 0.5:
        base, ink = dark, light
    else:
        base, ink = middle, light
    accent = middle
    if base == middle:
        accent = dark
    motif = choose(rng, GENERIC_GLYPHS + GENERIC_FILLS)
    layouts = GENERIC_FILL_LAYOUTS
    if motif in GENERIC_GLYPHS:
        layouts = GENERIC_GLYPH_LAYOUTS
    layout = choose(rng, layouts)
    word = ""
    if motif == "digit":
        word = f"{rng.integers(1, 100)}"
    return Texture(
        base=base,
        ink=ink,
        accent=accent,
        motif=motif,
        layout=layout,
        repeats=int(rng.integers(4, 9)),
        word=word,
        seed=int(rng.integers(LARGEST_SEED)),
    )


def draw_twin(
    family: Family, shape: Shape, texture: Texture, rng: np.random.Generator
) -> tuple[Shape, Texture]:
    """A look-alike of a generic instance: its decoration is new, its shape is so half the time.

    Half of the twins keep its base and ink colours, most others change one of them, the rest all.
    """
    change, same_shape = rng.random(), rng.random() < 0.5
    for _ in range(TWIN_ATTEMPTS):
        twin = _draw_twin_texture(family, texture, change, rng)
        if _is_distinguishable(twin, texture):
            if same_shape:
                return shape, twin
            break
    return family.draw(rng), twin


def _draw_colour(rng: np.random.Generator, brightness: tuple[float, float]) -> Srgb:
    hue = float(rng.random())
    saturation = float(rng.uniform(*SATURATION))
    red, green, blue = hsv_to_rgb(hue, saturation, float(rng.uniform(*brightness)))
    return round(255 * red), round(255 * green), round(255 * blue)


def _draw_twin_texture(
    family: Family, texture: Texture, change: float, rng: np.random.Generator
) -> Texture:
    """A new texture with colours of the given one; `change` in 0..1 says how many are replaced."""
    fresh = draw_texture(rng)
    if family.recolour is not None:
        fresh = family.recolour(fresh, int(rng.integers(LARGEST_SEED)))
    base, ink = texture.base, texture.ink
    if rng.random() < 0.2:
        base, ink = ink, base
    accent = texture.accent
    if rng.random() >= 0.6:
        accent = fresh.accent
    if change > 0.9:
        base, ink, accent = fresh.base, fresh.ink, fresh.accent
    elif change > 0.5:
        if rng.random() < 0.5:
            ink = fresh.ink
        else:
            base = fresh.base
    return replace(fresh, base=base, ink=ink, accent=accent)


def _is_distinguishable(twin: Texture, texture: Texture) -> bool:
    """Whether motif, layout, base or ink differ."""
    if (twin.motif, twin.layout) != (texture.motif, texture.layout):
        return True
    return len({twin.base, twin.ink} & {texture.base, texture.ink}) < 2
