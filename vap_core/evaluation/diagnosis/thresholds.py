"""The thresholds of the diagnosis, and their neighbours, by which its confidence is measured."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

from vap_core.simulation.suites.rules import LIFT_M, MOVED_M


@dataclass(frozen=True)
class Thresholds:
    """Where the rules draw their lines.

    A mask is on the target from `iou` on. A view counts if it shows at least `pixels` of the target
    (of 224 x 224), or highlights something. Prompts are wrong that are wrong in at least `share` of
    the judged steps. A candidate proposes the target from a box IoU of `proposal` on. The target is
    carried when it is held and at least `lift_m` higher. An object is knocked when it has moved by
    `moved_m`. The hand closes on the target when the gripper's command falls below `closed` with
    the tcp within `near_m` of the target's bounding box.
    """

    iou: float = 0.5
    pixels: float = 100.0
    share: float = 0.5
    proposal: float = 0.5
    lift_m: float = LIFT_M
    moved_m: float = MOVED_M
    near_m: float = 0.05
    closed: float = 0.5


THRESHOLDS = Thresholds()
NEIGHBOURS: dict[str, tuple[float, float]] = {
    "iou": (0.35, 0.65),
    "pixels": (50.0, 200.0),
    "share": (0.34, 0.67),
    "proposal": (0.35, 0.65),
    "lift_m": (0.005, 0.02),
    "moved_m": (0.02, 0.05),
    "near_m": (0.03, 0.08),
    "closed": (0.35, 0.65),
}
"""One threshold at a time, stricter and laxer."""


def neighbours(thresholds: Thresholds) -> Iterator[Thresholds]:
    """`thresholds` with one of them changed, twice for each."""
    for name, values in NEIGHBOURS.items():
        for each in values:
            yield replace(thresholds, **{name: each})
