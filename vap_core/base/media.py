"""Photos and videos from outside, decoded within one limit of pixels."""

import warnings
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from fractions import Fraction
from io import BufferedReader, BytesIO
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float64

from vap_core.base.errors import BadOutput, BadPhoto
from vap_core.base.files import file_fault, replacing
from vap_core.base.types import Mask, Rgb

if TYPE_CHECKING:
    import av
    from PIL import Image

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
    rgb = _photo(path, "RGB")
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
    pixels = _photo(path, "RGBA")
    total = pixels[..., 0].astype(np.uint16)
    total += pixels[..., 1]
    total += pixels[..., 2]
    return (total > 3 * BRIGHT) & (pixels[..., 3] > BRIGHT)


def _photo(path: Path | str, mode: str) -> np.ndarray:
    """The pixels of a photo's file, upright, as RGB or RGBA. Raises: BadPhoto."""
    from pillow_heif import register_heif_opener

    path = Path(path)
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
    register_heif_opener(thumbnails=False)
    with path.open("rb") as file:
        return decode_picture(file, f"load_photo: {path}", mode, PHOTO_FORMATS)


def decode_picture(
    source: BytesIO | BufferedReader,
    name: str,
    mode: str = "RGB",
    formats: tuple[str, ...] = PICTURE_FORMATS,
) -> np.ndarray:
    """The pixels of a picture from outside, upright and in sRGB, h x w x 3 or 4, uint8.

    Users' pictures and those inside recordings pass here; what the readers of meshes open keeps to
    the same limit and formats. `name` says in errors whose it is; `formats` are Pillow's names.

    Raises: BadPhoto: no picture of these formats, damaged, over MAX_PIXELS, or of more than 8 bits.
    """
    from PIL import Image, ImageOps, UnidentifiedImageError

    over = f"pixels, over {MAX_PIXELS / 1e6:.0f} million; scale it down."
    try:
        with (
            warnings.catch_warnings(action="ignore", category=Image.DecompressionBombWarning),
            Image.open(source, formats=formats) as image,
        ):
            if image.width * image.height > MAX_PIXELS:
                raise BadPhoto(f"{name} has {image.width}x{image.height} {over}")
            if image.mode.startswith(("I", "F")):
                raise BadPhoto(
                    f"{name} has {image.mode} pixels, more than 8 bits each; save it as an 8-bit "
                    "JPEG or PNG."
                )
            upright = _in_srgb(ImageOps.exif_transpose(image))
            if mode == "RGB" and upright.has_transparency_data:
                # What is hidden in the file is no part of the picture.
                grey = Image.new("RGBA", upright.size, (BEHIND, BEHIND, BEHIND, 255))
                upright = Image.alpha_composite(grey, upright.convert("RGBA"))
            return np.array(upright.convert(mode), dtype=np.uint8)
    except BadPhoto:
        raise
    except UnidentifiedImageError as error:
        raise BadPhoto(
            f"{name} cannot be read as an image, it is none of {', '.join(formats)}; export it as "
            "JPEG or PNG."
        ) from error
    except Image.DecompressionBombError as error:
        raise BadPhoto(f"{name} has too many {over}") from error
    except Exception as error:  # a damaged file makes the decoders raise anything
        raise BadPhoto(
            f"{name} cannot be read as an image ({error!s:.150}); export it as JPEG or PNG."
        ) from error


def _in_srgb(image: "Image.Image") -> "Image.Image":
    """The picture with its colours as sRGB says them, by the ICC profile in its file.

    A profile that cannot be read says nothing.
    """
    from PIL import Image, ImageCms

    profile = image.info.get("icc_profile")
    if not profile:
        return image
    alpha = image.convert("RGBA").getchannel("A") if image.has_transparency_data else None
    if image.mode not in ("L", "CMYK", "LAB"):
        image = image.convert("RGB")
    try:
        given = ImageCms.ImageCmsProfile(BytesIO(profile))
        intent = ImageCms.Intent.RELATIVE_COLORIMETRIC
        srgb = ImageCms.createProfile("sRGB")
        found = ImageCms.profileToProfile(image, given, srgb, intent, outputMode="RGB")
    except (ImageCms.PyCMSError, OSError, ValueError):
        found = image
    assert isinstance(found, Image.Image)
    if alpha is not None:
        found = found.convert("RGB")
        found.putalpha(alpha)
    return found


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


