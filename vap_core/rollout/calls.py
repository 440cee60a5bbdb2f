"""Calls of a policy: faults with their remedy, attention queries, and the audit of its inputs."""

import copy
import signal
import sys
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from numbers import Integral
from typing import Any

import numpy as np

from vap_core.base.errors import BadPlan, BadPolicy, BadStudy, TimeIsUp, interrupting, one_of
from vap_core.base.types import kind_of
from vap_core.policies.mini_pi0.learned_token import WORD
from vap_core.policies.protocol import (
    ACTION,
    TEXT,
    AttentionMap,
    Phrases,
    Policy,
    PolicyInput,
    observe_inputs,
)
from vap_core.prompt import PALETTE
from vap_core.rollout.types import ConsumedInput
from vap_core.simulation.types import EpisodeRow

NOTE_AFTER_S = 60.0
"""A call that takes longer is noted on stderr, with the episodes that wait for it."""


@contextmanager
def policy_call(limit_s: float | None, episodes: Sequence[str]) -> Iterator[None]:
    """Ends the block with an error after `limit_s` seconds (None: never).

    The limit is a timer signal, whose handler raises in the main thread. It interrupts Python code,
    sleeping, waiting for a lock and reading from a socket. It does not interrupt a call into C that
    returns late or never, such as one long kernel of torch: that one ends first. A policy whose own
    code catches BaseException can go on.

    Raises: TimeoutError; RuntimeError for what is no Exception, as sys.exit; BadStudy for a limit
        that is not above 0, or outside the main thread, where no handler runs.
    """
    check_limit(limit_s)
    note = threading.Timer(
        NOTE_AFTER_S,
        lambda: print(
            f"note: the policy has not answered for {NOTE_AFTER_S:.0f} s; waiting: "
            f"{', '.join(episodes)}; --policy-timeout SECONDS ends such a call.",
            file=sys.stderr,
            flush=True,
        ),
    )
    note.daemon = True
    note.start()
    try:
        with _timer(limit_s):
            yield
    except TimeIsUp:
        raise TimeoutError(
            f"the policy did not answer within {limit_s:g} s; allow more with --policy-timeout."
        ) from None
    except (Exception, KeyboardInterrupt):
        raise
    except BaseException as error:
        raise RuntimeError(f"the policy raised {error!r}; raise an Exception instead.") from error
    finally:
        note.cancel()


def check_limit(limit_s: float | None) -> None:
    """Raises: BadStudy for a limit that is not above 0: a timer of 0 s never ends a call."""
    if limit_s is not None and not limit_s > 0:
        raise BadStudy(
            f"rollout: policy_timeout_s is {limit_s:g}; give seconds above 0, or None for no limit."
        )


def check_policy(policy: Any) -> None:
    """Raises: BadPolicy when a policy lacks what a rollout needs (policies.protocol)."""
    name = type(policy).__name__
    lacking = [part for part in ("label", "execute", "start") if not hasattr(policy, part)]
    if not hasattr(policy, "plan") and not hasattr(policy, "plan_from_simulation"):
        lacking.append("plan")
    if lacking:
        raise BadPolicy(
            f"rollout: the policy {name} lacks {', '.join(lacking)}; it needs label (its name in "
            "tables), execute (actions of a chunk that are done before the next call), start(rng) "
            "and plan(states, inputs)."
        )
    if not isinstance(policy.label, str):
        raise BadPolicy(f"rollout: {name}.label is {policy.label!r}; it must be a string.")
    if not isinstance(policy.execute, Integral) or policy.execute < 1:
        raise BadPolicy(
            f"rollout: {name}.execute is {policy.execute!r}; it must be a whole number from 1 on."
        )


def checked_plan(returned: object, label: str, n: int) -> tuple[list[Any], list[Any]]:
    """The states that the policy `label` returned for `n` episodes, and what `check_chunks` checks.

    Raises: BadPlan when it returned something else, or not one of each for every episode.
    """
    if not isinstance(returned, tuple | list) or len(returned) != 2:
        raise BadPlan(
            f"{label}: plan returned {type(returned).__name__}; return two lists, of states and of "
            "chunks."
        )
    for name, parts in zip(("states", "chunks"), returned, strict=True):
        is_list = isinstance(parts, list | tuple | np.ndarray)
        if not is_list or len(parts) != n:
            what = len(parts) if is_list else type(parts).__name__
            raise BadPlan(
                f"{label}: plan returned {what} {name} for {n} episodes; return a list, one for "
                "each."
            )
    return list(returned[0]), list(returned[1])


