"""Hats of stuffed toys, and the ears or crest of those without one.

Lengths are metres; `radius` is the toy's half-width, `height` the whole toy's. Fronts face -y.
"""

from typing import Literal

import numpy as np

from vap_make.objects.bodies.parts import Profile, ellipsoid, lathe
from vap_make.objects.shapes import SIDES, Mesh, Number, Solid, rotation_matrix
from vap_make.objects.textures import ACCENT, INK, LIGHT

Hat = Literal["brim", "beanie", "cap", "ears", "crest"]
HAT_BOTTOMS: dict[Hat, float] = {"brim": 0.665, "beanie": 0.60, "cap": 0.64}
"""Where hats begin, as shares of the height."""
HEAD_SECTION = (1, 0.93, 2)
"""Cross-section of heads and hats: a little narrower front to back."""
POMPOM = (0.0075, 0.0075, 0.0065)
EAR = (0.0085, 0.0048, 0.0085)


def hat_meshes(hat: Hat, radius: Number, height: Number) -> list[Mesh]:
    """The hat on the toy's head."""
    match hat:
        case "brim":
            return _brimmed_hat(radius, height)
        case "beanie":
            return _beanie(radius, height)
        case "cap":
            return _cap(radius, height)
        case "ears":
            return _ears(radius, height)
        case "crest":
            return _crest(radius, height)


def hat_solids(hat: Hat, radius: Number, height: Number) -> list[Solid]:
    """The hat's collision solids."""
    r, h = radius, height
    match hat:
        case "brim":
            z = HAT_BOTTOMS[hat] * h
            solids = []
            for angle in (0.42, 0.79, 1.15):
                half = (1.09 * r * np.cos(angle), 1.02 * r * np.sin(angle), 0.002)
                solids.append(Solid("box", half, (0, 0, z + 0.001)))
            return [*solids, Solid("ellipsoid", (0.88 * r, 0.82 * r, h - z), (0, 0, z))]
        case "beanie":
            z = HAT_BOTTOMS[hat] * h
            return [
                Solid("ellipsoid", (1.0 * r, 0.93 * r, 0.9 * h - z), (0, 0, z)),
                Solid("ellipsoid", POMPOM, (0, 0, h - 0.0065)),
            ]
        case "cap":
            z = HAT_BOTTOMS[hat] * h
            dome = Solid("ellipsoid", (0.96 * r, 0.9 * r, h - 0.002 - z), (0, 0, z))
            peak = Solid(
                kind="ellipsoid",
                size=(0.8 * r, 0.62 * r, 0.0022),
                pos=(0, -0.72 * r, z + 0.001),
                euler=(0.18, 0, 0),
            )
            return [dome, peak]
        case "ears":
            solids = []
            for side in SIDES:
                solids.append(Solid("ellipsoid", EAR, (0.62 * side * r, 0, h - 0.0085)))
            return solids
        case "crest":
            return [Solid("box", (0.0035, 0.45 * r, 0.005), (0, 0, h - 0.011))]


def _turn_hat(profile: Profile, swatch: int) -> Mesh:
    return lathe(profile, swatch, 16, HEAD_SECTION)


def _brimmed_hat(radius: Number, height: Number) -> list[Mesh]:
    r, h = radius, height
    edge, z = 1.12 * r, HAT_BOTTOMS["brim"] * h
    brim: Profile = [
        (0.7 * r, z - 0.0005),
        (0.97 * edge, z - 0.001),
        (edge, z + 0.001),
        (0.97 * edge, z + 0.003),
        (0.7 * r, z + 0.003),
    ]
    crown: Profile = [
        (0.84 * r, z + 0.003),
        (0.82 * r, 0.84 * h),
        (0.68 * r, 0.955 * h),
        (0.4 * r, 0.995 * h),
        (0, h),
    ]
    band: Profile = [(0.86 * r, z + 0.003), (0.865 * r, z + 0.0075)]
    return [_turn_hat(brim, INK), _turn_hat(crown, INK), _turn_hat(band, ACCENT)]


def _beanie(radius: Number, height: Number) -> list[Mesh]:
    r, h = radius, height
    z = HAT_BOTTOMS["beanie"] * h
    cuff: Profile = [
        (0.88 * r, z - 0.001),
        (1.03 * r, z),
        (1.03 * r, z + 0.006),
        (0.9 * r, z + 0.007),
    ]
    dome: Profile = [
        (0.95 * r, z + 0.006),
        (0.86 * r, 0.77 * h),
        (0.55 * r, 0.87 * h),
        (0, 0.9 * h),
    ]
    pompom = ellipsoid(POMPOM, LIGHT, segments=9, rows=5)
    return [
        _turn_hat(cuff, ACCENT),
        _turn_hat(dome, INK),
        pompom.moved((0, 0, h - 0.0065)),
    ]


def _cap(radius: Number, height: Number) -> list[Mesh]:
    r, h = radius, height
    z = HAT_BOTTOMS["cap"] * h
    dome: Profile = [(0.96 * r, z), (0.9 * r, 0.82 * h), (0.6 * r, 0.95 * h), (0, h - 0.002)]
    peak = ellipsoid((0.8 * r, 0.62 * r, 0.0022), INK, segments=12, rows=4)
    button = ellipsoid((0.0028, 0.0028, 0.0022), ACCENT, segments=7, rows=4)
    return [
        _turn_hat(dome, INK),
        peak.moved((0, -0.72 * r, z + 0.001), rotation_matrix(x=0.18)),
        button.moved((0, 0, h - 0.0022)),
    ]


def _ears(radius: Number, height: Number) -> list[Mesh]:
    parts = []
    for side in SIDES:
        x = 0.62 * side * radius
        shell = ellipsoid(EAR, INK, segments=10, rows=5)
        lining = ellipsoid((0.0052, 0.002, 0.0052), ACCENT, segments=8, rows=4)
        parts.append(shell.moved((x, 0, height - 0.0085)))
        parts.append(lining.moved((x, -0.0036, height - 0.0088)))
    return parts


def _crest(radius: Number, height: Number) -> list[Mesh]:
    parts = []
    for y, tall in ((-0.5 * radius, 0.016), (0, 0.017), (0.45 * radius, 0.0185)):
        spike = lathe([(0.006, 0), (0.0045, 0.4 * tall), (0, tall)], INK, 6)
        parts.append(spike.moved((0, y, height - tall), rotation_matrix(x=-0.25)))
    return parts
