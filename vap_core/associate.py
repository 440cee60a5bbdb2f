"""Cross-view association: the candidates of all views that are most probably one object.

Grounded one by one, views can elect different instances, and the policy sees contradictory tints (P
appendix, Case 2; left there as future work). Here one choice per view is made for all views at
once, the most probable one (MAP), by enumeration:

    sum_v references(v, i_v)  +  sum_{v < w} pair(v, i_v, w, i_w)

Scores are natural logarithms. Every view's likest candidate scores 0; "none" (not visible in that
view) scores 0 in every pair.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import combinations
from typing import Literal

import numpy as np
from jaxtyping import Float32, Float64

from vap_core.base.errors import BadViews
from vap_core.base.types import SAME, Association, Camera, Grounding, election_scores, value

Scores = Float64[np.ndarray, "_ _"]
"""One row per candidate of one view, one column per candidate of another."""
PairScores = dict[tuple[int, int], Scores]
"""The scores of pairs by the numbers of the two views, a last row and column for none."""
ViewScores = Float64[np.ndarray, " _"]
"""One score per candidate of a view, and last that of none."""

MOST_VIEWS = 4
MOST_COMBINATIONS = 10_000_000
"""Limits of the enumeration: views, and combinations of their candidates."""
NEAREST = 1e-3
"""Cosine distances below this count as equal to it, so that their logarithm stays finite."""
ROUNDED = 5e-3
"""How far a rotation that was rounded to three decimals may be from one."""
HIGHEST_M = 20.0
"""A camera higher above the table than this has a pose in other units."""
HEIGHTS_M = (0.0, 0.08)
"""The centres of objects that stand on the table (z = 0 in the world) lie between these heights."""

EVIDENCE = 6.0
"""A candidate twice as far from the references, in cosine distance, is 2 ** `EVIDENCE` times less
likely. Ratios of distances do not depend on an encoder's scale."""
RELIANCE = 3.0
"""How much less the references tell its candidates apart in a view that is less like them: by the
least distance in all views over that in this one, to this power. (A wrist camera looks from above,
as few references do.)"""
HIDDEN, SLACK = 0.5, 0.1
"""None of a view scores this share of its candidates' mean, less `SLACK`."""
SIGMA_M, SPREAD_M = 0.03, 0.08
"""Distances between rays have deviation `SIGMA_M` for one object, and are as often below `SPREAD_M`
as objects stand that close on a table."""
ASTRAY = 0.015
"""The share of boxes so cut or so wrong that their centres carry no evidence."""


@value
class Sighting:
    """One view's candidates for one target.

    They have cosines with its k references, and boxes (pixels).
    """

    cosine: Float32[np.ndarray, "n k"]
    xyxy: Float32[np.ndarray, "n 4"]
    camera: Camera | None = None


def associate_targets(
    groundings: Mapping[str, tuple[Grounding, ...]], cameras: Mapping[str, Camera]
) -> tuple[dict[str, tuple[Grounding, ...]], tuple[Association | None, ...]]:
    """Let the views agree on each target, one target at a time.

    `groundings[camera][j]` is of target j.

    Raises: as `associate`; BadViews, when a view has no camera although geometry needs one, or one
        that is calibrated for another image size or cannot see the table.
    """
    _check_poses(groundings, cameras)
    chosen: dict[str, tuple[Grounding, ...]] = dict.fromkeys(groundings, ())
    associations: list[Association | None] = []
    n_targets = len(next(iter(groundings.values())))
    for j in range(n_targets):
        sightings = {}
        for camera, per_target in groundings.items():
            _check_calibration(camera, per_target[j], cameras)
            boxes = per_target[j].candidates
            sightings[camera] = Sighting(
                cosine=election_scores(per_target[j].similarity, boxes),
                xyxy=boxes.xyxy,
                camera=cameras.get(camera),
            )
        association = associate(sightings)
        associations.append(association)
        for camera, per_target in groundings.items():
            grounding = per_target[j]
            if association is not None:
                grounding = overrule(grounding, association.chosen[camera])
            chosen[camera] = (*chosen[camera], grounding)
    return chosen, tuple(associations)


def associate(views: Mapping[str, Sighting]) -> Association | None:
    """The most probable choice for `views`, by camera.

    None where fewer than two have candidates, or two objects are equally probable.

    Raises: BadViews, for more views or candidates than can be enumerated, or for geometry without
        calibrated cameras.
    """
    sightings = list(views.values())
    if sum(len(view.xyxy) > 0 for view in sightings) < 2:
        return None
    _check_size(sightings)

    singles = references(sightings)
    pairs = {}
    for v, w in combinations(range(len(sightings)), 2):
        scores = geometry(sightings[v], sightings[w])
        pairs[v, w] = np.pad(scores, ((0, 1), (0, 1)))
    totals = total_scores(singles, pairs)
    place = np.unravel_index(totals.argmax(), totals.shape)
    best = tuple(map(int, place))

    chosen: dict[str, int | None] = {}
    support: dict[str, ViewScores] = {}
    for v, (name, view) in enumerate(views.items()):
        choice = best[v]
        chosen[name] = None if choice == len(view.xyxy) else choice
        of_view = np.moveaxis(totals, v, 0).reshape(totals.shape[v], -1)
        support[name] = of_view.max(axis=1)
    total = float(totals[best])
    margin = total - _best_other_object(totals, best)
    if margin <= SAME:
        return None
    return Association(
        chosen=chosen,
        total=total,
        margin=margin,
        terms={
            "references": sum(float(single[i]) for single, i in zip(singles, best, strict=True)),
            "geometry": sum(float(s[best[v], best[w]]) for (v, w), s in pairs.items()),
        },
        support=support,
    )