SUFFIXES = (".mp4", ".mov", ".m4v", ".mkv", ".webm", ".avi")
MAX_FRAMES = 3600
"""Two minutes at 30 frames a second: longer clips are read so far."""
USUAL_HZ = 10
"""Frames a second of a video that does not say."""
SHARPNESS_SIDE = 512
"""Frames are compared at this size, so that sharpness does not depend on resolution."""


def is_video(path: Path) -> bool:
    """Whether a file's name is that of a video."""
    return path.suffix.lower() in SUFFIXES


CONTAINERS = "mov,mp4,m4a,3gp,3g2,mj2,matroska,webm,avi"
"""FFmpeg's names of what may be opened. Others of its formats are lists that name further files."""
MAX_VIDEO_PIXELS = 4096 * 2304
"""A frame: 4K."""


def frames(path: Path, long_side: int | None = None) -> Iterator[Rgb]:
    """The frames of a video, upright, shrunk to `long_side` pixels where longer.

    Raises: BadPhoto: the file is missing, unreadable, over MAX_VIDEO_PIXELS, or holds no video
        that can be decoded.
    """
    with _opened(path) as container:
        for number, frame in enumerate(container.decode(video=0)):
            if number >= MAX_FRAMES:
                return
            yield _picture(frame, long_side)


@contextmanager
def _opened(path: Path) -> "Iterator[av.container.InputContainer]":
    """Inside, a video of one of CONTAINERS is read. Raises: BadPhoto."""
    import av

    fault = file_fault(path)
    if fault:
        raise BadPhoto(f"video: {path} {fault}; check the path and its permissions.")
    options = {"format_whitelist": CONTAINERS, "protocol_whitelist": "file"}
    try:
        with av.open(f"file:{path}", options=options) as container:
            if not container.streams.video:
                raise BadPhoto(f"video: {path} holds no video; export the clip as MP4.")
            codec = container.streams.video[0].codec_context
            if codec.width * codec.height > MAX_VIDEO_PIXELS:
                raise BadPhoto(
                    f"video: {path} has {codec.width}x{codec.height} pixels a frame, over "
                    f"{MAX_VIDEO_PIXELS / 1e6:.1f} million; export the clip in 4K or less."
                )
            codec.options = {"max_pixels": str(MAX_VIDEO_PIXELS)}  # a later frame may be larger
            yield container
    except (av.FFmpegError, ValueError) as error:
        raise BadPhoto(
            f"video: {path} cannot be decoded ({error!s:.120}); export the clip as MP4."
        ) from error


def decode_video(packets: Sequence[np.ndarray], codec: str, name: str) -> list[Rgb]:
    """The pictures of a stream of packets, one of each. `name` says in errors whose it is.

    Raises: BadPhoto: a packet cannot be decoded, is over MAX_VIDEO_PIXELS, or holds none or several
        pictures.
    """
    import av

    context: Any = av.CodecContext.create(codec, "r")
    context.options = {"max_pixels": str(MAX_VIDEO_PIXELS)}
    pictures = []
    try:
        for data in [*packets, None]:
            packet = None if data is None else av.Packet(data.tobytes())
            for frame in context.decode(packet):
                pictures.append(frame.to_ndarray(format="rgb24"))
    except (av.FFmpegError, ValueError) as error:
        raise BadPhoto(
            f"{name} holds a video that cannot be decoded ({error!s:.120}; at most "
            f"{MAX_VIDEO_PIXELS / 1e6:.1f} million pixels a picture)."
        ) from error
    if len(pictures) != len(packets):
        raise BadPhoto(
            f"{name} holds a video of {len(packets)} packets that decodes to {len(pictures)} "
            "pictures."
        )
    return pictures


