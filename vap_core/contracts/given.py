"""What the options name, and what it is tested with."""

import inspect
import sys
from collections.abc import Sequence
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from vap_core.base.errors import UnknownName
from vap_core.base.types import Boxes, Rgb, value
from vap_core.rollout.loop import Trial
from vap_core.rollout.prompters import generic
from vap_core.simulation import suites
from vap_core.simulation.suites.open_row import build_scene, models_of, open_row
from vap_core.simulation.types import EpisodeRow

LEAST_PX = 150
"""Visible pixels of an object of the scene."""


@value
class RenderedScene:
    """A picture of a table, and the mask and the box of every object on it."""

    rgb: Rgb
    masks: np.ndarray
    boxes: Boxes


def made(name: str) -> Any:
    """What MODULE:NAME names; a class, or a function that needs no argument, is called.

    The folder stays on the path of imports, for what is named may import a file beside it later.

    Raises: UnknownName.
    """
    module_name, _, attribute = name.partition(":")
    folder = str(Path.cwd())
    if folder not in sys.path:
        sys.path.insert(0, folder)
    try:
        found = getattr(import_module(module_name), attribute)
    except (ImportError, AttributeError, ValueError) as error:
        raise UnknownName(
            f"contracts: {name!r} names nothing ({error}); write MODULE:NAME, as in "
            "my.module:Detector, from the folder in which `import my.module` works."
        ) from error
    if inspect.isclass(found):
        return found()
    if inspect.isroutine(found) and not _needed(found):
        return found()
    return found


def _needed(function: Any) -> list[str]:
    """The parameters of a function that have no default."""
    needed = [
        parameter.name
        for parameter in inspect.signature(function).parameters.values()
        if parameter.default is parameter.empty
        and parameter.kind
        not in (
            parameter.VAR_POSITIONAL,
            parameter.VAR_KEYWORD,
        )
    ]
    return needed


def rendered_scene() -> RenderedScene:
    """The fullest of eight views of development scenes, whose objects no film shows."""
    scenes = []
    for row in suites.benchmark("vlabench-dev")[:80:10]:
        with open_row(row) as env:
            shown = env.truth(masks=True).masks["front"].values()
            masks = [mask for mask in shown if mask.sum() >= LEAST_PX]
            scenes.append((env.observe().images["front"], masks))
    rgb, masks = max(scenes, key=lambda scene: len(scene[1]))
    corners = []
    for mask in masks:
        y, x = np.nonzero(mask)
        corners.append((x.min(), y.min(), x.max() + 1, y.max() + 1))
    boxes = Boxes(np.array(corners, np.float32), np.ones(len(masks), np.float32), "object")
    return RenderedScene(rgb, np.stack(masks), boxes)


def noise(seed: int, h: int = 96, w: int = 128) -> Rgb:
    """A picture of nothing."""
    return np.random.default_rng(seed).integers(0, 255, (h, w, 3), dtype=np.uint8)


def short_rows(where: str, steps: int) -> list[EpisodeRow]:
    """The first steps of the first two episodes of SUITE/TASK."""
    suite, _, task = where.partition("/")
    return [replace(row, max_steps=steps) for row in suites.rows(suite, task, 2)]


def trial_of(policy: Any, rows: Sequence[EpisodeRow]) -> Trial:
    """A trial of a policy that sees raw images and reads the raw instruction."""
    suite = suites.suite(rows[0].suite)
    return Trial(
        method="generic",
        scene=build_scene(suite.name, models_of(rows)),
        policy=policy,
        prompter=generic(),
        control=suite.control,
        sensor=suite.sensor,
    )
