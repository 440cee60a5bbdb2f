"""One opening frame with every form of a prompt, or two tints, as the policy sees it.

Masks are the true ones.

forms_figure(episode("simpler-bridge", "put-camera", 0))
tints_figure(episode("simpler-bridge-red", "put-camera", 0))
"""

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from vap_core.attend import Prompting
from vap_core.base.types import Mask, Rgb
from vap_core.perception.boxes import mask_box
from vap_core.prompt import PALETTE, Tint, choose_colours
from vap_core.simulation import robots
from vap_core.simulation.assets.objects import get_object
from vap_core.simulation.control import pose_transform
from vap_core.simulation.suites import suite
from vap_core.simulation.suites.open_row import open_row
from vap_core.simulation.types import EpisodeRow
from vap_core.study.forms import draw_arrow, hand_pixel
from vap_core.study.methods import ABLATIONS, DEFAULT

if TYPE_CHECKING:
    from matplotlib.figure import Figure

COLOUR = PALETTE[0]
FORMS = ("form", "opacity")
"""The ablations whose arms are drawn."""
ROUND_PX = 14
"""What is shown around the objects of the target's category."""


def marked_frames(row: EpisodeRow) -> dict[str, Rgb]:
    """The first camera's opening frame by arm, the default first, cut to the objects alike.

    Raises: UnknownName, as `open_row`.
    """
    base = robots.get(suite(row.suite).robot).base_world
    with open_row(row) as env:
        camera = env.cameras()[0]
        rgb = env.observe().images[camera.name]
        masks = env.truth(masks=True).masks[camera.name]
        start = hand_pixel(camera, pose_transform(base).apply(env.tcp_base()[:3, 3]))
    target = masks[row.target]
    others = _alike(row, masks)
    frames = {DEFAULT: Tint()(rgb, target, COLOUR, others)}
    for name in FORMS:
        for arm, how in ABLATIONS[name].arms.items():
            if isinstance(how, Prompting):
                frames[arm] = how.form(rgb, target, COLOUR, others)
            elif start is not None:
                frames[arm] = draw_arrow(rgb, target, COLOUR, start)
    rows, columns = _cut(target, others)
    return {arm: frame[rows, columns] for arm, frame in frames.items()}


def forms_figure(row: EpisodeRow) -> "Figure":
    """A sheet of `marked_frames`, each with the name of its arm. Raises: as `marked_frames`."""
    from vap_core.analysis.plots import Tile, sheet

    tiles = [Tile(frame, arm) for arm, frame in marked_frames(row).items()]
    half = -(-len(tiles) // 2)
    return sheet({"": tiles[:half], " ": tiles[half:]}, side_in=1.15, label_in=0.05)


def tinted_frames(row: EpisodeRow) -> dict[str, Rgb]:
    """The first camera's opening frame without a tint, with the one chosen for it, and with red.

    Each has its tint as key; the frames are cut to the objects alike.

    Raises: UnknownName, as `open_row`.
    """
    with open_row(row) as env:
        camera = env.cameras()[0].name
        rgb = env.observe().images[camera]
        masks = env.truth(masks=True).masks[camera]
    target = masks[row.target]
    others = _alike(row, masks)
    (chosen,) = choose_colours(1, [(rgb, [target, *others])])
    rows, columns = _cut(target, others)
    frames = {"no tint": rgb}
    for label, colour in (("chosen", chosen), ("always", COLOUR)):
        frames[f"{label}: {colour.name}"] = Tint()(rgb, target, colour, others)
    return {label: frame[rows, columns] for label, frame in frames.items()}


def tints_figure(row: EpisodeRow) -> "Figure":
    """A sheet of `tinted_frames`, each with its tint. Raises: as `tinted_frames`."""
    from vap_core.analysis.plots import Tile, sheet

    tiles = [Tile(frame, label) for label, frame in tinted_frames(row).items()]
    return sheet({"": tiles}, side_in=1.6, label_in=0.05)


def _alike(row: EpisodeRow, masks: Mapping[str, Mask]) -> list[Mask]:
    found = []
    for name, mask in masks.items():
        if name != row.target and get_object(name).category == row.category:
            found.append(mask)
    return found


def _cut(target: Mask, others: list[Mask]) -> tuple[slice, slice]:
    """The rows and columns of a square around all of them."""
    box = mask_box(np.any([target, *others], axis=0))
    assert box is not None
    x0, y0, x1, y1 = box.astype(int).tolist()
    side = max(x1 - x0, y1 - y0) // 2 + ROUND_PX
    x, y = (x0 + x1) // 2, (y0 + y1) // 2
    height, width = target.shape
    return slice(max(0, y - side), min(height, y + side)), slice(
        max(0, x - side), min(width, x + side)
    )
