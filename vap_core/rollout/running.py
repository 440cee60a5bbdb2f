"""An episode while it runs: its sub-goals, its expert, and masks that are drawn only when needed.

An episode that is dropped unless it fails keeps its states, a few kilobytes a step; the simulator
draws the true masks from them.
"""

from collections import deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal, Protocol, runtime_checkable

import numpy as np

from vap_core.base.types import Event
from vap_core.environments.protocol import Environment
from vap_core.policies.protocol import AttentionMap, Policy, PrivilegedPolicy
from vap_core.policies.scripted.expert import Expert, ExpertState
from vap_core.rollout.types import ConsumedInput, EpisodeHeader, Frame, SubGoalSpan
from vap_core.simulation import homing
from vap_core.simulation.env import Env, Snapshot
from vap_core.simulation.homing import Homing
from vap_core.simulation.suites.rules import Judge
from vap_core.simulation.types import Action, EpisodeRow, Outcome, of_subgoals


class LateMasks:
    """The states of one episode's steps; `make_env` makes an environment to draw them in."""

    def __init__(self, make_env: Callable[[], Environment]) -> None:
        self._make_env = make_env
        self._env: Env | None = None
        self._snapshots: dict[int, Snapshot] = {}

    def keep(self, frame_index: int, snapshot: Snapshot) -> None:
        """Keep the state of a step whose masks are wanted later."""
        self._snapshots[frame_index] = snapshot

    def draw(self, frame: Frame) -> Frame:
        """The frame with its masks; one whose state was not kept stays as it is."""
        snapshot = self._snapshots.pop(frame.frame_index, None)
        if snapshot is None:
            return frame
        if self._env is None:
            env = self._make_env()
            assert isinstance(env, Env)
            self._env = env
        self._env.restore(snapshot)
        drawn = self._env.truth(masks=True)
        return replace(frame, truth=replace(frame.truth, masks=drawn.masks, hand=drawn.hand))


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
    env: Environment
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


type AnyPolicy = Policy[Any] | PrivilegedPolicy[Any]


def next_subgoal(episode: RunningEpisode, policy: AnyPolicy) -> None:
    """Where a sub-goal is over and another follows: bring the hand home, then begin that one.

    It is grounded again, on the scene as it is then, and the policy begins anew.
    """
    if episode.homing is None:
        if episode.is_last or not episode.judge.over:
            return
        ended = episode.judge.outcome()
        episode.ended.append(ended)
        step = episode.judge.steps
        text = f"sub-goal {episode.stage + 1} of {episode.row.stages} ends: {ended.status}"
        episode.notes.append(Event(step, "INFO" if ended.success else "WARN", text))
        episode.homing = homing.begin(_own(episode))
        episode.prompting = False
    else:
        episode.homing = homing.advance(episode.homing, _own(episode))
    episode.queue.clear()
    if episode.homing.part != "there":
        episode.queue.append(homing.action(episode.homing, _own(episode)))
        return
    episode.homing = None
    episode.stage += 1
    row = episode.row.at(episode.stage)
    _own(episode).pursue(row)
    first = episode.judge.steps
    episode.judge = Judge.start(row, episode.judge.sizes_m, episode.env.truth(), first)
    episode.notes.append(begins(episode))
    rng = np.random.default_rng([row.seed, row.episode, episode.stage])
    episode.policy_state = policy.start(rng)


def _own(episode: RunningEpisode) -> Env:
    """Only our own suites have sub-goals."""
    assert isinstance(episode.env, Env)
    return episode.env


def begins(episode: RunningEpisode) -> Event:
    number = f"{episode.stage + 1} of {episode.row.stages}"
    text = f'sub-goal {number} begins: "{episode.goal.instruction}"'
    return Event(episode.judge.steps, "INFO", text)


def subgoal_number(episode: RunningEpisode) -> int | None:
    """Frame.subgoal."""
    if not episode.row.subgoals:
        return None
    return 0 if episode.homing is not None else episode.stage + 1


def ending(
    episode: RunningEpisode, status: Literal["error"] | None = None, detail: str = ""
) -> Outcome:
    """How the episode ended; of several sub-goals, how each did."""
    last = episode.judge.outcome(status, detail)
    if not episode.row.subgoals:
        return last
    if episode.homing is None:
        return of_subgoals([*episode.ended, last], episode.row.stages, episode.judge.steps)
    # On the way home no sub-goal is under way: those that ended stay as they are.
    whole = of_subgoals(episode.ended, episode.row.stages, episode.judge.steps)
    return replace(whole, status=last.status, success=False, detail=last.detail)


def expert_steps(
    env: Env,
    row: EpisodeRow,
    expert: Expert,
    state: ExpertState,
    disturb: Callable[[Action], Action] | None = None,
) -> Iterator[tuple[Judge, Action | None]]:
    """Yield the judge and the planned action before every step, and last the final judge with None.

    `env` stands at the start of `row`. The action is executed, changed by `disturb` if there is
    one, when the next step is asked for.

    Raises: OutOfReach.
    """
    sizes = {place.model: env.scene.sizes_m[place.model] for place in row.placements}
    judge = Judge.start(row, sizes, env.truth())
    while not judge.done and judge.steps < row.max_steps:
        (state,), (chunk,) = expert.plan_from_simulation([state], [env])
        action = chunk[0].astype(np.float32)
        yield judge, action
        env.step(action if disturb is None else disturb(action))
        judge = judge.step(env.truth())
    yield judge, None
