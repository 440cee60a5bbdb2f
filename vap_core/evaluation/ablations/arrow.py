"""An arrow along the way that the hand has to go, in place of the tint (P tab:ablation_prompt).

It is the paper's trajectory arrow. Where the hand is, the robot's own state and the calibrated
cameras say; nothing of the simulator is read.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Float64

from vap_core.attend import Attender, AttendState, are_shown
from vap_core.base.types import Attended, Camera, Rgb
from vap_core.evaluation.ablations.forms import draw_arrow
from vap_core.rollout.prompters.protocol import PromptContext
from vap_core.rollout.prompters.tint import TintPrompter
from vap_core.simulation.cameras import project
from vap_core.simulation.control import pose_transform
from vap_core.simulation.types import Observation, Pose

FARTHEST_PX = 4096.0
"""A hand that is not in the picture is drawn from at most so far outside it."""


@dataclass(frozen=True)
class Arrow:
    """An arrow from the gripper to the middle of the target, in every view at every step."""


class ArrowPrompter:
    """Grounds and tracks by an `Attender` that tints nothing, and draws the arrow.

    `base_world` is the pose of the robot's base.
    """

    needs_truth: Literal["never", "start", "always"] = "never"
    highlights = True

    def __init__(self, attender: Attender, base_world: Pose) -> None:
        self.follower = TintPrompter(attender)
        self.world_from_base = pose_transform(base_world)

    @property
    def references(self) -> Mapping[str, tuple[Rgb, ...]]:
        return self.follower.references

    def start(
        self, observation: Observation, context: PromptContext
    ) -> tuple[AttendState, Attended]:
        state, attended = self.follower.start(observation, context)
        return state, self._draw(attended, observation, context)

    def steps(
        self,
        states: Sequence[AttendState],
        observations: Sequence[Observation],
        contexts: Sequence[PromptContext],
    ) -> list[tuple[AttendState, Attended]]:
        followed = self.follower.steps(states, observations, contexts)
        results = []
        for (state, attended), observation, context in zip(
            followed, observations, contexts, strict=True
        ):
            results.append((state, self._draw(attended, observation, context)))
        return results

    def _draw(
        self, attended: Attended, observation: Observation, context: PromptContext
    ) -> Attended:
        """The attended images with an arrow to every target that is followed, one to a place."""
        images = dict(attended.images)
        hand_world = self.world_from_base.apply(observation.state[:3].astype(np.float64))
        for camera, tracks in attended.tracks.items():
            start = hand_pixel(context.cameras[camera], hand_world)
            shown = are_shown(tracks)
            for track, is_shown, colour in zip(tracks, shown, attended.colours, strict=True):
                if is_shown and track.mask is not None and start is not None:
                    images[camera] = draw_arrow(images[camera], track.mask, colour, start)
        return replace(attended, images=images)


def hand_pixel(camera: Camera, hand_world: Float64[np.ndarray, "3"]) -> tuple[int, int] | None:
    """The pixel of the gripper's tcp; None behind the camera, where nothing is drawn."""
    xy = project(camera, hand_world[None])[0]
    if not np.isfinite(xy).all():
        return None
    x, y = np.clip(xy, -FARTHEST_PX, FARTHEST_PX)
    return round(float(x)), round(float(y))
