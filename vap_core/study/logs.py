"""What a run keeps of its episodes beside their rows: states, audited inputs, hidden and switched
targets.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vap_core.base.errors import BadOutput
from vap_core.base.files import read_parquet
from vap_core.policies.protocol import TEXT
from vap_core.rollout.prompters import SWITCHED
from vap_core.rollout.types import Episode, Frame, MaskCoverage
from vap_core.simulation import robots
from vap_core.simulation.control import pose_transform
from vap_core.simulation.occluder import Occlusion
from vap_core.simulation.robots import Robot
from vap_core.simulation.suites import suite
from vap_core.simulation.types import Truth
from vap_core.study.cases import THRESHOLDS
from vap_core.study.stats import rate_over_layouts
from vap_core.study.store import KEY, key_of, write_part

if TYPE_CHECKING:
    import pandas as pd


def write_states(folder: Path, episodes: Sequence[Episode]) -> None:
    """Add the states of some finished episodes to a run, as one part.

    Episodes in error, and those of several sub-goals, are left out: they are not judged again.

    Raises: BadOutput when the disk is full.
    """
    rows = [
        _to_row(episode)
        for episode in episodes
        if episode.frames and not episode.subgoals and episode.outcome.status != "error"
    ]
    if rows:
        write_part(folder, "traces", rows, caller="traces")


def read_states(folder: Path) -> Iterator[tuple[tuple[Any, ...], list[Truth]]]:
    """The key (store.KEY) of every saved episode, and its truths.

    These are the settled start, then one per control step.

    Raises: BadOutput for a part that is damaged.
    """
    keys: set[tuple[Any, ...]] = set()
    for part in sorted((folder / "traces").glob("*.parquet")):
        table = read_parquet(part, "traces", "delete it, its episodes cannot be judged again")
        for row in table.to_dict("records"):
            key = key_of(row)
            if key not in keys:
                keys.add(key)
                yield key, _truths(row)


def _to_row(episode: Episode) -> dict[str, Any]:
    truths = [frame.truth for frame in episode.frames]
    names = [place.model for place in episode.header.row.placements if truths[0].objects_world]
    poses = [truth.objects_world[name] for truth in truths for name in names]
    official = episode.header.row.rule == "official"
    return {
        **dict(zip(KEY, episode.key, strict=True)),
        "objects": names,
        "poses": np.concatenate([*poses, np.zeros(0)]),
        "touched": [list(truth.touched) for truth in truths],
        "pressed": [[f"{n}={s!r}" for n, s in truth.pressed_s.items()] for truth in truths],
        "contacts": [
            [f"{name}={other}" for name in sorted(met) for other in sorted(met[name])]
            for met in (truth.contacts for truth in truths)
        ],
        **({"succeeded": [truth.succeeded for truth in truths]} if official else {}),
    }


def _truths(row: Mapping[str, Any]) -> list[Truth]:
    names = list(row["objects"])
    steps = len(row["touched"])
    poses = np.asarray(row["poses"], np.float64).reshape(steps, len(names), 7)
    succeeded = row["succeeded"] if row.get("succeeded") is not None else [False] * steps
    truths = []
    for step, touched, done, *texts in zip(
        poses, row["touched"], succeeded, row["pressed"], row["contacts"], strict=True
    ):
        pressed, contacts = ([text.rsplit("=", 1) for text in each] for each in texts)
        met = {name: frozenset(o for n, o in contacts if n == name) for name, _ in contacts}
        truth = Truth(
            objects_world=dict(zip(names, step, strict=True)),
            links_world={},
            touched=tuple(touched),
            pressed_s={name: float(seconds) for name, seconds in pressed},
            contacts=met,
            succeeded=bool(done),
        )
        truths.append(truth)
    return truths


def write_audit(folder: Path, episodes: Sequence[Episode]) -> None:
    """Add the calls of some finished episodes to a run. Raises: BadOutput."""
    lines = [
        {**dict(zip(KEY, episode.key, strict=True)), **asdict(call), "sound": call.sound}
        for episode in episodes
        for call in episode.consumed
    ]
    if lines:
        write_part(folder, "audit", lines, caller="audit")


def read_audit(folder: Path) -> "pd.DataFrame":
    """Every audited call of a run. Raises: BadOutput when the run was not audited."""
    import pandas as pd

    parts = sorted((folder / "audit").glob("*.parquet"))
    if not parts:
        raise BadOutput(
            f"audit: {folder} was not audited; run it with --audit into another folder."
        )
    remedy = "delete it; its calls are not shown"
    tables = [read_parquet(part, "audit", remedy) for part in parts]
    whole = pd.concat(tables, ignore_index=True)
    # A killed run may hold calls that the resumed run made again.
    return whole.drop_duplicates([*KEY, "step", "name"], ignore_index=True)


def verdict(folder: Path) -> str:
    """A line per method: what the policy consumed, and where it is not as the prompt says.

    Raises: BadOutput, as `read`.
    """
    table = read_audit(folder)
    lines = []
    for method, of_method in table.groupby("method"):
        images = of_method[of_method.name != TEXT]
        texts = of_method[of_method.name == TEXT]
        wrong = of_method[~of_method.sound]
        calls = len(of_method.drop_duplicates([*KEY, "step"]))
        lines.append(
            f"audit {method}: {calls} policy calls; {images.changed.sum()} of {len(images)} images "
            f"tinted ({images.pixels.sum()} pixels), {texts.changed.sum()} of {len(texts)} texts "
            f"rewritten; {len(wrong)} reached the policy otherwise"
        )
        for call in wrong[:5].itertuples():
            what = "is missing" if call.changed else "changed"
            lines.append(
                f"  {call.suite}/{call.task} episode {call.episode} step {call.step}: "
                f"{call.name} {what}"
            )
    return "\n".join(lines)


CALLS = 2
"""The track is kept if the prompt is on the target in one of so many prompted steps after it."""


def hidden_columns(episode: Episode, occlusion: Occlusion | None) -> dict[str, Any]:
    """What a results table keeps of an episode whose target was hidden; nothing of any other.

    `hidden_s` is for how long, `track_kept` whether the track found it again.
    """
    if occlusion is None or not episode.frames:
        return {}
    later = [
        frame.coverage
        for frame in episode.frames
        if frame.frame_index >= occlusion.start + occlusion.frames
    ]
    return {
        "hidden_s": occlusion.frames / episode.header.hz,
        "track_kept": is_track_kept(later, episode.header.row.target),
    }


def is_track_kept(later: Sequence[Sequence[MaskCoverage]], target: str) -> bool | None:
    """Whether the prompt is on the target, in every view that shows it, soon after it was hidden.

    `later` are the steps after that. Soon is the first or second prompted step in which the target
    is visible; None where it never is, for the episode is over or the target out of view.
    """
    views = ([view for view in step if view.pixels >= THRESHOLDS.pixels] for step in later)
    visible = [showing for showing in views if showing][:CALLS]
    if not visible:
        return None
    return any(all(view.object == target for view in showing) for showing in visible)


def hiding_lines(episodes: "pd.DataFrame") -> list[str]:
    """How often the track was kept, by suite and method; none where nothing was hidden.

    Its interval is over layouts where one returns, else Wilson's.
    """
    if "track_kept" not in episodes:
        return []
    lines = []
    hidden = episodes[episodes["track_kept"].notna()]
    for (name, method), part in hidden.groupby(["suite", "method"], sort=False):
        kept = rate_over_layouts(part, "track_kept")
        seconds = float(part["hidden_s"].iloc[0])
        lines.append(f"{name} {method}: hidden for {seconds:.1f} s, track kept in {kept}")
    return lines


def switch_columns(episode: Episode) -> dict[str, Any]:
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
    texts = ((i, e.text) for i, frame in enumerate(episode.frames[:-1]) for e in frame.events)
    found = ((i, text.removeprefix(SWITCHED)) for i, text in texts if text.startswith(SWITCHED))
    return next(found, None)


def _away_m(robot: Robot, frame: Frame, name: str) -> float:
    """From the gripper to an object, across the table."""
    tcp_world = pose_transform(robot.base_world).apply(frame.state[:3].astype(float))
    return float(np.hypot(*(tcp_world - frame.truth.objects_world[name][:3])[:2]))
