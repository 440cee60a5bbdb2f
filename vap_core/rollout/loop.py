"""The closed loop for a batch of episodes: observe, prompt, plan, act, until every episode is over.

Nothing here records, or measures success beyond the suite's judge; sinks and tables read the values
that it yields.
"""

import sys
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal

import numpy as np
from jaxtyping import TypeCheckError

from vap_core.base.errors import (
    BadAction,
    BadCrop,
    BadPart,
    BadPlan,
    BadStudy,
    OutOfReach,
    VapError,
)
from vap_core.base.types import Attended, Views
from vap_core.environments import AnyScene, Environment, open_env
from vap_core.policies.protocol import (
    AttentionMaps,
    Policy,
    PolicyInput,
    PrivilegedPolicy,
    observe_attention,
)
from vap_core.rollout import calls
from vap_core.rollout.calls import (
    check_chunks,
    check_limit,
    check_policy,
    checked_plan,
    only_queries,
    policy_call,
    query_phrases,
)
from vap_core.rollout.prompters import PromptContext, Prompter, SceneTruth, checked_steps, unchanged
from vap_core.rollout.running import (
    LateMasks,
    RunningEpisode,
    SubGoalSink,
    WaitingSink,
    begins,
    ending,
    next_subgoal,
    subgoal_number,
)
from vap_core.rollout.running import Sink as Sink
from vap_core.rollout.types import (
    Episode,
    EpisodeHeader,
    Frame,
    MaskCoverage,
    SubGoalSpan,
    mask_coverage,
)
from vap_core.simulation.control import BEYOND
from vap_core.simulation.env import Control, Env, timed
from vap_core.simulation.looks import PERFECT, Sensor
from vap_core.simulation.occluder import Occlusion
from vap_core.simulation.scenes import Scene
from vap_core.simulation.suites.open_row import cameras_of, models_of
from vap_core.simulation.suites.rules import Judge
from vap_core.simulation.types import EpisodeRow, Observation

OpenSink = Callable[[EpisodeHeader], Sink]
Follow = Literal["call", "step"]


@dataclass(frozen=True)
class Trial:
    """What a batch of episodes shares.

    A privileged policy needs no images; it gets them every `images_every` control steps (0: never),
    for their cost or for show. `follow` is when images are taken and targets tracked: when the
    policy is called, which is all that it ever sees, or at every control step. `audit` keeps what
    the policy consumed in every call (rollout.audit), `attention` where these queries looked
    (rollout.queries).
    `image_size` is simulation.Env's.
    A call of the policy that takes longer than `policy_timeout_s` fails (rollout.policy_call).

    Raises: BadPolicy: the policy lacks what the loop needs; BadStudy: `policy_timeout_s` is not
        above 0.
    """

    method: str
    scene: AnyScene
    policy: Policy[Any] | PrivilegedPolicy[Any]
    prompter: Prompter[Any]
    control: Control = "ee"
    sensor: Sensor = PERFECT
    images_every: int = 0
    occlusion: Occlusion | None = None
    follow: Follow = "step"
    audit: bool = False
    attention: tuple[str, ...] = ()
    image_size: int | tuple[int, int] = 224
    policy_timeout_s: float | None = None

    def __post_init__(self) -> None:
        check_policy(self.policy)
        check_limit(self.policy_timeout_s)

    @property
    def bound(self) -> bool:
        """Whether the policy or the prompter reads the simulator: then results are bounds."""
        return isinstance(self.policy, PrivilegedPolicy) or self.prompter.needs_truth != "never"


Step = tuple[Observation, Attended]
"""What one episode observed in this step, and what its prompter made of it."""


