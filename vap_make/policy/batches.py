"""What one step of a policy's training sees.

Frames of films, each with a command of its own and the chunk that the expert carries out from
there.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, UInt8
from torch import Tensor

from vap_core.base.errors import BadOutput
from vap_core.policies.mini_pi0.configuration_mini_pi0 import MiniPI0Config
from vap_core.policies.mini_pi0.processor_mini_pi0 import encode
from vap_core.policies.scripted.expert import TURN_RAD_S
from vap_core.simulation.suites import suite
from vap_make.films.demonstrations import Film
from vap_make.patches import patch_shares
from vap_make.policy.commands import Command, Known, Seen, colours_of, command
from vap_make.recipe import Recipe

AROUND = 4
"""Pictures from a change of the gripper that `focus` still calls close."""
START = 4.0
"""How many times `focus` the first pictures of a film are worth: they decide how the hand turns."""
FIRST = 3
"""How many first pictures of a film are worth that."""
STILL = 2e-3
"""Metres or radians: a step that asks for less and changes less is a wait."""
SPIN_Z = 5
"""Index of the hand's turn about the vertical, radians.

In states, and in actions of end-effector control.
"""
SPUN = 0.5
"""How often a hand is shown turned otherwise."""
IN_TIME = 0.8
"""Which part of the time that is left a hand that was turned otherwise has to turn back."""
ANGLES = (slice(3, 6), slice(7, None))
"""Where a state has angles in radians: the hand's turn, and the joints after the gripper."""
STEADY = 0.01
"""Least deviation by which an action or a state is scaled: what hardly moves is not blown up."""


@dataclass
class Batch:
    """Tensors of one step.

    Pictures (b x c x 3 x s x s, 0 to 255), tokens and where there are any, scaled state and chunk;
    of target and goal, the share of either in every patch (b x 2 x p) and its place (b x 2 x 3,
    metres, nan without a goal); how the hand will close on the target (b x 2, `turn`); embeddings
    of learned words (b x d, zeros where the command has none).
    """

    images: Tensor
    tokens: Tensor
    there: Tensor
    state: Tensor
    actions: Tensor
    patches: Tensor
    place: Tensor
    turn: Tensor
    learned: Tensor

    def to(self, device: torch.device) -> "Batch":
        """The same batch on a device."""
        moved = {part.name: getattr(self, part.name).to(device) for part in fields(self)}
        return Batch(**moved)


