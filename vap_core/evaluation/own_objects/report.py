"""The figures of a folder of objects as text, per object, per group and in all, and its sheets."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from vap_core.base.photos import load_photo
from vap_core.base.tables import Rows, align
from vap_core.base.types import value
from vap_core.evaluation.perception.estimates import clustered_share
from vap_core.evaluation.photos.pictures import join_tiles, write_picture

if TYPE_CHECKING:
    import pandas as pd

TILES, COLUMNS = 12, 2
NOTE = (
    "value [95 % interval] n, in %; Wilson's interval with n reduced to what the objects, which "
    "are the independent units, are worth.\n"
    "views: those that show 100 pixels of the object or more, of 224 x 224. proposed: some box "
    "overlaps it by IoU .5. right: the elected box does; not in view: of the right ones, those too "
    "unlike the references to be tinted; mask IoU: of the right ones, mean. wrong tint: another "
    "thing is tinted.\n"
    "expert: episodes in which it succeeds. VAP: successes of these; touches first: the first "
    "object that the robot touches in these is the right one."
)


@value
class Tables:
    """A row per view and per episode, the groups of every object, and why some were left out."""

    views: "pd.DataFrame"
    episodes: "pd.DataFrame"
    groups: Mapping[str, tuple[str, ...]]
    refused: Mapping[str, str]


def text_report(tables: Tables) -> str:
    """What the command prints."""
    parts = []
    if len(tables.views):
        parts += [align(object_rows(tables)), align(group_rows(tables))]
    if tables.refused:
        lines = [f"left out: {name}: {why}" for name, why in tables.refused.items()]
        parts.append("\n".join(lines))
    if len(tables.views):
        parts.append(NOTE)
    return "\n\n".join(parts)


def object_rows(tables: Tables) -> Rows:
    """One line per object: counts."""
    head = ["object", "views", "proposed", "right", "not in view", "wrong tint", "mask IoU"]
    rows = [[*head, "expert", "VAP"]]
    for name, part in tables.views.groupby("target", sort=True):
        seen = part[part.counts]
        wrong = part.tinted & (part.elected != part.target)
        right = _right(seen)
        refused = ~right.tinted
        counts = [len(seen), seen.proposed.sum(), len(right), refused.sum(), wrong.sum()]
        cells = [str(name), *(str(int(count)) for count in counts), _mean(seen.mask_iou)]
        if len(tables.episodes):
            of_object = tables.episodes[tables.episodes.object == name]
            can = of_object[of_object.expert]
            cells += [f"{len(can)} of {len(of_object)}", f"{int(can.success.sum())} of {len(can)}"]
        else:
            cells += ["-", "-"]
        rows.append(cells)
    return rows


def group_rows(tables: Tables) -> Rows:
    """All objects, by camera, and by group: shares."""
    head = ["", "proposed", "right", "not in view", "wrong tint", "mask IoU"]
    rows = [
        [*head, "expert", "VAP", "touches first"],
        _shares("all", tables, tables.groups),
    ]
    for camera, part in tables.views.groupby("camera", sort=True):
        cells = _view_cells(part)
        rows.append([f"- {camera} views", *cells, "", "", ""])
    for group in sorted({word for words in tables.groups.values() for word in words}):
        members = [name for name, words in tables.groups.items() if group in words]
        rows.append(_shares(f"- {group}", tables, members))
    return rows


def write_sheets(out: Path) -> list[Path]:
    """Join the pictures of all objects into sheet-01.png and so on. Raises: BadOutput."""
    tiles = []
    for path in sorted((out / "parts").glob("*.png")):
        tiles.append(load_photo(path, long_side=None))
    widest = max((tile.shape[1] for tile in tiles), default=0)
    for i, tile in enumerate(tiles):  # suites differ in cameras
        beside = ((0, 0), (0, widest - tile.shape[1]), (0, 0))
        tiles[i] = np.pad(tile, beside, constant_values=255)
    paths = []
    for first in range(0, len(tiles), TILES):
        path = out / f"sheet-{1 + first // TILES:02}.png"
        write_picture(path, join_tiles(tiles[first : first + TILES], COLUMNS))
        paths.append(path)
    return paths


def _shares(title: str, tables: Tables, members: Iterable[str]) -> list[str]:
    names = list(members)
    cells = _view_cells(tables.views[tables.views.target.isin(names)])
    if not len(tables.episodes):
        return [title, *cells, "-", "-", "-"]
    part = tables.episodes[tables.episodes.object.isin(names)]
    can = part[part.expert]
    return [
        title,
        *cells,
        _share(part.expert, part.object),
        _share(can.success, can.object),
        _share(can.first_object_correct, can.object),
    ]


def _view_cells(part: "pd.DataFrame") -> list[str]:
    seen = part[part.counts]
    right = _right(seen)
    wrong = part.tinted & (part.elected != part.target)
    return [
        _share(seen.proposed, seen.target),
        _share(seen.right, seen.target),
        _share(~right.tinted, right.target),
        _share(wrong, part.target),
        _mean(seen.mask_iou),
    ]


def _right(seen: "pd.DataFrame") -> "pd.DataFrame":
    """The views in which the object is elected, tinted or not."""
    return seen[seen.right.astype("boolean").fillna(False).astype(bool)]


def _share(hits: "pd.Series", clusters: "pd.Series") -> str:
    """The share of hits with its interval, objects as clusters."""
    known = hits.astype("boolean").fillna(False).to_numpy(float)
    return clustered_share(known, clusters).text(digits=0)


def _mean(values: "pd.Series") -> str:
    known = values.dropna().to_numpy(np.float64)
    if not len(known):
        return "-"
    return f"{known.mean():.2f}"
