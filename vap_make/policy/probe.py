"""Closed-loop episodes of a trained policy with generic objects that no film has shown.

They show what it can do before any user's object is involved. Four ways to say which object is
meant: a tint from the simulator's masks and the colour's word (VAP at its best); the word of the
colour that its materials are dyed with; a description of its own look; or nothing. When nothing is
said, any of its kind is right, and what counts is whether the hand commits.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache, partial
from operator import itemgetter
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from vap_core.base.errors import BadOutput, BadStudy, one_of
from vap_core.base.files import make_folder, read_parquet, write_atomic
from vap_core.base.types import Attended, Colour, Description, Rgb
from vap_core.policies.lerobot import adapter as lerobot
from vap_core.policies.names import label_of
from vap_core.prompt import PALETTE, tint
from vap_core.rollout.loop import Trial, rollout
from vap_core.rollout.prompters import PromptContext, unchanged
from vap_core.simulation.assets.objects import get_object
from vap_core.simulation.suites import Suite, Task, suite
from vap_core.simulation.suites.open_row import build_scene
from vap_core.simulation.types import EpisodeRow, Observation
from vap_core.study.stats import rate
from vap_core.study.table import printed
from vap_core.study.trials import shipped
from vap_core.study.workers import results
from vap_make.colours import HUES_DEG, stands_out
from vap_make.films.captions import describe, distinguishes
from vap_make.films.demonstrations import draw_models, row
from vap_make.objects import dyed_as, material_colours
from vap_make.policy.commands import describe_instruction, phrase_instruction
from vap_make.recipe import FILMED, RECIPES

if TYPE_CHECKING:
    import pandas as pd

WAYS = ("tinted", "coloured", "described", "plain")
EACH = 4
"""Episodes of one scene, each run in every way."""
ASKED = ["suite", "policy", "method"]
"""What tells the episodes of a kept table apart, whose place others take."""
OTHER_TABLE = "name another table with --out"
ProbeState = tuple[Colour, str]
"""The colour and the instruction of one episode."""


class ProbePrompter:
    """Says which object is meant; "tinted" tints it by ground-truth masks at every step."""

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
        described = _described(tuple(_same_kind(row)))
        colour = _draw_tint(row, rng)
        length = _length(described, rng)  # Drawn in every way, so that all ways draw alike.
        task = suite(row.suite).task(row.task)
        if self.way == "plain":
            text = context.instruction.replace("my ", "the ", 1)
        elif self.way == "described":
            text = describe_instruction(task, getattr(described[row.target], length))
        elif self.way == "coloured":
            text = phrase_instruction(task, material_colours(row.target)[0], rng)
        else:
            text = phrase_instruction(task, colour.name, rng)
        state = (colour, text)
        return state, self._prompt(state, observation, context)

    def steps(
        self,
        states: Sequence[ProbeState],
        observations: Sequence[Observation],
        contexts: Sequence[PromptContext],
    ) -> list[tuple[ProbeState, Attended]]:
        prompted = []
        for state, observation, context in zip(states, observations, contexts, strict=True):
            prompted.append((state, self._prompt(state, observation, context)))
        return prompted

    def _prompt(
        self, state: ProbeState, observation: Observation, context: PromptContext
    ) -> Attended:
        assert context.truth is not None
        colour, text = state
        images = dict(observation.images)
        for camera, rgb in observation.images.items():
            mask = context.truth.masks[camera].get(context.truth.row.target)
            if mask is not None and self.way == "tinted":
                images[camera] = tint(rgb, mask, colour)
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
) -> "pd.DataFrame":
    """One row per episode: suite, task, way, and how it ended.

    Scenes are spread over the suite's tasks; `execute` is the number of actions of each chunk that
    are carried out, None as the checkpoint says.

    Raises: UnknownName, BadStudy, BadPolicy.
    """
    import pandas as pd
    from tqdm import tqdm

    if suite_name not in FILMED:
        raise one_of("measure policy: suite", suite_name, FILMED)
    if FILMED[suite_name].pairs:
        raise BadStudy(
            f"measure policy: the commands of {suite_name} name two personal objects, and these "
            "ways ask for one; run its episodes with eval."
        )
    if not ways:
        raise BadStudy("measure policy: there is no way to ask; name one by --ways.")
    for way in ways:
        if way not in WAYS:
            raise one_of("probe: way", way, WAYS)
    work = partial(_scene, checkpoint, suite_name, tuple(ways), execute, seed)
    done = tqdm(
        results(work=work, jobs=range(scenes), workers=workers, remedy="--workers"),
        desc=f"episodes of {suite_name}",
        total=scenes,
        unit="scene",
    )
    lines = []
    for _, part in sorted(done, key=itemgetter(0)):
        lines += part
    if not lines:
        raise BadStudy(
            f"probe: nothing fits on the table of {suite_name} in {scenes} scenes; "
            "ask for more --scenes."
        )
    return pd.DataFrame(lines)


def conclude(table: "pd.DataFrame") -> str:
    """Rates by suite, policy and way: n, and percent with Wilson's 95 % interval."""
    header = ["suite", "policy", "way", "n", "succeeds", "moves a wrong object"]
    lines = [[*header, "touches something"]]
    for (known, policy, way), part in table.groupby(["suite", "policy", "method"], sort=False):
        n = len(part)
        line = [str(known), str(policy), str(way), str(n)]
        for name in ("success", "wrong_object", "touched"):
            count = int(part[name].sum())
            line.append(str(rate(count, n)))
        lines.append(line)
    return printed(lines)


