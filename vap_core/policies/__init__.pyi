from .lerobot.adapter import load_policy as load_policy
from .lerobot.checkpoints import fingerprint as fingerprint
from .mini_pi0.teach_token import MODEL as MODEL
from .mini_pi0.vlm import load_vlm as load_vlm
