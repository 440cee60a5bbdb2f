"""What a trained policy can do before anybody's own object is in play: closed-loop episodes with generic objects that no film has shown.

Four ways to say which of them is meant: a tint from the simulator's masks and the colour's word (VAP at its best), paint (it has the colour by
nature), a description of its own look, or nothing. When nothing is said, any of its kind is right, and what counts is whether the hand commits.
"""

from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from vap_core.base.errors import BadOutput, BadStudy, one_of
from vap_core.base.files import write_atomic
from vap_core.base.tables import align
from vap_core.base.types import Attended, Colour, Rgb
from vap_core.evaluation.metrics import rate
from vap_core.evaluation.processes import results
from vap_core.policies.lerobot import adapter as lerobot
from vap_core.prompt import ALPHA
from vap_core.rollout.loop import Trial, rollout
from vap_core.rollout.prompters.protocol import PromptContext, unchanged
from vap_core.simulation.suites import suite
from vap_core.simulation.suites.open_row import build_scene
from vap_core.simulation.types import EpisodeRow, Observation
from vap_core.training.films.demonstrations import cast, row
from vap_core.training.policy.commands import Way, painted, say, telling, tinted
from vap_core.training.words import free, looks

if TYPE_CHECKING:
    import pandas as pd

WAYS: tuple[Way, ...] = ("tinted", "painted", "described", "plain")
EACH = 4
"""Episodes of one scene, each said in every way."""
COAT = 0.85
"""Opacity of paint."""
ProbeState = tuple[Colour, str]
"""The colour and the instruction of one episode."""


class ProbePrompter:
    """Colours the target by ground-truth masks at every step, and says which object is meant."""

    needs_truth: Literal["never", "start", "always"] = "always"
    highlights = False
    """Its coverage is not recorded: what it shows is ground truth."""
    references: Mapping[str, tuple[Rgb, ...]] = MappingProxyType({})

    def __init__(self, way: str) -> None:
        self.way = way

    def start(
        self, observation: Observation, context: PromptContext
    ) -> tuple[ProbeState, Attended]:
        assert context.truth is not None
        row = context.truth.row
        rng = np.random.default_rng([79, row.seed, row.episode])
        names = _same_kind(row)
        usable = free({word for name in names[1:] for word in looks(name)})
        colour = usable[int(rng.integers(len(usable)))]
        word = {"plain": "", "described": telling(names, rng)}.get(self.way, colour.name)
        if word:
            text = say(suite(row.suite).task(row.task), word, rng)
        else:
            text = context.instruction.replace("my ", "the ", 1)
        state = colour, text
        return state, self._prompt(state, observation, context)

    def steps(
        self,
        states: Sequence[ProbeState],
        observations: Sequence[Observation],
        contexts: Sequence[PromptContext],
    ) -> list[tuple[ProbeState, Attended]]:
        results = []
        for state, observation, context in zip(states, observations, contexts, strict=True):
            results.append((state, self._prompt(state, observation, context)))
        return results

    def _prompt(
        self, state: ProbeState, observation: Observation, context: PromptContext
    ) -> Attended:
        assert context.truth is not None
        (colour, text), images = state, dict(observation.images)
        for camera, rgb in observation.images.items():
            mask = context.truth.masks[camera].get(context.truth.row.target)
            if mask is None:
                continue
            if self.way == "tinted":
                (images[camera],) = tinted(rgb[None], mask[None], colour, alpha=ALPHA)
            elif self.way == "painted":
                (images[camera],) = painted(rgb[None], mask[None], colour, coat=COAT)
        return unchanged(images, text)


