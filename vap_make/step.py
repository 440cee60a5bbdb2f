"""Training by steps, not epochs: a schedule of the rate, averaged weights, resumed bit for bit."""

import copy
import json
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from vap_core.base.errors import BadOutput
from vap_core.base.files import parse_json, writing
from vap_make.folder import STATE, checkpoint

KEEP = 0.999
"""Of the moving average of the weights, a step; the average is what is saved."""
WARM = 300
"""Steps until the full rate."""
LATER = ("taught_in",)
"""Parts of `made_of` that earlier code did not keep; a checkpoint without them goes with any."""
Figures = dict[str, float]
"""Figures to log, by name."""


@dataclass(frozen=True)
class Schedule:
    """How long and how fast; a checkpoint and a line of the log every so many steps."""

    name: str
    steps: int
    rate: float
    minutes: float | None = None
    every: int = 250
    made_of: Any = None
    """Recipe and data, as JSON: a training of something else is not gone on with."""
    slower: str = "lower the recipe's rate"
    """What to do about a training that diverges."""


def train_steps[M: nn.Module](
    model: M,
    losses: Callable[[M, int], tuple[Tensor, Figures]],
    run: Schedule,
    out: Path,
    helpers_cpu_s: Callable[[], float] = float,
) -> tuple[M, list[Any]]:
    """Train `model`, or go on where an earlier call stopped.

    The rate warms up over WARM steps and then falls with a cosine; gradients are clipped. Returns
    the moving average of the weights, and the log, whose `cpu_s` are the CPU seconds until then.
    `losses` gives the loss of one step, drawn from streams of its number, and figures to log;
    `helpers_cpu_s`, the CPU seconds of other processes since this call began.

    Raises: BadOutput when `out` holds another training or cannot be written, or when the training
        diverges: what is kept stays as it was.
    """
    from tqdm import tqdm

    optimiser = torch.optim.AdamW(
        params=model.parameters(), lr=run.rate, betas=(0.9, 0.95), weight_decay=1e-4
    )
    mean = copy.deepcopy(model)
    parts: dict[str, Any] = {"model": model, "mean": mean, "optimiser": optimiser}
    out.mkdir(parents=True, exist_ok=True)
    state, save = checkpoint(out / STATE, resume=True)
    made_of = json.dumps(run.made_of, sort_keys=True)
    if state:
        _require_same_training(_made_of(state), parse_json(made_of), out)
        for name, part in parts.items():
            part.load_state_dict(state[name])
    first_step = state.get("step", 0)
    log = state.get("log", [])
    started = time.monotonic()
    earlier_cpu_s = log[-1]["cpu_s"] if log else 0.0
    started_cpu = time.process_time()
    recent: list[Figures] = []
    numbers = range(first_step, run.steps)
    for step in tqdm(numbers, desc=run.name, total=run.steps, initial=first_step, mininterval=10):
        _set_rate(optimiser, run, step)
        loss, figures = losses(model, step)
        # `figures` are numbers already, so that this waits for nothing more on a GPU.
        remedy = f"not finite at step {step + 1}; {run.slower}, with another --out."
        require_finite([loss], f"train: {out}: the loss is {remedy}")
        optimiser.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(model.parameters(), 1.0)
        optimiser.step()
        _update_average(mean, model, step)
        recent.append(figures)
        last = step + 1 == run.steps or _is_time_up(run, started)
        if last or (step + 1) % run.every == 0:
            cpu_s = earlier_cpu_s + time.process_time() - started_cpu + helpers_cpu_s()
            log.append({"step": step + 1, "cpu_s": cpu_s, **average_of(recent)})
            recent = []
            saved: dict[str, Any] = {"step": step + 1, "log": log, "made_of": made_of}
            for name, part in parts.items():
                saved[name] = part.state_dict()
            # A finite loss can have a gradient that is not.
            require_finite(model.parameters(), f"train: {out}: the weights are {remedy}")
            with writing(out, "train"):
                save(saved)
        if last:
            break
    return mean, log


def begun_with(out: Path) -> dict[str, Any]:
    """Recipe and data of the training that `out` holds; nothing where it holds none.

    Raises: BadOutput when its checkpoint is damaged.
    """
    state, _ = checkpoint(out / STATE, resume=True)
    return dict(_made_of(state) or {})


def require_finite(tensors: Iterable[Tensor], line: str) -> None:
    """Raises: BadOutput, which says this line, when one of the numbers is not finite."""
    for numbers in tensors:
        if not bool(torch.isfinite(numbers.detach()).all()):
            raise BadOutput(line)


def average_of(batches: list[Figures]) -> Figures:
    """The mean of every figure over the batches that could measure it (not NaN).

    What no batch could measure is left out.
    """
    means: Figures = {}
    if not batches:
        return means
    for name in batches[0]:
        values = [figures[name] for figures in batches if not np.isnan(figures[name])]
        if values:
            means[name] = float(np.mean(values))
    return means


def _made_of(state: Mapping[str, Any]) -> Any:
    """Recipe and data of the training that a checkpoint is of, as JSON gives them back."""
    return parse_json(state.get("made_of", "null"))


def _require_same_training(kept: Any, made_of: Any, out: Path) -> None:
    """Raises: BadOutput when a checkpoint is of another recipe or other data."""
    wanted = made_of
    if isinstance(kept, dict) and isinstance(made_of, dict):
        unknown = set(LATER) - set(kept)
        wanted = {name: part for name, part in made_of.items() if name not in unknown}
    if kept != wanted:
        raise BadOutput(
            f"train: {out} holds a training with another recipe or other data; "
            "go on with those, or choose another --out."
        )


def _set_rate(optimiser: torch.optim.Optimizer, run: Schedule, step: int) -> None:
    """The rate of a step: a warm-up, then a cosine."""
    warm_up = min(1.0, (step + 1) / WARM)
    cosine = 1 + float(np.cos(np.pi * step / run.steps))
    for group in optimiser.param_groups:
        group["lr"] = run.rate * warm_up * 0.5 * cosine


def _update_average(mean: nn.Module, model: nn.Module, step: int) -> None:
    """Move the average of the weights towards those of a step, faster in the beginning."""
    share = min(KEEP, (step + 1) / (step + 10))
    with torch.no_grad():
        for average, weight in zip(mean.parameters(), model.parameters(), strict=True):
            average.lerp_(weight, 1 - share)


def _is_time_up(run: Schedule, started: float) -> bool:
    return run.minutes is not None and time.monotonic() - started > 60 * run.minutes
