"""Values in, matplotlib figures out; nothing here computes what it shows."""

import math
from collections.abc import Collection, Mapping, Sequence
from io import BytesIO
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from vap_core.base.files import write_atomic
from vap_core.base.pictures import (
    BAR_COLOURS,
    ELECTED,
    ELECTED_CASING,
    FRAME,
    GRID,
    LINE_COLOURS,
    METHODS,
    ROLES,
    SUITES,
    TEXT,
    THIN_LINES,
    TIER_COLOURS,
    empty_figure,
    vote_picture,
)
from vap_core.base.types import Attended, Grounding, PersonalObject, Rgb, value
from vap_core.simulation.types import EpisodeRow
from vap_core.study.stats import Rate

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.container import BarContainer
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D
    from PIL import Image


TIER_MARKERS = {"hard": "^", "medium": "s", "easy": "o"}
"""The marker of a look-alike, by hardness."""
SVG_LIMIT = 300_000
"""Bytes; a larger drawing stays a PNG."""
LABEL_ROOM = 0.07
"""Share of a picture's height that the number of a candidate takes."""
VOTE_CELL_PX = 110
"""Side of a cell of the vote's picture in a figure."""
LEGEND_DOT = 36.0
"""Area of a dot in a legend, points squared."""
SHARE_TOP = 1.03
"""The end of an axis of shares: a line at 1 is not cut."""
PANELS_IN_A_ROW = 4
"""More would be too small to read on a page."""
LAYERS = ("other objects", "look-alike", "target", "goal")
"""The roles of `layouts_figure`, the first one drawn below the others."""


def grounding_figure(
    rgb: Rgb, attended: Attended, objects: Sequence[PersonalObject], camera: str
) -> "Figure":
    """One row per target: the candidates, the policy's image, and the picture of the vote."""
    votes = []
    for grounding, obj in zip(attended.groundings[camera], objects, strict=True):
        votes.append(vote_picture(grounding, rgb, obj.crops, cell_px=VOTE_CELL_PX, dark=False))
    aspects = [vote.shape[1] / vote.shape[0] for vote in votes]
    figure = empty_figure(7.8 + 3.9 * max(aspects), 3.9 * len(objects))
    rows = figure.subfigures(len(objects), 1, squeeze=False)[:, 0]
    for row, grounding, vote in zip(rows, attended.groundings[camera], votes, strict=True):
        left, middle, right = row.subplots(1, 3, width_ratios=[1, 1, max(aspects)])
        candidates(left, rgb, grounding)
        left.set_title(f'candidates for "{grounding.candidates.phrase}"', pad=14)
        middle.imshow(attended.images[camera])
        middle.set_title(f'shown to the policy\n"{attended.text}"')
        right.imshow(vote)
        for axes in (left, middle, right):
            axes.set_axis_off()
    return figure


def candidates(axes: "Axes", rgb: Rgb, grounding: Grounding) -> None:
    """Draw every candidate box over the picture, the elected one in white."""
    from matplotlib.patches import Rectangle
    from matplotlib.patheffects import withStroke

    axes.imshow(rgb)
    for i, (x0, y0, x1, y1) in enumerate(grounding.candidates.xyxy):
        colour = FRAME
        box = Rectangle((x0, y0), x1 - x0, y1 - y0, fill=False, edgecolor=colour, linewidth=1.5)
        if i == grounding.winner:
            colour = ELECTED
            box.set(edgecolor=colour, linewidth=2.5)
            box.set_path_effects([withStroke(linewidth=5, foreground=ELECTED_CASING)])
        axes.add_patch(box)
        above = y0 > LABEL_ROOM * len(rgb)  # else the number would cover the title
        axes.text(
            x0 if above else x0 + 2,
            y0 - 2 if above else y0 + 2,
            f"#{i}",
            color="black",
            fontsize=8,
            va="bottom" if above else "top",
            bbox={"facecolor": colour, "edgecolor": "none", "pad": 1.5},
        )


