"""Values in, matplotlib figures out; nothing here computes what it shows."""

from collections.abc import Mapping, Sequence
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from vap_core.base.figures import OTHER, WINNER, empty_figure
from vap_core.base.types import Attended, Grounding, PersonalObject, Rgb, value
from vap_core.evaluation.metrics import Rate, Score
from vap_core.simulation.types import EpisodeRow

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.container import BarContainer
    from matplotlib.figure import Figure


def grounding_figure(
    rgb: Rgb, attended: Attended, objects: Sequence[PersonalObject], camera: str
) -> "Figure":
    """One row per target: the candidates, what the policy would see, the references, and the similarity matrix."""
    figure = empty_figure(13.0, 3.9 * len(objects))
    rows = figure.subfigures(len(objects), 1, squeeze=False)[:, 0]
    for row, grounding, obj in zip(rows, attended.groundings[camera], objects, strict=True):
        left, middle, refs, right = row.subplots(1, 4, width_ratios=[3, 3, 1.5, 2.6])
        candidates(left, rgb, grounding)
        left.set_title(f'candidates for "{obj.category}"', pad=14)
        middle.imshow(attended.images[camera])
        middle.set_title(f'shown to the policy\n"{attended.text}"')
        refs.imshow(_strip(obj.crops))
        refs.set_title(f"{obj.name}\n{len(obj.crops)} references")
        for axes in (left, middle, refs):
            axes.set_axis_off()
        similarity_matrix(right, grounding)
    return figure


def candidates(axes: "Axes", rgb: Rgb, grounding: Grounding) -> None:
    """Draw every candidate box over the picture, the winner in orange."""
    from matplotlib.patches import Rectangle

    axes.imshow(rgb)
    for i, (x0, y0, x1, y1) in enumerate(grounding.candidates.xyxy):
        colour = WINNER if i == grounding.winner else OTHER
        axes.add_patch(
            Rectangle(
                (x0, y0),
                x1 - x0,
                y1 - y0,
                fill=False,
                edgecolor=colour,
                linewidth=2.5 if i == grounding.winner else 1.5,
            )
        )
        axes.text(
            x0,
            max(y0 - 2, 0),
            f"#{i}",
            color="white",
            fontsize=8,
            va="bottom",
            bbox={"facecolor": colour, "edgecolor": "none", "pad": 1.5},
        )


def similarity_matrix(axes: "Axes", grounding: Grounding) -> None:
    """Cosines, candidates x references; a dot marks each reference's vote."""
    n, k = grounding.similarity.shape
    if n == 0:
        axes.text(
            0.5,
            0.5,
            f"no {grounding.candidates.phrase} found",
            ha="center",
            va="center",
            transform=axes.transAxes,
        )
        axes.set_axis_off()
        return
    axes.imshow(
        grounding.similarity,
        cmap="Greys",
        vmin=float(grounding.similarity.min()) - 0.05,
        vmax=1.05,
        aspect="auto",
    )
    middle = (float(grounding.similarity.min()) + 1.0) / 2
    for i in range(n):
        for j in range(k):
            cosine = float(grounding.similarity[i, j])
            axes.text(
                j,
                i,
                f"{cosine:.2f}",
                ha="center",
                va="center",
                fontsize=8,
                color="white" if cosine > middle else "black",
            )
    best = grounding.similarity.argmax(axis=0)
    axes.scatter(np.arange(k) + 0.33, best - 0.3, s=22, color=WINNER, zorder=3)
    axes.set_xticks(range(k), [f"ref {j}" for j in range(k)], fontsize=8)
    axes.set_yticks(
        range(n), [f"#{i}: {v} votes" for i, v in enumerate(grounding.ballot.votes)], fontsize=8
    )
    axes.set_title(f"cosine, dot = vote; margin {grounding.ballot.margin:.2f}")


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
    """One picture of a sheet, what is written under it, and the colour of its frame ("" for none)."""

    picture: Rgb
    title: str = ""
    edge: str = ""


