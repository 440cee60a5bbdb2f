"""The colours of recordings, figures and notebooks: each has one meaning.

Orange is the target, wherever it is: the object itself, its true mask, its reference photos. White
is what the method elected: a box, or a mask; a tick or a cross says whether it is right. Cool hues
are look-alikes and other objects, rose is the goal, greys are cameras and what only frames a
picture. Success and failure have no colour: they are words, with the same tick and cross.

Methods and suites have a palette each, for figures on white. Every palette is told apart by
colour-blind eyes (`tests/test_palette.py` simulates them); those of methods, suites, tiers and
cases are in grey, too. Beside it a method and a suite have a marker.
"""

from collections.abc import Sequence

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


def suite_colour(suite: str) -> str:
    """The colour of a suite, grey for one that is no benchmark."""
    colour, _ = SUITES.get(suite, (FRAME, "o"))
    return colour


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


def rgb8(hex_colour: str) -> Rgb8:
    """The three numbers of "#rrggbb"."""
    digits = hex_colour.removeprefix("#")
    return int(digits[0:2], 16), int(digits[2:4], 16), int(digits[4:6], 16)


def on_dark(hex_colour: str) -> str:
    """A method's or suite's colour for a dark ground: half as far from white."""
    return "#" + "".join(f"{(value + 255) // 2:02x}" for value in rgb8(hex_colour))
