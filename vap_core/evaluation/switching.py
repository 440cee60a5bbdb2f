"""What a robot does when the tint changes sides (prompters.switch): if it follows, and how soon."""

from typing import TYPE_CHECKING, Any

import numpy as np

from vap_core.evaluation.statistics import rate_over_layouts
from vap_core.rollout.prompters.switch import SWITCHED
from vap_core.rollout.types import Episode, Frame
from vap_core.simulation import robots
from vap_core.simulation.robots import Robot
from vap_core.simulation.suites import suite

if TYPE_CHECKING:
    import pandas as pd


def columns(episode: Episode) -> dict[str, Any]:
    """What a results table keeps of an episode whose tint was switched; nothing of any other.

    `switched_s` is when. `turned_s` is how long after it the gripper was nearer to the object that
    is tinted now than to the target, across the table; None where it never was, and where it was so
    already at the switch. `obeyed` says whether the robot touched that object afterwards.
    """
    switch = _switch(episode)
    if switch is None:
        return {}
    first, rival = switch
    frames = episode.frames[first:]
    target = episode.header.row.target
    robot = robots.get(suite(episode.header.row.suite).robot)
    turned_s = None
    for frame in frames:
        if _away_m(robot, frame, rival) < _away_m(robot, frame, target):
            if frame is not frames[0]:
                turned_s = frame.timestamp_s - frames[0].timestamp_s
            break
    obeyed = any(rival in frame.truth.touched for frame in frames[1:])
    return {"switched_s": frames[0].timestamp_s, "turned_s": turned_s, "obeyed": obeyed}


def switching_lines(episodes: "pd.DataFrame") -> list[str]:
    """What the robot did, by suite and method; of a table without such episodes nothing.

    The interval of `obeyed` is over layouts where one returns, else Wilson's. Tables of earlier
    versions have `turned_s` 0 where the gripper was nearer to the other object already at the
    switch; that hand did not turn.
    """
    if "switched_s" not in episodes:
        return []
    lines = []
    switched = episodes[episodes["switched_s"].notna()]
    for (name, method), part in switched.groupby(["suite", "method"], sort=False):
        turned = part["turned_s"].dropna().astype(float)
        turned = turned[turned > 0]
        obeyed = rate_over_layouts(part, "obeyed")
        line = f"{name} {method}: switched in {len(part)} episodes, obeyed in {obeyed}"
        if len(turned):
            line += f"; the hand turned in {len(turned)}, "
            line += f"median {turned.median():.1f} s after the switch"
        lines.append(line)
    return lines


def _switch(episode: Episode) -> tuple[int, str] | None:
    """The frame in which the tint was switched, and the object that it was switched to.

    A switch in the last frame is none: no action follows it.
    """
    for i, frame in enumerate(episode.frames[:-1]):
        for event in frame.events:
            if event.text.startswith(SWITCHED):
                return i, event.text.removeprefix(SWITCHED)
    return None


def _away_m(robot: Robot, frame: Frame, name: str) -> float:
    """From the gripper to an object, across the table."""
    from scipy.spatial.transform import Rotation

    base_from_tcp = frame.state[:3].astype(float)
    turn = Rotation.from_quat(robot.base_world[3:], scalar_first=True)
    tcp_world = turn.apply(base_from_tcp) + robot.base_world[:3]
    return float(np.hypot(*(tcp_world - frame.truth.objects_world[name][:3])[:2]))