def film(images: Mapping[str, Sequence[Rgb]], titles: Sequence[str]) -> "Figure":
    """Rows of pictures, one row per label, one column per title."""
    figure = empty_figure(2.1 * len(titles), 2.2 * len(images) + 0.3)
    grid = figure.subplots(len(images), len(titles), squeeze=False)
    for row, (label, pictures) in zip(grid, images.items(), strict=True):
        for axes, picture in zip(row, pictures, strict=True):
            axes.imshow(picture)
            axes.set(xticks=[], yticks=[])
        row[0].set_ylabel(label)
    for axes, title in zip(grid[0], titles, strict=True):
        axes.set_title(title, fontsize=9)
    return figure


@value
class Tile:
    """One picture of a sheet, the text under it, and the colour of its frame ("" for none)."""

    picture: Rgb
    title: str = ""
    edge: str = ""


def sheet(
    rows: Mapping[str, Sequence[Tile]],
    side_in: float = 1.0,
    label_in: float = 0.85,
    columns: int = 1,
    title_pt: float = 7.0,
) -> "Figure":
    """A contact sheet: one labelled row of square tiles per key.

    The rows are distributed over `columns` side by side. Sizes are in inches, that of the tiles'
    titles in points.
    """
    from matplotlib.figure import Figure

    most = max(map(len, rows.values()))
    caption = _caption_height_in(rows, title_pt)
    gap = 0.06
    rows_per_column = -(-len(rows) // columns)
    width = label_in + side_in * most
    height = side_in + caption + gap
    figure = Figure(figsize=(columns * width, rows_per_column * height))
    axes = figure.add_axes((0, 0, 1, 1))
    axes.set_axis_off()
    for i, (label, tiles) in enumerate(rows.items()):
        left = i // rows_per_column * width
        top = i % rows_per_column * height + gap / 2
        axes.text(
            left + label_in - 0.08, top + side_in / 2, label, ha="right", va="center", fontsize=9
        )
        for j, tile in enumerate(tiles):
            x = left + label_in + j * side_in
            _draw_tile(axes, tile, x=x, y=top, side_in=side_in, title_pt=title_pt)
    axes.set(xlim=(0, columns * width), ylim=(rows_per_column * height, 0))
    return figure


def hardness_figure(table: "pd.DataFrame") -> "Figure":
    """Cosines of look-alikes by tier, one line per personal object, of `gallery.hardness`.

    A diamond marks the object's own new views.
    """
    figure = empty_figure(8.5, 5.6)
    axes = figure.subplots()
    names = list(dict.fromkeys(table.object))
    place = dict(zip(names, range(len(names)), strict=True))
    for tier, part in table.groupby("tier", sort=False):
        axes.scatter(
            part.cosine,
            part.object.map(place),
            s=30,
            marker=TIER_MARKERS[str(tier)],
            color=TIER_COLOURS[str(tier)],
            label=f"look-alike, {tier}",
        )
    own = table.groupby("object", sort=False).own.first()
    axes.scatter(
        own,
        own.index.map(place),
        marker="D",
        s=34,
        facecolor="white",
        edgecolor="black",
        label="the object itself, new views",
    )
    axes.set_yticks(range(len(names)), names)
    axes.invert_yaxis()
    axes.set_xlabel("mean cosine to five references of the personal object")
    axes.grid(axis="y", color=GRID)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False, fontsize=8, loc="upper left")
    return figure


def layouts_figure(
    lists: Mapping[str, Sequence[EpisodeRow]],
    tables_m: Mapping[str, tuple[float, float, float, float]],
) -> "Figure":
    """Where objects stand at the start, seen from above with the robot at the bottom.

    One panel per suite; `tables_m` are the x0 y0 x1 y1 of its table.
    """
    from matplotlib.collections import PathCollection

    figure = empty_figure(3.4 * len(lists), 3.9)
    grid = figure.subplots(1, len(lists), squeeze=False)[0]
    for axes, (name, rows) in zip(grid, lists.items(), strict=True):
        _draw_layouts(axes, rows, tables_m[name])
        axes.set(
            xlim=(-0.36, 0.36),
            ylim=(-0.06, 0.72),
            aspect="equal",
            title=f"{name}\n{len(rows)} episodes",
            xlabel="to the robot's right, m",
        )
        axes.spines[["top", "right"]].set_visible(False)
    grid[0].set_ylabel("away from the robot, m")
    handles, labels = grid[0].get_legend_handles_labels()
    legend = figure.legend(handles, labels, loc="outside lower center", ncols=5, frameon=False)
    for handle in legend.legend_handles:
        if isinstance(handle, PathCollection):
            handle.set_sizes([LEGEND_DOT])  # the dots of a full panel are too small to see here
    return figure


