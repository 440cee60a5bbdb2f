from .loop import Trial as Trial
from .loop import rollout as rollout
