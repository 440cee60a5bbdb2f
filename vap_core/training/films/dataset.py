"""Demonstrations as a LeRobotDataset v3: any of lerobot's policies can be trained on them, and they come back bit for bit.

    python -m vap_core train demonstrations --suite simpler-bridge --stages 400 --out data/runs/demonstrations-simpler-bridge

A film is an episode. lerobot's policies see `observation.images.<camera>` (lossless video), `observation.state`, `action` and the task in generic
words. What our own training asks besides stands where no policy looks: `vap.ids.<camera>` (a grayscale PNG in base64: 0 the scene, i + 1 object i)
and `vap.places` (x, y, z of every object, world, metres, zeros behind the last) in every frame; what an episode is about, and the checksum of every
film, in meta/demonstrations.json. A suite whose films have fewer pictures than steps repeats each until the next.
"""

import base64
import hashlib
import io
import json
import os
import shutil
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from vap_core.base.errors import BadOutput
from vap_core.base.files import write_atomic
from vap_core.base.version import code_version
from vap_core.evaluation.processes import results
from vap_core.evaluation.store import locked, open_run
from vap_core.simulation import robots
from vap_core.simulation.suites import Suite, suite
from vap_core.simulation.types import EE_ACTION
from vap_core.training.films.demonstrations import PARTS, Film, cached, every

if TYPE_CHECKING:
    import pyarrow as pa

IMAGES, STATE, ACTION, IDS, PLACES = (
    "observation.images.",
    "observation.state",
    "action",
    "vap.ids.",
    "vap.places",
)
ABOUT, VERSION, LEROBOT = "meta/demonstrations.json", 1, "v3.0"
PART = 10
"""Stages that are written at a time: so much is written again after an interruption."""
MOST = 6
"""Objects of a film that have a place in `vap.places`."""
CODEC: dict[str, Any] = {
    "vcodec": "hevc",
    "pix_fmt": "gbrp",
    "g": 16,
    "crf": None,
    "preset": "medium",
    "extra_options": {
        "x265-params": "lossless=1:open-gop=0:bframes=0:pools=none:frame-threads=1:log-level=error"
    },
}
"""Lossless video with a key frame at least every 16, a third of the size of PNGs. x265's preset "slow" changes pixels of noise all the same, and
lerobot cannot join short clips with B-frames."""
AGAIN = (
    "write it again with: python -m vap_core train demonstrations --suite NAME --out OTHER_FOLDER"
)


def data_sha256(films: Iterable[Film]) -> str:
    """A checksum of what the films hold, in their order, whatever files they come from."""
    return _together(map(film_sha256, films))


def film_sha256(film: Film) -> str:
    """A checksum of every array's numbers, shape and type, and of every word."""
    digest = hashlib.sha256()
    for part in PARTS:
        held = getattr(film, part)
        if isinstance(held, np.ndarray):
            little = np.ascontiguousarray(held, held.dtype.newbyteorder("<"))
            digest.update(f"{part} {little.dtype.str} {little.shape} ".encode() + little.tobytes())
        else:
            digest.update(f"{part} {json.dumps(held)} ".encode())
    return digest.hexdigest()


def _together(hashes: Iterable[str]) -> str:
    return hashlib.sha256("".join(hashes).encode()).hexdigest()


def write(
    suite_name: str, stages: int, out: Path, *, cache: Path, seed: int = 0, jobs: int | None = None, part: int = PART
) -> dict[str, Any]:  # fmt: skip
    """Film the stages that `cache` lacks, write the dataset into `out`, or go on where an earlier call stopped; returns meta/demonstrations.json.

    `out` is a dataset once all of it is there; until then it holds `part` stages each in datasets of their own.
    Raises: BadOutput when `out` holds something else or cannot be written, or when no film succeeded.
    """
    from tqdm import tqdm

    known = suite(suite_name)
    open_run(out, {"demonstrations": suite_name, "stages": stages, "seed": seed})
    with locked(out):
        if not (out / ABOUT).exists():
            film(suite_name, stages, cache, seed=seed, jobs=jobs)
            folders = []
            for first in tqdm(range(0, stages, part), f"dataset of {suite_name}", mininterval=10):
                after = min(first + part, stages)
                folders.append(out / "parts" / f"{first:05d}-{after:05d}")
                _write_part(known, seed, range(first, after), cache, folders[-1])
            _join(known, {"suite": suite_name, "seed": seed, "stages": stages}, folders, out)
        shutil.rmtree(out / "parts", ignore_errors=True)
    return about(out)


