"""How far apart two colours look: to normal eyes, to colour-blind ones, and in grey."""

import numpy as np

VISIONS = {
    "normal": np.eye(3),
    "protanopia": np.array(
        [
            [0.152286, 1.052583, -0.204868],
            [0.114503, 0.786281, 0.099216],
            [-0.003882, -0.048116, 1.051998],
        ]
    ),
    "deuteranopia": np.array(
        [
            [0.367322, 0.860646, -0.227968],
            [0.280085, 0.672501, 0.047413],
            [-0.011820, 0.042940, 0.968881],
        ]
    ),
    "tritanopia": np.array(
        [
            [1.255528, -0.076749, -0.178779],
            [-0.078411, 0.930809, 0.147602],
            [0.004733, 0.691367, 0.303900],
        ]
    ),
}
"""What each kind of eye sees of linear RGB (Machado, Oliveira and Fernandes 2009, severity 1)."""
XYZ_OF_RGB = np.array(
    [
        [0.4124564, 0.3575761, 0.1804375],
        [0.2126729, 0.7151522, 0.0721750],
        [0.0193339, 0.1191920, 0.9503041],
    ]
)
"""sRGB's primaries under D65."""
WHITE_XYZ = XYZ_OF_RGB.sum(axis=1)


def lab(hex_colour: str, vision: str = "normal") -> np.ndarray:
    """CIE L*a*b* of "#rrggbb" as that kind of eye sees it."""
    digits = hex_colour.removeprefix("#")
    srgb = np.array([int(digits[i : i + 2], 16) for i in (0, 2, 4)]) / 255
    linear = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    seen = np.clip(VISIONS[vision] @ linear, 0, 1)
    ratio = XYZ_OF_RGB @ seen / WHITE_XYZ
    f = np.where(ratio > (6 / 29) ** 3, np.cbrt(ratio), ratio * (29 / 6) ** 2 / 3 + 4 / 29)
    return np.array([116 * f[1] - 16, 500 * (f[0] - f[1]), 200 * (f[1] - f[2])])


def delta_e(one: np.ndarray, other: np.ndarray) -> float:
    """CIEDE2000 of two colours in L*a*b* (Sharma, Wu and Dalal 2005)."""
    chroma = (np.hypot(*one[1:]) + np.hypot(*other[1:])) / 2
    g = 0.5 * (1 - np.sqrt(chroma**7 / (chroma**7 + 25**7)))
    a = np.array([one[1], other[1]]) * (1 + g)
    b = np.array([one[2], other[2]])
    c = np.hypot(a, b)
    h = np.degrees(np.arctan2(b, a)) % 360
    dl, dc = other[0] - one[0], c[1] - c[0]
    turn = 0.0
    if c.prod() > 0:
        turn = (h[1] - h[0] + 180) % 360 - 180
    dh = 2 * np.sqrt(c.prod()) * np.sin(np.radians(turn / 2))
    mean_l, mean_c = (one[0] + other[0]) / 2, c.mean()
    mean_h = h.sum() if c.prod() == 0 else h[0] + turn / 2
    t = (
        1
        - 0.17 * np.cos(np.radians(mean_h - 30))
        + 0.24 * np.cos(np.radians(2 * mean_h))
        + 0.32 * np.cos(np.radians(3 * mean_h + 6))
        - 0.20 * np.cos(np.radians(4 * mean_h - 63))
    )
    sl = 1 + 0.015 * (mean_l - 50) ** 2 / np.sqrt(20 + (mean_l - 50) ** 2)
    sc, sh = 1 + 0.045 * mean_c, 1 + 0.015 * mean_c * t
    bend = 60 * np.exp(-((((mean_h % 360) - 275) / 25) ** 2))
    rotation = -2 * np.sqrt(mean_c**7 / (mean_c**7 + 25**7)) * np.sin(np.radians(bend))
    return float(
        np.sqrt((dl / sl) ** 2 + (dc / sc) ** 2 + (dh / sh) ** 2 + rotation * dc / sc * dh / sh)
    )


def least_difference(colours: list[str], vision: str = "normal") -> tuple[float, str, str]:
    """The two of `colours` that look most alike to that kind of eye, and their CIEDE2000."""
    seen = [lab(colour, vision) for colour in colours]
    least = (np.inf, "", "")
    for i in range(len(colours)):
        for j in range(i):
            least = min(least, (delta_e(seen[i], seen[j]), colours[j], colours[i]))
    return least


def lightness(hex_colour: str) -> float:
    """L* of a colour: what is left of it in grey, 0 black to 100 white."""
    return float(lab(hex_colour)[0])