def kept(path: Path) -> "pd.DataFrame | None":
    """The episodes of a table that others are to be added to; None where there is no table yet.

    Raises: BadOutput for a file to which nothing can be added.
    """
    make_folder(path.parent, "probe", OTHER_TABLE)
    if not path.exists():
        return None
    found = read_parquet(path, "probe", OTHER_TABLE)
    if not set(ASKED) <= set(found):
        raise BadOutput(f"probe: {path} holds no episodes of measure policy; {OTHER_TABLE}.")
    return found


def keep(table: "pd.DataFrame", path: Path) -> None:
    """Add the episodes to a table; those of the same suite, policy and way are replaced.

    Raises: BadOutput.
    """
    import pandas as pd

    columns = [name for name in table if name != "detail" and not name.startswith("seconds_")]
    keys = list(table[ASKED].drop_duplicates().itertuples(index=False, name=None))
    old = kept(path)
    if old is None:
        old = table[:0]
    try:
        old_keys = pd.MultiIndex.from_frame(old[ASKED])
        parts = []
        for part in (old[~old_keys.isin(keys)], table[columns]):
            if len(part):
                parts.append(part)
        whole = pd.concat(parts, ignore_index=True)
        write_atomic(path, whole.to_parquet(compression="zstd", index=False))
    except (OSError, ValueError) as error:
        raise BadOutput(
            f"probe: {path} cannot be added to ({type(error).__name__}); {OTHER_TABLE}."
        ) from error


def of_shipped(table: "pd.DataFrame") -> "pd.DataFrame":
    """The episodes of the policies that ship; a suite without any keeps those of others.

    The column `whose` holds the label of such others, and nothing for a policy that ships.

    Raises: BadPolicy when a policy that ships lacks a file, or one is damaged.
    """
    labels = {}
    for name in table["suite"].unique():
        folder = shipped(name)
        labels[name] = label_of(folder) if folder.is_dir() else ""
    ships = table["policy"] == table["suite"].map(labels)
    without = ~ships.groupby(table["suite"]).transform("any")
    return table.assign(whose=table["policy"].where(without, ""))[ships | without]


def _scene(
    checkpoint: str,
    suite_name: str,
    ways: Sequence[str],
    execute: int | None,
    seed: int,
    number: int,
) -> list[dict[str, Any]]:
    """The episodes of scene `number`, said in every way."""
    known = suite(suite_name)
    rng = np.random.default_rng([78, seed, *suite_name.encode(), number])
    task = known.tasks[number % len(known.tasks)]
    names = [model.name for model in draw_models(known, task, rng, held_out=True)]
    if task.goal:
        names.append(task.goal)
    rows = _rows(known=known, task=task, names=names, number=number, rng=rng)
    coloured = [_with_dyed_target(row) for row in rows]
    lines = []
    with build_scene(suite_name, [*names, *{row.target: 0 for row in coloured}]) as scene:
        policy = lerobot.load_for_suite(checkpoint, scene, known)
        if execute is not None:
            policy = policy.with_execute(execute)
        for way in ways:
            played = rows
            if way == "described":
                played = [row for row in rows if _can_describe(row)]
            elif way == "coloured":
                played = coloured
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


def _rivals_show(row: EpisodeRow) -> list[frozenset[str]]:
    """The colours of the materials of the target's rivals."""
    return [material_colours(name)[1] for name in _same_kind(row)[1:]]


def _draw_tint(row: EpisodeRow, rng: np.random.Generator) -> Colour:
    """A colour of the palette that no rival shows; any where there is none."""
    rivals = _rivals_show(row)
    usable = [colour for colour in PALETTE if stands_out(colour.name, rivals)] or list(PALETTE)
    return usable[int(rng.integers(len(usable)))]


def _with_dyed_target(row: EpisodeRow) -> EpisodeRow:
    """The episode with its target dyed in a colour that no rival shows."""
    rng = np.random.default_rng([77, row.seed, row.episode])
    rivals = _rivals_show(row)
    left_out = RECIPES[row.suite].held_out_words
    words = [word for word in HUES_DEG if word not in left_out and stands_out(word, rivals)]
    model = dyed_as(str(rng.choice(words or list(HUES_DEG))), get_object(row.target), rng)
    first, *others = row.placements
    return replace(row, placements=(replace(first, model=model.name), *others))


@cache
def _described(names: tuple[str, ...]) -> dict[str, Description]:
    """The objects in the captioner's words."""
    return describe([get_object(name) for name in names])


def _length(described: Mapping[str, Description], rng: np.random.Generator) -> str:
    """Which description to use; one that distinguishes the target, if any does."""
    names = list(described)
    lengths = [str(length) for length in rng.permutation(["short", "long"])]
    for length in lengths:
        if distinguishes(described, names, length):
            return length
    return lengths[0]


def _can_describe(row: EpisodeRow) -> bool:
    """Whether a description of the target distinguishes it from its rivals."""
    names = tuple(_same_kind(row))
    described = _described(names)
    return any(distinguishes(described, names, length) for length in ("short", "long"))


def _same_kind(row: EpisodeRow) -> list[str]:
    """The target, then its rivals."""
    return [place.model for place in row.placements if place.model != row.goal]


def _rows(
    known: Suite, task: Task, names: Sequence[str], number: int, rng: np.random.Generator
) -> list[EpisodeRow]:
    """Episodes with these objects in new places; fewer than EACH where they do not fit."""
    rows = []
    for i in range(EACH):
        episode = number * EACH + i
        try:
            drawn = row(known=known, task=task, names=names, number=episode, rng=rng)
        except ValueError:
            # No room for these: the next draw may have it.
            continue
        rows.append(drawn)
    return rows