def learning_figure(
    logs: Mapping[str, Sequence[Mapping[str, int | float]]],
    panels: Mapping[str, str],
    shares: Collection[str] = (),
) -> "Figure":
    """What trainings logged, over their optimiser steps.

    A panel per quantity of the log, of which `panels` holds the name in the log and the title; a
    line per training that logs it, in the colour of the suite that its label begins with; what
    stands in brackets behind the suite says more of the training. The axes of `shares` end at 1.
    """
    figure = empty_figure(3.1 * len(panels) + 0.4, 3.0 + 0.3 * (len(logs) > 1))
    drawn: dict[str, Line2D] = {}
    grid = figure.subplots(1, len(panels), squeeze=False)[0]
    for axes, (name, title) in zip(grid, panels.items(), strict=True):
        for i, (label, log) in enumerate(logs.items()):
            if log and name in log[0]:
                steps = []
                values = []
                for entry in log:
                    steps.append(entry["step"])
                    values.append(entry[name])
                colour = LINE_COLOURS[i % len(LINE_COLOURS)]
                suite = label.partition(" (")[0]
                if suite in SUITES:
                    colour = THIN_LINES.get(suite, SUITES[suite][0])
                (drawn[label],) = axes.plot(steps, values, color=colour, linewidth=1.6)
        axes.set(title=title, xlabel="optimiser steps")
        axes.set_ylim(bottom=0, top=SHARE_TOP if name in shares else None)
        axes.grid(color=GRID)
        axes.spines[["top", "right"]].set_visible(False)
    if len(logs) > 1:
        figure.legend(
            drawn.values(), drawn.keys(), loc="outside lower center", ncols=5, frameon=False
        )
    return figure


