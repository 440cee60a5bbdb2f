"""What one step of a policy's training sees: frames of films, each with a command of its own and the chunk that the expert carries out from there."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32
from torch import Tensor

from vap_core.policies.mini_pi0.configuration_mini_pi0 import MiniPI0Config
from vap_core.policies.mini_pi0.processor_mini_pi0 import encode
from vap_core.policies.scripted.expert import TURN_RAD_S
from vap_core.simulation.suites import suite as known
from vap_core.training.films.demonstrations import Film, every
from vap_core.training.looking import shares
from vap_core.training.policy.commands import command

AROUND = 4
"""Pictures from there that `focus` still calls close."""
START, FIRST = 4.0, 3
"""How many times `focus` the first pictures of a film are worth, and how many they are: which way the hand turns is decided there."""
STILL = 2e-3
"""Metres or radians: a step that asks for less and changes less is a wait."""
SPIN_Z = 5
"""Where states, and actions of end-effector control, keep the hand's turn about the vertical, radians."""
SPUN, IN_TIME = 0.5, 0.8
"""How often a hand is shown turned otherwise, and which part of the time that is left it has to turn back."""
STEADY = 0.01
"""Least deviation by which an action or a state is scaled: what hardly moves is not blown up."""


@dataclass
class Batch:
    """Tensors of one step: pictures (b x c x 3 x s x s in 0..1), tokens, scaled state and chunk; of target and goal, the share of either in every
    patch (b x 2 x p) and its place (b x 2 x 3, metres, nan without a goal); how the hand will close on the target (b x 2, `turn`)."""

    images: Tensor
    tokens: Tensor
    there: Tensor
    state: Tensor
    actions: Tensor
    patches: Tensor
    place: Tensor
    turn: Tensor


def statistics(films: Sequence[Film]) -> dict[str, dict[str, Tensor]]:
    """Mean and deviation of states and actions, as lerobot's normalisers want them."""
    found = {}
    for name, parts in (
        ("observation.state", [film.state for film in films]),
        ("action", [film.action for film in films]),
    ):
        rows = np.concatenate(parts)
        found[name] = {
            "mean": torch.from_numpy(rows.mean(0)),
            "std": torch.from_numpy(np.maximum(rows.std(0), STEADY * max(1e-3, float(rows.std())))),
        }
    return found


class Frames:
    """The frames of some films of one suite, to draw batches from: every task as often, and in it a frame as often as `emphasis` says."""

    def __init__(
        self,
        suite: str,
        films: Sequence[Film],
        stats: dict[str, dict[str, Tensor]],
        config: MiniPI0Config,
        focus: float,
    ) -> None:
        self.suite, self.films, self.stats, self.config = suite, films, stats, config
        self.apart, told = every(suite), known(suite)
        self.turns, self.turn_rad = told.control == "ee", TURN_RAD_S / told.hz
        self.number = {word: i for i, word in enumerate(config.words)}
        self.chances = [emphasis(film, focus, self.apart) for film in films]
        self.totals = np.array([chance.sum() for chance in self.chances])
        tasks, of = np.unique([film.task for film in films], return_inverse=True)
        self.share = self.totals / np.bincount(of, self.totals)[of] / len(tasks)

    def draw(self, n: int, rng: np.random.Generator) -> Batch:
        """A batch of `n` frames, drawn anew."""
        made, states, chunks, shown, places, turns = [], [], [], [], [], []
        for i in rng.choice(len(self.films), n, p=self.share):
            film, chances = self.films[i], self.chances[i]
            f = int(rng.choice(len(chances), p=chances / self.totals[i]))
            t = f * self.apart
            made.append(command(film, t, self.suite, rng))
            state, chunk = film.state[t], ahead(film, t, self.config.chunk_size)
            if self.turns and rng.random() < SPUN:
                state, chunk = spun(film, t, chunk, self.turn_rad, rng)
            states.append(state)
            chunks.append(chunk)
            asked = (0, film.goal)
            shown.append(
                np.stack(
                    [shares((film.ids[f] == i + 1) & (i >= 0), self.config.patch) for i in asked]
                )
            )
            places.append([film.places[t, i] if i >= 0 else (np.nan,) * 3 for i in asked])
            turns.append(turn(film, t) if self.turns else (np.nan, np.nan))
        tokens, there = encode(
            [one.text for one in made], self.number, self.config.tokenizer_max_length
        )
        state, actions = (
            self._scaled(name, rows)
            for name, rows in (("observation.state", states), ("action", chunks))
        )
        images = (
            torch.from_numpy(np.stack([one.images for one in made])).permute(0, 1, 4, 2, 3).float()
            / 255
        )
        patches, place = (
            torch.from_numpy(np.stack(shown)).float(),
            torch.from_numpy(np.array(places, np.float32)),
        )
        return Batch(
            images,
            tokens,
            there,
            state,
            actions,
            patches,
            place,
            torch.from_numpy(np.array(turns, np.float32)),
        )

    def _scaled(self, name: str, rows: Sequence[Float32[np.ndarray, "..."]]) -> Tensor:
        return (torch.from_numpy(np.stack(rows)) - self.stats[name]["mean"]) / self.stats[name][
            "std"
        ]


