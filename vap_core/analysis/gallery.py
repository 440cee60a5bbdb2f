"""Pictures of the benchmarks, as notebook 01 shows them: objects taking turns on one table, opening frames, and how alike look-alikes are."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from vap_core.analysis.plots import Tile
from vap_core.base.figures import TIER_COLOURS
from vap_core.base.types import PersonalObject, Rgb
from vap_core.evaluation.metrics import Score, rate, score
from vap_core.perception.boxes import crop
from vap_core.perception.protocols import Encoder
from vap_core.policies.scripted.expert import Expert
from vap_core.rollout.expert_loop import expert_steps
from vap_core.simulation.assets.objects import (
    OBJECTS,
    TIERS,
    ObjectModel,
    generic_instance,
    lookalikes,
    personal_instance,
    tier,
)
from vap_core.simulation.studio import Shot, Stage
from vap_core.simulation.suites import BENCHMARKS, VARIANTS
from vap_core.simulation.suites.open_row import open_row
from vap_core.simulation.types import EpisodeRow

if TYPE_CHECKING:
    import pandas as pd

STEMS = tuple(name.removesuffix("-personal") for name in OBJECTS if name.endswith("-personal"))
"""One per personal object: "pen-holder"."""
GOALS = tuple(model for model in OBJECTS.values() if model.split == "prop")
REFERENCES = tuple(
    Shot(0.4 * np.pi * i, float(np.radians(18 + 8 * (2 * i % 5))), 0.6) for i in range(5)
)
"""Five views as one walks around an object, like studio.reference_views but under one lamp, so that only the object differs."""
QUERIES = tuple(
    Shot(azimuth, float(np.radians(elevation)), 0.6)
    for azimuth, elevation in ((0.6, 40), (2.5, 30), (4.4, 35))
)
"""Views from between those."""


def cut(stage: Stage, name: str, shot: Shot) -> Rgb:
    """A picture of one object, cut around it as grounding cuts its candidates, but by its true outline."""
    return crop(stage.picture(name, shot), stage.box(name, shot))


def _label(stem: str) -> str:
    return stem.removesuffix("-personal").replace("-", "\n").replace(" ", "\n")


def graded(stem: str) -> tuple[ObjectModel, ...]:
    """A personal object's look-alikes, hard ones first."""
    return tuple(sorted(lookalikes(stem), key=lambda model: TIERS.index(tier(model))))


def lookalike_sheet(stage: Stage) -> dict[str, list[Tile]]:
    """One row per personal object: itself, then its look-alikes from hard to easy: tier, and number in the name."""
    return {
        _label(stem): [
            Tile(stage.picture(personal_instance(stem).name), "personal", TIER_COLOURS["personal"]),
            *(
                Tile(
                    stage.picture(m.name),
                    f"{tier(m)}, {m.name.rpartition('-')[2]}",
                    TIER_COLOURS[tier(m)],
                )
                for m in graded(stem)
            ),
        ]
        for stem in STEMS
    }


def generic_sheet(kinds: Sequence[str], n: int = 6, size: int = 160) -> dict[str, list[Tile]]:
    """One row per kind (a category, or a family's stem): its first `n` generic instances, which training draws from."""
    models = {kind: [generic_instance(kind, i) for i in range(n)] for kind in kinds}
    with Stage([model for row in models.values() for model in row], size) as stage:
        return {
            _label(kind): [Tile(stage.picture(model.name)) for model in row]
            for kind, row in models.items()
        }


def reference_sheet(
    memory: Mapping[str, tuple[PersonalObject, tuple[int, ...]]],
) -> dict[str, list[Tile]]:
    """One row per remembered object: its crops; those that no detector cut are marked as whole photos."""
    return {
        _label(stem): [
            Tile(
                picture,
                "whole photo" if i in whole else "",
                TIER_COLOURS["hard"] if i in whole else TIER_COLOURS["easy"],
            )
            for i, picture in enumerate(obj.crops)
        ]
        for stem, (obj, whole) in memory.items()
    }


def hardness(stage: Stage, encoder: Encoder) -> "pd.DataFrame":
    """How near the encoder finds each look-alike to five references of the personal object, next to new views of that object itself.

    One line per look-alike: `cosine`, mean over queries and references; `own`, the same for the personal object's queries; `fooled`, the
    share of votes that the look-alike would win, over every reference, view of the look-alike and view of the personal object.
    """
    import pandas as pd

    lines = []
    for stem in STEMS:
        mine = personal_instance(stem).name
        references = encoder([cut(stage, mine, shot) for shot in REFERENCES])
        own = encoder([cut(stage, mine, shot) for shot in QUERIES]) @ references.T
        for model in graded(stem):
            theirs = encoder([cut(stage, model.name, shot) for shot in QUERIES]) @ references.T
            lines.append(
                {
                    "object": stem.replace("-", " "), "lookalike": model.name, "tier": tier(model), "cosine": float(theirs.mean()),
                    "own": float(own.mean()), "fooled": float((theirs[:, None] > own[None]).mean()),
                }
            )  # fmt: skip
    return pd.DataFrame(lines)


