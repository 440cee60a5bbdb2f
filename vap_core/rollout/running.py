"""One episode under way, and where its frames stream to."""

from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol, runtime_checkable

import numpy as np

from vap_core.base.types import Event
from vap_core.policies.hooks import AttentionMap
from vap_core.rollout.late_masks import LateMasks
from vap_core.rollout.types import ConsumedInput, EpisodeHeader, Frame, SubGoalSpan
from vap_core.simulation.env import Env
from vap_core.simulation.homing import Homing
from vap_core.simulation.suites.rules import Judge
from vap_core.simulation.types import EpisodeRow, Outcome


@runtime_checkable
class Sink(Protocol):
    """Where the frames of one episode stream to, a recording for example."""

    def frame(self, frame: Frame) -> None: ...

    def close(self, outcome: Outcome) -> None: ...


@runtime_checkable
class SubGoalSink(Protocol):
    """A sink that also takes what is known of every sub-goal after the first, when it begins."""

    def begin_subgoal(self, header: EpisodeHeader) -> None: ...


@runtime_checkable
class WaitingSink(Protocol):
    """A sink that may drop its episode: its frames come without masks, which it can draw later."""

    def draw_by(self, draw: Callable[[Frame], Frame]) -> None:
        """Take what adds the masks to a frame, until the sink is closed."""
        ...


@dataclass
class RunningEpisode:
    """One episode under way; the only mutable value of the loop.

    `stage` counts its sub-goals, `judge` is that of the present one. `homing` is there while the
    hand returns between two of them.
    """

    row: EpisodeRow
    env: Env
    judge: Judge
    keeps_images: bool
    stage: int = 0
    homing: Homing | None = None
    ended: list[Outcome] = field(default_factory=list)
    """The outcomes of the sub-goals before this one."""
    spans: list[SubGoalSpan] = field(default_factory=list)
    notes: list[Event] = field(default_factory=list)
    """Events of this step that neither judge nor prompter gives."""
    policy_state: Any = None
    prompting: bool = False
    """Whether the prompter has begun, with a state that may be anything."""
    prompter_state: Any = None
    header: EpisodeHeader | None = None
    sink: Sink | None = None
    late: LateMasks | None = None
    """Where the sink draws masks later."""
    queue: deque[np.ndarray] = field(default_factory=deque)
    """Actions of the last chunk that are still to be executed."""
    frames: list[Frame] = field(default_factory=list)
    consumed: list[ConsumedInput] = field(default_factory=list)
    attention: Mapping[str, Mapping[str, AttentionMap]] = field(default_factory=dict)
    """Where the policy looked in this step's call."""
    beyond: int = 0
    """Actions far beyond the robot's speed."""
    seconds: dict[str, float] = field(
        default_factory=lambda: {"attend": 0.0, "policy": 0.0, "record": 0.0}
    )
    outcome: Outcome | None = None

    @property
    def goal(self) -> EpisodeRow:
        """The row of the present sub-goal."""
        return self.judge.row

    @property
    def is_last(self) -> bool:
        """Whether no sub-goal follows."""
        return self.stage == self.row.stages - 1

    @property
    def over(self) -> bool:
        """Whether no action is left to take."""
        return self.homing is None and self.is_last and self.judge.over