def sharp_frames(path: Path, count: int) -> list[Rgb]:
    """The sharpest frame of each of `count` equal parts of a video.

    Sharpness is the variance of the Laplacian. Raises: BadPhoto.
    """
    sharpness = np.array([_sharpness(rgb) for rgb in frames(path, SHARPNESS_SIDE)])
    if len(sharpness) < count:
        raise BadPhoto(
            f"video: {path} has {len(sharpness)} frames, fewer than the {count} that are wanted; "
            "film for some seconds."
        )
    wanted = set(_best_of_each_part(sharpness, count))
    chosen = []
    for number, rgb in enumerate(frames(path)):
        if number in wanted:
            chosen.append(rgb)
    return chosen


class Mp4:
    """Writes pictures of one size as an H.264 file, one by one.

    The file takes its name when the block ends without an error.

    Raises: BadOutput, when the file cannot be written.
    """

    def __init__(self, path: Path, hz: float) -> None:
        import av

        if path.is_dir():
            raise BadOutput(f"video: {path} is a folder; name a file that ends with .mp4.")
        self.path = path
        self._hz = Fraction(hz).limit_denominator(1000)
        self._stream: Any = None
        with self._told(), ExitStack() as files:
            path.parent.mkdir(parents=True, exist_ok=True)
            part = files.enter_context(replacing(path))
            self._container: Any = av.open(str(part), "w", format="mp4")
            self._files = files.pop_all()
        self._files.callback(self._finish)

    def __enter__(self) -> "Mp4":
        return self

    def __exit__(self, *error: Any) -> None:
        with self._told():
            self._files.__exit__(*error)

    @contextmanager
    def _told(self) -> Iterator[None]:
        """A full disk, or a folder that cannot be written, in one line."""
        import av

        try:
            yield
        except (av.FFmpegError, OSError) as error:
            raise BadOutput(
                f"video: {self.path} cannot be written ({error!s:.120}); make room, or choose "
                "another folder."
            ) from error

    def _finish(self) -> None:
        if self._stream is not None:
            self._container.mux(self._stream.encode(None))
        self._container.close()

    def add(self, rgb: Rgb) -> None:
        """Append one picture; an odd last row or column is cut off.

        Raises: BadOutput, when it cannot be written.
        """
        import av

        height, width = (side - side % 2 for side in rgb.shape[:2])
        if self._stream is None:
            self._stream = self._container.add_stream("libx264", rate=self._hz)
            self._stream.width, self._stream.height = width, height
            self._stream.pix_fmt = "yuv420p"
        even = np.ascontiguousarray(rgb[:height, :width])
        frame = av.VideoFrame.from_ndarray(even, format="rgb24")
        with self._told():
            self._container.mux(self._stream.encode(frame))


def frame_rate(path: Path) -> float:
    """Frames a second of a video. Raises: BadPhoto."""
    with _opened(path) as container:
        return float(container.streams.video[0].average_rate or USUAL_HZ)


def _picture(frame: "av.VideoFrame", long_side: int | None) -> Rgb:
    """One decoded frame upright, as RGB."""
    width, height = frame.width, frame.height
    if long_side is not None and max(width, height) > long_side:
        scale = long_side / max(width, height)
        width, height = round(width * scale), round(height * scale)
    rgb = frame.to_ndarray(format="rgb24", width=width, height=height)
    turns = round(frame.rotation / 90) % 4
    return np.ascontiguousarray(np.rot90(rgb, turns))


def _sharpness(rgb: Rgb) -> float:
    import cv2

    grey = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
    return float(cv2.Laplacian(grey, cv2.CV_64F).var())


def _best_of_each_part(sharpness: Float64[np.ndarray, " n"], count: int) -> list[int]:
    edges = np.linspace(0, len(sharpness), count + 1).round().astype(int)
    best = []
    for first, stop in pairwise(edges.tolist()):
        best.append(first + int(sharpness[first:stop].argmax()))
    return best
