"""Photos and videos from outside, decoded within one limit of pixels."""

import re
import struct
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from fractions import Fraction
from io import BufferedReader, BytesIO
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

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
    *,
    upright: bool = True,
    convert: bool = True,
) -> np.ndarray:
    """The pixels of a picture from outside, upright and in sRGB, h x w x 3 or 4, uint8.

    Users' pictures, those inside recordings and the textures of meshes pass here. Texture
    coordinates are of the picture as it is stored (not `upright`), and glTF's textures are in sRGB
    whatever they declare (not `convert`). `name` says in errors whose it is; `formats` are Pillow's
    names.

    Raises: BadPhoto: no picture of these formats, damaged, over MAX_PIXELS, or of more than 8 bits.
    """
    from PIL import Image, ImageOps

    head = source.read(HEAD_BYTES)
    with opened_picture(source, name, formats) as image:
        if image.mode.startswith(("I", "F")):
            raise BadPhoto(
                f"{name} has {image.mode} pixels, more than 8 bits each; save it as an 8-bit JPEG "
                "or PNG."
            )
        space = _declared_space(image, head, name) if convert else None
        found = ImageOps.exif_transpose(image) if upright else image
        found = _in_srgb(found, space) if convert else found
        if mode == "RGB" and found.has_transparency_data:
            # What is hidden in the file is no part of the picture.
            grey = Image.new("RGBA", found.size, (BEHIND, BEHIND, BEHIND, 255))
            found = Image.alpha_composite(grey, found.convert("RGBA"))
        return np.array(found.convert(mode), dtype=np.uint8)


@contextmanager
def opened_picture(
    source: BytesIO | BufferedReader, name: str, formats: tuple[str, ...] = PICTURE_FORMATS
) -> "Iterator[Image.Image]":
    """Inside, a picture of these formats and of MAX_PIXELS at most is read. Raises: BadPhoto."""
    from PIL import Image, UnidentifiedImageError

    over = f"pixels, over {MAX_PIXELS / 1e6:.0f} million; scale it down."
    try:
        with (
            warnings.catch_warnings(action="ignore"),  # of Pillow, at what is damaged or large
            Image.open(source, formats=formats) as image,
        ):
            if image.width * image.height > MAX_PIXELS:
                raise BadPhoto(f"{name} has {image.width}x{image.height} {over}")
            yield image
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


Channels = Float[np.ndarray, "*shape"]


def to_srgb(linear: Channels) -> Channels:
    """Light from 0 to 1 as sRGB encodes it, 0 to 1."""
    linear = np.clip(linear, 0.0, 1.0)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


def to_linear(srgb: Channels) -> Channels:
    """The light that sRGB encodes, both from 0 to 1."""
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def _power(exponent: float) -> Callable[[Channels], Channels]:
    return lambda level: level**exponent


def _hlg(level: Channels) -> Channels:
    """ARIB STD-B67 on a display of 1000 cd/m2, channel by channel; white is 203 cd/m2."""
    scene = np.where(
        level <= 0.5, level**2 / 3, (np.exp((level - 0.55991073) / 0.17883277) + 0.28466892) / 12
    )
    return scene**1.2 * (1000 / 203)


D65, D65_RED = (0.3127, 0.3290), (0.64, 0.33)
PRIMARIES = {
    1: (*D65, *D65_RED, 0.30, 0.60, 0.15, 0.06),
    9: (*D65, 0.708, 0.292, 0.170, 0.797, 0.131, 0.046),
    12: (*D65, 0.68, 0.32, 0.265, 0.69, 0.15, 0.06),
}
"""x and y of white, red, green and blue, by the number that ITU-T H.273 gives them; 1 is sRGB's."""
TRANSFERS = {1: to_linear, 4: _power(2.2), 5: _power(2.8), 8: _power(1.0), 18: _hlg}
"""The light of a level, both from 0 to 1, by H.273's number."""
AS_SRGB = (0, 2, 3, 5, 6, 7), (0, 2, 3, 6, 13, 14, 15)
"""Primaries and transfers that are shown as sRGB: none is said, or those of television."""
ADOBE_RGB = (*D65, *D65_RED, 0.21, 0.71, 0.15, 0.06)
HEAD_BYTES = 65536
"""Of a picture's file, in which the codes of its colours stand."""
Space = tuple[tuple[float, ...], Callable[[Channels], Channels]]
"""Primaries as above, and the light of a level."""