def check_chunks(chunks: Sequence[Any], label: str, action_names: Sequence[str]) -> None:
    """Raises: BadPlan when a chunk is no float32 array with `action_names` in every row."""
    size = len(action_names)
    for chunk in chunks:
        kind = kind_of(chunk)
        if kind.startswith("ndarray float32 (") and chunk.shape[1:] == (size,) and len(chunk):
            continue
        raise BadPlan(
            f"{label}: plan returned {kind} as a chunk; return a NumPy array of type float32 and "
            f"shape (steps, {size}), in every row {', '.join(action_names)}."
        )


@contextmanager
def _timer(limit_s: float | None) -> Iterator[None]:
    """Raises TimeIsUp in the block after that time."""
    if limit_s is None:
        yield
        return
    if threading.current_thread() is not threading.main_thread():
        raise BadStudy(
            "policy_timeout_s works in a process's main thread only; run the rollout there, or "
            "leave the limit out."
        )

    with interrupting(limit_s, signal.SIGALRM, signal.ITIMER_REAL):
        yield


TOKEN, COLOUR, CATEGORY = "token", "colour", "category"
QUERIES = (TOKEN, COLOUR, CATEGORY, ACTION)
ALL = "all"


def query_phrases(row: EpisodeRow) -> Phrases:
    """The words of every query in one episode; a text that lacks them has no such query."""
    colours = tuple(colour.name for colour in PALETTE)
    return {TOKEN: (WORD,), COLOUR: colours, CATEGORY: (row.category,)}


def only_queries(
    maps: Mapping[str, Mapping[str, AttentionMap]], wanted: Sequence[str]
) -> dict[str, dict[str, AttentionMap]]:
    """The maps of the wanted queries, by camera; empty where the text has none of them."""
    kept = {
        camera: {query: heat for query, heat in of_queries.items() if query in wanted}
        for camera, of_queries in maps.items()
    }
    return {camera: of_queries for camera, of_queries in kept.items() if of_queries}


def named_queries(names: Sequence[str]) -> tuple[str, ...]:
    """The queries that are named, in the order of QUERIES; "all" names every one.

    Raises: UnknownName.
    """
    for name in names:
        if name not in (*QUERIES, ALL):
            raise one_of("--attention: query", name, [*QUERIES, ALL])
    return tuple(query for query in QUERIES if query in names or ALL in names)


Digests = tuple[Mapping[str, str], Mapping[str, str]]
"""By camera or TEXT: digests of what was consumed of the prompted, and of the raw input."""


def plan(
    policy: Policy[Any],
    states: Sequence[Any],
    prompted: Sequence[PolicyInput],
    raw: Sequence[PolicyInput],
) -> tuple[list[Any], list[Any], list[Digests]]:
    """The policy's chunks for the prompted inputs, and what it consumed in each episode.

    Raises: BadPolicy when the policy reports nothing.
    """
    spare = copy.deepcopy(list(states))
    with observe_inputs() as of_prompted:
        returned = policy.plan(states, prompted)
        after, chunks = checked_plan(returned, policy.label, len(states))
    chunks = copy.deepcopy(chunks)  # the second call may write into the same arrays
    with observe_inputs() as of_raw:
        policy.plan(spare, raw)
    if len(of_prompted) != len(prompted):
        raise BadPolicy(
            f"audit: {policy.label} does not report what it consumes; call "
            "vap_core.policies.protocol.report_input where it uses its inputs."
        )
    return after, chunks, [(of_prompted[i], of_raw[i]) for i in range(len(prompted))]


def compare(
    step: int, prompted: PolicyInput, raw: PolicyInput, digests: Digests
) -> list[ConsumedInput]:
    """What one episode consumed in one call; views that the policy does not read are left out."""
    of_prompted, of_raw = digests
    found = []
    for name, digest in of_prompted.items():
        if name == TEXT:
            pixels, changed = 0, prompted.text != raw.text
        else:
            pixels = int((prompted.images[name] != raw.images[name]).any(axis=2).sum())
            changed = pixels > 0
        found.append(ConsumedInput(step, name, changed, pixels, digest, of_raw[name]))
    return found