def _best_other_object(totals: Float64[np.ndarray, "..."], best: Sequence[int]) -> float:
    """The best total of a combination that shares no candidate with the `best` one."""
    others = totals
    for v, choice in enumerate(best):
        is_candidate = choice < totals.shape[v] - 1
        if is_candidate:
            others = np.delete(others, choice, axis=v)
    return float(others.max())


def total_scores(singles: Sequence[ViewScores], pairs: PairScores) -> Float64[np.ndarray, "..."]:
    """The total of every combination: one axis per view, each candidate in turn and none last."""
    sizes = list(map(len, singles))
    totals = np.zeros(sizes)
    for v, single in enumerate(singles):
        shape = np.ones(totals.ndim, int)
        shape[v] = -1
        totals += single.reshape(shape)
    for (v, w), scores in pairs.items():
        shape = np.ones(totals.ndim, int)
        shape[[v, w]] = scores.shape
        totals += scores.reshape(shape)
    return totals


def references(views: Sequence[Sighting]) -> list[ViewScores]:
    """The references' evidence for the candidates of every view, and the score of none.

    It is `EVIDENCE` (d / d_v) ** `RELIANCE` log(d_v / d_i): d_i is candidate i's distance, the
    geometric mean of 1 - its mean cosine and 1 - its greatest; d_v is the least in its view, d the
    least in all views.
    """
    distances = []
    for view in views:
        cosine = view.cosine.astype(np.float64)
        to_all = np.maximum(1.0 - cosine.mean(axis=1), NEAREST)
        to_likest = np.maximum(1.0 - cosine.max(axis=1), NEAREST)
        distances.append(np.sqrt(to_all * to_likest))
    least = min(float(d.min()) for d in distances if len(d))
    scores = []
    for d in distances:
        nearest = d.min(initial=np.inf)
        of_view = EVIDENCE * (least / nearest) ** RELIANCE * np.log(nearest / d)
        none = HIDDEN * float(of_view.mean()) - SLACK if len(d) else 0.0
        scores.append(np.append(of_view, none))
    return scores


def geometry(a: Sighting, b: Sighting) -> Scores:
    """Log ratio of two densities of `ray_distance_m`, less its greatest value.

    For one object a Gaussian of `SIGMA_M`, but for a share `ASTRAY`; for two, `SPREAD_M` wide.
    Geometry only speaks against pairs: an object that fewer views show has no disadvantage.

    Raises: BadViews, without calibrated cameras.
    """
    if a.camera is None or b.camera is None:
        raise BadViews(
            "associate: needs calibrated cameras; give Attender.start cameras=..., or ground every "
            "view by itself (Prompting.associate=False)."
        )
    gaussian = np.exp(-0.5 * (ray_distance_m(a, b) / SIGMA_M) ** 2)
    densest = (1 - ASTRAY) * (SPREAD_M / SIGMA_M) ** 2
    return np.log((ASTRAY + densest * gaussian) / (ASTRAY + densest))


def ray_distance_m(a: Sighting, b: Sighting) -> Scores:
    """Least distance between the rays through the centres of two boxes, in metres.

    Both rays are taken at one height within `HEIGHTS_M`; inf for a ray that never meets the table.

    Of 2020 candidates visible in two views (true boxes, first frames of vlabench, tabletop and
    generic scenes), the nearest candidate of the other view was the same object for 2019; by the
    rays' least distance at any height for 1953, as rays also meet in mid-air or below the table; by
    the feet of the boxes on the table for 2016, but those lie 2 to 4 cm apart for the same object,
    and these rays 2 to 4 mm (medians).
    """
    foot_a, slope_a = _rays(a)
    foot_b, slope_b = _rays(b)
    foot = foot_a[:, None] - foot_b
    slope = slope_a[:, None] - slope_b
    best = -(foot * slope).sum(-1) / np.maximum((slope**2).sum(-1), 1e-12)
    height = np.clip(best, *HEIGHTS_M)
    distance = np.linalg.norm(foot + height[..., None] * slope, axis=-1)
    return np.where(np.isfinite(distance), distance, np.inf)


def overrule(grounding: Grounding, choice: int | None) -> Grounding:
    """The grounding with `choice` for its winner; its ballot stays as it was."""
    return replace(grounding, winner=choice)


ViewsVerdict = Literal["right", "nothing", "case 1", "case 2"]


