"""The figures of a photo set as text: grounding per object and per kind of scene, and the vote."""

from collections.abc import Iterable
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float64

from vap_core.base.tables import Rows, align
from vap_core.evaluation.perception.estimates import (
    RESAMPLES,
    Estimate,
    clustered_share,
)

if TYPE_CHECKING:
    import pandas as pd

RIGHT_IOU, LOOSE_IOU = 0.5, 0.25
NOTE = (
    "value [95 % interval] n, in %; Wilson's interval with n reduced to what the scenes, which are "
    "the independent units, are worth.\n"
    "right: the tinted box overlaps the object by IoU .5; proposed: some candidate does. wrong: "
    "another box is tinted. silent: nothing is; not in view: of the rightly elected, those too "
    "unlike the references to be tinted. look-alikes: other objects of its kind in the "
    "scene.\n"
    "vote: the true boxes of a scene are the candidates; with one reference (the mean over them) "
    "and with all."
)


def text_report(table: "pd.DataFrame") -> str:
    """What the command prints."""
    seconds = f"ms a photo: median {table.ms.median():.0f}, slowest {table.ms.max():.0f}"
    if "cpu_ms" in table:
        cpu = table.cpu_ms
        seconds += f"; of CPU: median {cpu.median():.0f}, slowest {cpu.max():.0f}"
    parts = [align(object_rows(table)), align(scene_rows(table)), align(vote_rows(table))]
    return "\n\n".join([*parts, f"{seconds}\n{NOTE}"])


def clip_report(clips: "pd.DataFrame") -> str:
    """What became of the objects in clips made of the scenes."""
    if not len(clips):
        return "clips: no object with references is in view in any scene"
    rows = [["clips", "on the object", "on its twin", "elsewhere", "no mask"]]
    cells = []
    for end in ("object", "twin", "other", ""):
        cells.append(_share(clips.end == end, clips))
    rows.append(["at the end", *cells])
    in_view, on_object = int(clips.in_view.sum()), int(clips.on_object.sum())
    on_twin, frames = int(clips.on_twin.sum()), int(clips.frames.sum())
    return (
        f"{align(rows)}\n\nclips: the object's mask in {on_object} of {in_view} frames that show "
        f"it, its twin's in {on_twin} of {frames} frames. The window pans from a photo to a copy "
        "of it and back; the tracker starts from the true boxes."
    )


def mask_report(masks: "pd.DataFrame") -> str:
    """How well the true masks are met from true boxes; the interval resamples scenes."""
    if not len(masks):
        return ""
    estimate = clustered_mean(masks.mask_iou.to_numpy(np.float64), masks.scene)
    return f"masks from true boxes: mean IoU {estimate.text(scale=1.0, digits=2)}"


def single_report(single: "pd.DataFrame") -> str:
    """How often three references elect a left-out photo of their object among two others'."""
    if not len(single):
        return ""
    found = clustered_share(single.right.to_numpy(float), single.object)
    by_object = single.groupby("object").right.mean()
    return (
        f"photos of one object: three references elect a left-out one among photos of two others "
        f"in {found.text()} elections of {len(by_object)} objects, which are the independent "
        f"units; worst: {by_object.idxmin()}, {100 * by_object.min():.0f}"
    )


def clustered_mean(values: Float64[np.ndarray, " n"], clusters: Iterable[object]) -> Estimate:
    """The mean, and percentiles of it when whole clusters are drawn again, seeded."""
    _, number = np.unique([str(name) for name in clusters], return_inverse=True)
    sums = np.bincount(number, values)
    counts = np.bincount(number).astype(np.float64)
    low = high = float("nan")
    if len(sums) > 1:
        share = np.full(len(sums), 1 / len(sums))
        times = np.random.default_rng(0).multinomial(len(sums), share, RESAMPLES)
        low, high = np.percentile(times @ sums / (times @ counts), [2.5, 97.5]).tolist()
    return Estimate(value=float(values.mean()), low=low, high=high, n=len(values))


def object_rows(table: "pd.DataFrame") -> Rows:
    """One line per object, and one for all: counts."""
    rows = [
        ["object", "kind", "in view", "right", "IoU .25", "wrong", "silent", "absent", "tinted"]
    ]
    for (name, kind), part in table.groupby(["object", "category"], sort=True):
        rows.append([str(name), str(kind), *_counts(part)])
    rows.append(["all", "", *_counts(table)])
    return rows


def scene_rows(table: "pd.DataFrame") -> Rows:
    """One line per kind of scene: with the object and without, with look-alikes and without."""
    head = ["scenes", "proposed", "right", "right at IoU .25", "wrong tinted", "silent"]
    rows = [[*head, "not in view"]]
    seen, absent = table[table.present], table[~table.present]
    kinds = (
        ("object in view", seen),
        ("- beside look-alikes", seen[seen.lookalikes > 0]),
        ("- alone of its kind", seen[seen.lookalikes == 0]),
        ("object absent", absent),
        ("- look-alikes in view", absent[absent.lookalikes > 0]),
        ("- none of its kind", absent[absent.lookalikes == 0]),
    )
    for number, (name, part) in enumerate(kinds):
        right = part.iou >= RIGHT_IOU
        measures = [part.proposed_iou >= RIGHT_IOU, right, part.iou >= LOOSE_IOU]
        cells = [_share(hits, part) for hits in measures]
        if number >= 3:
            cells = ["", "", ""]
        cells += [_share(part.tinted & ~right, part), _share(~part.tinted, part)]
        elected = part[part.chosen_iou.astype(float).fillna(0) >= RIGHT_IOU]
        price = _share(~elected.tinted, elected)
        rows.append([name, *cells, price if number < 3 else ""])
    return rows


def vote_rows(table: "pd.DataFrame") -> Rows:
    """How the vote does among the true boxes of a scene."""
    rows = [["vote among", "boxes", "chance", "one reference", "all references"]]
    for among, name in (("all", "all true boxes"), ("kind", "those of its kind")):
        cells = [name]
        known = table
        if f"{among}_boxes" in table:
            known = table.dropna(subset=[f"{among}_boxes"])
        if f"{among}_boxes" not in table or not len(known):
            rows.append([*cells, "-", "-", "-", "-"])
            continue
        boxes = known[f"{among}_boxes"].to_numpy(float)
        cells += [f"{boxes.mean():.1f}", f"{100 * (1 / boxes).mean():.0f}"]
        for column in (f"{among}_one", f"{among}_every"):
            cells.append(_share(known[column], known))
        rows.append(cells)
    return rows


def _share(hits: "pd.Series", part: "pd.DataFrame") -> str:
    """The share of hits with its interval, scenes as clusters."""
    return clustered_share(hits.to_numpy(float), part.scene).text(digits=0)


def _counts(part: "pd.DataFrame") -> list[str]:
    """In view, right, right at IoU .25, wrong, silent; absent, tinted all the same."""
    seen, absent = part[part.present], part[~part.present]
    wrong = seen.tinted & (seen.iou < RIGHT_IOU)
    counts = (
        len(seen),
        (seen.iou >= RIGHT_IOU).sum(),
        (seen.iou >= LOOSE_IOU).sum(),
        wrong.sum(),
        (~seen.tinted).sum(),
        len(absent),
        absent.tinted.sum(),
    )
    return [str(int(count)) for count in counts]
