"""Pictures and tables of the benchmarks, as notebook 01 shows them.

Contact sheets of the objects, opening frames of episodes, and how similar the look-alikes are.
"""

from collections.abc import Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from vap_core.analysis.plots import Tile
from vap_core.base.files import read_parquet
from vap_core.base.pictures import TIER_COLOURS
from vap_core.base.types import PersonalObject, Rgb
from vap_core.perception.boxes import crop
from vap_core.perception.protocols import Encoder
from vap_core.policies.scripted.expert import Expert
from vap_core.rollout.running import expert_steps
from vap_core.simulation.assets.objects import (
    OBJECTS,
    TIERS,
    ObjectModel,
    lookalikes,
    personal_instance,
    tier,
)
from vap_core.simulation.studio import Shot, Stage
from vap_core.simulation.suites import BENCHMARKS, VARIANTS
from vap_core.simulation.suites.open_row import open_row
from vap_core.simulation.types import EpisodeRow
from vap_core.study.stats import Score, rate, score

if TYPE_CHECKING:
    import pandas as pd

STEMS = tuple(name.removesuffix("-personal") for name in OBJECTS if name.endswith("-personal"))
"""One per personal object: "pen-holder"."""
GOALS = tuple(model for model in OBJECTS.values() if model.split == "prop")
"""The models that serve as goals of tasks."""


def _shot(azimuth: float, elevation_deg: float) -> Shot:
    """A view from 0.6 m; `azimuth` in radians."""
    return Shot(azimuth, float(np.radians(elevation_deg)), 0.6)


REFERENCES = (
    _shot(0.0, 18.0),
    _shot(0.4 * np.pi, 34.0),
    _shot(0.4 * np.pi * 2, 50.0),
    _shot(0.4 * np.pi * 3, 26.0),
    _shot(0.4 * np.pi * 4, 42.0),
)
"""Five views from around an object, under one lamp, so that only the object differs."""
QUERIES = (_shot(0.6, 40.0), _shot(2.5, 30.0), _shot(4.4, 35.0))
"""Views from between those."""


def cut(stage: Stage, name: str, shot: Shot) -> Rgb:
    """A picture of one object, cropped to its true outline as grounding crops its candidates."""
    return crop(stage.picture(name, shot), stage.box(name, shot))


def lookalikes_by_tier(stem: str) -> tuple[ObjectModel, ...]:
    """A personal object's look-alikes, hard ones first."""

    def rank(model: ObjectModel) -> int:
        return TIERS.index(tier(model))

    return tuple(sorted(lookalikes(stem), key=rank))


def lookalike_sheet(stage: Stage, goals: Sequence[ObjectModel] = ()) -> dict[str, list[Tile]]:
    """One row per personal object: itself, then its look-alikes from hard to easy.

    The title of a look-alike is its tier and the number in its name. `goals` are a last row.
    """
    sheet = {}
    for stem in STEMS:
        picture = stage.picture(personal_instance(stem).name)
        tiles = [Tile(picture, "personal", TIER_COLOURS["personal"])]
        for model in lookalikes_by_tier(stem):
            tiles.append(_lookalike_tile(stage, model))
        sheet[_label(stem)] = tiles
    if goals:
        sheet["goals"] = [Tile(stage.picture(goal.name), goal.category) for goal in goals]
    return sheet


def object_sheet(
    models: Mapping[str, Sequence[ObjectModel]], size: int = 160
) -> dict[str, list[Tile]]:
    """One row per kind, with its objects."""
    sheet = {}
    with Stage(list(chain.from_iterable(models.values())), size) as stage:
        for kind, row in models.items():
            tiles = []
            for model in row:
                tiles.append(Tile(stage.picture(model.name)))
            sheet[_label(kind)] = tiles
    return sheet