class Frames:
    """The frames of some films of one suite, to draw batches from.

    Every task is drawn as often, and in it a frame as often as `emphasis` says, where a command
    fits it. Films that show a held-out word's colour are left out.

    Raises: UnknownName for a recipe of a suite that no registry holds.
    """

    def __init__(
        self,
        recipe: Recipe,
        films: Sequence[Film],
        stats: dict[str, dict[str, Tensor]],
        config: MiniPI0Config,
        known: Known,
    ) -> None:
        self.recipe = recipe
        held_out = set(recipe.held_out_words)
        self.films: list[Film] = []
        self.colours: list[list[Seen]] = []
        for film in films:
            colours = colours_of(film)
            if all(held_out.isdisjoint(shown) for _, shown in colours):
                self.films.append(film)
                self.colours.append(colours)
        if films and not self.films:
            raise BadOutput(
                f"train policy: every film shows {' or '.join(sorted(held_out))}, which the recipe "
                "holds out; film others with another --seed or --cache."
            )
        films = self.films
        self.stats = stats
        self.config = config
        self.known = known
        benchmark = suite(recipe.suite)
        self.interval = recipe.interval
        self.turns = benchmark.control == "ee"
        self.turn_rad = TURN_RAD_S / benchmark.hz
        self.number = {word: i for i, word in enumerate(config.words)}
        self.chances = [emphasis(film, recipe.focus, self.interval) for film in films]
        self.totals = np.array([chances.sum() for chances in self.chances])
        tasks, task_of = np.unique([film.task for film in films], return_inverse=True)
        self.share = self.totals / np.bincount(task_of, self.totals)[task_of] / len(tasks)

    def draw(self, n: int, rng: np.random.Generator) -> Batch:
        """A batch of `n` frames, drawn anew. Raises: as `command`."""
        commands: list[Command] = []
        states = []
        chunks = []
        patches = []
        places = []
        turns = []
        while len(commands) < n:
            sample = self._draw_sample(int(rng.choice(len(self.films), p=self.share)), rng)
            if sample is None:
                continue
            commands.append(sample.command)
            states.append(sample.state)
            chunks.append(sample.chunk)
            patches.append(sample.patches)
            places.append(sample.place)
            turns.append(sample.turn)
        tokens, there = encode(
            [each.text for each in commands], self.number, self.config.tokenizer_max_length
        )
        return Batch(
            images=_stack_images(commands),
            tokens=tokens,
            there=there,
            state=self._scale("observation.state", self._read_angles(np.stack(states), rng)),
            actions=self._scale("action", np.stack(chunks)),
            patches=torch.from_numpy(np.stack(patches)).float(),
            place=torch.from_numpy(np.stack(places)),
            turn=torch.from_numpy(np.array(turns, np.float32)),
            learned=_stack_learned(commands, self.config.width),
        )

    def _draw_sample(self, i: int, rng: np.random.Generator) -> "_Sample | None":
        """A frame of film i, drawn anew; None where no command of the drawn form fits it."""
        film = self.films[i]
        chances = self.chances[i]
        picture = int(rng.choice(len(chances), p=chances / self.totals[i]))
        t = picture * self.interval
        drawn = command(film, t, self.recipe, self.known, self.colours[i], rng)
        if drawn is None:
            return None
        state = film.state[t]
        chunk = target_chunk(film, t, self.config.chunk_size)
        closing = (np.nan, np.nan)
        if self.turns:
            closing = turn(film, t)
            if rng.random() < SPUN:
                state, chunk = turn_otherwise(
                    film=film, t=t, chunk=chunk, turn_rad=self.turn_rad, rng=rng
                )
        patches = []
        place = np.full((2, 3), np.nan, np.float32)
        for row, index in enumerate((0, film.goal)):
            mask = (film.ids[picture] == index + 1) & (index >= 0)
            patches.append(patch_shares(mask, self.config.patch))
            if index >= 0:
                place[row] = film.places[t, index]
        return _Sample(
            command=drawn,
            state=state,
            chunk=chunk,
            patches=np.stack(patches),
            place=place,
            turn=closing,
        )

    def _read_angles(
        self, states: Float32[np.ndarray, "b p"], rng: np.random.Generator
    ) -> Float32[np.ndarray, "b p"]:
        """The states, their angles with noise."""
        for angles in ANGLES:
            exact = states[:, angles]
            exact += rng.normal(0.0, self.recipe.angle_noise_rad, exact.shape)
        return states

    def _scale(self, name: str, rows: Float32[np.ndarray, "..."]) -> Tensor:
        """Rows as lerobot's normalisers scale them."""
        stats = self.stats[name]
        return (torch.from_numpy(rows) - stats["mean"]) / stats["std"]


def statistics(films: Sequence[Film], angle_noise_rad: float = 0.0) -> dict[str, dict[str, Tensor]]:
    """Mean and deviation of states and actions, as lerobot's normalisers want them.

    Angles of states deviate by the noise with which they are read, too.
    """
    states = []
    actions = []
    for film in films:
        states.append(film.state)
        actions.append(film.action)
    scales = {"observation.state": _mean_and_std(states), "action": _mean_and_std(actions)}
    deviation = scales["observation.state"]["std"]
    for angles in ANGLES:
        deviation[angles] = torch.hypot(deviation[angles], torch.tensor(angle_noise_rad))
    return scales


def emphasis(film: Film, focus: float, apart: int = 1) -> Float[np.ndarray, " f"]:
    """How often each picture, one in `apart` steps, is drawn.

    More often close to a change of the gripper's command and to the end, where a centimetre
    decides; most often at the start, where it is decided which way the hand turns; and never where
    the expert waits, as a policy without memory would wait for ever.
    """
    shut = film.action[:, -1] < 0.5
    changes = [0, *np.flatnonzero(shut[1:] != shut[:-1]) + 1, len(shut) - 1]
    steps = np.arange(0, len(shut), apart)
    distances = np.abs(steps[:, None] - changes).min(axis=1)
    chances = np.where(distances <= AROUND * apart, focus, 1.0)
    chances[:FIRST] *= START
    return np.where(waits(film)[::apart], 0.0, chances)


