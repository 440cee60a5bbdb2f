"""The names of policies, and where those that ship are."""

from vap_core.base.files import DATA

MINI = "mini-pi0"
"""The shipped frozen policy, one checkpoint a suite."""
SHIPPED = DATA / "policies"
"""The folder of the checkpoints."""
POLICIES = ("scripted", "expert", "random")
"""Policies without weights; each is built for one scene."""
PRIVILEGED = ("expert", "random")
"""Policies that read the simulator, or nothing at all: bounds, never results."""
