"""Stacks by name: the embedded one, offline on a CPU, and the foundation ones."""

from collections.abc import Callable
from functools import partial

from vap_core.base.device import check_device
from vap_core.base.errors import one_of
from vap_core.perception.protocols import Stack, Thresholds

EMBEDDED_THRESHOLDS = Thresholds(familiar=0.53, unfamiliar=0.54)
"""Chosen on development views, five references each. Familiar: 209 rendered opening views of the
suites. The object is in view and elected rightly in 188, of which 183 are at least that like it;
where its kind is absent, 7 of 209 views are, and with only its look-alikes left, 54 %. Unfamiliar:
80 pictures with objects pasted into real photos, 15 photos of one object, 7 scenes; 64 of 67 are at
least that like it, 5 % of 869 where the kind is absent, and 25 % of 40 with only look-alikes."""


def load_embedded() -> Stack:
    """Boxes of a COCO detector; EfficientNet-Lite0 features with heads trained on renders."""
    from vap_core.perception.embedded import (
        cut_segmenter,
        detector,
        encoder,
        open_detector,
        tracker,
    )

    return Stack(
        name="embedded",
        detector=open_detector.load(),
        encoder=encoder.load(),
        segmenter=cut_segmenter.load(),
        tracker=tracker.load(),
        by_category=detector.load(),
        unfamiliar_encoder=encoder.load_unfamiliar(),
        thresholds=EMBEDDED_THRESHOLDS,
    )


def load_foundation(kind: str = "foundation") -> Stack:
    """Grounding DINO, DINOv2 and SAM 2.1 (P 5.1), on a GPU where there is one."""
    from vap_core.perception import foundation

    return foundation.load(kind)


STACKS: dict[str, Callable[[], Stack]] = {
    "embedded": load_embedded,
    "foundation": load_foundation,
    "foundation-small": partial(load_foundation, "foundation-small"),
}


def load_stack(name: str) -> Stack:
    """The stack of that name; loading its weights takes about a second.

    Raises: UnknownName: no such stack, or `VAP_DEVICE` names no device of this machine.
    """
    if name not in STACKS:
        raise one_of("load_stack: stack", name, STACKS)
    check_device()
    return STACKS[name]()