def _space_of(primaries: int, transfer: int, name: str) -> Space | None:
    """The colours of two codes of H.273; None for sRGB. Raises: BadPhoto for those not read."""
    codes = zip((primaries, transfer), AS_SRGB, strict=True)
    primaries, transfer = (1 if code in alike else code for code, alike in codes)
    if primaries not in PRIMARIES or transfer not in TRANSFERS:
        raise BadPhoto(
            f"{name} declares colours {primaries}/{transfer} of ITU-T H.273, which are not read "
            "here; export it in sRGB."
        )
    space = PRIMARIES[primaries], TRANSFERS[transfer]
    return None if space == (PRIMARIES[1], to_linear) else space


def _declared_space(image: "Image.Image", head: bytes, name: str) -> Space | None:
    """The colours that a picture's file declares beside an ICC profile; None where they are sRGB.

    PNG's cICP comes before a profile, all others behind it. Raises: BadPhoto.
    """
    info = image.info
    if image.format == "PNG":
        codes = re.search(rb"cICP(.)(.)", head.partition(b"IDAT")[0], re.DOTALL)
        if codes:
            info.pop("icc_profile", None)
            return _space_of(codes[1][0], codes[2][0], name)
    if info.get("icc_profile"):
        return None
    if "srgb" not in info and ("gamma" in info or "chromaticity" in info):
        gamma = info.get("gamma", 0.45455)
        usual = abs(gamma - 0.45455) < 1e-3 and "chromaticity" not in info
        light = to_linear if usual else _power(1 / max(gamma, 1e-3))
        return tuple(info.get("chromaticity", PRIMARIES[1])), light
    if image.format == "AVIF" and (codes := re.search(rb"colrnclx.(.).(.)", head, re.DOTALL)):
        return _space_of(codes[1][0], codes[2][0], name)
    if nclx := info.get("nclx_profile"):
        return _space_of(nclx["color_primaries"], nclx["transfer_characteristics"], name)
    with suppress(Exception):  # a damaged EXIF says nothing
        if str(image.getexif().get_ifd(0xA005).get(1, "")).startswith("R03"):  # DCF's option
            return ADOBE_RGB, _power(563 / 256)
    return None


def _xyz(primaries: Sequence[float]) -> np.ndarray:
    """The matrix from a space's linear RGB to CIE XYZ, in shares of its white."""
    x, y = np.reshape(primaries, (4, 2)).T
    white, *points = np.stack([x / y, np.ones(4), (1 - x - y) / y], axis=1)
    columns = np.transpose(points)
    return columns * np.linalg.solve(columns, white) / white[:, None]