def reference_sheet(
    memory: Mapping[str, tuple[PersonalObject, tuple[int, ...]]],
) -> dict[str, list[Tile]]:
    """One row per remembered object: its crops; undetected ones are marked as whole photos."""
    sheet = {}
    for stem, (obj, whole) in memory.items():
        tiles = []
        for i, picture in enumerate(obj.crops):
            if i in whole:
                tiles.append(Tile(picture, "whole photo", TIER_COLOURS["hard"]))
            else:
                tiles.append(Tile(picture, "", TIER_COLOURS["easy"]))
        sheet[_label(stem)] = tiles
    return sheet


def hardness(stage: Stage, encoder: Encoder) -> "pd.DataFrame":
    """How similar the encoder finds each look-alike to its personal object.

    The personal object is given by five references. One line per look-alike: `cosine`, the mean
    over queries and references; `own`, the same for the personal object's own queries; `fooled`,
    the share of votes that the look-alike would win, over every reference, view of the look-alike
    and view of the personal object.
    """
    import pandas as pd

    lines = []
    for stem in STEMS:
        personal = personal_instance(stem).name
        references = _encode_shots(stage, encoder, personal, REFERENCES)
        own = _encode_shots(stage, encoder, personal, QUERIES) @ references.T
        for model in lookalikes_by_tier(stem):
            cosines = _encode_shots(stage, encoder, model.name, QUERIES) @ references.T
            wins = cosines[:, None] > own[None]
            lines.append(
                {
                    "object": stem.replace("-", " "),
                    "lookalike": model.name,
                    "tier": tier(model),
                    "cosine": float(cosines.mean()),
                    "own": float(own.mean()),
                    "fooled": float(wins.mean()),
                }
            )
    return pd.DataFrame(lines)


def out_of_order(table: "pd.DataFrame") -> "pd.DataFrame":
    """Of `hardness`: pairs of one object's look-alikes whose tiers contradict their cosines.

    The easier one has the higher cosine. The widest gap comes first.
    """
    rank = table.assign(rank=table.tier.map(TIERS.index))
    pairs = rank.merge(rank, on="object", suffixes=("", "_easier"))
    wrong = pairs[(pairs["rank"] < pairs.rank_easier) & (pairs.cosine < pairs.cosine_easier)]
    wrong = wrong.assign(gap=wrong.cosine_easier - wrong.cosine).sort_values("gap", ascending=False)
    columns = ["lookalike", "tier", "lookalike_easier", "tier_easier", "gap"]
    return wrong[columns].reset_index(drop=True)


def census(lists: Mapping[str, Sequence[EpisodeRow]]) -> "pd.DataFrame":
    """One line per task and track of the suites' episode lists.

    Robot, cameras, control rate, instruction, rule, step limit, and the numbers of variants of the
    room and of episodes.
    """
    import pandas as pd

    tracks: dict[tuple[str, str, str], list[EpisodeRow]] = {}
    for name, rows in lists.items():
        for row in rows:
            tracks.setdefault((name, row.task, row.split), []).append(row)
    lines = []
    for (name, _, split), rows in tracks.items():
        suite = BENCHMARKS[name]
        row = rows[0]
        variants = {row.variant for row in rows}
        lines.append(
            {
                "suite": name,
                "robot": suite.robot,
                "cameras": len(suite.cameras),
                "Hz": suite.hz,
                "instruction": row.instruction,
                "rule": row.rule,
                "steps": row.max_steps,
                "track": split or "-",
                "looks": len(variants),
                "episodes": len(rows),
            }
        )
    return pd.DataFrame(lines)


def camera_images(row: EpisodeRow, steps: int = 0, size: int = 224) -> dict[str, Rgb]:
    """The images of the suite's cameras after `steps` control steps of the expert.

    The room is that of the row's variant, and the images pass the suite's sensor.

    Raises: UnknownName, as `open_row`; OutOfReach when the expert cannot reach its next pose.
    """
    expert = Expert()
    with open_row(row, image_size=size) as env:
        state = expert.start(np.random.default_rng([row.seed, row.episode]))
        for judge, _ in expert_steps(env, row, expert, state):
            if judge.steps == steps:
                break
        return dict(env.observe().images)


