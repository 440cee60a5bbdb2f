"""The device that the user asks for: an argument, or `VAP_DEVICE`."""

import os

from vap_core.base.errors import UnknownName
from vap_core.base.extras import require

VARIABLE = "VAP_DEVICE"
"""Environment variable that names the device of foundation models and policies: cpu, cuda:1, ..."""


def device_name(device: str | None = None) -> str:
    """The argument, else `VAP_DEVICE`, else a GPU where there is one.

    Raises: UnknownName: no such device on this machine.
    """
    require("policy", "a choice of device")
    import torch

    name = device or os.environ.get(VARIABLE)
    if not name:
        return "cuda" if torch.cuda.is_available() else "cpu"
    try:
        torch.empty(0, device=torch.device(name))
    except (RuntimeError, AssertionError) as error:
        raise UnknownName(
            f"device {name!r} is not on this machine ({str(error).splitlines()[0]}); "
            f"unset {VARIABLE}, or use cpu."
        ) from error
    return name


def check_device() -> None:
    """What `VAP_DEVICE` names is on this machine, whether or not the models at hand use it.

    Raises: UnknownName.
    """
    if os.environ.get(VARIABLE, "cpu") not in ("", "cpu"):
        device_name()
