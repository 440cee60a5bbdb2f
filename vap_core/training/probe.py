"""What a trained policy can do before anybody's own object is in play: closed-loop episodes with generic objects that no film has shown.

Four ways to say which of them is meant: a tint from the simulator's masks and the colour's word (VAP at its best), paint (it has the colour by
nature), a description of its own look, or nothing. When nothing is said, any of its kind is right, and what counts is whether the hand commits.
"""

from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vap_core.errors import BadOutput, BadStudy, one_of
from vap_core.files import write_atomic
from vap_core.metrics import rate
from vap_core.oracle import Masks, Revealed
from vap_core.policies import lerobot
from vap_core.processes import results
from vap_core.prompt import ALPHA
from vap_core.report.text import align
from vap_core.rollout import Trial, rollout
from vap_core.sim import objects
from vap_core.sim.scenes import build
from vap_core.suites import VARIANTS, suite
from vap_core.training.commands import Way, painted, say, telling, tinted
from vap_core.training.demonstrations import cast, row
from vap_core.training.words import free, looks
from vap_core.values import Attended, EpisodeRow, PersonalObject, Views

if TYPE_CHECKING:
    import pandas as pd

WAYS: tuple[Way, ...] = ("tinted", "painted", "described", "plain")
EACH = 4
"""Episodes of one scene, each said in every way."""
COAT = 0.85
"""Opacity of paint."""


class Told(Revealed):
    """Colours the target by the simulator's masks at every step, and says what tells it."""

    def __init__(self, way: str) -> None:
        self.way = way

    @property
    def memory(self) -> Mapping[str, PersonalObject]:
        return {}

    @property
    def highlights(self) -> bool:
        """Nothing of it is judged: what it shows is the truth."""
        return False

    @property
    def always(self) -> bool:
        return True

    def start(self, views: Views, instruction: str, row: EpisodeRow, masks: Masks) -> tuple[Any, Attended]:
        rng = np.random.default_rng([79, row.seed, row.episode])
        names = _same_kind(row)
        usable = free({word for name in names[1:] for word in looks(name)})
        colour = usable[int(rng.integers(len(usable)))]
        word = {"plain": "", "described": telling(names, rng)}.get(self.way, colour.name)
        text = say(suite(row.suite).task(row.task), word, rng) if word else instruction.replace("my ", "the ", 1)
        return (colour, text), self._show((colour, text), views, row, masks)

    def steps(self, states: Sequence[Any], views: Sequence[Views], rows: Sequence[EpisodeRow], masks: Sequence[Masks]) -> list[tuple[Any, Attended]]:
        return [(state, self._show(state, seen, row, now)) for state, seen, row, now in zip(states, views, rows, masks, strict=True)]

    def _show(self, state: Any, views: Views, row: EpisodeRow, masks: Masks) -> Attended:
        (colour, text), shown = state, dict(views)
        if self.way in ("tinted", "painted"):
            for camera, rgb in views.items():
                mask = masks[camera].get(row.target)
                if mask is not None:
                    change = partial(tinted, alpha=ALPHA) if self.way == "tinted" else partial(painted, coat=COAT)
                    shown[camera] = change(rgb[None], mask[None], colour)[0]
        return Attended(shown, text, (), {}, {}, ())


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
    done = tqdm(results(work, list(range(scenes)), workers, "--workers"), f"episodes of {suite_name}", scenes, unit="scene")
    lines = [line for _, part in sorted(done, key=lambda found: found[0]) for line in part]
    if not lines:
        raise BadStudy(f"probe: nothing fits on the table of {suite_name} in {scenes} scenes; ask for more --scenes.")
    return pd.DataFrame(lines)


def _scene(checkpoint: str, suite_name: str, ways: Sequence[str], execute: int | None, seed: int, number: int) -> list[dict[str, Any]]:
    known, rng = suite(suite_name), np.random.default_rng([78, seed, *suite_name.encode(), number])
    task = known.tasks[number % len(known.tasks)]
    names = cast(known, task, rng, held_out=True)
    rows = list(_rows(known, task, names, number, rng))
    sizes = {name: objects.extent_m(objects.get(name)) for name in names}
    lines = []
    with build(known.robot, names, look=VARIANTS["base"].look) as scene:
        policy = lerobot.fitted(checkpoint, scene, known)
        if execute is not None:
            policy = policy.executing(execute)
        for way in ways:
            played = [row for row in rows if way != "described" or looks(row.target).difference(*map(looks, _same_kind(row)[1:]))]
            trial = Trial(way, scene, policy, Told(way), sizes, known.control, known.sensor, follow="call")
            for episode in rollout(trial, played, batch=EACH):
                lines.append({**episode.summary(), "scene": number})
    return lines


def _same_kind(row: EpisodeRow) -> list[str]:
    """The target, then its rivals."""
    return [place.model for place in row.placements if place.model != row.goal]


def _rows(known: Any, task: Any, names: Sequence[str], number: int, rng: np.random.Generator) -> Iterator[EpisodeRow]:
    for i in range(EACH):
        try:
            yield row(known, task, names, number * EACH + i, "base", rng)
        except ValueError:  # no room for these: the next draw may have it
            continue


def conclude(table: "pd.DataFrame") -> str:
    """Rates by suite, task and way: n, and percent with Wilson's 95 % interval."""
    lines = [["suite", "policy", "way", "n", "succeeds", "moves a wrong object", "touches something"]]
    for (known, policy, way), part in table.groupby(["suite", "policy", "method"], sort=False):
        shown = [rate(int(part[name].sum()), len(part)) for name in ("success", "wrong_object", "touched")]
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
        whole = pd.concat([part for part in (others, table[columns]) if len(part)], ignore_index=True)
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomic(path, whole.to_parquet(compression="zstd", index=False))
    except (OSError, ValueError, KeyError) as error:
        raise BadOutput(f"probe: {path} cannot be added to ({type(error).__name__}); name another table with --out.") from error
