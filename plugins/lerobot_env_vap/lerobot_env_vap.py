"""lerobot's commands import this module, and with it what `vap_core` registers there.

`--env.type=vap` and `vap_over`; the policy type `mini_pi0` with its processor steps; the step
`vap_prompt`;
`--robot.type=vap_so101_twin` and `--teleop.type=vap_expert`.
"""

from vap_core.policies.lerobot import over as over
from vap_core.policies.lerobot import step as step
from vap_core.policies.lerobot import twin as twin
from vap_core.policies.mini_pi0 import configuration_mini_pi0 as configuration_mini_pi0
from vap_core.policies.mini_pi0 import processor_mini_pi0 as processor_mini_pi0