def film(
    suite_name: str, stages: int, cache: Path, *, seed: int = 0, jobs: int | None = None
) -> None:
    """Shoot the stages that `cache` lacks, in processes."""
    from tqdm import tqdm

    missing = [
        n for n in range(stages) if not (cache / f"{suite_name}-{seed}-{n:05d}.npz").exists()
    ]
    if missing:
        work = results(
            partial(_shoot, cache, suite_name, seed), missing, jobs or os.cpu_count() or 1, "jobs"
        )
        for _ in tqdm(work, f"films of {suite_name}", len(missing), mininterval=10):
            pass


def _shoot(cache: Path, suite_name: str, seed: int, number: int) -> None:
    cached(cache, suite_name, seed, number)


def features(
    known: Suite, side: int, state_size: int, action_size: int
) -> dict[str, dict[str, Any]]:
    """What a frame holds, as lerobot wants it described."""
    joints = robots.get(known.robot).joints
    actions = EE_ACTION if known.control == "ee" else (*joints, "gripper")
    states = ("x", "y", "z", "rx", "ry", "rz", "gripper", *joints)
    places = [f"{axis}_{i}" for i in range(MOST) for axis in "xyz"]
    return {
        **{
            IMAGES + name: {
                "dtype": "video",
                "shape": (side, side, 3),
                "names": ["height", "width", "channels"],
            }
            for name in known.cameras
        },
        STATE: {"dtype": "float32", "shape": (state_size,), "names": list(states)},
        ACTION: {"dtype": "float32", "shape": (action_size,), "names": list(actions)},
        PLACES: {"dtype": "float32", "shape": (3 * MOST,), "names": places},
        **{IDS + name: {"dtype": "string", "shape": (1,), "names": None} for name in known.cameras},
    }


def said(known: Suite, task: str) -> str:
    """The task in generic words."""
    return known.task(task).instruction.replace("my ", "the ", 1)


def _write_part(known: Suite, seed: int, numbers: Sequence[int], cache: Path, folder: Path) -> None:
    """A dataset of some stages, read back and whole or not there; one without a film is a folder with its list of none."""
    from lerobot.configs import RGBEncoderConfig
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    if folder.exists():
        return
    scratch = folder.with_name(f".{folder.name}")
    shutil.rmtree(scratch, ignore_errors=True)
    scratch.parent.mkdir(parents=True, exist_ok=True)
    dataset, episodes = None, []
    try:
        with _quiet():
            for number in numbers:
                for film in cached(cache, known.name, seed, number):
                    if dataset is None:
                        dataset = LeRobotDataset.create(
                            f"vap/{known.name}", round(known.hz), features(known, film.images.shape[2], film.state.shape[1], film.action.shape[1]),
                            scratch, known.robot, video_backend="pyav", rgb_encoder=RGBEncoderConfig(**CODEC), encoder_threads=1,
                        )  # fmt: skip
                    for frame in _frames(known, film):
                        dataset.add_frame(frame)
                    dataset.save_episode(parallel_encoding=False)
                    episodes.append(
                        {
                            "stage": number,
                            "task": film.task,
                            "names": film.names,
                            "goal": film.goal,
                            "sha256": film_sha256(film),
                        }
                    )
            if dataset is not None:
                dataset.finalize()
                list(_films(known, scratch, episodes))
        (scratch / ABOUT).parent.mkdir(parents=True, exist_ok=True)
        (scratch / ABOUT).write_text(json.dumps(episodes))
        os.replace(scratch, folder)
    except OSError as error:
        raise BadOutput(
            f"demonstrations: {folder} cannot be written ({error}); make room and run the same command again."
        ) from error
    except ValueError as error:
        raise BadOutput(
            f"demonstrations: {folder} was not written as it was filmed ({_line(error)}); install PyAV's own build of FFmpeg."
        ) from error


