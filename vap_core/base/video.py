"""Video files: their frames as pictures, and pictures as an mp4."""

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from fractions import Fraction
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from vap_core.base.errors import BadOutput, BadPhoto
from vap_core.base.files import check_regular, file_fault, replacing
from vap_core.base.types import Rgb

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


def frames(path: Path, long_side: int | None = None) -> Iterator[Rgb]:
    """The frames of a video, upright, shrunk to `long_side` pixels where longer.

    Raises: BadPhoto: the file is missing or unreadable, or holds no video that can be decoded.
    """
    import av

    fault = file_fault(path)
    if fault:
        raise BadPhoto(f"video: {path} {fault}; check the path and its permissions.")
    try:
        with av.open(str(path)) as container:
            if not container.streams.video:
                raise BadPhoto(f"video: {path} holds no video; export the clip as MP4.")
            for number, frame in enumerate(container.decode(video=0)):
                if number >= MAX_FRAMES:
                    return
                yield _picture(frame, long_side)
    except (av.FFmpegError, ValueError) as error:
        raise _undecodable(path, error) from error


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
    import av

    try:
        check_regular(path)
        with av.open(str(path)) as container:
            hz = container.streams.video[0].average_rate
    except (av.FFmpegError, IndexError, OSError) as error:
        raise _undecodable(path, error) from error
    return float(hz or USUAL_HZ)


def _undecodable(path: Path, error: Exception) -> BadPhoto:
    return BadPhoto(f"video: {path} cannot be decoded ({error!s:.120}); export the clip as MP4.")


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