def frame_sheet(episodes: Sequence[Sequence[EpisodeRow]]) -> dict[str, list[Tile]]:
    """One row per suite: the opening frame of each of its `episodes`, by every camera.

    Raises: as `camera_images`.
    """
    sheet = {}
    for rows in episodes:
        tiles = []
        for row in rows:
            for i, (camera, rgb) in enumerate(camera_images(row).items()):
                title = f"{camera}: {row.instruction}" if i == 0 else camera
                tiles.append(Tile(rgb, title))
        sheet[rows[0].suite] = tiles
    return sheet


def same_layout(rows: Sequence[EpisodeRow], like: EpisodeRow) -> dict[str, EpisodeRow]:
    """The first row of every variant that places the objects of `like` as `like` does.

    Distractors may be added.
    """
    poses = _model_poses(like)
    first_rows: dict[str, EpisodeRow] = {}
    for row in rows:
        if row.task == like.task and _model_poses(row)[: len(poses)] == poses:
            first_rows.setdefault(row.variant, row)
    layouts = {}
    for variant in VARIANTS:
        if variant in first_rows:
            layouts[variant] = first_rows[variant]
    return layouts


def bounds(path: Path) -> list[Score]:
    """The scores of the episodes in a parquet file, in the order of the suites and their tasks.

    Raises: BadOutput when the file is absent or damaged.
    """

    positions: dict[tuple[str, str], int] = {}
    for suite in BENCHMARKS.values():
        for task in suite.tasks:
            positions[suite.name, task.name] = len(positions)

    def rank(line: Score) -> tuple[int, bool, str]:
        position = positions[line.suite, line.task]
        return position, line.split == "variant aggregation", line.policy

    records = read_parquet(path, "bounds", "publish it again").to_dict("records")
    return sorted(score(records), key=rank)


def bounds_table(scores: Sequence[Score]) -> "pd.DataFrame":
    """Success of every policy per suite over all its tasks, with Wilson's 95 % interval.

    Beside it the task in which the expert succeeds least, and that in which another policy succeeds
    most.
    """
    import pandas as pd

    policies = list(dict.fromkeys(line.policy for line in scores))
    lines = []
    for suite in dict.fromkeys(line.suite for line in scores):
        cells = {"suite": suite}
        for policy in policies:
            own = [line for line in scores if (line.suite, line.policy) == (suite, policy)]
            if not own:
                continue
            success = rate(sum(line.sr.k for line in own), sum(line.n for line in own))
            cells[f"{policy}, SR %"] = f"{success} of {success.n}"
            ordered = sorted(own, key=lambda line: line.sr.value)
            word, task = ("most", ordered[-1])
            if policy == "expert":
                word, task = ("least", ordered[0])
            cells[f"{policy}, {word} in"] = task.task
            cells[f"{policy}, SR % in that task"] = f"{task.sr} of {task.n}"
        lines.append(cells)
    return pd.DataFrame(lines).set_index("suite")


def _label(stem: str) -> str:
    return stem.removesuffix("-personal").replace("-", "\n").replace(" ", "\n")


def _lookalike_tile(stage: Stage, model: ObjectModel) -> Tile:
    number = model.name.rpartition("-")[2]
    picture = stage.picture(model.name)
    return Tile(picture, f"{tier(model)}, {number}", TIER_COLOURS[tier(model)])


def _encode_shots(stage: Stage, encoder: Encoder, name: str, shots: Sequence[Shot]) -> np.ndarray:
    """The embeddings of one object's crops, (len(shots), D)."""
    return encoder([cut(stage, name, shot) for shot in shots])


def _model_poses(row: EpisodeRow) -> list[tuple[str, float, float, float]]:
    poses = []
    for place in row.placements:
        poses.append((place.model, place.x, place.y, place.yaw))
    return poses