def rollout(
    trial: Trial,
    rows: Sequence[EpisodeRow],
    sink: OpenSink | None = None,
    *,
    batch: int = 4,
    keep_images: bool = False,
) -> Iterator[Episode]:
    """Run every row once and yield its episode.

    Episodes do not depend on each other. Only the rounding of a policy that is called for several
    episodes at once depends on `batch`: `batch` 1 and 5 can differ in the last bits of an action.
    An exception inside an episode, a call of sys.exit, a crop that an encoder cannot embed, or what
    a prompter returns against its protocol ends that episode with status "error" and its traceback
    in `detail`; the others go on.
    Frames keep their images only with `keep_images`; a sink always gets them.

    Raises: VapError: the user has to act: weights are absent, the policy returns arrays of another
        shape or type than its protocol's, an encoder cannot embed the references either, or `batch`
        is below 1.
    """
    if batch < 1:
        raise BadStudy(f"rollout: batch is {batch}; give how many episodes run at once, from 1 on.")
    keeps_images = sink is not None or keep_images
    for first in range(0, len(rows), batch):
        running = [_begin(trial, row, keeps_images) for row in rows[first : first + batch]]
        _run(trial, running, sink, keep_images)
        while running:  # an episode that has ended keeps no environment
            yield _end(trial, running.pop(0))


def _run(
    trial: Trial, running: Sequence[RunningEpisode], sink: OpenSink | None, keep_images: bool
) -> None:
    """Step the episodes together until all have ended."""
    live = _live(running)
    while live:
        for episode in live:
            _guard(episode, next_subgoal, episode, trial.policy)
        live = _live(live)
        steps = _observe_and_prompt(trial, live, sink)
        live = _live(live)
        _plan(trial, live, steps)
        for episode in _live(live):
            observation, attended = steps[id(episode)]
            _guard(episode, _act, trial, episode, observation, attended, keep_images)
        live = _live(running)


def _live(episodes: Sequence[RunningEpisode]) -> list[RunningEpisode]:
    """The episodes that have not ended."""
    return [episode for episode in episodes if episode.outcome is None]


def _env(trial: Trial, row: EpisodeRow) -> Environment:
    """An environment for the row's episode, in which it has not begun.

    Its scene holds what the row places and no more: the last bits of the physics depend on every
    object in a scene, and an episode must not depend on the rows beside it.
    """
    shared = trial.scene
    return open_env(
        shared.only(models_of([row])) if isinstance(shared, Scene) else shared,
        cameras_of(row),
        image_size=trial.image_size,
        control=trial.control,
        sensor=trial.sensor,
        occlusion=trial.occlusion,
    )


def _begin(trial: Trial, row: EpisodeRow, keeps_images: bool) -> RunningEpisode:
    env = _env(trial, row)
    env.reset(row)
    if isinstance(env, Env):
        env.pursue(row.at(0))
    judge = Judge.start(row.at(0), trial.scene.sizes_m, env.truth())
    episode = RunningEpisode(row, env, judge, keeps_images)
    if row.subgoals:
        episode.notes.append(begins(episode))
    rng = np.random.default_rng([row.seed, row.episode])
    episode.policy_state = _guard(episode, trial.policy.start, rng)
    return episode


def _observe_and_prompt(
    trial: Trial, live: Sequence[RunningEpisode], sink: OpenSink | None
) -> dict[int, Step]:
    """Render and prompt every episode; at t = 0 open its sink.

    An episode that fails here ends and is left out.
    """
    observations: dict[int, Observation] = {}
    for episode in live:
        observation = _guard(episode, _observe, trial, episode)
        if observation is not None:
            observations[id(episode)] = observation

    following = [
        episode
        for episode in live
        if episode.prompting and id(episode) in observations and observations[id(episode)].images
    ]
    prompted = _prompt_batch(trial, following, observations)

    steps: dict[int, Step] = {}
    for episode in live:
        if episode.outcome is not None:
            continue
        observation = observations[id(episode)]
        attended = prompted.get(id(episode))
        if attended is None:
            attended = _guard(episode, _start_prompting, trial, episode, observation)
        if attended is None:
            continue
        if episode.header is None:
            _guard(episode, _open_sink, trial, episode, attended, sink)
        if episode.row.subgoals and episode.homing is None:
            _guard(episode, _open_subgoal, episode, attended)
        if episode.outcome is None:
            steps[id(episode)] = observation, attended
    return steps


