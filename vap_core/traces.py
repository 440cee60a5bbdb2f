"""The saved state of every control step of a run: enough to judge each episode again without a simulator."""

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from vap_core.errors import BadOutput
from vap_core.store import KEY, add
from vap_core.values import Episode, Truth


def write(folder: Path, episodes: Sequence[Episode]) -> None:
    """Add the traces of some finished episodes to a run, as one part. Raises BadOutput when the disk is full."""
    rows = [_to_row(episode) for episode in episodes if episode.frames and episode.outcome.status != "error"]  # an error is not judged again
    if rows:
        add(folder, "traces", rows, "traces")


def read(folder: Path) -> Iterator[tuple[tuple[Any, ...], list[Truth]]]:
    """The key (store.KEY) of every saved episode and its truths: the settled start, then one per control step.

    Raises: BadOutput for a part that is damaged.
    """
    import pandas as pd

    seen: set[tuple[Any, ...]] = set()
    for part in sorted((folder / "traces").glob("*.parquet")):
        try:
            table = pd.read_parquet(part)
        except (OSError, ValueError) as error:
            raise BadOutput(f"traces: {part} is damaged; delete it, its episodes cannot be judged again.") from error
        for row in table.to_dict("records"):
            key = tuple(row[name] for name in KEY)
            if key not in seen:
                seen.add(key)
                yield key, list(_truths(row))


def _to_row(episode: Episode) -> dict[str, Any]:
    row, frames = episode.opening.row, episode.frames
    names = [place.model for place in row.placements]
    truths = [frame.truth for frame in frames]
    return {
        **dict(zip(KEY, episode.key, strict=True)),
        "objects": names,
        "poses": np.concatenate([truth.objects_world[name] for truth in truths for name in names]),
        "touched": [list(truth.touched) for truth in truths],
        "pressed": [_pairs(truth.pressed_s.items()) for truth in truths],
        "contacts": [_pairs((name, other) for name in sorted(truth.contacts) for other in sorted(truth.contacts[name])) for truth in truths],
    }


def _pairs(items: Iterable[tuple[str, Any]]) -> list[str]:
    return [f"{name}={value!r}" if isinstance(value, float) else f"{name}={value}" for name, value in items]


def _truths(row: dict[str, Any]) -> Iterator[Truth]:
    names = list(row["objects"])
    poses = np.asarray(row["poses"], np.float64).reshape(-1, len(names), 7)
    for step, touched, pressed, touching in zip(poses, row["touched"], row["pressed"], row["contacts"], strict=True):
        contacts: dict[str, set[str]] = {}
        for name, other in (text.rsplit("=", 1) for text in touching):
            contacts.setdefault(name, set()).add(other)
        seconds = {name: float(text) for name, text in (text.rsplit("=", 1) for text in pressed)}
        partners = {name: frozenset(others) for name, others in contacts.items()}
        yield Truth(dict(zip(names, step, strict=True)), {}, tuple(touched), seconds, partners)
