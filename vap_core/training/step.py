"""One loop for what is trained by steps, not epochs: warm-up and cosine, clipped steps, a moving average of the weights, resumed bit for bit."""

import copy
import json
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from vap_core.base.errors import BadOutput
from vap_core.training.perception.fitting import checkpoint

KEEP = 0.999
"""Of the moving average of the weights, a step; the average is what is saved."""
WARM = 300
"""Steps until the full rate."""
Told = dict[str, float]


@dataclass(frozen=True)
class Descent:
    """How long and how fast; a checkpoint and a line of the log every so many steps."""

    name: str
    steps: int
    rate: float
    minutes: float | None = None
    every: int = 250
    made_of: Any = None
    """Recipe and data, as JSON: a training of something else is not gone on with."""


def descend[M: nn.Module](
    model: M, losses: Callable[[M, int], tuple[Tensor, Told]], run: Descent, out: Path
) -> tuple[M, list[Any]]:
    """Train `model`, or go on where an earlier call stopped; returns the average of its weights, and the log.

    `losses` gives the loss of one step, drawn from streams of its number, and figures to log. Raises: BadOutput when `out` holds another training.
    """
    from tqdm import tqdm

    optimiser = torch.optim.AdamW(
        model.parameters(), run.rate, betas=(0.9, 0.95), weight_decay=1e-4
    )
    mean, begun, log = copy.deepcopy(model), 0, []
    out.mkdir(parents=True, exist_ok=True)
    state, keep = checkpoint(out / "training.pt", resume=True)
    made_of = json.dumps(run.made_of, sort_keys=True)
    if state and state.get("made_of") != made_of:
        raise BadOutput(
            f"train: {out} holds a training with another recipe or other data; go on with those, or choose another --out."
        )
    if state:
        for part, name in ((model, "model"), (mean, "mean"), (optimiser, "optimiser")):
            part.load_state_dict(state[name])
        begun, log = state["step"], state["log"]
    started, recent = time.monotonic(), []
    for step in tqdm(range(begun, run.steps), run.name, run.steps, initial=begun, mininterval=10):
        for group in optimiser.param_groups:
            group["lr"] = (
                run.rate
                * min(1.0, (step + 1) / WARM)
                * 0.5
                * (1 + float(np.cos(np.pi * step / run.steps)))
            )
        loss, told = losses(model, step)
        optimiser.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(model.parameters(), 1.0)
        optimiser.step()
        with torch.no_grad():
            share = min(KEEP, (step + 1) / (step + 10))
            for average, now in zip(mean.parameters(), model.parameters(), strict=True):
                average.lerp_(now, 1 - share)
        recent.append(told)
        last = step + 1 == run.steps or (
            run.minutes is not None and time.monotonic() - started > 60 * run.minutes
        )
        if last or (step + 1) % run.every == 0:
            log.append({"step": step + 1, **average_of(recent)})
            recent = []
            keep(
                {
                    "model": model.state_dict(),
                    "mean": mean.state_dict(),
                    "optimiser": optimiser.state_dict(),
                    "step": step + 1,
                    "log": log,
                    "made_of": made_of,
                }
            )
        if last:
            break
    return mean, log


def average_of(told: list[Told]) -> Told:
    """The mean of every figure over the batches that could measure it (not NaN); what none could is left out."""
    held = {
        name: [one[name] for one in told if not np.isnan(one[name])]
        for name in (told[0] if told else ())
    }
    return {name: float(np.mean(values)) for name, values in held.items() if values}
