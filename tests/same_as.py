"""Whether another checkout computes the same on this machine: pictures, groundings, actions, outcomes.

    python tests/same_as.py values > now.json             in this checkout
    python THIS/tests/same_as.py values > before.json     in the other one (git worktree add ...)
    python tests/same_as.py compare before.json now.json

Machines round differently: only values of one machine are compared. `--episodes` is how many
closed-loop episodes a suite are run.
"""

import argparse
import hashlib
import json
import os
import sys
import tempfile
from dataclasses import fields, is_dataclass
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
sys.path.insert(0, os.getcwd())

SUITES = ("simpler-bridge", "simpler-fractal", "vlabench", "tabletop")
OPENINGS = 4
"""Rows a task whose views are grounded."""


def sha(*arrays) -> str:
    found = hashlib.sha256()
    for array in arrays:
        found.update(repr((array.dtype.str, array.shape)).encode() + array.tobytes())
    return found.hexdigest()[:16]


def leaves(value) -> list:
    """The numbers and words of a value, whatever its class is called."""
    if is_dataclass(value) and not isinstance(value, type):
        return [leaves(getattr(value, field.name)) for field in fields(value)]
    return value.tolist() if hasattr(value, "tolist") else value


def spread(rows, n: int) -> list:
    return [rows[i * len(rows) // n] for i in range(min(n, len(rows)))]


def openings(suite: str, task: str, rows) -> dict[str, str]:
    from vap_core import (
        Attender,
        Prompting,
        get_object,
        load_stack,
        open_row,
        reference_views,
        register,
    )

    stack = load_stack("embedded")
    found = {}
    for row in spread(rows, OPENINGS):
        where = f"{suite}/{task}/{row.episode}"
        with open_row(row) as env:
            views = env.observe().images
        for camera, rgb in views.items():
            found[f"picture {where}/{camera}"] = sha(rgb)
        model = get_object(row.target)
        photos = reference_views(model, 5)
        obj, _ = register(row.target, model.category, photos, stack.detector, stack.encoder)
        attender = Attender(stack, {obj.name: obj}, Prompting())
        state, attended = attender.start(views, row.instruction)
        found[f"text {where}"] = attended.text
        for camera, (grounding,) in state.groundings.items():
            boxes, masks = grounding.candidates.xyxy, grounding.masks
            found[f"boxes {where}/{camera}"] = sha(boxes, grounding.similarity)
            found[f"masks {where}/{camera}"] = f"{grounding.winner} {sha(masks)}"
            found[f"prompted {where}/{camera}"] = sha(attended.images[camera])
    return found


def episodes(suite: str, tasks, listed, n: int) -> dict[str, str]:
    import numpy as np

    from vap_core import Study, make_trial, register_personal
    from vap_core.rollout.loop import rollout

    each = -(-n // len(tasks))
    study = Study(
        tasks=tuple((suite, task) for task in tasks),
        methods=("generic", "vap"),
        policy="mini-pi0",
        follow="call",
    )
    found = {}
    with tempfile.TemporaryDirectory() as folder:
        bank = Path(folder)
        register_personal(study, bank)
        for task in tasks:
            for row in spread(listed[task], each):
                for method in study.methods:
                    trial = make_trial(study, [row], method, bank)
                    (episode,) = rollout(trial, [row], batch=1)
                    actions = [frame.action for frame in episode.frames if frame.action is not None]
                    name = f"{suite}/{task}/{row.episode}/{method}"
                    found[f"outcome {name}"] = json.dumps(leaves(episode.outcome), default=str)
                    found[f"actions {name}"] = sha(np.array(actions))
    return found


def values(n: int) -> dict[str, str]:
    from vap_core import BENCHMARKS
    from vap_core.simulation import suites

    found = {}
    for suite in SUITES:
        tasks = [task.name for task in BENCHMARKS[suite].tasks]
        listed = {task: suites.listed(suite, task) for task in tasks}
        for task in tasks:
            found |= openings(suite, task, listed[task])
            print(suite, task, file=sys.stderr, flush=True)
        if n:
            found |= episodes(suite, tasks, listed, n)
            print(suite, "episodes", file=sys.stderr, flush=True)
    return found


def compare(before: dict[str, str], now: dict[str, str]) -> int:
    """Print what differs, and how many values of each kind are equal; the number of differences."""
    kinds: dict[str, list[int]] = {}
    for name in sorted({*before, *now}):
        counts = kinds.setdefault(name.split()[0], [0, 0])
        counts[1] += 1
        if before.get(name) == now.get(name):
            counts[0] += 1
        else:
            print(f"{name}: {before.get(name)} before, {now.get(name)} now")
    for kind, (equal, total) in kinds.items():
        print(f"{kind}: {equal} of {total} equal")
    return sum(total - equal for equal, total in kinds.values())


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("what", choices=["values", "compare"])
    parser.add_argument("files", nargs="*", type=Path)
    parser.add_argument("--episodes", type=int, default=40)
    asked = parser.parse_args()
    if asked.what == "values":
        json.dump(values(asked.episodes), sys.stdout, indent=0)
    else:
        before, now = (json.loads(path.read_text()) for path in asked.files)
        sys.exit(1 if compare(before, now) else 0)