def sheet(
    rows: Mapping[str, Sequence[Tile]],
    side_in: float = 1.0,
    label_in: float = 0.85,
    columns: int = 1,
) -> "Figure":
    """A contact sheet: one labelled row of square tiles per key, the rows dealt into `columns` side by side; inches."""
    from matplotlib.figure import Figure
    from matplotlib.patches import Rectangle

    most = max(map(len, rows.values()))
    caption = max(
        0.05 + 0.11 * len(tile.title.splitlines()) if tile.title else 0.0
        for row in rows.values()
        for tile in row
    )
    deep, gap, width = -(-len(rows) // columns), 0.06, label_in + (side := side_in) * most
    figure = Figure(figsize=(columns * width, deep * (side + caption + gap)))
    axes = figure.add_axes((0, 0, 1, 1))
    axes.set_axis_off()
    for i, (label, tiles) in enumerate(rows.items()):
        left, top = i // deep * width, i % deep * (side + caption + gap) + gap / 2
        axes.text(
            left + label_in - 0.08, top + side / 2, label, ha="right", va="center", fontsize=9
        )
        for j, tile in enumerate(tiles):
            x = left + label_in + j * side
            tall, wide = (
                (side - 0.06) / 2 / max(tile.picture.shape[:2]) * np.array(tile.picture.shape[:2])
            )
            extent = (
                x + side / 2 - wide,
                x + side / 2 + wide,
                top + side / 2 + tall,
                top + side / 2 - tall,
            )
            axes.imshow(tile.picture, extent=extent, aspect="auto", interpolation="antialiased")
            if tile.edge:
                axes.add_patch(
                    Rectangle(
                        (x + 0.03, top + 0.03),
                        side - 0.06,
                        side - 0.06,
                        fill=False,
                        edgecolor=tile.edge,
                        linewidth=1.8,
                    )
                )
            axes.text(
                x + side / 2,
                top + side + caption / 2 - 0.02,
                tile.title,
                ha="center",
                va="center",
                fontsize=7,
                color=tile.edge or "black",
            )
    axes.set(xlim=(0, columns * width), ylim=(deep * (side + caption + gap), 0))
    return figure


def hardness_figure(table: "pd.DataFrame", colours: Mapping[str, str]) -> "Figure":
    """Cosines of look-alikes by tier, one line per personal object, a diamond for its own new views (columns of `gallery.hardness`)."""
    figure = empty_figure(8.5, 5.6)
    axes = figure.subplots()
    names = list(dict.fromkeys(table.object))
    place = {name: i for i, name in enumerate(names)}
    for tier, part in table.groupby("tier", sort=False):
        axes.scatter(
            part.cosine,
            part.object.map(place),
            s=26,
            color=colours[str(tier)],
            alpha=0.85,
            label=f"look-alike, {tier}",
        )
    own = table.groupby("object", sort=False).own.first()
    axes.scatter(
        own,
        [place[str(name)] for name in own.index],
        marker="D",
        s=34,
        facecolor="white",
        edgecolor="black",
        label="the object itself, new views",
    )
    axes.set_yticks(range(len(names)), names)
    axes.invert_yaxis()
    axes.set_xlabel("mean cosine to five references of the personal object")
    axes.grid(axis="y", color="#e6e6e6")
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False, fontsize=8, loc="upper left")
    return figure


