"""Policies by name, as studies and commands name them."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from vap_core.base.errors import one_of
from vap_core.perception.protocols import Detector, Stack
from vap_core.policies.names import MINI as MINI
from vap_core.policies.names import POLICIES as POLICIES
from vap_core.policies.names import PRIVILEGED as PRIVILEGED
from vap_core.policies.names import SHIPPED as SHIPPED
from vap_core.policies.names import checkpoint_of, shipped_checkpoint
from vap_core.policies.protocol import Policy, PrivilegedPolicy
from vap_core.policies.scripted.expert import Expert
from vap_core.policies.scripted.random import Random
from vap_core.policies.scripted.scripted import Scripted
from vap_core.simulation.env import Env
from vap_core.simulation.scenes import Scene
from vap_core.simulation.suites import Suite, benchmark_name


def scripted(detector: Detector, scene: Scene, suite: Suite) -> Scripted:
    """The scripted policy, calibrated to the suite's first camera.

    Raises: UnknownName for a camera that the scene lacks, or a robot without a scripted motion.
    """
    (camera,) = Env(scene, cameras=suite.cameras[:1]).cameras()
    return Scripted(
        detector=detector,
        camera=camera,
        robot=scene.robot,
        hz=suite.hz,
        control=suite.control,
    )


def make_policy(
    name: str, scene: Scene, suite: Suite, stack: Stack | None
) -> Policy[Any] | PrivilegedPolicy[Any]:
    """One of `POLICIES`; only the scripted one needs a stack. Raises: UnknownName."""
    match name:
        case "scripted":
            assert stack is not None, "the scripted policy needs a detector"
            return scripted(stack.category_detector, scene, suite)
        case "expert":
            return Expert()
        case "random":
            return Random()
    raise one_of("make_policy: policy", name, POLICIES)


def shipped(suite: str) -> Path:
    """Where the shipped policy of a suite is, if there is one."""
    return shipped_checkpoint(benchmark_name(suite))


def policy_today(policy: str, label: str, suite: str) -> str:
    """How the policy of a run is named here, of which a row of the suite has this label.

    Where the run names no folder that is here, it is the shipped one that the label names: the
    suite's default, or a folder below data/policies.
    """
    from vap_core.policies.lerobot.checkpoints import is_checkpoint_name

    name = checkpoint_of(label)
    if not name or not (SHIPPED / name).is_dir() or is_checkpoint_name(policy):
        return policy
    return MINI if name == shipped(suite).name else f"data/policies/{name}"


def default_policy(suites: Iterable[str]) -> str:
    """The shipped frozen policy where every suite has one, else the scripted one."""
    return MINI if all(shipped(suite).is_dir() for suite in suites) else "scripted"
