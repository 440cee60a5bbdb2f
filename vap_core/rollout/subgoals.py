"""An instruction in several steps: one sub-goal after the other (P multi-user).

A sub-goal ends when its rule is met or its time is out. The hand then returns to where it began,
and the next sub-goal starts as an episode does: grounded on the scene as it is then, with a policy
that begins anew and a judge that measures from here.
"""

from dataclasses import replace
from typing import Any, Literal

import numpy as np

from vap_core.base.types import Event
from vap_core.policies.protocol import Policy, PrivilegedPolicy
from vap_core.rollout.running import RunningEpisode
from vap_core.simulation import homing
from vap_core.simulation.suites.rules import Judge
from vap_core.simulation.types import Outcome, of_subgoals

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
        episode.homing = homing.begin(episode.env)
        episode.prompting = False
    else:
        episode.homing = homing.advance(episode.homing, episode.env)
    episode.queue.clear()
    if episode.homing.part != "there":
        episode.queue.append(homing.action(episode.homing, episode.env))
        return
    episode.homing = None
    episode.stage += 1
    row = episode.row.at(episode.stage)
    episode.env.pursue(row)
    first = episode.judge.steps
    episode.judge = Judge.start(row, episode.judge.sizes_m, episode.env.truth(), first)
    episode.notes.append(begins(episode))
    rng = np.random.default_rng([row.seed, row.episode, episode.stage])
    episode.policy_state = policy.start(rng)


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
