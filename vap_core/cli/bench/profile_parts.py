"""Which functions of the running code are counted for which part.

Where a function moves, mend PARTS or ROLLOUT_PARTS; a test resolves every name.
"""

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from importlib import import_module
from typing import Any

from vap_core.base.errors import UnknownName
from vap_core.cli.bench.timing import Parts

TRACKER = "vap_core.perception.embedded.tracker.tracker"
PI0 = "lerobot.policies.pi0.modeling_pi0"


@dataclass(frozen=True)
class Part:
    """A row of the profile: functions as "module:attribute", or "module:Class.attribute".

    A function that is imported by name is named where it is called. `whole` parts keep the time of
    parts that they call (timing.Parts).
    """

    name: str
    functions: tuple[str, ...]
    whole: bool = False


PARTS = (
    Part("scene and models of a job", ("vap_core.evaluation.jobs:make_trial",), whole=True),
    Part("mj_step", ("mujoco:mj_step",)),
    Part("Python round it (contacts)", ("vap_core.simulation.env:Env._advance",)),
    Part("IK", ("vap_core.simulation.env:Env.commanded",)),
    Part("RGB", ("vap_core.simulation.cameras:Renderer.rgb",)),
    Part("sensor noise", ("vap_core.simulation.env:apply_sensor",)),
    Part("truth masks", ("vap_core.simulation.cameras:Renderer.masks_and_hand",)),
    Part("tracker: backbone", (f"{TRACKER}:embed_cells",)),
    Part(
        "tracker: segmenter",
        ("vap_core.perception.embedded.segmenter:LiteSegmenter.mask_probability",),
    ),
    Part("tracker: re-detection", (f"{TRACKER}:search",), whole=True),
    Part("tracker: rest", (f"{TRACKER}:LiteTracker.step",)),
    Part("grounding at t = 0", ("vap_core.attend:Attender.start",), whole=True),
    Part("tint", ("vap_core.attend:Attender.steps",)),
    Part("policy: image tower", (f"{PI0}:PaliGemmaWithExpertModel.embed_image",)),
    Part("policy: denoising", (f"{PI0}:PI0Pytorch.denoise_step",)),
    Part("policy: prefix", (f"{PI0}:PI0Policy.predict_action_chunk",)),
    Part("policy: traced graph", ("vap_core.policies.lerobot.traced:ChunkPredictor.__call__",)),
    Part("policy: before and after", ("vap_core.policies.lerobot.adapter:LeRobot.plan",)),
    Part(
        "poses, judge",
        (
            "vap_core.simulation.env:Env.truth",
            "vap_core.simulation.suites.rules:Judge.step",
        ),
    ),
    Part(
        "recording",
        (
            "vap_core.recording:DeferredRecorder.frame",
            "vap_core.recording:DeferredRecorder.close",
        ),
    ),
    Part(
        "checksum of the weights",
        ("vap_core.policies.lerobot.adapter:LeRobot.sha256",),
    ),
)

ENV = "vap_core.simulation.env:Env"
ROLLOUT_PARTS = (
    Part(
        "environment",
        (
            f"{ENV}.__init__",
            f"{ENV}.reset",
            f"{ENV}.observe",
            f"{ENV}.state",
            f"{ENV}.step",
            f"{ENV}.truth",
            "vap_core.simulation.suites.rules:Judge.step",
        ),
        whole=True,
    ),
    Part(
        "attend",
        (
            "vap_core.rollout.prompters.tint:TintPrompter.start",
            "vap_core.rollout.prompters.tint:TintPrompter.steps",
        ),
        whole=True,
    ),
    Part("policy", ("vap_core.policies.lerobot.adapter:LeRobot.plan",), whole=True),
)
"""What lerobot's loop can be divided into, too. The environment has the judge in it, as there."""


@contextmanager
def profiled(table: Sequence[Part] = PARTS) -> Iterator[Parts]:
    """Inside, every function of the table counts its CPU time. Raises: UnknownName."""
    parts = Parts()
    with ExitStack() as hooks:
        for part in table:
            for function in part.functions:
                owner, name = resolve(function)
                hooks.enter_context(parts.hooked(owner, name, part.name, whole=part.whole))
        yield parts


def resolve(function: str) -> tuple[Any, str]:
    """The module or class that holds a function, and the function's name. Raises: UnknownName."""
    module, _, path = function.partition(":")
    *classes, name = path.split(".")
    try:
        owner: Any = import_module(module)
        for each in classes:
            owner = getattr(owner, each)
        getattr(owner, name)
    except (ImportError, AttributeError) as error:
        raise UnknownName(
            f"bench profile: there is no {function} ({error}); mend the parts in "
            "vap_core/cli/bench/profile_parts.py."
        ) from error
    return owner, name
