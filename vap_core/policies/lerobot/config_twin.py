"""What lerobot's command line says about the twin of an SO-101, and about its expert.

lerobot finds the device of `NameConfig` as `Name` in the module of this name without `config_`.
"""

from dataclasses import dataclass

from lerobot.robots.config import RobotConfig
from lerobot.teleoperators.config import TeleoperatorConfig


@RobotConfig.register_subclass("vap_so101_twin")
@dataclass(kw_only=True)
class VapSo101TwinConfig(RobotConfig):
    """An SO-101 on the desk of a tabletop episode.

    `task` is SUITE/TASK of a suite whose robot is an SO-101, `episode` the number of its row.
    Pictures are `image_size` pixels a side. `object` takes the target's place, as in `rollout
    --object`.
    """

    task: str = "tabletop/select-cup"
    episode: int = 0
    image_size: int = 224
    object: str = ""


@TeleoperatorConfig.register_subclass("vap_expert")
@dataclass(kw_only=True)
class VapExpertConfig(TeleoperatorConfig):
    """The scripted expert, which reads the simulator, in place of a leader arm."""
