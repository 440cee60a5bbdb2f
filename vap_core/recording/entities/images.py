"""Pictures as rerun stores them: JPEG, class images, contact sheets."""

from collections.abc import Sequence

import cv2
import numpy as np
import rerun as rr

from vap_core.base.types import Rgb


def encode_jpeg(rgb: Rgb, quality: int) -> np.ndarray:
    """JPEG bytes of an RGB picture."""
    bgr = cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR)
    return cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, quality])[1]


def jpeg_image(jpeg: np.ndarray) -> rr.EncodedImage:
    """JPEG bytes as an archetype."""
    return rr.EncodedImage(contents=jpeg.tobytes(), media_type="image/jpeg")


def send_jpegs(
    rec: rr.RecordingStream,
    entity: str,
    index: Sequence[rr.TimeColumn],
    jpegs: Sequence[np.ndarray],
) -> None:
    """One compressed picture per step."""
    columns = rr.EncodedImage.columns(blob=jpegs, media_type=["image/jpeg"] * len(jpegs))
    rec.send_columns(entity, index, columns)


def send_class_images(
    rec: rr.RecordingStream,
    entity: str,
    index: Sequence[rr.TimeColumn],
    images: Sequence[np.ndarray],
    draw_order: float | None = None,
) -> None:
    """Class images of one size, one per step."""
    n = len(images)
    height, width = images[0].shape
    image_format = rr.components.ImageFormat(width, height, color_model="L", channel_datatype="U8")
    draw_orders = None
    if draw_order is not None:
        draw_orders = [draw_order] * n
    columns = rr.SegmentationImage.columns(
        buffer=[image.reshape(-1) for image in images],
        format=[image_format] * n,
        opacity=[1.0] * n,
        draw_order=draw_orders,
    )
    rec.send_columns(entity, index, columns)