def layouts_figure(
    lists: Mapping[str, Sequence[EpisodeRow]],
    tables_m: Mapping[str, tuple[float, float, float, float]],
) -> "Figure":
    """Where things stand at the start, seen from above with the robot at the bottom: one panel per suite; `tables_m` are its table's x0 y0 x1 y1."""
    from matplotlib.patches import Rectangle

    figure = empty_figure(3.4 * len(lists), 3.9)
    grid = figure.subplots(1, len(lists), squeeze=False)[0]
    roles = {"other objects": "#c9ccd1", "look-alike": OTHER, "target": WINNER, "goal": "#59a14f"}
    for axes, (name, rows) in zip(grid, lists.items(), strict=True):
        spots: dict[str, set[tuple[float, float]]] = {role: set() for role in roles}
        for row in rows:
            for i, p in enumerate(row.placements):
                role = (
                    "target"
                    if i == 0
                    else "goal"
                    if p.model == row.goal
                    else "look-alike"
                    if "-lookalike-" in p.model
                    else "other objects"
                )
                spots[role].add((-p.y, p.x))
        x0, y0, x1, y1 = tables_m[name]
        axes.add_patch(
            Rectangle((-y1, x0), y1 - y0, x1 - x0, facecolor="#f3ede4", edgecolor="#cdbfa8")
        )
        few = (
            len(set().union(*spots.values())) < 10
        )  # everything shares these places: nest the marks
        for role, places in spots.items():
            size = (
                {"look-alike": 90, "goal": 190}.get(role, 14) if few else {"goal": 45}.get(role, 6)
            )
            fill, line = ("none", 1.6) if role == "goal" else (roles[role], 0.0)
            xy = np.array(sorted(places)).reshape(-1, 2)
            axes.scatter(
                xy[:, 0],
                xy[:, 1],
                s=size,
                facecolor=fill,
                edgecolor=roles[role],
                linewidths=line,
                label=role,
            )
        axes.plot(
            0, 0, marker="s", markersize=9, color="#444444", linestyle="none", label="robot's base"
        )
        axes.set(
            xlim=(-0.36, 0.36),
            ylim=(-0.06, 0.72),
            aspect="equal",
            title=f"{name}\n{len(rows)} episodes",
            xlabel="to the robot's right, m",
        )
        axes.spines[["top", "right"]].set_visible(False)
    grid[0].set_ylabel("away from the robot, m")
    figure.legend(
        *grid[0].get_legend_handles_labels(), loc="outside lower center", ncols=5, frameon=False
    )
    return figure


def bounds_figure(scores: Sequence[Score]) -> "Figure":
    """Success rates with 95 % Wilson intervals, one line per task and track, one colour per policy."""
    lines = list(dict.fromkeys((s.suite, s.task, s.split) for s in scores))
    policies = {policy: f"C{i}" for i, policy in enumerate(dict.fromkeys(s.policy for s in scores))}
    figure = empty_figure(8.5, 0.27 * len(lines) + 1.1)
    axes = figure.subplots()
    for policy, colour in policies.items():
        shown = [s for s in scores if s.policy == policy]
        middle = np.array([100 * s.sr.value for s in shown])
        spread = np.abs(
            [middle - [100 * s.sr.low for s in shown], [100 * s.sr.high for s in shown] - middle]
        )
        at = [
            lines.index((s.suite, s.task, s.split))
            + 0.24 * (list(policies).index(policy) - (len(policies) - 1) / 2)
            for s in shown
        ]
        axes.errorbar(
            middle,
            at,
            xerr=spread,
            fmt="o",
            color=colour,
            markersize=4,
            capsize=2.5,
            linewidth=1,
            label=f"{policy} policy",
        )
    axes.set_yticks(
        range(len(lines)),
        [f"{suite} / {task}{f' ({split})' if split else ''}" for suite, task, split in lines],
        fontsize=8,
    )
    axes.invert_yaxis()
    axes.set(xlim=(-2, 102), xlabel="% of episodes that succeed, 95 % interval")
    axes.grid(axis="y", color="#eeeeee")
    axes.spines[["top", "right"]].set_visible(False)
    figure.legend(
        *axes.get_legend_handles_labels(),
        loc="outside upper center",
        ncols=len(policies),
        frameon=False,
    )
    return figure


def learning_figure(
    logs: Mapping[str, Sequence[Mapping[str, int | float]]], panels: Mapping[str, str]
) -> "Figure":
    """What trainings logged, over their steps: a panel per figure of the log (its name there, and its title), a line per training that has it."""
    figure, shown = empty_figure(3.1 * len(panels) + 0.4, 3.0 + 0.3 * (len(logs) > 1)), {}
    for axes, (name, title) in zip(
        figure.subplots(1, len(panels), squeeze=False)[0], panels.items(), strict=True
    ):
        for i, (label, log) in enumerate(logs.items()):
            if log and name in log[0]:
                (shown[label],) = axes.plot(
                    [line["step"] for line in log],
                    [line[name] for line in log],
                    color=f"C{i}",
                    linewidth=1.4,
                )
        axes.set(title=title, xlabel="optimiser steps")
        axes.set_ylim(bottom=0)
        axes.grid(color="#eeeeee")
        axes.spines[["top", "right"]].set_visible(False)
    if len(logs) > 1:
        figure.legend(
            shown.values(), shown.keys(), loc="outside lower center", ncols=5, frameon=False
        )
    return figure


