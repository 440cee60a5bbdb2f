"""The folder of a training, and the files that an earlier call left for this one."""

import fcntl
import io
import json
import shutil
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch

from vap_core.base.errors import BadOutput
from vap_core.base.files import make_folder, parse_json, write_atomic, writing
from vap_core.policies.lerobot.checkpoints import RECIPE
from vap_core.study.store import LOCK, differences, locked

STATE = "training.pt"
"""The file that a training goes on from."""
SAVING = ".saving-"
"""What the scratch folder of a model that is being saved is called."""
WEIGHTS = ("model.safetensors", "vlm.safetensors")


@contextmanager
def training_folder(out: Path, caller: str, recipe: Mapping[str, Any]) -> Iterator[None]:
    """Inside, this process alone trains in `out`, by this recipe.

    What a save that was killed left there is removed.

    Raises: BadOutput when `out` cannot be written, another process trains there, or it holds the
        training of another recipe, or a model without what its training would go on from.
    """
    make_folder(out, caller)
    # The processes that draw batches are forked, and outlive a training that is killed.
    with locked(out, fcntl.lockf):
        # Of a save that was killed; nobody else saves here.
        for scratch in out.glob(f"{SAVING}*"):
            shutil.rmtree(scratch, ignore_errors=True)
        _begin(out, caller, recipe)
        yield


@contextmanager
def reading_kept(path: Path, caller: str, also: str = "") -> Iterator[None]:
    """Inside, a file is read that an earlier call wrote.

    Raises: BadOutput when it is damaged; with `also`, which names what has to be deleted besides.
    """
    try:
        yield
    except Exception as error:  # numpy and torch raise anything for a damaged file
        raise BadOutput(
            f"{caller}: {path} is damaged ({type(error).__name__}); delete it{also} and run the "
            "same command again."
        ) from error


@contextmanager
def kept_arrays(path: Path, caller: str) -> Iterator[Mapping[str, np.ndarray]]:
    """The arrays of an npz file that an earlier call wrote. Raises: BadOutput: it is damaged."""
    # Of a damaged file that it opens itself, np.load does not close all.
    with reading_kept(path, caller), path.open("rb") as file, np.load(file) as arrays:
        yield arrays


def cost_s(stage: Path) -> float:
    """CPU seconds that a stage's films or scenes took to make.

    Raises: BadOutput when its file is absent or damaged.
    """
    with kept_arrays(stage, "train") as arrays:
        return float(arrays["cpu_s"])


def checkpoint(path: Path, resume: bool) -> tuple[dict[str, Any], Callable[[dict[str, Any]], None]]:
    """What an interrupted run left at `path`, and a function that replaces it atomically.

    The first is empty where there is nothing, or without `resume`. The second raises OSError.

    Raises: BadOutput when what is there is damaged.
    """

    def save(state: dict[str, Any]) -> None:
        # Into a file torch raises RuntimeError where the disk is full.
        whole = io.BytesIO()
        torch.save(state, whole)
        write_atomic(path, whole.getvalue())

    state: dict[str, Any] = {}
    if resume and path.exists():
        # A model without what its training goes on from is refused.
        models = [name for name in WEIGHTS if (path.parent / name).exists()]
        also = f", with {models[0]} beside it," if models else ""
        # Begun on a GPU, a training goes on where there is none.
        with reading_kept(path, "train", also):
            state = torch.load(path, map_location="cpu", weights_only=True)
    return state, save


def _begin(out: Path, caller: str, recipe: Mapping[str, Any]) -> None:
    """Write the recipe, where nothing of another one is. Raises: BadOutput."""
    file = out / RECIPE
    kept = {path.name for path in out.iterdir()} - {LOCK, RECIPE}
    if kept.intersection(WEIGHTS) and STATE not in kept:
        raise BadOutput(
            f"{caller}: {out} holds a model without {STATE}, which its training would go on from; "
            "choose another --out."
        )
    if kept and file.exists():
        with reading_kept(file, caller):
            begun = dict(parse_json(file.read_bytes()))
        if begun != parse_json(json.dumps(dict(recipe))):
            changed = differences({"configuration": begun}, recipe)
            raise BadOutput(
                f"{caller}: {out} holds a training with another recipe ({changed}); go on with "
                "that, or choose another --out."
            )
        return
    with writing(out, caller):
        write_atomic(file, json.dumps(dict(recipe), indent=1).encode())
