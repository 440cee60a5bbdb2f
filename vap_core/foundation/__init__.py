"""The foundation stack: Grounding DINO, DINOv2 and SAM 2.1 behind the protocols of the embedded one. Sole importer of transformers."""

from dataclasses import dataclass
from functools import cache
from pathlib import Path

from vap_core.detect import Detector
from vap_core.embed import Encoder
from vap_core.segment import Segmenter
from vap_core.track import Tracker


@dataclass(frozen=True)
class Parts:
    """The four models of one stack; segmenter and tracker share theirs."""

    detector: Detector
    encoder: Encoder
    segmenter: Segmenter
    tracker: Tracker


@cache
def load(kind: str, device: str | None = None, store: Path | None = None) -> Parts:
    """The models of a stack of `hub.KINDS`, from verified local weights.

    Raises:
        MissingWeights: what is not on this machine, and both ways to get it.
        UnknownName: no such device.
    """
    from vap_core import hub
    from vap_core.foundation import architectures
    from vap_core.foundation.runtime import pick

    runtime = pick(device)
    return architectures.assemble(architectures.read(*hub.ready(kind, store)), runtime)


def random(kind: str, device: str | None = None) -> Parts:
    """The real architectures of a stack with random weights: as fast, and as large, as the trained ones."""
    from vap_core.foundation import architectures
    from vap_core.foundation.runtime import pick

    return architectures.assemble(architectures.invent(kind), pick(device))
