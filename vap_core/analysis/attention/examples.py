"""Single episodes of a run, run again with the attention observed: recorded, or as tiles.

record(Path("data/results/mini_pi0.parquet"), "tabletop/put-plant/soft/3", folder)
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from vap_core.analysis.attention.patterns import WORDS
from vap_core.analysis.attention.pictures import run_again, strip
from vap_core.analysis.plots import Tile
from vap_core.base.errors import BadStudy
from vap_core.base.files import writing
from vap_core.policies.protocol import AttentionMap, heat_map
from vap_core.study.results import read_runs

PARTS = ("suite", "task", "method", "episode")
"""What names an episode, with slashes between; that of another seed has the seed at its end."""


def name_of(line: Mapping[str, Any]) -> str:
    """An episode's name, which `record` takes."""
    name = "/".join(str(line[part]) for part in PARTS)
    return f"{name}/{line['seed']}" if line["seed"] else name


def record(
    source: Path, name: str, folder: Path, memory: Path, policy: str = ""
) -> tuple[Path, int]:
    """Record the named episode of a run with the maps of every query, in `folder`.

    It is of the first policy whose label holds `policy`.

    Returns: the recording, and the step of the call whose map of a word is highest.

    Raises: BadOutput for a folder that cannot be written; BadStudy for an episode that the run does
        not hold.
    """
    manifest, line = _find(source, name, policy)
    path = folder / f"{name.replace('/', '.')}.rrd"
    with writing(folder, "attention", "choose another --out"):
        folder.mkdir(parents=True, exist_ok=True)
    _, frames = run_again(manifest, line, memory, path)
    return path, clearest({frame.frame_index: frame.attention for frame in frames})


def clearest(calls: Mapping[int, Mapping[str, Mapping[str, AttentionMap]]]) -> int:
    """The step of the call with the highest peak of any word's map; 0 where there is none.

    `calls` has the maps of every step by camera and query.
    """
    best, highest = 0, -1.0
    for step, of_cameras in calls.items():
        for of_queries in of_cameras.values():
            for query in of_queries.keys() & set(WORDS):
                peak = float(heat_map(of_queries[query], query).max())
                if peak > highest:
                    best, highest = step, peak
    return best


def example_tiles(source: Path, line: Mapping[str, Any], memory: Path) -> list[Tile]:
    """The tiles of an episode of `patterns.per_episode`, run again from the run of `source`.

    Raises: BadOutput when `source` is no run; BadStudy for an episode that it does not hold, and as
        `run_again`.
    """
    manifest, listed = _find(source, name_of(line), str(line.get("policy", "")))
    episode, frames = run_again(manifest, listed, memory)
    return strip(episode, frames, str(line["query"]))


def _find(source: Path, name: str, policy: str = "") -> tuple[Mapping[str, Any], Mapping[str, Any]]:
    """The manifest of the run that holds an episode, and its row there."""
    parts = name.split("/")
    if len(parts) not in (len(PARTS), len(PARTS) + 1) or not all(map(str.isdecimal, parts[3:])):
        raise BadStudy(
            f"attention: --record {name}: give SUITE/TASK/METHOD/EPISODE, such as "
            "simpler-bridge/put-camera/soft/22."
        )
    suite, task, method = parts[:3]
    number = int(parts[3])
    seed = int(parts[4]) if parts[4:] else 0
    for manifest, episodes in read_runs(source):
        found = episodes[
            (episodes["suite"] == suite)
            & (episodes["task"] == task)
            & (episodes["method"] == method)
            & (episodes["episode"] == number)
            & (episodes["seed"] == seed)
            & episodes["policy"].str.contains(policy, regex=False)
        ]
        if len(found):
            return manifest, found.iloc[0].to_dict()
    raise BadStudy(f"attention: {source} holds no episode {name}; choose another of --record.")
