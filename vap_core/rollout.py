"""The closed loop: physics, render, attend, policy, chunked actions, for a batch of episodes at once.

Nothing here records or measures success beyond what the suite's judge says; sinks and tables read the values it makes.
"""

import time
import traceback
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, field
from typing import Any, Literal, Protocol, runtime_checkable

import numpy as np

from vap_core import audit
from vap_core.attend import Attender
from vap_core.errors import BadAction, OutOfReach, VapError
from vap_core.hard_prompt import Reworded
from vap_core.oracle import Revealed
from vap_core.policies import Insider, Policy, attention
from vap_core.shown import shown
from vap_core.sim.env import Control, Env
from vap_core.sim.occluder import Occlusion
from vap_core.sim.scenes import Scene
from vap_core.sim.sensor import PERFECT, Sensor
from vap_core.suites import Judge
from vap_core.values import Attended, Call, Chunk, Episode, EpisodeRow, Frame, Opening, Outcome, PolicyInput


@runtime_checkable
class Sink(Protocol):
    """Where the frames of one episode stream to, a recording for example."""

    def frame(self, frame: Frame) -> None: ...

    def close(self, outcome: Outcome) -> None: ...


Follow = Literal["call", "step"]


@dataclass(frozen=True)
class Trial:
    """What a batch of episodes shares. `attender` None is the generic policy: raw images, raw instruction; a Revealed reads the simulator.

    An Insider needs no pictures; it gets them every `images_every` control steps all the same (0: never), for their cost or their look.
    `follow` is when images are taken and targets tracked: at the policy's calls, which is all it ever sees, or at every control step.
    `audit` keeps what the policy consumed in every call (module audit); `attention` where it looked, for the sink (policies.attention).
    """

    method: str
    scene: Scene
    policy: Policy[Any] | Insider[Any]
    attender: Attender | Reworded | Revealed | None
    sizes_m: Mapping[str, tuple[float, float, float]]
    control: Control = "ee"
    sensor: Sensor = PERFECT
    images_every: int = 0
    occlusion: Occlusion | None = None
    follow: Follow = "step"
    audit: bool = False
    attention: bool = False


@dataclass
class Running:
    """One episode under way; the only mutable thing in the loop."""

    row: EpisodeRow
    env: Env
    policy_state: Any
    judge: Judge
    sink: Sink | None
    watched: bool
    opening: Opening | None = None
    attend_state: Any = None
    queue: deque[np.ndarray] = field(default_factory=deque)
    frames: list[Frame] = field(default_factory=list)
    calls: list[Call] = field(default_factory=list)
    looked: Mapping[str, attention.Heat] = field(default_factory=dict)
    """Where the policy looked in this step's call."""
    seconds: dict[str, float] = field(default_factory=lambda: dict.fromkeys(("attend", "policy", "record"), 0.0))
    outcome: Outcome | None = None


def rollout(
    trial: Trial, rows: Sequence[EpisodeRow], sink: Callable[[Opening], Sink] | None = None, *, batch: int = 4, keep_images: bool = False
) -> Iterator[Episode]:
    """Run every row once and yield its episode when it is over; the result does not depend on `batch`.

    An exception inside an episode ends that episode with status "error" and its traceback in `detail`; the others go on.
    Images are kept in the frames only with `keep_images`; a sink gets them all the same.
    """
    for first in range(0, len(rows), batch):
        running = [_begin(trial, row, sink is not None or keep_images) for row in rows[first : first + batch]]
        while any(one.outcome is None for one in running):
            live = [one for one in running if one.outcome is None]
            seen = _see(trial, live, sink)
            live = [one for one in live if one.outcome is None]
            _plan(trial, live, seen)
            for one in live:
                if one.outcome is None:
                    _guard(one, _act, one, *seen[id(one)], keep_images, trial.attender is not None and trial.attender.highlights)
        for one in running:
            yield _end(trial, one)


def _begin(trial: Trial, row: EpisodeRow, watched: bool) -> Running:
    env = Env(trial.scene, cameras=row.cameras or None, control=trial.control, sensor=trial.sensor, occlusion=trial.occlusion)
    env.reset(row)
    one = Running(row, env, None, Judge.start(row, trial.sizes_m, env.truth()), None, watched)
    one.policy_state = _guard(one, trial.policy.start, np.random.default_rng([row.seed, row.episode]))
    return one