def _frames(known: Suite, film: Film) -> Iterator[dict[str, Any]]:
    places = np.zeros((len(film.action), MOST, 3), np.float32)
    places[:, : len(film.names)] = film.places
    for t in range(len(film.action)):
        shown = t // every(known.name)
        seen = {IMAGES + name: film.images[shown, c] for c, name in enumerate(known.cameras)}
        ids = {IDS + name: _png(film.ids[shown, c]) for c, name in enumerate(known.cameras)}
        yield {
            **seen,
            **ids,
            STATE: film.state[t],
            ACTION: film.action[t],
            PLACES: places[t].reshape(-1),
            "task": said(known, film.task),
        }


def _png(ids: UInt8[np.ndarray, "s s"]) -> str:
    sink = io.BytesIO()
    Image.fromarray(ids).save(sink, "png")
    return base64.b64encode(sink.getvalue()).decode()


def _join(known: Suite, recipe: dict[str, Any], folders: Sequence[Path], out: Path) -> None:
    """One dataset of all parts; meta/ comes last, so that whatever was cut short is joined anew."""
    from lerobot.datasets.aggregate import aggregate_datasets

    lists = [json.loads((folder / ABOUT).read_text()) for folder in folders]
    full = [folder for folder, episodes in zip(folders, lists, strict=True) if episodes]
    episodes = [episode for part in lists for episode in part]
    if not full:
        raise BadOutput(
            f"demonstrations: no film of {recipe} succeeded; ask for more stages, with another --out."
        )
    for name in ("data", "videos", ".whole"):
        shutil.rmtree(out / name, ignore_errors=True)
    try:
        with _quiet():
            aggregate_datasets(
                [f"vap/{known.name}"] * len(full), f"vap/{known.name}", full, out / ".whole"
            )
        card = {
            "version": VERSION,
            **recipe,
            "written_by": code_version(),
            "data_sha256": _together(one["sha256"] for one in episodes),
        }
        write_atomic(
            out / ".whole" / ABOUT,
            (json.dumps({**card, "episodes": episodes}, indent=1) + "\n").encode(),
        )
        for name in ("data", "videos", "meta"):
            os.replace(out / ".whole" / name, out / name)
        shutil.rmtree(out / ".whole")
    except OSError as error:
        raise BadOutput(
            f"demonstrations: {out} cannot be written ({error}); make room and run the same command again."
        ) from error


@contextmanager
def _quiet() -> Iterator[None]:
    """Without the bars of Hugging Face's datasets and the remarks of libav, of which every episode has some."""
    import av
    import datasets

    shown = datasets.are_progress_bars_disabled()
    datasets.disable_progress_bars()
    av.logging.set_libav_level(av.logging.ERROR)
    try:
        yield
    finally:
        av.logging.set_libav_level(av.logging.INFO)
        if not shown:
            datasets.enable_progress_bars()