def probe(
    checkpoint: str,
    suite_name: str,
    *,
    scenes: int = 12,
    ways: Sequence[str] = WAYS,
    execute: int | None = None,
    seed: int = 0,
    workers: int = 2,
) -> "pd.DataFrame":  # fmt: skip
    """One row per episode: suite, task, way, and how it ended. Scenes are spread over the suite's tasks; `execute` is the number of actions of
    each chunk that are carried out, None as the checkpoint says. Raises: UnknownName, BadStudy, BadPolicy."""
    import pandas as pd
    from tqdm import tqdm

    for way in ways:
        if way not in WAYS:
            raise one_of("probe: way", way, WAYS)
    work = partial(_scene, checkpoint, suite_name, tuple(ways), execute, seed)
    done = tqdm(
        results(work, list(range(scenes)), workers, "--workers"),
        f"episodes of {suite_name}",
        scenes,
        unit="scene",
    )
    lines = [line for _, part in sorted(done, key=lambda found: found[0]) for line in part]
    if not lines:
        raise BadStudy(
            f"probe: nothing fits on the table of {suite_name} in {scenes} scenes; ask for more --scenes."
        )
    return pd.DataFrame(lines)


def _scene(
    checkpoint: str,
    suite_name: str,
    ways: Sequence[str],
    execute: int | None,
    seed: int,
    number: int,
) -> list[dict[str, Any]]:
    known, rng = suite(suite_name), np.random.default_rng([78, seed, *suite_name.encode(), number])
    task = known.tasks[number % len(known.tasks)]
    names = cast(known, task, rng, held_out=True)
    rows = list(_rows(known, task, names, number, rng))
    lines = []
    with build_scene(suite_name, names) as scene:
        policy = lerobot.load_for_suite(checkpoint, scene, known)
        if execute is not None:
            policy = policy.with_execute(execute)
        for way in ways:
            played = [
                row
                for row in rows
                if way != "described"
                or looks(row.target).difference(*map(looks, _same_kind(row)[1:]))
            ]
            trial = Trial(
                method=way,
                scene=scene,
                policy=policy,
                prompter=ProbePrompter(way),
                control=known.control,
                sensor=known.sensor,
                follow="call",
            )
            for episode in rollout(trial, played, batch=EACH):
                lines.append({**episode.summary(), "scene": number})
    return lines


def _same_kind(row: EpisodeRow) -> list[str]:
    """The target, then its rivals."""
    return [place.model for place in row.placements if place.model != row.goal]


def _rows(
    known: Any, task: Any, names: Sequence[str], number: int, rng: np.random.Generator
) -> Iterator[EpisodeRow]:
    for i in range(EACH):
        try:
            yield row(known, task, names, number * EACH + i, "base", rng)
        except ValueError:  # no room for these: the next draw may have it
            continue


def conclude(table: "pd.DataFrame") -> str:
    """Rates by suite, task and way: n, and percent with Wilson's 95 % interval."""
    lines = [
        ["suite", "policy", "way", "n", "succeeds", "moves a wrong object", "touches something"]
    ]
    for (known, policy, way), part in table.groupby(["suite", "policy", "method"], sort=False):
        shown = [
            rate(int(part[name].sum()), len(part))
            for name in ("success", "wrong_object", "touched")
        ]
        lines.append([str(known), str(policy), str(way), str(len(part)), *map(str, shown)])
    return align(lines)


def keep(table: "pd.DataFrame", path: Path) -> None:
    """Add the episodes to a table; those of the same suite and policy in it are replaced. Raises: BadOutput."""
    import pandas as pd

    columns = [name for name in table if name != "detail" and not name.startswith("seconds_")]
    keys = table[["suite", "policy"]].drop_duplicates().itertuples(index=False, name=None)
    try:
        old = pd.read_parquet(path) if path.exists() else table[:0]
        others = old[~pd.MultiIndex.from_frame(old[["suite", "policy"]]).isin(list(keys))]
        whole = pd.concat(
            [part for part in (others, table[columns]) if len(part)], ignore_index=True
        )
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomic(path, whole.to_parquet(compression="zstd", index=False))
    except (OSError, ValueError, KeyError) as error:
        raise BadOutput(
            f"probe: {path} cannot be added to ({type(error).__name__}); name another table with --out."
        ) from error
