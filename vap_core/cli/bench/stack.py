"""What the models of one perception stack cost, beside the paper's runtime table (P tab:runtime).

Speed does not depend on weights.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from vap_core.base.tables import align
from vap_core.base.types import Boxes, Rgb
from vap_core.cli.bench.timing import Clock, median_seconds
from vap_core.perception import foundation
from vap_core.perception.embedded.backbone import features
from vap_core.perception.protocols import Stack
from vap_core.perception.stacks import load_embedded, load_mixed, load_random

PAPER_S = {"detection": 0.19, "segmentation and embedding": 0.07, "track step": 0.02}
SIDE = 224
"""Pixels of a view."""
VIEWS = 3
CANDIDATES = 5
REPEAT = 15
SLOW_REPEAT = 1
"""For foundation models on a CPU."""
CORNERS = ((10, 10), (80, 10), (150, 10), (10, 100), (80, 100))
"""Of the candidates' boxes, which are 50 x 60 pixels."""


@dataclass(frozen=True)
class Timer:
    """How often work is timed, and by which clock (seconds)."""

    repeat: int
    clock: Clock

    def seconds(self, work: Callable[[], object]) -> float:
        """The median; work that is timed more than once is warmed up."""
        warm_up = 1 if self.repeat > 1 else 0
        return median_seconds(work, self.repeat, warm_up=warm_up, clock=self.clock)


def run(kind: str, *, random: bool = False, device: str | None = None) -> str:
    """Time every part and report it: elapsed time on a GPU, CPU time of one thread otherwise.

    Large models need several minutes on a CPU.

    Raises: UnknownName: no such stack or device; MissingPart, MissingWeights, BadOutput,
        as `load_stack`.
    """
    import torch

    from vap_core.perception.foundation.runtime import select_runtime

    runtime = select_runtime("cpu" if kind == "embedded" else device)
    parts = _parts(kind, random, device)
    on_gpu = runtime.device.type == "cuda"
    if on_gpu:
        timer = Timer(REPEAT, time.perf_counter)
        name = torch.cuda.get_device_name(runtime.device)
        note = ""
    else:
        timer = Timer(REPEAT if kind == "embedded" else SLOW_REPEAT, time.process_time)
        name = f"CPU ({torch.get_num_threads()} thread, CPU time)"
        note = " No GPU was used: GPU figures were not measured."
    rng = np.random.default_rng(0)
    backbone_timer = Timer(REPEAT, time.process_time)
    unit = backbone_timer.seconds(lambda: features([_view(rng)], ["head"]))
    table = _table(_measure(parts, rng, timer), unit)
    weights = "random weights" if random else "its weights"
    title = (
        f"stack {kind} with {weights} on {name}, {runtime.half or 'float32'}; "
        f"views of {SIDE} px; median of {timer.repeat}"
    )
    unit_text = (
        "unit: one EfficientNet-Lite0 pass of such a view on the CPU in the same run, "
        f"{1e3 * unit:.1f} ms"
    )
    paper = "The paper names neither its GPU nor the sizes of its models."
    return "\n".join([title, unit_text, "", table, f"{paper}{note}"])


def _parts(kind: str, random: bool, device: str | None) -> Stack:
    if kind == "embedded":
        return load_embedded()
    if random:
        return load_random(kind, device)
    if ":" in kind:
        return load_mixed(kind, device)
    return foundation.load(kind, device)


def _table(seconds: dict[str, float], unit: float) -> str:
    """A row per part: milliseconds, units, and the paper's milliseconds."""
    rows = [["part", "ms", "units", "paper, ms"]]
    for part, s in seconds.items():
        paper = ""
        if part in PAPER_S:
            paper = f"{1e3 * PAPER_S[part]:.0f}"
        rows.append([part, f"{1e3 * s:.1f}", f"{s / unit:.1f}", paper])
    return align(rows)


def _measure(parts: Stack, rng: np.random.Generator, timer: Timer) -> dict[str, float]:
    """Seconds of every part.

    Opening frames are new each time, because their features are kept.
    """
    boxes = _boxes()
    crops = []
    for view in _views(rng, CANDIDATES):
        crops.append(view[:60, :50].copy())

    def detect() -> None:
        parts.detector([_view(rng)], "cup")

    def detect_in_views() -> None:
        parts.detector(_views(rng, VIEWS), "cup")

    def embed() -> None:
        parts.encoder(crops)

    def segment() -> None:
        parts.segmenter(_view(rng), boxes)

    def embed_and_segment() -> None:
        embed()
        segment()

    detection = f"detection, {VIEWS} views, per view"
    embedding = f"embedding, {CANDIDATES} crops, per crop"
    tracking = f"track step, {CANDIDATES} identities, {VIEWS} views, per view"
    # Parts are measured in this order.
    seconds = {}
    seconds["detection"] = timer.seconds(detect)
    seconds[detection] = timer.seconds(detect_in_views) / VIEWS
    seconds[embedding] = timer.seconds(embed) / CANDIDATES
    seconds[f"segmentation, {CANDIDATES} boxes"] = timer.seconds(segment)
    seconds["segmentation and embedding"] = timer.seconds(embed_and_segment)
    seconds["track step"] = _track_seconds(parts, rng, 1, 1, timer)
    seconds[tracking] = _track_seconds(parts, rng, CANDIDATES, VIEWS, timer) / VIEWS
    return seconds


def _track_seconds(
    parts: Stack, rng: np.random.Generator, identities: int, views: int, timer: Timer
) -> float:
    """A step once the memory is full."""
    images = _views(rng, views)
    masks = np.zeros((identities, SIDE, SIDE), bool)
    corners = _boxes().xyxy.astype(int)
    for mask, (x0, y0, x1, y1) in zip(masks, corners, strict=False):
        mask[y0:y1, x0:x1] = True
    opening = parts.tracker.start(images, [masks] * views)
    states, _ = parts.tracker.step(opening, images)
    states = [_fill(state) for state in states]
    return timer.seconds(lambda: parts.tracker.step(states, images))


def _fill(state: object) -> object:
    """A stream whose memory holds as many frames as it ever will.

    Other trackers' states stay as they are.
    """
    from vap_core.perception.foundation.tracker import SamTrackState

    if isinstance(state, SamTrackState):
        return replace(state, recent=state.recent * 6, pointers=state.pointers * 15)
    return state


def _view(rng: np.random.Generator) -> Rgb:
    return rng.integers(0, 256, (SIDE, SIDE, 3), dtype=np.uint8)


def _views(rng: np.random.Generator, n: int) -> list[Rgb]:
    return [_view(rng) for _ in range(n)]


def _boxes() -> Boxes:
    corners = np.array(CORNERS, np.float32)
    xyxy = np.concatenate([corners, corners + np.array([50, 60], np.float32)], axis=1)
    return Boxes(xyxy, np.ones(len(xyxy), np.float32), "cup")
