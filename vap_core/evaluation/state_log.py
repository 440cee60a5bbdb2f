"""The simulator state of every control step of a run: enough to judge each episode again."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from vap_core.base.parquet import read_parquet
from vap_core.evaluation.store import KEY, key_of, write_part
from vap_core.rollout.types import Episode
from vap_core.simulation.types import Truth


def write(folder: Path, episodes: Sequence[Episode]) -> None:
    """Add the states of some finished episodes to a run, as one part.

    Episodes in error, and those of several sub-goals, are left out: they are not judged again.

    Raises: BadOutput when the disk is full.
    """
    rows = []
    for episode in episodes:
        if episode.frames and not episode.subgoals and episode.outcome.status != "error":
            rows.append(_to_row(episode))
    if rows:
        write_part(folder, "traces", rows, caller="traces")


def read(folder: Path) -> Iterator[tuple[tuple[Any, ...], list[Truth]]]:
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
    names = [place.model for place in episode.header.row.placements]
    poses = []
    touched = []
    pressed = []
    contacts = []
    for frame in episode.frames:
        truth = frame.truth
        for name in names:
            poses.append(truth.objects_world[name])
        touched.append(list(truth.touched))
        pressed.append(_pressed_to_text(truth.pressed_s))
        contacts.append(_contacts_to_text(truth.contacts))
    return {
        **dict(zip(KEY, episode.key, strict=True)),
        "objects": names,
        "poses": np.concatenate(poses),
        "touched": touched,
        "pressed": pressed,
        "contacts": contacts,
    }


def _truths(row: Mapping[str, Any]) -> list[Truth]:
    names = list(row["objects"])
    poses = np.asarray(row["poses"], np.float64).reshape(-1, len(names), 7)
    truths = []
    for step, touched, pressed, contacts in zip(
        poses, row["touched"], row["pressed"], row["contacts"], strict=True
    ):
        truth = Truth(
            objects_world=dict(zip(names, step, strict=True)),
            links_world={},
            touched=tuple(touched),
            pressed_s=_pressed_from_text(pressed.tolist()),
            contacts=_contacts_from_text(contacts.tolist()),
        )
        truths.append(truth)
    return truths


def _pressed_to_text(pressed_s: Mapping[str, float]) -> list[str]:
    texts = []
    for name, seconds in pressed_s.items():
        texts.append(f"{name}={seconds!r}")
    return texts


def _pressed_from_text(texts: Sequence[str]) -> dict[str, float]:
    pressed_s = {}
    for text in texts:
        name, seconds = text.rsplit("=", 1)
        pressed_s[name] = float(seconds)
    return pressed_s


def _contacts_to_text(contacts: Mapping[str, frozenset[str]]) -> list[str]:
    texts = []
    for name in sorted(contacts):
        for other in sorted(contacts[name]):
            texts.append(f"{name}={other}")
    return texts


def _contacts_from_text(texts: Sequence[str]) -> dict[str, frozenset[str]]:
    partners: dict[str, set[str]] = {}
    for text in texts:
        name, other = text.rsplit("=", 1)
        partners.setdefault(name, set()).add(other)
    contacts = {}
    for name, others in partners.items():
        contacts[name] = frozenset(others)
    return contacts