def about(folder: Path) -> dict[str, Any]:
    """meta/demonstrations.json: where the films come from, what each is about, and their checksum. Raises: BadOutput."""
    if not (folder / ABOUT).exists():
        half = (folder / "parts").exists()
        mend = (
            "run the command that began it again"
            if half
            else "make them with: python -m vap_core train demonstrations --suite NAME --out FOLDER"
        )
        raise BadOutput(
            f"read: {folder} holds {'half-written' if half else 'no'} demonstrations; {mend}."
        )
    try:
        held = json.loads((folder / ABOUT).read_bytes())
        lerobot = json.loads((folder / "meta" / "info.json").read_bytes())["codebase_version"]
        version = held["version"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise BadOutput(
            f"read: meta/ of {folder} is absent or damaged ({_line(error)}); {AGAIN}."
        ) from error
    if (version, lerobot) != (VERSION, LEROBOT):
        raise BadOutput(
            f"read: {folder} has version {version} of a LeRobotDataset {lerobot}, not {VERSION} of {LEROBOT}; {AGAIN}."
        )
    return dict(held)


def read(folder: Path, keep: Callable[[int], bool] = lambda stage: True) -> list[Film]:
    """The films of the stages that `keep` wants, in their order, exactly as they were shot; each is held against its checksum.

    Raises: BadOutput for a folder that is absent, half-written, damaged or of another version.
    """
    held = about(folder)
    try:
        return list(_films(suite(held["suite"]), folder, held["episodes"], keep))
    except (
        OSError,
        ValueError,
        LookupError,
        TypeError,
        RuntimeError,
    ) as error:  # ArrowException and FFmpegError are among them
        raise BadOutput(f"read: {folder} is damaged ({_line(error)}); {AGAIN}.") from error


def _films(
    known: Suite,
    folder: Path,
    told: Sequence[dict[str, Any]],
    keep: Callable[[int], bool] = lambda stage: True,
) -> Iterator[Film]:
    """The films that `told` lists. Raises: ValueError for one that is not what its checksum says, and whatever damaged files raise."""
    frames = _table(folder, "data")
    rows = _table(folder, "meta/episodes").sort_by("episode_index").to_pylist()
    for row, one in zip(rows, told, strict=True):
        if keep(one["stage"]):
            film = _film(known, folder, row, one, frames)
            if film_sha256(film) != one["sha256"]:
                raise ValueError(f"episode {row['episode_index']} is not what its checksum says")
            yield film


def _line(error: Exception) -> str:
    return f"{type(error).__name__}: {error}".strip().splitlines()[0]


def _table(folder: Path, kind: str) -> "pa.Table":
    """The rows of all files of a kind, in the order of their numbers."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    return pa.concat_tables(
        [pq.read_table(path) for path in sorted((folder / kind).glob("*/*.parquet"))]
    )


def _film(
    known: Suite, folder: Path, row: dict[str, Any], told: dict[str, Any], frames: "pa.Table"
) -> Film:
    from lerobot.datasets.video_utils import decode_video_frames

    begin, steps, names = row["dataset_from_index"], row["length"], tuple(told["names"])
    mine = frames.slice(begin, steps)
    if len(mine) != steps or set(mine["episode_index"].to_pylist()) != {row["episode_index"]}:
        raise ValueError(f"frames of episode {row['episode_index']} are missing")
    images, ids = [], []
    for camera in known.cameras:
        video = f"videos/{IMAGES}{camera}"
        path = (
            folder
            / video
            / f"chunk-{row[f'{video}/chunk_index']:03d}"
            / f"file-{row[f'{video}/file_index']:03d}.mp4"
        )
        times = [
            row[f"{video}/from_timestamp"] + t / round(known.hz)
            for t in range(0, steps, every(known.name))
        ]
        images.append(
            decode_video_frames(path, times, 0.1 / known.hz, "pyav", return_uint8=True)
            .permute(0, 2, 3, 1)
            .numpy()
        )
        ids.append(
            np.stack(
                [
                    np.asarray(Image.open(io.BytesIO(base64.b64decode(png))))
                    for png in mine[IDS + camera].to_pylist()[:: every(known.name)]
                ]
            )
        )
    state, action, places = (
        np.stack(mine[name].to_numpy()).astype(np.float32) for name in (STATE, ACTION, PLACES)
    )
    where = np.ascontiguousarray(places.reshape(steps, MOST, 3)[:, : len(names)])
    return Film(
        np.stack(images, 1),
        np.stack(ids, 1),
        state,
        action,
        where,
        names,
        told["task"],
        told["goal"],
    )