def emphasis(film: Film, focus: float, apart: int = 1) -> Float[np.ndarray, " f"]:
    """How often each picture, one in `apart` steps, is drawn: more often close to a change of the gripper's command and to the end, where a
    centimetre decides, most often at the start, where it is decided which way the hand turns; and never where the expert waits, as a policy
    without memory would wait for ever."""
    shut = film.action[:, -1] < 0.5
    turns = [0, *np.flatnonzero(shut[1:] != shut[:-1]) + 1, len(shut) - 1]
    away = np.abs(np.arange(0, len(shut), apart)[:, None] - turns).min(axis=1)
    often = np.where(away <= AROUND * apart, focus, 1.0)
    often[:FIRST] *= START
    return np.where(waits(film)[::apart], 0.0, often)


def turn(film: Film, t: int) -> tuple[float, float]:
    """How the hand is turned where it closes next: cosine and sine of twice its angle about the vertical, as a jaw turned half around is the same.

    NaN while it is closed, and when it closes no more. States begin with the hand's pose, as under end-effector control.
    """
    close = _open_for(film.action[t:])
    if not 0 < close < len(film.action) - t:
        return np.nan, np.nan
    angle = float(film.state[t + close, SPIN_Z])
    return float(np.cos(2 * angle)), float(np.sin(2 * angle))


def spun(
    film: Film, t: int, chunk: Float32[np.ndarray, "n 7"], turn_rad: float, rng: np.random.Generator
) -> tuple[Float32[np.ndarray, " p"], Float32[np.ndarray, "n 7"]]:
    """The state at t and the chunk from there, had the hand been turned otherwise about the vertical, by as much as it can still turn back at
    `turn_rad` a step; both as they are when it closes no more.

    In the expert's films a hand that turns goes on turning, and one that does not is turned as it should be: who learns from them alone looks at
    the hand, and not at the object. The hand points down, so its last joint turns it and nothing else; pictures stay as they are.
    """
    close = _open_for(film.action[t:])
    if not 0 < close < len(film.action) - t:
        return film.state[t], chunk
    state, chunk = film.state[t].copy(), chunk.copy()
    left = float(rng.uniform(-1, 1)) * min(np.pi / 2, IN_TIME * turn_rad * close)
    by = float(film.action[t : t + close, SPIN_Z].sum()) - left
    state[SPIN_Z] += by
    state[-1] -= by
    for action in chunk[: _open_for(chunk)]:
        action[SPIN_Z] = np.clip(left, -turn_rad, turn_rad)
        left -= float(action[SPIN_Z])
    return state, chunk


def _open_for(actions: Float32[np.ndarray, "n a"]) -> int:
    """How many actions come before the hand is told to close; all of them where it is not."""
    shut = actions[:, -1] < 0.5
    return int(shut.argmax()) if shut.any() else len(shut)


def waits(film: Film) -> Bool[np.ndarray, " t"]:
    """The steps in which nothing is asked for and nothing happens; those at the end, where there is nothing left to do, do not count."""
    asked = np.abs(film.action[:, :-1]).max(axis=1) + np.abs(
        np.diff(film.action[:, -1], prepend=film.action[0, -1])
    )
    happens = np.abs(np.diff(film.state, axis=0, append=film.state[-1:])).max(axis=1)
    idle = (asked < STILL) & (happens < 2 * STILL)
    return idle & np.logical_or.accumulate(~idle[::-1])[::-1]


def ahead(film: Film, t: int, size: int) -> Float32[np.ndarray, "n a"]:
    """The chunk that is taught at step t: what the expert does from there, its waits left out, and, after its end, nothing.

    A jaw that has just closed looks like one that has waited: with the waits in the chunk, a policy that is asked there waits for ever.
    """
    moving = np.flatnonzero(~waits(film))
    rest = film.action[moving[moving >= t][:size]]
    still = np.repeat(rest[-1:], size - len(rest), axis=0)
    still[:, :-1] = 0.0
    return np.concatenate([rest, still])
