"""Visual Attentive Prompting: steer a frozen policy to the user's own object, and see why it worked
or failed.

The public names below load when they are first used: importing this package loads no torch, mujoco
or rerun. Start reading at attend.py.
"""

import os
import sys
from typing import TYPE_CHECKING, Any

try:
    import lazy_loader
except ModuleNotFoundError as error:
    if sys.argv[:1] == ["-m"]:
        from vap_core.__main__ import without_environment

        sys.exit(without_environment())
    raise ModuleNotFoundError(
        f"vap_core: {error.name} is not installed for {sys.executable} (Python "
        f"{sys.version.split()[0]}); run `make setup`, then .venv/bin/python",
        name=error.name,
    ) from error

# Before any of them is imported, in this process and in those that it starts: nothing is sent out.
for _switch in ("ORT_DISABLE_TELEMETRY", "HF_HUB_DISABLE_TELEMETRY", "DO_NOT_TRACK"):
    os.environ.setdefault(_switch, "1")
if os.path.expanduser("~") == "~":  # a user without a name: libraries ask for a home, and raise
    os.environ["HOME"] = "/"

if TYPE_CHECKING:
    from vap_core.attend import Attender as Attender
    from vap_core.attend import Prompting as Prompting
    from vap_core.base.errors import VapError as VapError
    from vap_core.base.files import WORKSPACE as WORKSPACE
    from vap_core.base.media import load_photo as load_photo
    from vap_core.base.media import photos_in as photos_in
    from vap_core.instruction import parse as parse
    from vap_core.instruction import rewrite as rewrite
    from vap_core.memory import load as load
    from vap_core.memory import load_bank as load_bank
    from vap_core.memory import register as register
    from vap_core.memory import save as save
    from vap_core.perception.protocols import Stack as Stack
    from vap_core.perception.references import choose_references as choose_references
    from vap_core.perception.stacks import load_stack as load_stack
    from vap_core.policies.lerobot.adapter import load_policy as load_policy
    from vap_core.policies.lerobot.checkpoints import fingerprint as fingerprint
    from vap_core.policies.mini_pi0.vlm import load_vlm as load_vlm
    from vap_core.prompt import PALETTE as PALETTE
    from vap_core.prompt import choose_colours as choose_colours
    from vap_core.prompt import tint as tint
    from vap_core.recording import Recorder as Recorder
    from vap_core.recording import recording_name as recording_name
    from vap_core.recording import screenshot as screenshot
    from vap_core.recording import view as view
    from vap_core.rollout.loop import Trial as Trial
    from vap_core.simulation.assets.objects import get_object as get_object
    from vap_core.simulation.env import Env as Env
    from vap_core.simulation.studio import reference_views as reference_views
    from vap_core.simulation.suites import BENCHMARKS as BENCHMARKS
    from vap_core.simulation.suites.open_row import open_row as open_row
    from vap_core.study.diagnosis import diagnose as diagnose
    from vap_core.study.methods import METHODS as METHODS
    from vap_core.study.photos import measure_photos as measure_photos
    from vap_core.study.stats import rate as rate
    from vap_core.study.trials import DEMO as DEMO
    from vap_core.study.trials import Study as Study
    from vap_core.study.trials import make_trial as make_trial
    from vap_core.study.trials import register_personal as register_personal
    from vap_core.study.trials import shipped as shipped
    from vap_core.vote import similarity as similarity

__version__ = "0.1.0"

_load, __dir__, __all__ = lazy_loader.attach(
    __name__,
    submod_attrs={
        "attend": ["Attender", "Prompting"],
        "base.errors": ["VapError"],
        "base.files": ["WORKSPACE"],
        "base.media": ["load_photo", "photos_in"],
        "study.diagnosis": ["diagnose"],
        "study.methods": ["METHODS"],
        "study.photos": ["measure_photos"],
        "study.stats": ["rate"],
        "study.trials": ["DEMO", "Study", "make_trial", "register_personal", "shipped"],
        "instruction": ["parse", "rewrite"],
        "memory": ["load", "load_bank", "register", "save"],
        "perception.protocols": ["Stack"],
        "perception.references": ["choose_references"],
        "perception.stacks": ["load_stack"],
        "policies.lerobot.adapter": ["load_policy"],
        "policies.lerobot.checkpoints": ["fingerprint"],
        "policies.mini_pi0.vlm": ["load_vlm"],
        "prompt": ["PALETTE", "choose_colours", "tint"],
        "recording": ["Recorder", "recording_name", "screenshot", "view"],
        "rollout.loop": ["Trial"],
        "simulation.assets.objects": ["get_object"],
        "simulation.env": ["Env"],
        "simulation.studio": ["reference_views"],
        "simulation.suites": ["BENCHMARKS"],
        "simulation.suites.open_row": ["open_row"],
        "vote": ["similarity"],
    },
)

if not TYPE_CHECKING:  # else every name would exist for type checkers

    def __getattr__(name: str) -> Any:
        """Load a public name. Raises: MissingPart: its extra is not installed."""
        try:
            return _load(name)
        except ModuleNotFoundError as error:
            from vap_core.base.errors import missing_part

            part = missing_part(error)
            if part is None:
                raise
            raise part from error