def _observe(trial: Trial, episode: RunningEpisode) -> Observation:
    """This control step's observation, with pictures where they are wanted.

    The first step always has them; the others when the policy is called, or every step is wanted.
    """
    steps = episode.judge.steps
    if episode.homing is not None:
        sees = episode.keeps_images
    elif isinstance(trial.policy, PrivilegedPolicy):
        every = trial.images_every
        sees = episode.keeps_images or bool(every and steps % every == 0)
    else:
        sees = trial.follow == "step" or episode.header is None
        sees = sees or not episode.queue or episode.over
    return episode.env.observe() if sees else Observation({}, episode.env.state())


def _start_prompting(trial: Trial, episode: RunningEpisode, observation: Observation) -> Attended:
    """Start the prompter at the first step with images.

    A step without images, or on the way home between sub-goals, passes unchanged.
    """
    if not observation.images or episode.homing is not None:
        return unchanged(observation.images, episode.goal.instruction)
    context = _context(trial, episode)
    drawn_s = episode.env.seconds["render"]
    with timed(episode.seconds, "attend"):
        shown = _shown(observation)
        started = [trial.prompter.start(shown, context)]
        [(state, attended)] = checked_steps(started, trial.prompter, [shown], "start")
    episode.seconds["attend"] -= episode.env.seconds["render"] - drawn_s
    episode.prompter_state = state
    episode.prompting = True
    return attended


def _prompt_batch(
    trial: Trial,
    following: Sequence[RunningEpisode],
    observations: dict[int, Observation],
) -> dict[int, Attended]:
    """Prompt in one batch; when that fails, retry one at a time to isolate the failing episode."""
    if not following:
        return {}
    start = time.perf_counter()
    try:
        states = [episode.prompter_state for episode in following]
        shown = [_shown(observations[id(episode)]) for episode in following]
        contexts = [_context(trial, episode) for episode in following]
        returned = trial.prompter.steps(states, shown, contexts)
        results = checked_steps(returned, trial.prompter, shown)
    except KeyboardInterrupt:
        raise
    except BaseException as error:
        if _ends_the_run(error):
            raise
        if len(following) == 1:
            _fail(following[0])
            return {}
        alone = [_prompt_batch(trial, [episode], observations) for episode in following]
        return {key: attended for one in alone for key, attended in one.items()}
    share = (time.perf_counter() - start) / len(following)
    attended = {}
    for episode, (state, of_episode) in zip(following, results, strict=True):
        episode.prompter_state = state
        episode.seconds["attend"] += share
        attended[id(episode)] = of_episode
    return attended


def _shown(observation: Observation) -> Observation:
    """What the prompter sees. It cannot write: the recording shows what the cameras saw."""
    return Observation(_locked(observation.images), _read_only(observation.state))


def _context(trial: Trial, episode: RunningEpisode) -> PromptContext:
    """What the prompter may know; ground truth only if it declares that it needs it now."""
    needs = trial.prompter.needs_truth
    truth = None
    if needs == "always" or (needs == "start" and not episode.prompting):
        masks = episode.env.truth(masks=True).masks
        if not masks:
            raise BadStudy(
                f"{trial.method}: {episode.row.suite} has no ground truth; take a method that "
                "reads none."
            )
        judge = episode.judge
        truth = SceneTruth(episode.goal, masks, step=judge.steps, moved=judge.moved)
    cameras = {each.name: each for each in episode.env.cameras() if each.calibrated}
    return PromptContext(episode.goal.instruction, cameras, truth, episode.env.look)


def _open_sink(
    trial: Trial, episode: RunningEpisode, attended: Attended, sink: OpenSink | None
) -> None:
    episode.header = _header(trial, episode, attended)
    with timed(episode.seconds, "record"):
        episode.sink = sink(episode.header) if sink is not None else None
    redraws = isinstance(episode.env, Env) and not episode.row.subgoals
    if redraws and isinstance(episode.sink, WaitingSink):
        episode.late = LateMasks(partial(_env, trial, episode.row))
        episode.sink.draw_by(episode.late.draw)


