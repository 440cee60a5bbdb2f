"""Where the foundation models run, and how.

A GPU works in half precision on batches, a CPU in single precision on one image at a time: it gains
nothing from batches, and without them the last bits of a result do not depend on the other images.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import torch

from vap_core.base.device import device_name


@dataclass(frozen=True)
class Runtime:
    """A device and how it computes.

    `half` is the half-precision type of matrix products (None: everything in float32); `batched`
    says whether inputs share passes.
    """

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
        autocast = torch.autocast(
            self.device.type, self.half or torch.bfloat16, enabled=self.half is not None
        )
        with torch.inference_mode(), autocast:
            yield


def select_runtime(device: str | None = None) -> Runtime:
    """The runtime of a device: the argument, else `VAP_DEVICE`, else a GPU where there is one.

    Raises: UnknownName: no such device on this machine.
    """
    chosen = torch.device(device_name(device))
    if chosen.type != "cuda":
        return Runtime(chosen, None, batched=False)
    half = torch.bfloat16 if torch.cuda.is_bf16_supported() else torch.float16
    return Runtime(chosen, half, batched=True)