Seen = dict[int, tuple[PolicyInput, Attended]]
"""By id of the running episode: the raw input, and what attending made of it."""


def _see(trial: Trial, live: Sequence[Running], sink: Callable[[Opening], Sink] | None) -> Seen:
    """Render, attend, and at t = 0 open the recordings. An episode that fails here ends, and is left out."""
    raws = {id(one): raw for one in live if (raw := _guard(one, _observe, trial, one)) is not None}
    followed = _follow(trial, [one for one in live if one.attend_state is not None and id(one) in raws and raws[id(one)].images], raws)
    seen: Seen = {}
    for one in live:
        if one.outcome is None:
            raw = raws[id(one)]
            attended = followed.get(id(one)) or _guard(one, _start, trial, one, raw)
            if attended is not None and (one.opening is not None or _guard(one, _begin_record, trial, one, attended, sink)):
                seen[id(one)] = raw, attended
    return seen


def _observe(trial: Trial, one: Running) -> PolicyInput:
    return one.env.observe(one.row.instruction) if _looks(trial, one) else PolicyInput({}, one.row.instruction, one.env.state())


def _start(trial: Trial, one: Running, raw: PolicyInput) -> Attended:
    """Ground at t = 0; a step without images, or without VAP, passes as it is."""
    if trial.attender is None or not raw.images:
        return Attended(raw.images, raw.text, (), {}, {}, ())
    masks = one.env.truth(masks=True).masks if isinstance(trial.attender, Revealed) else {}
    with _timed(one.seconds, "attend"):
        if isinstance(trial.attender, Revealed):
            one.attend_state, attended = trial.attender.start(raw.images, raw.text, one.row, masks)
        else:
            one.attend_state, attended = trial.attender.start(raw.images, raw.text, cameras={c.name: c for c in one.env.cameras()})
    return attended


def _follow(trial: Trial, following: Sequence[Running], raws: Mapping[int, PolicyInput]) -> dict[int, Attended]:
    """Track in one batch; when that fails, one by one, to find out whose fault it is."""
    if trial.attender is None or not following:
        return {}
    states, views = [one.attend_state for one in following], [raws[id(one)].images for one in following]
    told = isinstance(trial.attender, Revealed) and trial.attender.always
    masks = [one.env.truth(masks=True).masks if told else {} for one in following]
    start = time.perf_counter()
    try:
        if isinstance(trial.attender, Revealed):
            done: Sequence[tuple[Any, Attended]] = trial.attender.steps(states, views, [one.row for one in following], masks)
        else:
            done = trial.attender.steps(states, views)
    except Exception as error:
        if _ends_the_run(error):
            raise
        if len(following) == 1:
            following[0].outcome = following[0].judge.outcome("error", traceback.format_exc(limit=8))
            return {}
        return {name: attended for one in following for name, attended in _follow(trial, [one], raws).items()}
    share, found = (time.perf_counter() - start) / len(following), {}
    for one, (state, attended) in zip(following, done, strict=True):
        one.attend_state = state
        one.seconds["attend"] += share
        found[id(one)] = attended
    return found


def _begin_record(trial: Trial, one: Running, attended: Attended, sink: Callable[[Opening], Sink] | None) -> bool:
    one.opening = _open(trial, one, attended)
    with _timed(one.seconds, "record"):
        one.sink = sink(one.opening) if sink is not None else None
    return True


def _looks(trial: Trial, one: Running) -> bool:
    """Whether this control step takes images: always for the first; else when the policy is asked, or whoever watches wants every step."""
    if isinstance(trial.policy, Insider):
        return one.watched or bool(trial.images_every and one.judge.steps % trial.images_every == 0)
    return trial.follow == "step" or one.opening is None or not one.queue or _over(one)


def _open(trial: Trial, one: Running, attended: Attended) -> Opening:
    """What is known before the first action."""
    row, env = one.row, one.env
    sizes = {place.model: trial.sizes_m[place.model] for place in row.placements}
    return Opening(
        row, trial.method, trial.policy.label, env.hz, env.cameras(), row.instruction, attended.text, attended.groundings, sizes, env.action_names,
        attended.associations, {} if trial.attender is None else {name: obj.crops for name, obj in trial.attender.memory.items()},
    )  # fmt: skip