def turn(film: Film, t: int) -> tuple[float, float]:
    """How the hand is turned where it closes next.

    The cosine and sine of twice its angle about the vertical, as a jaw turned half around is the
    same. NaN while it is closed, and when it closes no more. States begin with the hand's pose, as
    under end-effector control.
    """
    close = _open_for(film.action[t:])
    if not 0 < close < len(film.action) - t:
        return np.nan, np.nan
    angle = float(film.state[t + close, SPIN_Z])
    return float(np.cos(2 * angle)), float(np.sin(2 * angle))


def turn_otherwise(
    film: Film, t: int, chunk: Float32[np.ndarray, "n 7"], turn_rad: float, rng: np.random.Generator
) -> tuple[Float32[np.ndarray, " p"], Float32[np.ndarray, "n 7"]]:
    """The state at t and the chunk from there, had the hand been turned otherwise.

    It is turned about the vertical, by as much as it can still turn back at `turn_rad` a step; both
    are as they were when it closes no more. In the expert's films a hand that turns goes on
    turning, and one that does not is turned as it should be: a policy that learns from them alone
    looks at the hand, and not at the object. The hand points down, so its last joint turns it and
    nothing else; pictures stay as they are.
    """
    close = _open_for(film.action[t:])
    if not 0 < close < len(film.action) - t:
        return film.state[t], chunk
    state = film.state[t].copy()
    chunk = chunk.copy()
    most = min(np.pi / 2, IN_TIME * turn_rad * close)
    left = float(rng.uniform(-1, 1)) * most
    offset = float(film.action[t : t + close, SPIN_Z].sum()) - left
    state[SPIN_Z] += offset
    state[-1] -= offset
    for action in chunk[: _open_for(chunk)]:
        action[SPIN_Z] = np.clip(left, -turn_rad, turn_rad)
        left -= float(action[SPIN_Z])
    return state, chunk


def waits(film: Film) -> Bool[np.ndarray, " t"]:
    """The steps in which nothing is asked for and nothing happens.

    Those at the end, where there is nothing left to do, do not count.
    """
    gripper = film.action[:, -1]
    motion = np.abs(film.action[:, :-1]).max(axis=1)
    asked = motion + np.abs(np.diff(gripper, prepend=gripper[0]))
    change = np.abs(np.diff(film.state, axis=0, append=film.state[-1:])).max(axis=1)
    idle = (asked < STILL) & (change < 2 * STILL)
    return idle & np.logical_or.accumulate(~idle[::-1])[::-1]


def target_chunk(film: Film, t: int, size: int) -> Float32[np.ndarray, "n a"]:
    """The chunk that is taught at step t: what the expert does from there, its waits left out.

    After the film's end, nothing moves. A jaw that has just closed looks like one that has waited:
    with the waits in the chunk, a policy that is asked there waits for ever.
    """
    moving = np.flatnonzero(~waits(film))
    rest = film.action[moving[moving >= t][:size]]
    still = np.repeat(rest[-1:], size - len(rest), axis=0)
    still[:, :-1] = 0.0
    return np.concatenate([rest, still])


@dataclass
class _Sample:
    """One frame of a batch."""

    command: Command
    state: Float32[np.ndarray, " p"]
    chunk: Float32[np.ndarray, "n a"]
    patches: Float[np.ndarray, "2 k"]
    place: Float32[np.ndarray, "2 3"]
    turn: tuple[float, float]


def _stack_images(commands: Sequence[Command]) -> UInt8[Tensor, "b c 3 s s"]:
    """Views, the colours before rows and columns."""
    views = np.stack([each.images for each in commands])
    return torch.from_numpy(views).permute(0, 1, 4, 2, 3)


def _stack_learned(commands: Sequence[Command], width: int) -> Float[Tensor, "b d"]:
    """The embeddings of learned words, zeros where there is none."""
    learned = torch.zeros(len(commands), width)
    for row, each in zip(learned, commands, strict=True):
        if each.embedding is not None:
            row.copy_(torch.from_numpy(each.embedding))
    return learned


def _mean_and_std(parts: Sequence[Float32[np.ndarray, "_ n"]]) -> dict[str, Tensor]:
    rows = np.concatenate(parts)
    least = STEADY * max(1e-3, float(rows.std()))
    return {
        "mean": torch.from_numpy(rows.mean(0)),
        "std": torch.from_numpy(np.maximum(rows.std(0), least)),
    }


def _open_for(actions: Float32[np.ndarray, "n a"]) -> int:
    """How many actions come before the hand is told to close; all of them where it is not."""
    shut = actions[:, -1] < 0.5
    return int(shut.argmax()) if shut.any() else len(shut)
