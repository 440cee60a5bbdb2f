"""Named colours of the evaluation objects, sRGB."""

from vap_make.objects.textures import Srgb

CREAM: Srgb = (233, 223, 201)
BONE: Srgb = (219, 214, 206)
SAND: Srgb = (201, 176, 139)
RUST: Srgb = (140, 79, 62)
SAGE: Srgb = (157, 171, 146)
MOSS: Srgb = (91, 106, 77)
TEAL: Srgb = (71, 115, 117)
NAVY: Srgb = (51, 63, 86)
PLUM: Srgb = (102, 73, 93)
ROSE: Srgb = (198, 151, 149)
MUSTARD: Srgb = (198, 158, 83)
COCOA: Srgb = (87, 66, 55)
PORCELAIN: Srgb = (232, 228, 220)

VIVID_COLOURS: tuple[Srgb, ...] = (
    (236, 178, 40),
    (208, 56, 48),
    (54, 112, 186),
    (66, 150, 90),
    (236, 122, 44),
    (226, 130, 160),
    (128, 92, 170),
    (90, 180, 190),
)
"""Bright colours of generic toys, scrubbers and plants."""