def out_of_order(table: "pd.DataFrame") -> "pd.DataFrame":
    """Of `hardness`: pairs of one object's look-alikes of which the easier tier has the higher cosine, the widest gap first."""
    rank = table.assign(rank=table.tier.map(TIERS.index))
    pairs = rank.merge(rank, on="object", suffixes=("", "_easier"))
    wrong = pairs[(pairs["rank"] < pairs.rank_easier) & (pairs.cosine < pairs.cosine_easier)]
    wrong = wrong.assign(gap=wrong.cosine_easier - wrong.cosine).sort_values("gap", ascending=False)
    return wrong[["lookalike", "tier", "lookalike_easier", "tier_easier", "gap"]].reset_index(
        drop=True
    )


def census(lists: Mapping[str, Sequence[EpisodeRow]]) -> "pd.DataFrame":
    """One line per task and track: robot, cameras, control rate, instruction, rule, step limit, and how many looks of the room and episodes."""
    import pandas as pd

    tracks: dict[tuple[str, str, str], list[EpisodeRow]] = {}
    for name, rows in lists.items():
        for row in rows:
            tracks.setdefault((name, row.task, row.split), []).append(row)
    lines = []
    for (name, _, split), rows in tracks.items():
        suite, row = BENCHMARKS[name], rows[0]
        lines.append(
            {
                "suite": name, "robot": suite.robot, "cameras": len(suite.cameras), "Hz": suite.hz, "instruction": row.instruction, "rule": row.rule,
                "steps": row.max_steps, "track": split or "-", "looks": len({row.variant for row in rows}), "episodes": len(rows),
            }
        )  # fmt: skip
    return pd.DataFrame(lines)


def seen(row: EpisodeRow, steps: int = 0, size: int = 224) -> dict[str, Rgb]:
    """What the cameras of the row's suite see after `steps` control steps of the expert, with the variant's look and the suite's sensor."""
    expert = Expert()
    with open_row(row, image_size=size) as env:
        state = expert.start(np.random.default_rng([row.seed, row.episode]))
        for judge, _ in expert_steps(env, row, expert, state):
            if judge.steps == steps:
                break
        return dict(env.observe().images)


def frame_sheet(shown: Sequence[Sequence[EpisodeRow]]) -> dict[str, list[Tile]]:
    """One row per suite: the opening frame of each of its episodes in `shown`, by every camera."""
    return {
        rows[0].suite: [
            Tile(rgb, f"{camera}: {row.instruction}" if i == 0 else camera)
            for row in rows
            for i, (camera, rgb) in enumerate(seen(row).items())
        ]
        for rows in shown
    }


def same_layout(rows: Sequence[EpisodeRow], like: EpisodeRow) -> dict[str, EpisodeRow]:
    """One row per variant in which everything that `like` places stands as it does there; distractors may join it."""
    held = [
        place
        for place in rows
        if place.task == like.task and _spots(place)[: len(like.placements)] == _spots(like)
    ]
    return {
        variant: next(row for row in held if row.variant == variant)
        for variant in VARIANTS
        if any(row.variant == variant for row in held)
    }


def _spots(row: EpisodeRow) -> list[tuple[str, float, float, float]]:
    return [(place.model, place.x, place.y, place.yaw) for place in row.placements]


def bounds(path: Path) -> list[Score]:
    """The scores of the episodes in a parquet file, one line each, in the order of the suites and their tasks."""
    import pandas as pd

    order = {
        (suite.name, task.name): i
        for i, (suite, task) in enumerate(
            (suite, task) for suite in BENCHMARKS.values() for task in suite.tasks
        )
    }
    return sorted(
        score(pd.read_parquet(path).to_dict("records")),
        key=lambda s: (order[s.suite, s.task], s.split == "variant aggregation", s.policy),
    )


def pooled(scores: Sequence[Score]) -> "pd.DataFrame":
    """Success of every policy per suite, all its tasks and tracks taken together, with its 95 % Wilson interval."""
    import pandas as pd

    keys = dict.fromkeys((s.suite, s.policy) for s in scores)
    rates = {
        key: rate(
            sum(s.sr.k for s in scores if (s.suite, s.policy) == key),
            sum(s.n for s in scores if (s.suite, s.policy) == key),
        )
        for key in keys
    }
    return pd.DataFrame(
        [
            {"suite": suite, "policy": policy, "episodes": r.n, "SR % [95 %]": str(r)}
            for (suite, policy), r in rates.items()
        ]
    )
