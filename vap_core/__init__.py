"""Visual Attentive Prompting: steer a frozen policy to the user's own object, and see why it worked or failed.

Names load when asked for; importing this package loads no torch, mujoco or rerun.
"""

from importlib import import_module
from typing import Any

__version__ = "0.1.0"

_HOME = {
    "Attender": "attend", "Prompting": "attend", "Stack": "attend", "load_stack": "attend",
    "register": "memory", "load_photo": "memory", "load_bank": "memory", "save": "memory", "load": "memory",
    "parse": "instruction", "rewrite": "instruction",
    "similarity": "vote",
    "tint": "prompt", "PALETTE": "prompt", "choose_colours": "prompt",
    "Trial": "rollout",
    "Study": "experiments", "DEMO": "experiments", "METHODS": "experiments",
    "Recorder": "record", "screenshot": "record",
    "VapError": "errors",
}  # fmt: skip

__all__ = sorted(_HOME)


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'vap_core' has no attribute {name!r}")
    return getattr(import_module(f"vap_core.{_HOME[name]}"), name)


def __dir__() -> list[str]:
    return [*globals(), *_HOME]