def _open_subgoal(episode: RunningEpisode, attended: Attended) -> None:
    """Keep what is known of a sub-goal at its first step, and pass it on to the sink."""
    if len(episode.spans) > episode.stage:
        return
    assert episode.header is not None
    header = replace(
        episode.header,
        row=episode.goal,
        instruction=episode.goal.instruction,
        rewritten=attended.text,
        groundings=attended.groundings,
        associations=attended.associations,
        cameras=episode.env.cameras(),
    )
    episode.spans.append(SubGoalSpan(header, episode.judge.steps))
    if episode.stage and isinstance(episode.sink, SubGoalSink):
        with timed(episode.seconds, "record"):
            episode.sink.begin_subgoal(header)


def _header(trial: Trial, episode: RunningEpisode, attended: Attended) -> EpisodeHeader:
    row = episode.row
    env = episode.env
    sizes_m = trial.scene.sizes_m
    sizes_m = {each.model: sizes_m[each.model] for each in row.placements if sizes_m}
    return EpisodeHeader(
        row=row,
        method=trial.method,
        policy=trial.policy.label,
        hz=env.hz,
        cameras=env.cameras(),
        instruction=row.instruction,
        rewritten=attended.text,
        groundings=attended.groundings,
        object_sizes_m=sizes_m,
        action_names=env.action_names,
        associations=attended.associations,
        references=trial.prompter.references,
    )


def _plan(trial: Trial, live: Sequence[RunningEpisode], steps: dict[int, Step]) -> None:
    """Call the policy, in one batch, for every episode that goes on and whose chunk is used up."""
    calling = [episode for episode in live if not episode.queue and not episode.over]
    if not calling:
        return
    start = time.perf_counter()
    try:
        rows = [episode.row for episode in calling]
        names = [f"{r.suite} {r.task} episode {r.episode} seed {r.seed}" for r in rows]
        names = [f"{name} ({trial.method})" for name in names]
        with policy_call(trial.policy_timeout_s, names):
            states, chunks = _call_policy(trial, calling, steps)
        check_chunks(chunks, trial.policy.label, calling[0].env.action_names)
    except Exception as error:
        if _ends_the_run(error):
            raise
        if len(calling) == 1:
            _fail(calling[0])
            return
        for episode in calling:  # one at a time, to isolate the failing episode
            _plan(trial, [episode], steps)
        return
    share = (time.perf_counter() - start) / len(calling)
    for episode, state, chunk in zip(calling, states, chunks, strict=True):
        episode.policy_state = state
        # A copy: the policy may write its next chunk into the same array.
        episode.queue.extend(np.array(chunk[: trial.policy.execute]))
        episode.seconds["policy"] += share


def _call_policy(
    trial: Trial, calling: Sequence[RunningEpisode], steps: dict[int, Step]
) -> tuple[list[Any], list[Any]]:
    policy = trial.policy
    states = [episode.policy_state for episode in calling]
    if isinstance(policy, PrivilegedPolicy):
        returned = policy.plan_from_simulation(states, [episode.env for episode in calling])
        return checked_plan(returned, policy.label, len(calling))

    told = getattr(policy, "needs_places", False)
    raw = []
    prompted = []
    for episode in calling:
        seen, attended = steps[id(episode)]
        # It cannot write: the recording shows what the prompter made.
        state = _read_only(seen.state)
        raw.append(PolicyInput(_locked(seen.images), episode.goal.instruction, state))
        places = episode.env.truth().objects_world if told else {}
        prompted.append(PolicyInput(_locked(attended.images), attended.text, state, places))

    observer: AbstractContextManager[AttentionMaps] = nullcontext({})
    if trial.attention:
        observer = observe_attention([query_phrases(episode.goal) for episode in calling])
    with observer as maps:
        if trial.audit:
            after, chunks, consumed = calls.plan(policy, states, prompted, raw)
            for i, episode in enumerate(calling):
                step = episode.judge.steps
                episode.consumed += calls.compare(step, prompted[i], raw[i], consumed[i])
        else:
            returned = policy.plan(states, prompted)
            after, chunks = checked_plan(returned, policy.label, len(calling))
    for i, episode in enumerate(calling):
        episode.attention = only_queries(maps.get(i, {}), trial.attention)
    return after, chunks


def _locked(images: Views) -> Views:
    """The images, read-only."""
    return {name: _read_only(rgb) for name, rgb in images.items()}


def _read_only(array: np.ndarray) -> np.ndarray:
    view = array.view()
    view.flags.writeable = False
    return view