def _space_to_srgb(rgb: Rgb, space: Space) -> Rgb:
    """The picture of a space in sRGB; what sRGB cannot show is clipped."""
    primaries, light = space
    matrix = np.linalg.solve(_xyz(PRIMARIES[1]), _xyz(primaries)).T.astype(np.float32)
    table = light(np.arange(256) / 255).astype(np.float32)
    found = np.empty_like(rgb)
    for rows, into in zip(
        *(np.array_split(array, -(-rgb.size // 3_000_000)) for array in (rgb, found)), strict=True
    ):
        into[:] = np.round(255 * to_srgb(table[rows] @ matrix))
    return found


MODES = {"GRAY": "L", "RGB ": "RGB", "CMYK": "CMYK", "Lab ": "LAB"}
"""The mode of the pictures that a profile is for, by the profile's own word."""


def _in_srgb(image: "Image.Image", space: Space | None) -> "Image.Image":
    """The picture with its colours as sRGB says them, by its `space` or the ICC profile in its
    file.

    A profile that cannot be read, or is for other pictures, says nothing.
    """
    from PIL import Image, ImageCms

    profile: Any = image.info.get("icc_profile")
    if space is None and not profile:
        return image
    alpha = image.convert("RGBA").getchannel("A") if image.has_transparency_data else None
    if space is not None:
        found = Image.fromarray(_space_to_srgb(np.array(image.convert("RGB")), space))
    else:
        own = {"1": "L", "LA": "L"}.get(image.mode, image.mode)
        own = own if own in ("L", "CMYK", "LAB") else "RGB"
        try:
            given = ImageCms.ImageCmsProfile(BytesIO(profile))
            mode = MODES.get(given.profile.xcolor_space, "")
            mode = mode if mode == own or (mode, own) == ("RGB", "L") else own
            intent = ImageCms.Intent.RELATIVE_COLORIMETRIC
            srgb = ImageCms.createProfile("sRGB")
            converted = ImageCms.profileToProfile(
                image.convert(mode), given, srgb, intent, outputMode="RGB"
            )
            assert converted is not None
            found = converted
        except (ImageCms.PyCMSError, OSError, ValueError):
            found = image
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
    found = [
        path
        for path in paths
        if path.suffix.lower() in PICTURE_SUFFIXES and not path.name.startswith(".")
    ]
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
    with opened_video(path) as container:
        codec = container.streams.video[0].codec_context
        space = _space_of(codec.color_primaries, codec.color_trc, f"video: {path}")
        for number, frame in enumerate(container.decode(video=0)):
            if number >= MAX_FRAMES:
                return
            rgb = _picture(frame, long_side)
            yield rgb if space is None else _space_to_srgb(rgb, space)


@contextmanager
def opened_video(path: Path) -> "Iterator[av.container.InputContainer]":
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
    try:
        pictures = [
            frame.to_ndarray(format="rgb24")
            for packet in [*(av.Packet(data.tobytes()) for data in packets), None]
            for frame in context.decode(packet)
        ]
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
    edges = np.linspace(0, len(sharpness), count + 1).round().astype(int).tolist()
    wanted = {first + int(sharpness[first:stop].argmax()) for first, stop in pairwise(edges)}
    return [rgb for number, rgb in enumerate(frames(path)) if number in wanted]


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
    with opened_video(path) as container:
        return float(container.streams.video[0].average_rate or USUAL_HZ)


def _picture(frame: "av.VideoFrame", long_side: int | None) -> Rgb:
    """One decoded frame upright, as RGB by its own matrix and range."""
    from av.video.reformatter import ColorRange, Colorspace

    width, height = frame.width, frame.height
    if long_side is not None and max(width, height) > long_side:
        scale = long_side / max(width, height)
        width, height = round(width * scale), round(height * scale)
    # PyAV converts by the matrix and the range of a frame only where the result's are others.
    other = Colorspace.ITU601 if frame.colorspace != Colorspace.ITU601 else Colorspace.ITU709
    rgb = frame.to_ndarray(
        format="rgb24",
        width=width,
        height=height,
        src_colorspace=frame.colorspace,
        dst_colorspace=other,
        src_color_range=frame.color_range,
        dst_color_range=ColorRange.JPEG,
    )
    matrix: Any = frame.side_data.get("DISPLAYMATRIX")
    a, b, _, c, d = np.frombuffer(matrix or struct.pack("=5i", 1, 0, 0, 0, 1), np.int32, 5).tolist()
    if abs(b) > abs(a):  # columns become rows
        rgb, a, d = rgb.transpose(1, 0, 2), c, b
    return np.ascontiguousarray(rgb[:: -1 if d < 0 else 1, :: -1 if a < 0 else 1])


def _sharpness(rgb: Rgb) -> float:
    import cv2

    return float(cv2.Laplacian(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), cv2.CV_64F).var())