def _plan(trial: Trial, live: Sequence[Running], seen: Seen) -> None:
    """Ask the policy, in one batch, for every episode that goes on and whose chunk is used up."""
    asking = [one for one in live if not one.queue and not _over(one)]
    if not asking:
        return
    start = time.perf_counter()
    try:
        states, chunks = _ask(trial, asking, seen)
    except Exception as error:
        if _ends_the_run(error):
            raise
        if len(asking) == 1:
            asking[0].outcome = asking[0].judge.outcome("error", traceback.format_exc(limit=8))
        else:  # find out whose fault it is
            for one in asking:
                _plan(trial, [one], seen)
        return
    share = (time.perf_counter() - start) / len(asking)
    for one, state, chunk in zip(asking, states, chunks, strict=True):
        one.policy_state = state
        one.queue.extend(chunk[: trial.policy.execute])
        one.seconds["policy"] += share


def _ask(trial: Trial, asking: Sequence[Running], seen: Seen) -> tuple[list[Any], list[Chunk]]:
    policy, states = trial.policy, [one.policy_state for one in asking]
    if isinstance(policy, Insider):
        return policy.plan_inside(states, [one.env for one in asking])
    raw, attended = zip(*(seen[id(one)] for one in asking), strict=True)
    prompted = [PolicyInput(a.images, a.text, r.state) for r, a in zip(raw, attended, strict=True)]
    looking: AbstractContextManager[attention.Heats] = attention.watching() if trial.attention else nullcontext({})
    with looking as heats:
        if trial.audit:
            after, chunks, heard, plain = audit.plan(policy, states, prompted, raw)
            for i, (one, r, a) in enumerate(zip(asking, raw, attended, strict=True)):
                one.calls += audit.calls(one.judge.steps, a, r, heard[i], plain[i])
        else:
            after, chunks = policy.plan(states, prompted)
    for i, one in enumerate(asking):
        one.looked = heats.get(i, {})
    return after, chunks


def _act(one: Running, raw: PolicyInput, attended: Attended, keep_images: bool, highlights: bool) -> None:
    """Execute one action, or none when the episode is over, and hand the frame on."""
    over = _over(one)
    action = None if over else one.queue.popleft()
    judged = highlights and bool(attended.tracks)
    truth, cameras = one.env.truth(masks=bool(raw.images) and (one.sink is not None or judged)), one.env.cameras()
    if over:
        one.outcome = one.judge.outcome()
    events = (*attended.events, *one.judge.events)
    covered = shown(attended, truth, one.row.target, opening=not one.frames) if judged else ()
    frame = Frame(
        one.judge.steps, one.env.time_s, raw.images, attended.images, attended.tracks, cameras, raw.state, action, truth, events, covered, one.looked
    )
    one.looked = {}
    with _timed(one.seconds, "record"):
        if one.sink is not None:
            one.sink.frame(frame)
    one.frames.append(frame if keep_images else frame.light())
    if action is not None:
        one.env.step(action)
        one.judge = one.judge.step(one.env.truth())


def _over(one: Running) -> bool:
    return one.judge.done or one.judge.steps >= one.row.max_steps


def _end(trial: Trial, one: Running) -> Episode:
    with _timed(one.seconds, "record"):
        if one.sink is not None:
            assert one.outcome is not None
            _guard(one, one.sink.close, one.outcome)
    assert one.outcome is not None
    opening = one.opening or _open(trial, one, Attended({}, one.row.instruction, (), {}, {}, ()))
    return Episode(opening, tuple(one.frames), one.outcome, {**one.env.seconds, **one.seconds}, tuple(one.calls))


def _guard[**P, R](one: Running, work: Callable[P, R], *args: P.args, **kwargs: P.kwargs) -> R | None:
    """Run one episode's share of a step; its failure ends that episode alone, as an error that keeps its traceback.

    What the user can mend (a full disk, an absent weight) is no episode's fault and ends the run instead.
    """
    try:
        return work(*args, **kwargs)
    except Exception as error:
        if _ends_the_run(error):
            raise
        one.outcome = one.judge.outcome("error", traceback.format_exc(limit=8))
        return None


def _ends_the_run(error: Exception) -> bool:
    """What the user can mend stops everything; a bad action or an object out of reach is its own episode's misfortune."""
    return isinstance(error, VapError) and not isinstance(error, OutOfReach | BadAction)


@contextmanager
def _timed(seconds: dict[str, float], part: str) -> Iterator[None]:
    start = time.perf_counter()
    try:
        yield
    finally:
        seconds[part] += time.perf_counter() - start