def rates_figure(
    panels: Mapping[str, Mapping[str, Mapping[str, "Rate"]]], label: str, groups_label: str = ""
) -> "Figure":
    """Grouped bars: a panel per key, a group per inner key, a colour per innermost key.

    A row has PANELS_IN_A_ROW panels at most; the rows of more are as even as they can be. Rates are
    drawn in percent with their intervals. Groups and colours keep one order over all panels, that
    in which they first appear; methods, in any case, have the colours that they have everywhere.
    `groups_label` says what the groups are.
    """
    groups: dict[str, None] = {}
    names: dict[str, None] = {}
    for panel in panels.values():
        groups |= dict.fromkeys(panel)
        for rates in panel.values():
            names |= dict.fromkeys(rates)
    n_rows = math.ceil(len(panels) / PANELS_IN_A_ROW)
    n_columns = math.ceil(len(panels) / n_rows)
    figure = empty_figure(0.9 + 2.9 * n_columns, 0.6 + 2.6 * n_rows)
    grid = figure.subplots(n_rows, n_columns, squeeze=False, sharey=True)
    for axes in grid.flat[len(panels) :]:
        axes.set_axis_off()
    colours = _bar_colours(list(names))
    drawn: dict[str, BarContainer] = {}
    for axes, (title, panel) in zip(grid.flat[: len(panels)], panels.items(), strict=True):
        own = [group for group in groups if group in panel]
        for i, name in enumerate(names):
            at = []
            rates_of_name = []
            for x, group in enumerate(own):
                if name in panel[group]:
                    at.append(x)
                    rates_of_name.append(panel[group][name])
            offset = (i - (len(names) - 1) / 2) * 0.84 / len(names)
            bars = _draw_rates(
                axes=axes,
                x=np.array(at) + offset,
                rates=rates_of_name,
                colour=colours[i],
                width=0.76 / len(names),
            )
            if at:
                drawn.setdefault(name, bars)
        axes.set_xticks(range(len(own)), own, fontsize=8)
        axes.set(title=title, ylim=(0, 105))
        axes.spines[["top", "right"]].set_visible(False)
    for axes in grid[:, 0]:
        axes.set_ylabel(label)
    used = len(panels) - (n_rows - 1) * n_columns
    grid[-1, used // 2].set_xlabel(groups_label)
    figure.legend(
        handles=list(drawn.values()),
        labels=list(drawn),
        loc="outside lower center",
        ncols=4,
        frameon=False,
    )
    return figure


def keep(
    figure: "Figure",
    path: Path,
    dpi: int = 110,
    limit: int = 480_000,
    small: int = 115_000,
    about: Mapping[str, str] | None = None,
) -> bytes:
    """Save a figure as a PNG of at most `limit` bytes; return a JPEG of at most `small` bytes.

    The JPEG is for a notebook; `about` becomes the PNG's text chunks. A figure without pictures is
    saved as an SVG, too.
    """
    drawn = BytesIO()
    _keep_svg(figure, path.with_suffix(".svg"))
    figure.savefig(drawn, dpi=dpi, metadata={"Software": None, **(about or {})})
    return keep_png(drawn.getvalue(), path, limit=limit, small=small)


def _keep_svg(figure: "Figure", path: Path) -> None:
    """Save a figure as an SVG where it has no picture in it, and fits into SVG_LIMIT."""
    from matplotlib import rc_context
    from matplotlib.image import AxesImage

    if figure.findobj(AxesImage):
        return
    drawn = BytesIO()
    with rc_context({"svg.hashsalt": "vap_core", "svg.fonttype": "none"}):
        figure.savefig(drawn, format="svg", metadata={"Date": None, "Creator": None})
    if drawn.tell() <= SVG_LIMIT:
        write_atomic(path, drawn.getvalue())


def keep_png(drawn: bytes, path: Path, limit: int = 480_000, small: int = 115_000) -> bytes:
    """The same for a picture, with its text chunks.

    What is too large is saved with coarser colours (6 or 5 bits a channel), then with fewer pixels.
    """
    from PIL import Image
    from PIL.PngImagePlugin import PngInfo

    source = Image.open(BytesIO(drawn))
    texts = PngInfo()
    for name, text in source.info.items():
        if isinstance(name, str) and isinstance(text, str):
            texts.add_text(name, text)
    full = source.convert("RGB")
    for share, bits in ((1.0, 8), (1.0, 6), (1.0, 5), (0.8, 6), (0.8, 5), (0.6, 5)):
        size = (round(share * full.width), round(share * full.height))
        resized = full.resize(size, Image.Resampling.LANCZOS)
        png = BytesIO()
        resized.point(_coarse_levels(bits) * 3).save(png, "PNG", optimize=True, pnginfo=texts)
        if png.tell() <= limit:
            break
    path.write_bytes(png.getvalue())
    return small_jpeg(full, small)


def small_jpeg(picture: "Image.Image", limit: int = 115_000) -> bytes:
    """An RGB picture as a JPEG of at most `limit` bytes, for a notebook; shrinks `picture`."""
    from PIL import Image

    for width in (1100, 1000, 880, 760, 640, 520, 400):
        picture.thumbnail((width, 4 * width), Image.Resampling.LANCZOS)
        jpeg = BytesIO()
        picture.save(jpeg, "JPEG", quality=84)
        if jpeg.tell() <= limit:
            break
    return jpeg.getvalue()


@value
class _Percentages:
    """Rates and the ends of their intervals, in percent."""

    value: np.ndarray
    low: np.ndarray
    high: np.ndarray


def _percentages(rates: Sequence[Rate]) -> _Percentages:
    values = []
    lows = []
    highs = []
    for rate in rates:
        values.append(rate.value)
        lows.append(rate.low)
        highs.append(rate.high)
    return _Percentages(100 * np.array(values), 100 * np.array(lows), 100 * np.array(highs))


def _bar_colours(names: Sequence[str]) -> list[str]:
    """The colours of the bars of a group: of methods their own, of anything else by place."""
    colours = []
    are_methods = all(name.lower() in METHODS for name in names)
    for i, name in enumerate(names):
        if are_methods:
            colour, _ = METHODS[name.lower()]
        else:
            colour = BAR_COLOURS[i % len(BAR_COLOURS)]
        colours.append(colour)
    return colours


def _draw_rates(
    axes: "Axes", x: np.ndarray, rates: Sequence[Rate], colour: str, width: float
) -> "BarContainer":
    """Bars of rates with their intervals, in percent."""
    percent = _percentages(rates)
    bars = axes.bar(x, percent.value, width, color=colour)
    axes.errorbar(
        x,
        percent.value,
        np.maximum([percent.value - percent.low, percent.high - percent.value], 0),
        fmt="none",
        ecolor="black",
        capsize=2,
        linewidth=0.9,
    )
    return bars


def _caption_height_in(rows: Mapping[str, Sequence[Tile]], title_pt: float) -> float:
    """The height of the longest title of a sheet, in inches."""
    height = 0.0
    for tile in chain.from_iterable(rows.values()):
        if tile.title:
            n_lines = len(tile.title.splitlines())
            height = max(height, 0.05 + 0.12 * n_lines * title_pt / 7)
    return height


def _draw_tile(
    axes: "Axes", tile: Tile, *, x: float, y: float, side_in: float, title_pt: float
) -> None:
    """One tile of a sheet with its top left corner at (x, y)."""
    from matplotlib.patches import Rectangle

    shape = tile.picture.shape[:2]
    half_height, half_width = (side_in - 0.06) / 2 / max(shape) * np.array(shape)
    extent = (
        x + side_in / 2 - half_width,
        x + side_in / 2 + half_width,
        y + side_in / 2 + half_height,
        y + side_in / 2 - half_height,
    )
    axes.imshow(tile.picture, extent=extent, aspect="auto", interpolation="antialiased")
    if tile.edge:
        frame = Rectangle(
            (x + 0.03, y + 0.03),
            side_in - 0.06,
            side_in - 0.06,
            fill=False,
            edgecolor=tile.edge,
            linewidth=1.8,
        )
        axes.add_patch(frame)
    axes.text(
        x + side_in / 2,
        y + side_in,
        tile.title,
        ha="center",
        va="top",
        fontsize=title_pt,
        color=TEXT,
    )


def _draw_layouts(
    axes: "Axes", rows: Sequence[EpisodeRow], table_m: tuple[float, float, float, float]
) -> None:
    """The table, the robot's base and every place an object starts from, coloured by role."""
    from matplotlib.patches import Rectangle

    spots: dict[str, set[tuple[float, float]]] = {}
    for role in LAYERS:
        spots[role] = set()
    for row in rows:
        for i, placement in enumerate(row.placements):
            role = _role(row, i)
            spots[role].add((-placement.y, placement.x))
    x0, y0, x1, y1 = table_m
    table = Rectangle((-y1, x0), y1 - y0, x1 - x0, facecolor="#f3ede4", edgecolor="#cdbfa8")
    axes.add_patch(table)
    sizes = {"goal": 45}
    default_size = 6
    if len(set().union(*spots.values())) < 10:  # the roles share these places: nest the marks
        sizes = {"look-alike": 90, "goal": 190}
        default_size = 14
    for role, places in spots.items():
        fill = ROLES[role]
        line_width = 0.0
        if role == "goal":
            fill = "none"
            line_width = 1.6
        xy = np.array(sorted(places)).reshape(-1, 2)
        axes.scatter(
            xy[:, 0],
            xy[:, 1],
            s=sizes.get(role, default_size),
            facecolor=fill,
            edgecolor=ROLES[role],
            linewidths=line_width,
            label=role,
        )
    axes.plot(0, 0, marker="s", markersize=9, color=TEXT, linestyle="none", label="robot's base")


def _role(row: EpisodeRow, number: int) -> str:
    """The role in ROLES of the object that `row` places as number `number`."""
    model = row.placements[number].model
    if number == 0:
        return "target"
    if model == row.goal:
        return "goal"
    if "-lookalike-" in model:
        return "look-alike"
    return "other objects"


def _coarse_levels(bits: int) -> list[int]:
    """A table from 8 bits to the nearest of 2**bits levels."""
    top = 2**bits - 1
    levels = []
    for v in range(256):
        level = round(v / 255 * top)
        levels.append(round(level * 255 / top))
    return levels
