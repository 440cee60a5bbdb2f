"""The suites as an EnvHub environment: put this file into a repository of the Hugging Face hub.

    from lerobot.envs.factory import make_env
    make_env("you/vap-core", n_envs=2, trust_remote_code=True)

The machine needs `vap_core` (`pip install 'vap-core[policy]'`). A configuration names the task and
may have `image_size`, `robots` and `max_steps`, as `--env.type=vap` has; without one it is
simpler-bridge/put-camera.
"""

from typing import Any

from vap_core.policies.lerobot.step import VapEnvConfig

DEFAULT = "simpler-bridge/put-camera"
OPTIONS = ("image_size", "robots", "max_steps")
"""What a configuration may set besides the task."""


def make_env(n_envs: int = 1, use_async_envs: bool = False, cfg: Any = None) -> Any:
    """Vector environments by suite and number of the task, as lerobot's factory asks for them."""
    task = getattr(cfg, "task", None) or DEFAULT
    settings = {}
    for name in OPTIONS:
        setting = getattr(cfg, name, None)
        if setting is not None:
            settings[name] = setting
    return VapEnvConfig(task=task, **settings).create_envs(n_envs, use_async_envs)