def _act(
    trial: Trial,
    episode: RunningEpisode,
    observation: Observation,
    attended: Attended,
    keep_images: bool,
) -> None:
    """Pass the frame on and execute one action, or none when the episode is over."""
    action = None if episode.over else episode.queue.popleft()
    prompts = trial.prompter.highlights and bool(attended.tracks)
    needs_masks = bool(observation.images) and (episode.sink is not None or prompts)
    if needs_masks and episode.late is not None and not prompts and not keep_images:
        assert isinstance(episode.env, Env)
        episode.late.keep(episode.judge.steps, episode.env.snapshot())
        needs_masks = False
    truth = episode.env.truth(masks=needs_masks)
    coverage: tuple[MaskCoverage, ...] = ()
    if prompts and truth.masks:
        opening = episode.judge.steps == episode.judge.first
        coverage = mask_coverage(attended, truth, episode.goal.target, opening=opening)
    # The method counts its own calls, from the beginning of a sub-goal.
    events = [replace(event, frame_index=episode.judge.steps) for event in attended.events]
    frame = Frame(
        frame_index=episode.judge.steps,
        timestamp_s=episode.env.time_s,
        images=observation.images,
        prompted=attended.images,
        tracks=attended.tracks,
        cameras=episode.env.cameras(),
        state=observation.state,
        action=action,
        truth=truth,
        events=(*episode.notes, *events, *episode.judge.events),
        coverage=coverage,
        attention=episode.attention,
        subgoal=subgoal_number(episode),
    )
    if episode.over:
        note = ""
        if episode.beyond:  # a line for the results table
            note = (
                f"{episode.beyond} of {episode.judge.steps} actions asked for over {BEYOND} times "
                "the robot's speed and were cut to it; check the policy's units."
            )
        episode.outcome = ending(episode, detail=note)
    episode.attention = {}
    episode.notes = []
    with timed(episode.seconds, "record"):
        if episode.sink is not None:
            episode.sink.frame(frame)
    episode.frames.append(frame if keep_images else frame.without_images())
    if action is not None:
        episode.env.step(action)
        episode.beyond += episode.env.is_beyond_limits(action)
        episode.judge = episode.judge.step(episode.env.truth())


def _end(trial: Trial, episode: RunningEpisode) -> Episode:
    assert episode.outcome is not None
    with timed(episode.seconds, "record"):
        if episode.sink is not None:
            _guard(episode, episode.sink.close, episode.outcome)
    if isinstance(episode.env, Env):
        episode.env.scene.close()
    header = episode.header
    if header is None:
        header = _header(trial, episode, unchanged({}, episode.row.instruction))
    return Episode(
        header=header,
        frames=tuple(episode.frames),
        outcome=episode.outcome,
        seconds={**episode.env.seconds, **episode.seconds},
        consumed=tuple(episode.consumed),
        subgoals=tuple(episode.spans),
    )


def _guard[**P, R](
    episode: RunningEpisode, work: Callable[P, R], *args: P.args, **kwargs: P.kwargs
) -> R | None:
    """Do one episode's share of a step.

    Its failure ends that episode alone, as an error with its traceback.
    """
    try:
        return work(*args, **kwargs)
    except KeyboardInterrupt:
        raise
    except BaseException as error:  # sys.exit, and what no library should raise
        if _ends_the_run(error):
            raise
        _fail(episode)
        return None


def _fail(episode: RunningEpisode) -> None:
    """End an episode with the exception that is being handled; its last line is the cause."""
    detail = traceback.format_exc(limit=8)
    error = sys.exception()
    if isinstance(error, TypeCheckError):
        detail += f"TypeError: {' '.join(str(error).splitlines()[:4])}\n"
    episode.outcome = ending(episode, "error", detail)


def _ends_the_run(error: BaseException) -> bool:
    """Whether the user has to act (a full disk, an absent weight).

    A bad action, plan or part, and a crop that cannot be embedded, fail their episode only.
    """
    of_episode = isinstance(error, OutOfReach | BadAction | BadCrop | BadPart | BadPlan)
    return isinstance(error, VapError) and not of_episode
