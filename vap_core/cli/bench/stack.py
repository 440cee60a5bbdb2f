"""What the models of one perception stack cost, beside the paper's runtime table (P tab:runtime); speed does not depend on weights."""

import time
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from vap_core.base.tables import align
from vap_core.base.types import Boxes, Rgb
from vap_core.perception import foundation
from vap_core.perception.embedded.backbone import features
from vap_core.perception.protocols import Stack
from vap_core.perception.stacks import load_embedded

PAPER_S = {"detection": 0.19, "segmentation and embedding": 0.07, "track step": 0.02}
SIDE, VIEWS, CANDIDATES, REFERENCES = 224, 3, 5, 5
REPEAT, SLOW_REPEAT = 15, 1
"""The second for foundation models on a CPU."""


def run(kind: str, *, random: bool = False, device: str | None = None) -> str:
    """Time every part and say it: elapsed time on a GPU, CPU time of one thread otherwise. Large models need several minutes on a CPU."""
    import torch

    from vap_core.perception.foundation.runtime import select_runtime

    where = select_runtime("cpu" if kind == "embedded" else device)
    parts = _parts(kind, random, device)
    on_gpu = where.device.type == "cuda"
    repeat = REPEAT if on_gpu or kind == "embedded" else SLOW_REPEAT
    rng = np.random.default_rng(0)
    clock = time.perf_counter if on_gpu else time.process_time
    unit = _seconds(lambda: features([_view(rng)], ["head"]), REPEAT, time.process_time)
    rows = [
        [
            what,
            f"{1e3 * took:.1f}",
            f"{took / unit:.1f}",
            f"{1e3 * PAPER_S[what]:.0f}" if what in PAPER_S else "",
        ]
        for what, took in _measure(parts, rng, repeat, clock).items()
    ]
    name = (
        torch.cuda.get_device_name(where.device)
        if on_gpu
        else f"CPU ({torch.get_num_threads()} thread, CPU time)"
    )
    weights = "random weights" if random else "its weights"
    return "\n".join(
        [
            f"stack {kind} with {weights} on {name}, {where.half or 'float32'}; views of {SIDE} px; median of {repeat}",
            f"unit: one EfficientNet-Lite0 pass of such a view on the CPU in the same run, {1e3 * unit:.1f} ms",
            "",
            align([["part", "ms", "units", "paper, ms"], *rows]),
            "The paper names neither its GPU nor the sizes of its models."
            + ("" if on_gpu else " No GPU was used: GPU figures were not measured."),
        ]
    )


def _parts(kind: str, random: bool, device: str | None) -> Stack:
    if kind == "embedded":
        return load_embedded()
    return foundation.load_random(kind, device) if random else foundation.load(kind, device)


def _measure(
    parts: Stack, rng: np.random.Generator, repeat: int, clock: Callable[[], float]
) -> dict[str, float]:
    """Seconds of every part; opening frames are new each time, because their features are kept."""
    boxes = _boxes()
    crops = [_view(rng)[:60, :50].copy() for _ in range(CANDIDATES)]
    found = {
        "detection": _seconds(lambda: parts.detector([_view(rng)], "cup"), repeat, clock),
        f"detection, {VIEWS} views, per view": _seconds(
            lambda: parts.detector([_view(rng) for _ in range(VIEWS)], "cup"), repeat, clock
        )
        / VIEWS,
        f"embedding, {CANDIDATES} crops, per crop": _seconds(
            lambda: parts.encoder(crops), repeat, clock
        )
        / CANDIDATES,
        f"segmentation, {CANDIDATES} boxes": _seconds(
            lambda: parts.segmenter(_view(rng), boxes), repeat, clock
        ),
        "segmentation and embedding": _seconds(
            lambda: (parts.encoder(crops), parts.segmenter(_view(rng), boxes)), repeat, clock
        ),
    }
    for what, identities, views in (
        ("track step", 1, 1),
        (f"track step, {CANDIDATES} identities, {VIEWS} views, per view", CANDIDATES, VIEWS),
    ):
        found[what] = _track_seconds(parts, rng, identities, views, repeat, clock) / views
    return found


def _track_seconds(
    parts: Stack,
    rng: np.random.Generator,
    identities: int,
    views: int,
    repeat: int,
    clock: Callable[[], float],
) -> float:
    """A step once the memory is full."""
    images = [_view(rng) for _ in range(views)]
    masks = np.zeros((identities, SIDE, SIDE), bool)
    for mask, (x0, y0, x1, y1) in zip(masks, _boxes().xyxy.astype(int), strict=False):
        mask[y0:y1, x0:x1] = True
    states, _ = parts.tracker.step(parts.tracker.start(images, [masks] * views), images)
    states = [_filled(state) for state in states]
    return _seconds(lambda: parts.tracker.step(states, images), repeat, clock)


def _filled(state: object) -> object:
    """A stream whose memory holds as many frames as it ever will; other trackers' states as they are."""
    from vap_core.perception.foundation.tracker import SamTrackState

    return (
        replace(state, recent=state.recent * 6, pointers=state.pointers * 15)
        if isinstance(state, SamTrackState)
        else state
    )


def _view(rng: np.random.Generator) -> Rgb:
    return rng.integers(0, 256, (SIDE, SIDE, 3), dtype=np.uint8)


def _boxes() -> Boxes:
    xyxy = np.array(
        [[x, y, x + 50, y + 60] for x, y in ((10, 10), (80, 10), (150, 10), (10, 100), (80, 100))],
        np.float32,
    )
    return Boxes(xyxy, np.ones(len(xyxy), np.float32), "cup")


def _seconds(work: Callable[[], object], repeat: int, clock: Callable[[], float]) -> float:
    """The median; work that is timed more than once is warmed up."""
    took: Sequence[float] = []
    for _ in range(repeat + (repeat > 1)):
        start = clock()
        work()
        took = [*took, clock() - start]
    return float(np.median(took[1:] if repeat > 1 else took))
