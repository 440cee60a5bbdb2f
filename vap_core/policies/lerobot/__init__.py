"""Policies that lerobot loads, and the method as a step of lerobot's own pipelines."""

from typing import Any


def __getattr__(name: str) -> Any:
    """The twin's devices, which lerobot looks for in the package of their configurations."""
    if name in ("VapSo101Twin", "VapExpert"):
        from vap_core.policies.lerobot import twin

        return getattr(twin, name)
    raise AttributeError(name)
