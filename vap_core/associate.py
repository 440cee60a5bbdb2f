"""Cross-view association: the candidate of each view, or none, that together are most probably one and the same object.

Grounded one by one, views can elect different instances, and the policy sees contradictory tints (P appendix, Case 2; left there as
future work). Here one choice per view is made for all views at once, the most probable one (MAP), by enumeration:

    sum_v references(v, i_v)  +  sum_{v < w} pair(v, i_v, w, i_w)

Scores are natural logarithms. "None" (not visible in that view) scores 0, in itself and in every pair; the rest is measured against it.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from math import prod
from typing import Literal

import numpy as np
from jaxtyping import Float32, Float64

from vap_core.errors import BadViews
from vap_core.values import Association, Camera, Grounding, value

Term = Literal["embedding", "hungarian", "geometry"]
Scores = Float64[np.ndarray, "_ _"]
"""One row per candidate of one view, one column per candidate of another."""

MOST_VIEWS, MOST_CHOICES = 4, 10_000_000
"""Enumeration stops being cheap beyond these: views, and combinations of their candidates."""
NEAREST = 1e-3
"""Cosine distances below this count as equal to it: a candidate can be infinitely like its references otherwise."""
HEIGHTS_M = (0.0, 0.08)
"""The middles of things that stand on the table, whose top is z = 0 in the world, lie between these heights."""


@dataclass(frozen=True)
class Pairing:
    """What speaks for two candidates of two views being one object; of several `terms` the mean is taken, as none is independent of the others.

    The numbers are near the greatest conditional likelihood of the true choice, each term by itself, in 114 rendered three-camera scenes of
    generic objects with two twins each (342 views, every tenth box withheld; true boxes, embedded encoder). They do not depend on an encoder's
    scale: `evidence` and `absent` count ratios of cosine distances, `likeness` cosines of what sets a view's candidates apart.
    """

    terms: tuple[Term, ...]
    evidence: float = 3.7
    """A candidate twice as far from the references, in cosine distance, is 2 ** `evidence` times less likely."""
    absent: float = 0.4
    """By itself, the nearest candidate of a view is likelier than none if it is less than exp(`absent`) times as far from the references as the
    nearest of all views, and as likely if it is farther: views differ in how well they see, so that only the others can tell it is another."""
    likeness: float = 5.7
    matched: float = 1.0
    """A pair of the one-to-one matching gains this, any other loses it."""
    sigma_m: float = 0.03
    spread_m: float = 0.08
    """Distances are drawn with `sigma_m` for one object, and as often below `spread_m` as objects stand that close on a table."""
    astray: float = 0.015
    """The share of boxes so cut or so wrong that their middle says nothing."""


@value
class Sighting:
    """What one view has to say about one target: cosines with its k references, embeddings and boxes (pixels) of its n candidates."""

    cosine: Float32[np.ndarray, "n k"]
    embeddings: Float32[np.ndarray, "n d"]
    xyxy: Float32[np.ndarray, "n 4"]
    camera: Camera | None = None


def associate(views: Mapping[str, Sighting], pairing: Pairing) -> Association | None:
    """The most probable choice for `views`, by camera; None where fewer than two have candidates, so that there is nothing to associate.

    As long as `absent` is positive, the target is chosen in at least one view. Equal choices go to the candidates listed first.
    Raises: BadViews, for more views or candidates than can be enumerated, or geometry without calibrated cameras.
    """
    if sum(len(view.xyxy) > 0 for view in views.values()) < 2:
        return None
    names, sights = list(views), list(views.values())
    combinations_of = prod(len(view.xyxy) + 1 for view in sights)
    if len(sights) > MOST_VIEWS or combinations_of > MOST_CHOICES:
        raise BadViews(
            f"associate: {len(sights)} views with {combinations_of} combinations; at most {MOST_VIEWS} views and {MOST_CHOICES} combinations "
            "are enumerated. Give fewer cameras or candidates, or ground views one by one (Prompting.associate=None)."
        )
    singles = references(sights, pairing)
    pairs = {
        term: {(v, w): _with_none(TERMS[term](sights[v], sights[w], pairing)) / len(pairing.terms) for v, w in combinations(range(len(sights)), 2)}
        for term in pairing.terms
    }
    totals = add_up(singles, [scores for of_term in pairs.values() for scores in of_term.items()])
    best = tuple(int(i) for i in np.unravel_index(totals.argmax(), totals.shape))
    terms = {"references": float(sum(single[i] for single, i in zip(singles, best, strict=True)))}
    terms |= {term: float(sum(scores[best[v], best[w]] for (v, w), scores in of_term.items())) for term, of_term in pairs.items()}
    support = [totals.max(axis=tuple(axis for axis in range(totals.ndim) if axis != v)) for v in range(totals.ndim)]
    rival = max(float(np.delete(of_view, i).max(initial=-np.inf)) for of_view, i in zip(support, best, strict=True))
    chosen = {name: None if i == len(view.xyxy) else i for name, view, i in zip(names, sights, best, strict=True)}
    return Association(chosen, float(totals[best]), float(totals[best]) - rival, terms, dict(zip(names, support, strict=True)))


def add_up(singles: Sequence[Float64[np.ndarray, " _"]], pairs: Sequence[tuple[tuple[int, int], Scores]]) -> Float64[np.ndarray, "..."]:
    """The total of every combination: one axis per view, each candidate in turn and none last."""
    totals = np.zeros([len(single) for single in singles])
    for v, single in enumerate(singles):
        totals += single.reshape([-1 if axis == v else 1 for axis in range(totals.ndim)])
    for (v, w), scores in pairs:
        totals += scores.reshape([size if axis in (v, w) else 1 for axis, size in enumerate(totals.shape)])
    return totals


def references(views: Sequence[Sighting], pairing: Pairing) -> list[Float64[np.ndarray, " _"]]:
    """What the references say, per view: `evidence` (log(d_v / d_i) + max(log(d / d_v) + `absent`, 0)), and 0 for none.

    d_i is 1 - the mean cosine of candidate i with the references, d_v the least in its view, d the least in all views.
    """
    distances = [np.maximum(1.0 - view.cosine.astype(np.float64).mean(axis=1), NEAREST) for view in views]
    of_all = min(float(d.min()) for d in distances if len(d))
    seen = [max(float(np.log(of_all / d.min())) + pairing.absent, 0.0) if len(d) else 0.0 for d in distances]
    return [np.append(pairing.evidence * (np.log(d.min(initial=np.inf) / d) + more), 0.0) for d, more in zip(distances, seen, strict=True)]


def embedding(a: Sighting, b: Sighting, pairing: Pairing) -> Scores:
    """How much likelier than by chance each would pick the other as its like: log-softmax of their cosines, both ways, halved.

    The cosine is of what sets a view's candidates apart: their mean (category, light, viewpoint) is taken away first.
    """
    cosine = pairing.likeness * (_apart(a.embeddings) @ _apart(b.embeddings).T)
    if not cosine.size:
        return cosine
    by_a = cosine - np.logaddexp.reduce(cosine, axis=1, keepdims=True) + np.log(cosine.shape[1])
    by_b = cosine - np.logaddexp.reduce(cosine, axis=0, keepdims=True) + np.log(cosine.shape[0])
    return 0.5 * (by_a + by_b)


def hungarian(a: Sighting, b: Sighting, pairing: Pairing) -> Scores:
    """`matched` for the pairs of the one-to-one matching of greatest total cosine: all candidates are distinct objects; minus that for others."""
    from scipy.optimize import linear_sum_assignment

    cosine = a.embeddings.astype(np.float64) @ b.embeddings.astype(np.float64).T
    scores = np.full(cosine.shape, -pairing.matched)
    scores[linear_sum_assignment(cosine, maximize=True)] = pairing.matched
    return scores


def geometry(a: Sighting, b: Sighting, pairing: Pairing) -> Scores:
    """Log ratio of two densities of `apart_m`: for one object a Gaussian of `sigma_m`, but for a share `astray`; for two, `spread_m` wide.

    Raises: BadViews, without calibrated cameras.
    """
    if a.camera is None or b.camera is None:
        raise BadViews("associate: geometry needs calibrated cameras; give Attender.start cameras=..., or pair by 'embedding' or 'hungarian'.")
    near = (pairing.spread_m / pairing.sigma_m) ** 2 * np.exp(-0.5 * (apart_m(a, b) / pairing.sigma_m) ** 2)
    return np.log(pairing.astray + (1 - pairing.astray) * near)


def apart_m(a: Sighting, b: Sighting) -> Scores:
    """Metres between the rays through the middles of two boxes, where they pass each other best at one height within `HEIGHTS_M`; inf for a ray
    that never meets the table.

    Of 2020 candidates with their like in another view (true boxes, opening frames of vlabench, tabletop and generic scenes), the nearest was
    that like for 2019; by the rays' least distance at any height for 1953, as rays also meet in mid-air or below the table; by the feet of the
    boxes on the table for 2016, but those lie 2 to 4 cm apart for one and the same object, and these rays 2 to 4 mm (medians).
    """
    foot_a, lean_a = _rays(a)
    foot_b, lean_b = _rays(b)
    foot, lean = foot_a[:, None] - foot_b, lean_a[:, None] - lean_b
    best = -(foot * lean).sum(-1) / np.maximum((lean**2).sum(-1), 1e-12)
    apart = np.linalg.norm(foot + np.clip(best, *HEIGHTS_M)[..., None] * lean, axis=-1)
    return np.where(np.isfinite(apart), apart, np.inf)


TERMS: dict[Term, Callable[[Sighting, Sighting, Pairing], Scores]] = {"embedding": embedding, "hungarian": hungarian, "geometry": geometry}
"""What can speak for a pair: a score for every candidate of one view with every candidate of another."""

PAIRINGS: dict[str, Pairing] = {**{term: Pairing((term,)) for term in TERMS}, "all": Pairing(tuple(TERMS))}
"""By name, to choose from: each term alone, and all."""


def overrule(grounding: Grounding, choice: int | None) -> Grounding:
    """The grounding with `choice` for its winner; what the vote elected stays beside it."""
    return grounding if choice == grounding.winner else replace(grounding, winner=choice, overruled=grounding.winner)


Case = Literal["right", "nothing", "case 1", "case 2"]


def case(prompted: Mapping[str, str | None], target: str) -> Case:
    """What the views of an episode show (SPEC section 7): `prompted[camera]` is the object that is highlighted there, None where none is.

    "right": every highlighted view shows the target; "case 1": all show one and the same other; "case 2": they contradict each other.
    """
    shown = {name for name in prompted.values() if name is not None}
    if len(shown) > 1:
        return "case 2"
    return "nothing" if not shown else "right" if shown == {target} else "case 1"


def _rays(view: Sighting) -> tuple[Float64[np.ndarray, "n 2"], Float64[np.ndarray, "n 2"]]:
    """Of the ray through each box's middle: the x, y where it meets the table (m), and how far x, y move per metre up; NaN if it never does."""
    assert view.camera is not None
    middle = 0.5 * (view.xyxy[:, :2] + view.xyxy[:, 2:]).astype(np.float64)
    pixels = np.concatenate([middle, np.ones((len(middle), 1))], axis=1)
    rays = pixels @ np.linalg.inv(view.camera.k).T @ view.camera.pose_world[:3, :3].T
    eye = view.camera.pose_world[:3, 3]
    down = np.where(rays[:, 2:] * eye[2] < 0, rays[:, 2:], np.nan)
    lean = rays[:, :2] / down
    return eye[:2] - eye[2] * lean, lean


def _apart(embeddings: Float32[np.ndarray, "n d"]) -> Float64[np.ndarray, "n d"]:
    """Rows of length 1 about their mean; a row that is their mean stays 0."""
    rows = embeddings.astype(np.float64)
    rows -= rows.mean(axis=0) if len(rows) else 0.0
    length = np.linalg.norm(rows, axis=1, keepdims=True)
    return np.where(length > 1e-6, rows / np.maximum(length, 1e-6), 0.0)


def _with_none(scores: Scores) -> Scores:
    return np.pad(scores, ((0, 1), (0, 1)))
