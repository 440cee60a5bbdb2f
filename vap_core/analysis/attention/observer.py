"""Measures the attention of one episode while it runs: a sink of the rollout.

    observer = Observer(header, policy)
    rollout(trial, rows, lambda header: observer)
    observer.tables["calls"]

`calls` has a row per call of the policy, camera and query; `layers` one per query, layer and head,
over the calls before the first touch; `causal` one per explained call, measure and query.
"""

from typing import Any

import numpy as np
from scipy.stats import spearmanr

from vap_core.analysis.attention.measures import (
    GOAL,
    LOOKALIKES,
    REGIONS,
    TARGET,
    Areas,
    inside,
    kind_of,
    measure,
    patch_areas,
)
from vap_core.policies.lerobot.adapter import LeRobot
from vap_core.policies.lerobot.attribution import gradient_maps, masking_maps
from vap_core.policies.protocol import PolicyInput, heat_map
from vap_core.rollout.types import EpisodeHeader, Frame
from vap_core.simulation.types import Outcome

Rows = list[dict[str, Any]]
NOTHING = "nothing"
"""The first touch of an episode that touches nothing."""


class Observer:
    """Collects the measures of one episode; `tables` is complete when the episode is closed.

    `explain` asks for the causal measures of the first call and of the last before the first touch.
    """

    def __init__(self, header: EpisodeHeader, policy: LeRobot, *, explain: bool = False) -> None:
        self.header = header
        self.policy = policy
        self.explain = explain
        self.tables: dict[str, Rows] = {"calls": [], "layers": [], "causal": []}
        self.first_touch: tuple[int, str] | None = None
        self.outcome: Outcome | None = None
        self._heads: dict[str, list[np.ndarray]] = {}
        self._chances: list[np.ndarray] = []
        self._explained: list[tuple[Frame, dict[str, Areas]]] = []

    def frame(self, frame: Frame) -> None:
        """Measure a control step in which the policy was called."""
        self._note_touch(frame)
        if not frame.attention:
            return
        areas = {}
        for camera, of_queries in frame.attention.items():
            side = next(iter(of_queries.values())).shape[-1]
            areas[camera] = patch_areas(self.header.row, frame.truth, camera, side)
            for query, weights in of_queries.items():
                measures = measure(heat_map(weights, query), areas[camera])
                where = {"step": frame.frame_index, "camera": camera, "query": query}
                self.tables["calls"].append({**where, **measures})
        if self.first_touch is None:
            self._add_heads(frame, areas)
            if self.explain:
                self._explained = [*self._explained[:1], (frame, areas)]

    def close(self, outcome: Outcome) -> None:
        """Finish the tables."""
        self.outcome = outcome
        self._finish_layers()
        for frame, areas in self._explained:
            self._explain_call(frame, areas)
        self._explained = []

    def _note_touch(self, frame: Frame) -> None:
        """Keep the step and the region of the first object that is touched, without the goal."""
        if self.first_touch is not None:
            return
        kinds = [kind_of(name, self.header.row) for name in frame.truth.touched]
        touched = [kind for kind in kinds if kind != GOAL]
        if touched:
            first = TARGET if TARGET in touched else touched[0]
            self.first_touch = frame.frame_index, first

    def _add_heads(self, frame: Frame, areas: dict[str, Areas]) -> None:
        """Add what every head has inside the target and the look-alikes, over all views."""
        chance = np.zeros(2)
        for camera in areas:
            chance += [areas[camera][TARGET].mean(), areas[camera][LOOKALIKES].mean()]
        self._chances.append(chance / len(areas))
        totals: dict[str, np.ndarray] = {}
        for camera, of_queries in frame.attention.items():
            for query, weights in of_queries.items():
                totals[query] = totals.get(query, 0) + inside(weights, areas[camera])
        for query, total in totals.items():
            self._heads.setdefault(query, []).append(total)

    def _finish_layers(self) -> None:
        """A row for every query, layer and head: means over the calls before the first touch."""
        for query, calls in self._heads.items():
            total = np.stack(calls)
            shares = (total[..., 1:] / np.maximum(total[..., :1], 1e-12)).mean(0)
            mass = total[..., 0].mean(0)
            chance = np.mean(self._chances, axis=0)
            for layer, head in np.ndindex(*mass.shape):
                row = {"query": query, "layer": layer, "head": head, "calls": len(calls)}
                row["mass"] = float(mass[layer, head])
                for i, region in enumerate((TARGET, LOOKALIKES)):
                    row[f"share_{region}"] = float(shares[layer, head, i])
                    row[f"chance_{region}"] = float(chance[i])
                self.tables["layers"].append(row)

    def _explain_call(self, frame: Frame, areas: dict[str, Areas]) -> None:
        """Compare the attention of a call with the two causal measures of the same call."""
        header = self.header
        rng = np.random.default_rng([header.row.seed, header.row.episode])
        state = self.policy.start(rng)  # as the loop starts it
        policy_input = PolicyInput(frame.prompted, header.rewritten, frame.state)
        maps: dict[str, dict[str, np.ndarray]] = {
            "gradient": gradient_maps(self.policy, state, policy_input),
            "masking": masking_maps(self.policy, state, policy_input),
        }
        for query in next(iter(frame.attention.values())):
            maps[query] = {}
            for camera, of_queries in frame.attention.items():
                maps[query][camera] = heat_map(of_queries[query], query)
        cameras = list(areas)
        for name, of_cameras in maps.items():
            row: dict[str, Any] = {"step": frame.frame_index, "measure": name}
            row |= _all_views(of_cameras, areas, cameras)
            for causal in ("gradient", "masking"):
                row[f"rank_{causal}"] = _rank_correlation(of_cameras, maps[causal], cameras)
            self.tables["causal"].append(row)


def _all_views(
    maps: dict[str, np.ndarray], areas: dict[str, Areas], cameras: list[str]
) -> dict[str, float | bool]:
    """Share inside every region, its area, and the pointing game, over all views."""
    heat = np.stack([maps[camera] for camera in cameras])
    measures: dict[str, float | bool] = {}
    for region in REGIONS:
        area = np.stack([areas[camera][region] for camera in cameras])
        measures[f"share_{region}"] = float((heat * area).sum() / max(float(heat.sum()), 1e-12))
        measures[f"chance_{region}"] = float(area.mean())
        if region == TARGET:
            measures["hit"] = bool(area.flat[int(heat.argmax())] > 0)
            measures["chance_hit"] = float((area > 0).mean())
    return measures


def _rank_correlation(
    one: dict[str, np.ndarray], other: dict[str, np.ndarray], cameras: list[str]
) -> float:
    """Spearman's, over the patches of all views."""
    first = np.concatenate([one[camera].ravel() for camera in cameras])
    second = np.concatenate([other[camera].ravel() for camera in cameras])
    if np.ptp(first) == 0 or np.ptp(second) == 0:
        return 0.0
    return float(spearmanr(first, second).statistic)
