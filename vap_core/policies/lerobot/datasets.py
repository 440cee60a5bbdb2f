"""Recorded episodes of any LeRobotDataset v3 as our views, and a copy with other pictures.

Datasets come from outside: they are parsed, never executed, and nothing is looked up on a network.
"""

import hashlib
import io
import logging
import os
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, redirect_stderr
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any
from unittest.mock import patch

import numpy as np

from vap_core.base.errors import BadDataset, BadPhoto
from vap_core.base.files import read_file, sha256_of
from vap_core.base.media import opened_picture, opened_video
from vap_core.base.types import Mask, Rgb, Views, value

if TYPE_CHECKING:
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

PREFIXES = ("observation.images.", "observation.")
INFO = Path("meta", "info.json")
PARTS = ("meta", "data", "images", "videos")
"""The folders of a dataset."""
MASK = "vap.mask."
"""Begins the name of a feature that has a target's mask."""


@value
class RecordedFrame:
    """One frame of an episode: its views by camera, its task, and what else the dataset has."""

    number: int
    at_s: float
    views: Views
    task: str
    item: Mapping[str, Any]


@dataclass(frozen=True)
class Recorded:
    """An opened dataset. `keys` is the feature of every camera, by the camera's name."""

    folder: Path
    dataset: "LeRobotDataset"
    keys: Mapping[str, str]
    hz: float
    episodes: int

    def length(self, episode: int) -> int:
        """Frames of an episode."""
        return int(self.dataset.meta.episodes[episode]["length"])

    def digest(self) -> str:
        """A digest of the contents of meta/, and of the name, size and time of every other file.

        Raises: BadDataset.
        """
        found = hashlib.sha256()
        try:
            for part in PARTS:
                for path in filter(Path.is_file, sorted((self.folder / part).rglob("*"))):
                    about = path.stat()
                    what = f"{about.st_size} {about.st_mtime_ns}"
                    what = sha256_of(path) if part == "meta" else what
                    name = path.relative_to(self.folder).as_posix()
                    found.update(f"{name} {what}\n".encode())
        except OSError as error:
            raise _damaged(self.folder, error) from error
        return found.hexdigest()[:16]

    def tasks(self, episodes: int) -> tuple[str, ...]:
        """The tasks of the first `episodes` episodes, each once, in their order."""
        of_episodes = [self.dataset.meta.episodes[i]["tasks"] for i in range(episodes)]
        return tuple(dict.fromkeys(str(task) for tasks in of_episodes for task in tasks))

    def frames(self, episode: int) -> Iterator[RecordedFrame]:
        """The frames of an episode, in order. Raises: BadDataset."""
        about = self.dataset.meta.episodes[episode]
        first, stop = int(about["dataset_from_index"]), int(about["dataset_to_index"])
        for number in range(stop - first):
            try:
                with bounded(self.folder):
                    item = self.dataset[first + number]
            except BadPhoto as error:
                raise BadDataset(f"dataset: {self.folder}: {error}") from error
            except Exception as error:  # decoders of damaged files raise anything
                raise _damaged(self.folder, error) from error
            views = {camera: _rgb(item[key]) for camera, key in self.keys.items()}
            yield RecordedFrame(number, number / self.hz, views, str(item["task"]), item)


def open_dataset(folder: Path) -> Recorded:
    """Open the LeRobotDataset v3 in a folder.

    Raises: BadDataset when there is none, it is damaged, of another version, or without pictures.
    """
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    folder = Path(folder)
    if not (folder / INFO).is_file():
        raise BadDataset(
            f"dataset: {folder} is no LeRobotDataset (it has no {INFO}); name its folder, for one "
            "from the hub the folder that `hf download --repo-type dataset OWNER/NAME` prints."
        )
    try:
        with offline():
            dataset = LeRobotDataset(
                f"local/{folder.name}", root=folder, return_uint8=True, video_backend="pyav"
            )
            n_episodes = len(dataset.meta.episodes)
    except Exception as error:  # lerobot and pyarrow raise anything for a damaged folder
        raise _damaged(folder, error) from error
    keys = _cameras(dataset, folder)
    if not keys or not n_episodes:
        what = "episode" if keys else "colour picture"
        raise BadDataset(f"dataset: {folder} has no {what}; record one with lerobot-record.")
    return Recorded(folder, dataset, keys, float(dataset.meta.fps), n_episodes)