def rates_figure(panels: Mapping[str, Mapping[str, Mapping[str, "Rate"]]], label: str) -> "Figure":
    """Grouped bars: a panel per key, a group per inner key, a colour per innermost key.

    Rates are drawn in percent with their intervals. Groups and colours keep one order over all
    panels, that in which they first appear.
    """
    groups: dict[str, None] = {}
    names: dict[str, None] = {}
    for panel in panels.values():
        groups |= dict.fromkeys(panel)
        for rates in panel.values():
            names |= dict.fromkeys(rates)
    figure = empty_figure(0.9 + 2.9 * len(panels), 3.2)
    all_axes = figure.subplots(1, len(panels), squeeze=False, sharey=True)[0]
    drawn: dict[str, BarContainer] = {}
    for axes, (title, panel) in zip(all_axes, panels.items(), strict=True):
        own = [group for group in groups if group in panel]
        for i, name in enumerate(names):
            at = [x for x, group in enumerate(own) if name in panel[group]]
            rates_of_name = [panel[own[x]][name] for x in at]
            offset = (i - (len(names) - 1) / 2) * 0.84 / len(names)
            bars = _draw_rates(axes, np.array(at) + offset, rates_of_name, i, 0.76 / len(names))
            if at:
                drawn.setdefault(name, bars)
        axes.set_xticks(range(len(own)), own, fontsize=8)
        axes.set(title=title, ylim=(0, 105))
        axes.spines[["top", "right"]].set_visible(False)
    all_axes[0].set_ylabel(label)
    figure.legend(
        handles=list(drawn.values()),
        labels=list(drawn),
        loc="outside lower center",
        ncols=4,
        frameon=False,
    )
    return figure


def _draw_rates(
    axes: "Axes", x: np.ndarray, rates: "Sequence[Rate]", colour: int, width: float
) -> "BarContainer":
    """Bars of rates with their intervals, in percent."""
    value = 100 * np.array([rate.value for rate in rates])
    low = 100 * np.array([rate.low for rate in rates])
    high = 100 * np.array([rate.high for rate in rates])
    bars = axes.bar(x, value, width, color=f"C{colour}")
    axes.errorbar(
        x,
        value,
        np.maximum([value - low, high - value], 0),
        fmt="none",
        ecolor="black",
        capsize=2,
        linewidth=0.9,
    )
    return bars


def keep(
    figure: "Figure", path: Path, dpi: int = 110, limit: int = 480_000, small: int = 115_000
) -> bytes:
    """Save a figure as a PNG of `limit` bytes at most, and return a JPEG of it for a notebook, `small` bytes at most."""
    figure.savefig(drawn := BytesIO(), dpi=dpi, metadata={"Software": None})
    return keep_png(drawn.getvalue(), path, limit, small)


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
        size = round(share * full.width), round(share * full.height)
        coarse = [round(round(v / 255 * (2**bits - 1)) * 255 / (2**bits - 1)) for v in range(256)]
        full.resize(size, Image.Resampling.LANCZOS).point(coarse * 3).save(
            png := BytesIO(), "PNG", optimize=True, pnginfo=texts
        )
        if png.tell() <= limit:
            break
    path.write_bytes(png.getvalue())
    for width in (1100, 1000, 880, 760, 640, 520, 400):
        full.thumbnail((width, 4 * width), Image.Resampling.LANCZOS)
        full.save(jpeg := BytesIO(), "JPEG", quality=84)
        if jpeg.tell() <= small:
            break
    return jpeg.getvalue()


def _strip(crops: Sequence[Rgb], side: int = 96) -> Rgb:
    """Reference crops stacked in two columns, each fitted into a grey square."""
    from PIL import Image

    tiles = []
    for crop in crops:
        tile, small = Image.new("RGB", (side, side), (235, 235, 235)), Image.fromarray(crop)
        small.thumbnail((side - 6, side - 6))
        tile.paste(small, ((side - small.width) // 2, (side - small.height) // 2))
        tiles.append(np.asarray(tile))
    if len(tiles) % 2:
        tiles.append(np.full((side, side, 3), 255, np.uint8))
    return np.concatenate(
        [np.concatenate(tiles[i : i + 2], axis=1) for i in range(0, len(tiles), 2)]
    )
