"""Visual Attentive Prompting: steer a frozen policy to the user's own object.

It also says why an episode worked or failed. The public names below load when they are first used:
importing this package loads no torch, mujoco or rerun. Start reading at attend.py.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from vap_core.attend import Attender as Attender
    from vap_core.attend import Prompting as Prompting
    from vap_core.base.errors import VapError as VapError
    from vap_core.base.photos import load_photo as load_photo
    from vap_core.evaluation.methods import METHODS as METHODS
    from vap_core.evaluation.study import DEMO as DEMO
    from vap_core.evaluation.study import Study as Study
    from vap_core.evaluation.study import make_trial as make_trial
    from vap_core.instruction import parse as parse
    from vap_core.instruction import rewrite as rewrite
    from vap_core.memory import load as load
    from vap_core.memory import load_bank as load_bank
    from vap_core.memory import register as register
    from vap_core.memory import save as save
    from vap_core.perception.protocols import Stack as Stack
    from vap_core.perception.stacks import load_stack as load_stack
    from vap_core.prompt import PALETTE as PALETTE
    from vap_core.prompt import choose_colours as choose_colours
    from vap_core.prompt import tint as tint
    from vap_core.recording import Recorder as Recorder
    from vap_core.recording import screenshot as screenshot
    from vap_core.rollout.loop import Trial as Trial
    from vap_core.vote import similarity as similarity

__version__ = "0.1.0"

_MODULES = {
    "Attender": "attend",
    "DEMO": "evaluation.study",
    "METHODS": "evaluation.methods",
    "PALETTE": "prompt",
    "Prompting": "attend",
    "Recorder": "recording",
    "Stack": "perception.protocols",
    "Study": "evaluation.study",
    "Trial": "rollout.loop",
    "VapError": "base.errors",
    "choose_colours": "prompt",
    "load": "memory",
    "load_bank": "memory",
    "load_photo": "base.photos",
    "load_stack": "perception.stacks",
    "make_trial": "evaluation.study",
    "parse": "instruction",
    "register": "memory",
    "rewrite": "instruction",
    "save": "memory",
    "screenshot": "recording",
    "similarity": "vote",
    "tint": "prompt",
}

__all__ = sorted(_MODULES)


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module 'vap_core' has no attribute {name!r}; it has {__all__}")
    return getattr(import_module(f"vap_core.{_MODULES[name]}"), name)


def __dir__() -> list[str]:
    return [*globals(), *_MODULES]