class Copy:
    """A copy of a dataset whose pictures and tasks are replaced; complete, or not there.

    With `masks` it has a feature `vap.mask.CAMERA` more, height x width bytes, 1 on the target.

    It grows beside its place under a name with a leading dot; what a killed process left there is
    removed by the next.

    Raises: BadDataset when `out` exists or cannot be written.
    """

    def __init__(self, source: Recorded, out: Path, masks: bool = False) -> None:
        from lerobot.datasets.lerobot_dataset import LeRobotDataset
        from lerobot.utils.constants import DEFAULT_FEATURES

        if out.exists():
            raise BadDataset(f"dataset: {out} exists; choose another folder with --copy.")
        self.out = out
        self._stage = out.with_name(f".{out.name}.partial")
        self._source = source
        meta = source.dataset.meta
        self._features = {
            key: {**feature, "shape": tuple(feature["shape"])}
            for key, feature in meta.features.items()
            if key not in DEFAULT_FEATURES
        }
        described = dict(self._features)
        self._masks = {}
        for camera, key in source.keys.items() if masks else ():
            shape = list(self._features[key]["shape"])
            shape.pop(0 if shape[0] == 3 and shape[-1] != 3 else -1)  # the channels
            self._masks[camera] = tuple(shape)
            feature = {"dtype": "uint8", "shape": tuple(shape), "names": ["height", "width"]}
            described[MASK + camera] = feature
        shutil.rmtree(self._stage, ignore_errors=True)
        try:
            out.parent.mkdir(parents=True, exist_ok=True)
            self._dataset = LeRobotDataset.create(
                f"local/{out.name}",
                fps=round(source.hz),
                features=described,
                root=self._stage,
                robot_type=meta.robot_type,
                use_videos=bool(meta.video_keys),
                video_backend="pyav",
                encoder_threads=1,
            )
        except OSError as error:
            raise _unwritable(out, error) from error

    def __enter__(self) -> "Copy":
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        try:
            if kind is None:
                self._dataset.finalize()
                self._stage.rename(self.out)
        except OSError as full:
            raise _unwritable(self.out, full) from full
        finally:
            shutil.rmtree(self._stage, ignore_errors=True)

    def add(
        self, frame: RecordedFrame, views: Views, task: str, masks: Mapping[str, Mask | None]
    ) -> None:
        """The frame with these views, this task, and perhaps the target's mask in every view.

        Raises: BadDataset when `out` cannot be written.
        """
        copied: dict[str, Any] = {"task": task}
        for key, feature in self._features.items():
            cell = frame.item[key]
            if feature["dtype"] in ("image", "video"):
                cell = np.asarray(cell).transpose(1, 2, 0)
            elif feature["dtype"] != "string" and not isinstance(cell, str):
                cell = np.asarray(cell).astype(feature["dtype"]).reshape(feature["shape"])
            copied[key] = cell
        copied |= {key: views[camera] for camera, key in self._source.keys.items()}
        for camera, shape in self._masks.items():
            mask = masks[camera]
            copied[MASK + camera] = np.zeros(shape, np.uint8) if mask is None else mask.astype("u1")
        try:
            self._dataset.add_frame(copied)
        except OSError as error:
            raise _unwritable(self.out, error) from error

    def end_episode(self) -> None:
        """Save the frames that were added as one episode.

        Raises: BadDataset when `out` cannot be written.
        """
        try:
            with redirect_stderr(io.StringIO()):
                self._dataset.save_episode(parallel_encoding=False)
        except OSError as error:
            raise _unwritable(self.out, error) from error


@contextmanager
def offline() -> Iterator[None]:
    """Inside, lerobot asks no hub, and its log is silent."""
    level = logging.root.manager.disable
    logging.disable(logging.WARNING)
    try:
        with patch("huggingface_hub.constants.HF_HUB_OFFLINE", True):
            yield
    finally:
        logging.disable(level)


@contextmanager
def bounded(folder: Path) -> Iterator[None]:
    """Inside, lerobot opens videos and pictures of the dataset in a folder as `base.media` does.

    Their formats and their pixels are limited, and they lie in the folder.
    """
    import av
    from datasets import Image
    from lerobot.datasets import video_utils

    decode = Image.decode_example

    def inside(path: Path) -> Path:
        if not Path(os.path.normpath(path)).is_relative_to(os.path.normpath(folder)):
            raise BadPhoto(f"{path} lies outside of the dataset; copy it there.")
        return path

    def checked(self: Image, value: dict[str, Any], token_per_repo_id: Any = None) -> Any:
        data = value["bytes"]
        if data is None:
            data = read_file(inside(folder / value["path"]))
        with opened_picture(io.BytesIO(data), "a picture"):
            return decode(self, {"bytes": data, "path": None})

    def opened(path: str, *args: Any, **options: Any) -> Any:
        if args or options:  # to write
            return av.open(path, *args, **options)
        return opened_video(inside(Path(path)))

    limited = SimpleNamespace(**{**vars(av), "open": opened})
    with patch.object(video_utils, "av", limited), patch.object(Image, "decode_example", checked):
        yield


def _cameras(dataset: "LeRobotDataset", folder: Path) -> dict[str, str]:
    """The features of colour pictures, by their camera. Raises: BadDataset: two have one name."""
    keys: dict[str, str] = {}
    for key, feature in dataset.meta.features.items():
        is_picture = feature["dtype"] in ("image", "video")
        if is_picture and key not in dataset.meta.depth_keys and 3 in feature["shape"]:
            camera = key
            for prefix in PREFIXES:
                if key.startswith(prefix):
                    camera = key.removeprefix(prefix)
                    break
            if camera in keys:
                raise BadDataset(
                    f"dataset: {folder} has pictures {keys[camera]} and {key}, which are both of a "
                    f"camera {camera!r} here; remove one (lerobot-edit-dataset), or rename it."
                )
            keys[camera] = key
    return keys


def _rgb(picture: Any) -> Rgb:
    """lerobot's C x H x W tensor as H x W x 3 bytes."""
    levels = picture.numpy()
    if levels.dtype != np.uint8:
        levels = np.clip(np.rint(levels * 255), 0, 255).astype(np.uint8)
    return np.ascontiguousarray(levels.transpose(1, 2, 0))


def _damaged(folder: Path, error: Exception) -> BadDataset:
    words = " ".join(str(error).split())[:200]
    return BadDataset(
        f"dataset: {folder} cannot be read ({type(error).__name__}: {words}); it has to be a whole "
        "LeRobotDataset of version 3.0."
    )


def _unwritable(out: Path, error: OSError) -> BadDataset:
    return BadDataset(
        f"dataset: {out} cannot be written ({error.strerror or error}); make room, or choose "
        "another folder."
    )
