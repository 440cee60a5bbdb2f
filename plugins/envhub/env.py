"""The suites as an EnvHub environment: put this file into a repository of the Hugging Face hub.

    from lerobot.envs.factory import make_env
    make_env("you/vap-core", n_envs=2, trust_remote_code=True)

The machine needs `vap_core` (`pip install 'vap-core[policy]'`). Without a configuration that
names a task it is simpler-bridge/put-camera.
"""

from typing import Any

from vap_core.policies.lerobot.step import VapEnvConfig

DEFAULT = "simpler-bridge/put-camera"


def make_env(n_envs: int = 1, use_async_envs: bool = False, cfg: Any = None) -> Any:
    """Vector environments by suite and number of the task, as lerobot's factory asks for them."""
    task = getattr(cfg, "task", None) or DEFAULT
    return VapEnvConfig(task=task).create_envs(n_envs, use_async_envs)
