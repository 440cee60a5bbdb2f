"""Reading a user's photos: upright RGB, bounded in size, and one line of error for whatever cannot
be read."""

import warnings
from pathlib import Path

import numpy as np

from vap_core.base.errors import BadPhoto
from vap_core.base.files import file_fault
from vap_core.base.types import Mask, Rgb

PICTURE_FORMATS = ("JPEG", "PNG", "WEBP", "BMP", "GIF", "TIFF", "AVIF")
"""What Pillow may open of files from outside.

All are decoded inside this process. Pillow's list holds others that are not: for EPS it starts
Ghostscript on the file, whatever the file's suffix.
"""
PHOTO_FORMATS = (*PICTURE_FORMATS, "HEIF")
"""Of a user's photos; HEIF, which phones write, needs a plugin."""
PICTURE_SUFFIXES = (
    *(".jpg", ".jpeg", ".jpe", ".jfif", ".mpo", ".png", ".webp", ".bmp", ".gif"),
    *(".tif", ".tiff", ".avif", ".heic", ".heif"),
)
MAX_PIXELS = 50_000_000
MAX_BYTES = 200_000_000
LONG_SIDE = 1024
BRIGHT = 127
"""Mean of the channels, and opacity, above which a pixel of a mask's picture is the object's."""

BEHIND = 127
"""The grey behind what is transparent, which is also what encoders see beside an object."""


def load_photo(path: Path | str, long_side: int | None = LONG_SIDE) -> Rgb:
    """Read a picture file upright and shrink its longer side to `long_side` pixels (None keeps its
    size). Grey stands where it is transparent.

    Raises:
        BadPhoto: missing, unreadable, empty, not an image, truncated, or more than 50 megapixels.
    """
    rgb = _decode(path, "RGB")
    return rgb if long_side is None else shrink(rgb, long_side)


def shrink(rgb: Rgb, long_side: int) -> Rgb:
    """The picture with a longer side of `long_side` pixels; a smaller one as it is."""
    from PIL import Image

    image = Image.fromarray(rgb)
    image.thumbnail((long_side, long_side))
    return np.array(image, dtype=np.uint8)


def load_mask(path: Path | str) -> Mask:
    """A mask from a picture that is bright on the object, in its own size.

    What is transparent is not the object. Raises: BadPhoto.
    """
    pixels = _decode(path, "RGBA")
    bright = pixels[..., :3].mean(axis=2) > BRIGHT
    return bright & (pixels[..., 3] > BRIGHT)


def _decode(path: Path | str, mode: str) -> np.ndarray:
    """The pixels of a picture file, upright, as RGB or RGBA. Raises: BadPhoto."""
    from PIL import Image, ImageOps, UnidentifiedImageError
    from pillow_heif import register_heif_opener

    path = Path(path)
    _check_file(path)
    register_heif_opener(thumbnails=False)
    try:
        with (
            warnings.catch_warnings(action="ignore", category=Image.DecompressionBombWarning),
            path.open("rb") as file,
            Image.open(file, formats=PHOTO_FORMATS) as image,
        ):
            if image.width * image.height > MAX_PIXELS:
                raise BadPhoto(
                    f"load_photo: {path} has {image.width}x{image.height} pixels, over "
                    f"{MAX_PIXELS / 1e6:.0f} million; scale it down."
                )
            if image.mode.startswith(("I", "F")):
                raise BadPhoto(
                    f"load_photo: {path} has {image.mode} pixels, more than 8 bits each; save it "
                    "as an 8-bit JPEG or PNG."
                )
            upright = ImageOps.exif_transpose(image)
            if mode == "RGB" and upright.has_transparency_data:
                # What is hidden in the file is no part of the picture.
                grey = Image.new("RGBA", upright.size, (BEHIND, BEHIND, BEHIND, 255))
                upright = Image.alpha_composite(grey, upright.convert("RGBA"))
            return np.array(upright.convert(mode), dtype=np.uint8)
    except BadPhoto:
        raise
    except UnidentifiedImageError as error:
        raise BadPhoto(
            f"load_photo: {path} cannot be read as an image, it is none of "
            f"{', '.join(PHOTO_FORMATS)}; export it as JPEG or PNG."
        ) from error
    except Image.DecompressionBombError as error:
        raise BadPhoto(
            f"load_photo: {path} has over {MAX_PIXELS / 1e6:.0f} million pixels; scale it down."
        ) from error
    except Exception as error:  # a damaged file makes the decoders raise anything
        raise BadPhoto(
            f"load_photo: {path} cannot be read as an image ({error!s:.150}); export it as JPEG or "
            "PNG."
        ) from error


def photos_in(folder: Path) -> list[Path]:
    """The picture files of a folder by their suffixes, in the order of their names.

    Hidden ones, such as the `._NAME` that macOS writes beside its files, are left out.

    Raises: BadPhoto: there is no such folder, or it cannot be read.
    """
    try:
        paths = list(folder.iterdir())
    except OSError as error:
        raise BadPhoto(
            f"photos_in: {folder} cannot be read as a folder ({error.strerror or error}); name a "
            "folder of photos."
        ) from error
    found = []
    for path in paths:
        if path.suffix.lower() in PICTURE_SUFFIXES and not path.name.startswith("."):
            found.append(path)
    return sorted(found)


def _check_file(path: Path) -> None:
    fault = file_fault(path)
    if fault:
        raise BadPhoto(f"load_photo: {path} {fault}; check the path and its permissions.")
    size = path.stat().st_size
    if not size:
        raise BadPhoto(f"load_photo: {path} is empty; export the photo again.")
    if size > MAX_BYTES:
        raise BadPhoto(
            f"load_photo: {path} has {size / 1e6:.0f} MB, over {MAX_BYTES / 1e6:.0f}; save it "
            "smaller."
        )
