"""The training loop of every head.

Epochs can be interrupted; the rate warms up and falls with a cosine; a bar shows the loss.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn
from tqdm import tqdm

from vap_core.base.errors import BadOutput
from vap_core.base.files import writing
from vap_make.folder import checkpoint
from vap_make.step import require_finite


@dataclass(frozen=True)
class Run:
    """How long and how fast.

    `file` keeps each epoch; with `resume`, training goes on from it. It stops early once `expired`.
    """

    name: str
    seed: int
    epochs: int
    rate: float
    decay: float
    file: Path
    resume: bool
    expired: Callable[[], bool]


def half_precision() -> torch.autocast:
    """A context in which heads compute in bfloat16 where that is safe.

    Three times as fast on processors that have it in hardware.
    """
    return torch.autocast("cpu", dtype=torch.bfloat16)


def fit(
    head: nn.Module,
    losses: Callable[[np.random.Generator], Iterator[Tensor]],
    per_epoch: int,
    run: Run,
) -> None:
    """Train `head` in place.

    `losses` yields the loss of each of an epoch's `per_epoch` batches, drawn from the stream it is
    given.

    Raises: BadOutput when the file is damaged, or of a head that was trained otherwise, or when the
        training diverges: the file stays as it was.
    """
    optimiser = torch.optim.AdamW(head.parameters(), run.rate, weight_decay=run.decay)
    state, save = checkpoint(run.file, run.resume)
    made_of = {
        "epochs": run.epochs,
        "rate": run.rate,
        "decay": run.decay,
        "batches": per_epoch,
        "shapes": {name: list(tensor.shape) for name, tensor in head.state_dict().items()},
    }
    if state:
        if state.get("made_of") != made_of:
            raise BadOutput(
                f"train perception: {run.file} is of a {run.name} head that was trained otherwise; "
                "delete it and run the same command again."
            )
        head.load_state_dict(state["head"])
        optimiser.load_state_dict(state["optimiser"])
    head_name = f"train perception: the {run.name} head's"
    remedy = "run it again with another --seed."
    for epoch in range(state.get("epoch", 0), run.epochs):
        if run.expired():
            return
        rng = np.random.default_rng([run.seed, *run.name.encode(), epoch])
        total = 0.0
        batch = 0
        title = f"{run.name} {epoch + 1}/{run.epochs}"
        bar = tqdm(losses(rng), total=per_epoch, desc=title, mininterval=10)
        for batch, loss in enumerate(bar, start=1):
            done = (epoch * per_epoch + batch) / (run.epochs * per_epoch)
            _set_rate(optimiser, run.rate, done)
            at = f"not finite at batch {batch} of epoch {epoch + 1}"
            require_finite([loss], f"{head_name} loss is {at}; {remedy}")
            optimiser.zero_grad()
            loss.backward()
            nn.utils.clip_grad_norm_(head.parameters(), 5.0)
            optimiser.step()
            total += loss.item()
            bar.set_postfix(loss=f"{total / batch:.3f}", refresh=False)
        at = f"not finite after epoch {epoch + 1}"
        require_finite(head.parameters(), f"{head_name} weights are {at}; {remedy}")
        saved = {
            "made_of": made_of,
            "head": head.state_dict(),
            "optimiser": optimiser.state_dict(),
            "epoch": epoch + 1,
            "loss": total / max(batch, 1),
        }
        with writing(run.file, "train perception"):
            save(saved)


def _set_rate(optimiser: torch.optim.Optimizer, rate: float, done: float) -> None:
    """The rate when a share `done` of the training is over: a warm-up, then a cosine."""
    warm_up = min(1.0, done * 50 + 0.05)
    cosine = 1 + np.cos(np.pi * done)
    for group in optimiser.param_groups:
        group["lr"] = float(rate * warm_up * 0.5 * cosine)