def compare_views(prompted: Mapping[str, str | None], target: str) -> ViewsVerdict:
    """What the views of an episode show (SPEC section 7).

    `prompted[camera]` is the object that is highlighted there, None where none is. "right": every
    highlighted view shows the target; "case 1": all show one and the same other object; "case 2":
    they contradict each other.
    """
    shown = {name for name in prompted.values() if name is not None}
    if len(shown) > 1:
        return "case 2"
    if not shown:
        return "nothing"
    return "right" if shown == {target} else "case 1"


def _check_calibration(camera: str, grounding: Grounding, cameras: Mapping[str, Camera]) -> None:
    if camera not in cameras:
        return
    known = cameras[camera]
    height, width = grounding.masks.shape[1:]
    if (known.height, known.width) != (height, width):
        raise BadViews(
            f"Attender.start: camera {camera!r} is calibrated for {known.width}x{known.height} "
            f"pixels, but its view has {width}x{height}; scale its k, or the view."
        )


def _check_poses(
    groundings: Mapping[str, Sequence[Grounding]], cameras: Mapping[str, Camera]
) -> None:
    """Raises: BadViews: of two views or more that have candidates, one has no camera, or one of a
    pose that cannot be; or all look away from the table. (A hand may look up for a while.)
    """
    views = [
        view
        for view, per_target in groundings.items()
        if any(len(grounding.candidates) for grounding in per_target)
    ]
    if len(views) < 2:
        return
    missing = [view for view in views if view not in cameras]
    if missing:
        raise BadViews(
            f"associate: needs calibrated cameras; give Attender.start cameras=... for "
            f"{', '.join(missing)} (given: {', '.join(cameras) or 'none'}), or ground every view "
            "by itself (Prompting.associate=False)."
        )
    faults = {view: _pose_fault(cameras[view]) for view in views}
    if not any(faults.values()) and all(_looks_away(cameras[view]) for view in views):
        faults[views[0]] = "looks away from the table, as all do"
    for view, fault in faults.items():
        if fault:
            raise BadViews(
                f"Attender.start: camera {view!r} {fault}; pose_world maps the camera (OpenCV "
                "axes: x right, y down, z ahead) to the world, in metres, with the table at z = 0."
            )


def _pose_fault(camera: Camera) -> str:
    """Why a camera cannot stand as its pose says, "" where it can."""
    pose = camera.pose_world
    if (np.shape(camera.k), np.shape(pose)) != ((3, 3), (4, 4)):
        return "has a k that is not 3 x 3, or a pose_world that is not 4 x 4"
    if not (np.isfinite(pose).all() and np.isfinite(camera.k).all()):
        return "has numbers that are not finite"
    if np.linalg.matrix_rank(camera.k) < 3:
        return "has a k that cannot be inverted"
    rotation = pose[:3, :3]
    is_rotation = np.allclose(rotation @ rotation.T, np.eye(3), atol=ROUNDED)
    if not is_rotation or np.linalg.det(rotation) < 0:
        return "has a pose_world without a rotation"
    height_m = float(pose[2, 3])
    if not 0 < height_m < HIGHEST_M:
        return f"stands {height_m:g} m above the table"
    return ""


def _looks_away(camera: Camera) -> bool:
    """Whether no ray of a camera above the table meets it."""
    corners = np.array([[x, y] for x in (0.0, camera.width) for y in (0.0, camera.height)])
    return bool((_directions(camera, corners)[:, 2] >= 0).all())


def _check_size(sightings: Sequence[Sighting]) -> None:
    size = 1
    for view in sightings:
        size *= len(view.xyxy) + 1
    if len(sightings) > MOST_VIEWS or size > MOST_COMBINATIONS:
        raise BadViews(
            f"associate: {len(sightings)} views with {size} combinations; at most {MOST_VIEWS} "
            f"views and {MOST_COMBINATIONS} combinations are enumerated. Give fewer cameras or "
            "candidates, or ground views one by one (Prompting.associate=False)."
        )


def _rays(view: Sighting) -> tuple[Float64[np.ndarray, "n 2"], Float64[np.ndarray, "n 2"]]:
    """The ray through each box's centre: where it meets the table, and its slope.

    The first are x, y (m), the second x, y per metre of height. NaN where it never meets the table.
    """
    assert view.camera is not None
    centre = 0.5 * (view.xyxy[:, :2] + view.xyxy[:, 2:]).astype(np.float64)
    rays = _directions(view.camera, centre)
    eye = view.camera.pose_world[:3, 3]
    down = np.where(rays[:, 2:] * eye[2] < 0, rays[:, 2:], np.nan)
    slope = rays[:, :2] / down
    return eye[:2] - eye[2] * slope, slope


def _directions(camera: Camera, pixels: Float64[np.ndarray, "n 2"]) -> Float64[np.ndarray, "n 3"]:
    """The rays through some pixels in the world, of any length."""
    homogeneous = np.concatenate([pixels, np.ones((len(pixels), 1))], axis=1)
    return homogeneous @ np.linalg.inv(camera.k).T @ camera.pose_world[:3, :3].T
