"""Where the policy's attention was: numbers per image patch, and overlays on its input.

Every query has its own entity below `/vap/attention/<camera>`, a tensor of all layers and heads,
and its own overlay below `<image>/attention`, of the layer shown, in the mean over heads.
"""

from collections.abc import Sequence

import cv2
import numpy as np
import rerun as rr

from vap_core.base.types import Rgb
from vap_core.policies.hooks import heat_map
from vap_core.recording.entities.images import encode_jpeg, send_jpegs
from vap_core.recording.entities.paths import image_root
from vap_core.recording.stream import frame_times, log_row
from vap_core.rollout.types import Frame


def send_attention(rec: rr.RecordingStream, frames: Sequence[Frame], jpeg_quality: int) -> None:
    """The share of attention on every image patch, and the overlays; `frames` have attention."""
    for camera, of_queries in frames[0].attention.items():
        for query in of_queries:
            overlays = []
            for frame in frames:  # rerun has no columns of tensors
                weights = frame.attention[camera][query]
                tensor = rr.Tensor(weights, dim_names=("layer", "head", "row", "column"))
                log_row(rec, f"/vap/attention/{camera}/{query}", tensor, at=frame_times([frame]))
                overlay = attention_overlay(frame.prompted[camera], heat_map(weights, query))
                overlays.append(encode_jpeg(overlay, jpeg_quality))
            entity = f"{image_root(camera)}/attention/{query}"
            send_jpegs(rec, entity, frame_times(frames), overlays)


def attention_overlay(rgb: Rgb, heat: np.ndarray) -> Rgb:
    """The dimmed picture with a heat map over it; the most attended patch is brightest."""
    height, width = rgb.shape[:2]
    share = cv2.resize(
        heat / max(float(heat.max()), 1e-9), (width, height), interpolation=cv2.INTER_LINEAR
    )
    bgr = cv2.applyColorMap((255 * share).astype(np.uint8), cv2.COLORMAP_INFERNO)
    colour = cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB)
    weight = (0.4 + 0.35 * share)[..., None]
    return ((1 - weight) * rgb + weight * colour).astype(np.uint8)
