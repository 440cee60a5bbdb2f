"""One loop for every head: epochs that can be interrupted, a warm-up and a cosine of the rate, the loss on a bar."""

import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from tqdm import tqdm


@dataclass(frozen=True)
class Run:
    """How long and how fast. `state` is what an earlier run saved, or nothing; `save` keeps each epoch; training stops early once `expired`."""

    name: str
    seed: int
    epochs: int
    rate: float
    decay: float
    state: dict[str, Any]
    save: Callable[[dict[str, Any]], None]
    expired: Callable[[], bool]


def halved() -> torch.autocast:
    """A context in which heads compute in bfloat16 where that is safe: three times as fast on processors that have it in hardware."""
    return torch.autocast("cpu", dtype=torch.bfloat16)


def fit(
    head: nn.Module,
    losses: Callable[[np.random.Generator], Iterator[Tensor]],
    per_epoch: int,
    run: Run,
) -> None:
    """Train `head` in place; `losses` yields the loss of each of an epoch's `per_epoch` batches, drawn from the stream it is given."""
    optimiser = torch.optim.AdamW(head.parameters(), run.rate, weight_decay=run.decay)
    if run.state:
        head.load_state_dict(run.state["head"])
        optimiser.load_state_dict(run.state["optimiser"])
    for epoch in range(run.state.get("epoch", 0), run.epochs):
        if run.expired():
            return
        rng, total, batch = np.random.default_rng([run.seed, *run.name.encode(), epoch]), 0.0, 0
        bar = tqdm(
            losses(rng),
            total=per_epoch,
            desc=f"{run.name} {epoch + 1}/{run.epochs}",
            mininterval=10,
        )
        for batch, loss in enumerate(bar, start=1):
            done = (epoch * per_epoch + batch) / (run.epochs * per_epoch)
            for group in optimiser.param_groups:
                group["lr"] = float(
                    run.rate * min(1.0, done * 50 + 0.05) * 0.5 * (1 + np.cos(np.pi * done))
                )
            optimiser.zero_grad()
            loss.backward()
            nn.utils.clip_grad_norm_(head.parameters(), 5.0)
            optimiser.step()
            total += loss.item()
            bar.set_postfix(loss=f"{total / batch:.3f}", refresh=False)
        run.save(
            {
                "head": head.state_dict(),
                "optimiser": optimiser.state_dict(),
                "epoch": epoch + 1,
                "loss": total / max(batch, 1),
            }
        )


def checkpoint(path: Path, resume: bool) -> tuple[dict[str, Any], Callable[[dict[str, Any]], None]]:
    """What an interrupted run left at `path`, or nothing; and a function that replaces it atomically."""

    def save(state: dict[str, Any]) -> None:
        part = path.with_suffix(".part")
        torch.save(state, part)
        os.replace(part, path)

    return torch.load(path, weights_only=True) if resume and path.exists() else {}, save
