"""Grounding against simulator ground truth: what notebook 02 shows, as tables. The method itself never sees any of it."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from vap_core.attend import Attender
from vap_core.experiments import scripted
from vap_core.rollout import Trial, rollout
from vap_core.segment import iou
from vap_core.sim.env import Env
from vap_core.sim.objects import extent_m, get
from vap_core.sim.scenes import Scene
from vap_core.values import EpisodeRow, Frame, Grounding, Mask, Opening, Outcome

if TYPE_CHECKING:
    import pandas as pd

SEEN = 0.5
"""A candidate shows the object whose true mask it overlaps by more than this IoU."""


def grounding_table(grounding: Grounding, truth: Mapping[str, Mask]) -> "pd.DataFrame":
    """One line per candidate: score, votes, mean cosine, and the true object its mask covers best, with that IoU."""
    import pandas as pd

    lines = []
    for i, mask in enumerate(grounding.masks):
        overlaps = {name: iou(mask, true) for name, true in truth.items()}
        best = max(overlaps, key=lambda name: overlaps[name])
        lines.append(
            {
                "candidate": i, "score": float(grounding.candidates.score[i]), "votes": int(grounding.votes[i]),
                "mean cosine": float(grounding.similarity[i].mean()), "winner": i == grounding.winner, "is": best, "iou": overlaps[best],
            }
        )  # fmt: skip
    return pd.DataFrame(lines)


def survey(attender: Attender, scene: Scene, rows: Sequence[EpisodeRow]) -> "pd.DataFrame":
    """Ground the opening frame of every row; one line per view: proposed, right, margin, mask IoU with the target."""
    import pandas as pd

    lines = []
    for row in rows:
        env = Env(scene)
        env.reset(row)
        _, attended = attender.start(env.observe().images, row.instruction)
        for camera, masks in env.truth(masks=True).masks.items():
            g, true = attended.groundings[camera][0], masks[row.target]
            overlaps = [iou(mask, true) for mask in g.masks]
            won = overlaps[g.winner] if g.winner is not None else 0.0
            lines.append(
                {
                    "episode": row.episode, "camera": camera, "candidates": len(g.candidates), "proposed": max(overlaps, default=0.0) > SEEN,
                    "right": won > SEEN, "votes": int(g.votes.max(initial=0)), "margin": g.margin, "cosine margin": g.cosine_margin, "mask_iou": won,
                }
            )  # fmt: skip
    return pd.DataFrame(lines)


def follow(attender: Attender, scene: Scene, row: EpisodeRow) -> "pd.DataFrame":
    """Run one prompted episode of the scripted policy; a line per step and camera: the target track's IoU with ground truth and its score."""
    import pandas as pd

    lines: list[dict[str, object]] = []

    class Watch:
        def frame(self, frame: Frame) -> None:
            for camera, (track, *_) in frame.tracks.items():
                true = frame.truth.masks[camera][row.target]
                mask = np.zeros_like(true) if track.mask is None else track.mask
                lines.append({"step": frame.frame_index, "camera": camera, "iou": iou(mask, true), "score": track.score, "visible": bool(true.any())})

        def close(self, outcome: Outcome) -> None:
            pass

    def watch(opening: Opening) -> Watch:
        return Watch()

    policy = scripted(attender.stack.detector, scene)
    list(rollout(Trial("vap", scene, policy, attender, {name: extent_m(get(name)) for name in scene.objects}), [row], watch))
    return pd.DataFrame(lines)
