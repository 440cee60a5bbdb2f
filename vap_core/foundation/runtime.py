"""Where the foundation models run, and how: a GPU works in half precision on batches, a CPU in single precision one by one.

A CPU gains nothing from batches, and without them an answer does not depend, in its last bits, on what else was asked.
"""

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import torch

from vap_core.errors import UnknownName

DEVICE = "VAP_DEVICE"
"""Environment variable that overrides the device, for example cpu or cuda:1."""


@dataclass(frozen=True)
class Runtime:
    """A device, the half-precision type of matrix products there (None: everything in float32), and whether inputs share passes."""

    device: torch.device
    half: torch.dtype | None
    batched: bool

    def batches[T](self, items: Sequence[T], limit: int) -> list[Sequence[T]]:
        """What goes through a network together: up to `limit` items, or each alone."""
        size = limit if self.batched else 1
        return [items[start : start + size] for start in range(0, len(items), size)]

    @contextmanager
    def inference(self) -> Iterator[None]:
        """No gradients, and autocast where half precision is used."""
        with torch.inference_mode(), torch.autocast(self.device.type, self.half or torch.bfloat16, enabled=self.half is not None):
            yield


def pick(device: str | None = None) -> Runtime:
    """The device asked for, by argument or by `VAP_DEVICE`; otherwise a GPU where there is one.

    Raises:
        UnknownName: no such device on this machine.
    """
    name = device or os.environ.get(DEVICE) or ("cuda" if torch.cuda.is_available() else "cpu")
    try:
        chosen = torch.device(name)
        torch.empty(0, device=chosen)
    except (RuntimeError, AssertionError) as error:
        raise UnknownName(
            f"foundation: device {name!r} is not on this machine ({str(error).splitlines()[0]}); unset {DEVICE}, or use cpu."
        ) from error
    if chosen.type != "cuda":
        return Runtime(chosen, None, batched=False)
    return Runtime(chosen, torch.bfloat16 if torch.cuda.is_bf16_supported() else torch.float16, batched=True)
