"""Demonstrations as a LeRobotDataset v3, on which any of lerobot's policies can be trained.

    ./vap train demonstrations --suite simpler-bridge --stages 400 --out FOLDER

A film is an episode, and it comes back bit for bit. lerobot's policies see
`observation.images.<camera>` (lossless video), `observation.state`, `action` and the task in
generic words. What our own training needs besides has names that no policy reads:
`vap.ids.<camera>` (a grayscale PNG in base64: 0 the scene, i + 1 object i) and `vap.places`
(x, y, z of every object, world, metres, zeros behind the last) in every frame; what an episode is
about, and the checksum of every film, in meta/demonstrations.json. A suite whose films have fewer
pictures than steps repeats each until the next.
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
from jaxtyping import Float32, UInt8
from PIL import Image

from vap_core.base.errors import BadOutput, BadPhoto
from vap_core.base.files import code_version, parse_json, read_file, write_atomic, writing
from vap_core.simulation import robots
from vap_core.simulation.suites import Suite, suite
from vap_core.simulation.types import EE_ACTION
from vap_core.study.store import locked, open_run
from vap_core.study.workers import results
from vap_make.films.demonstrations import MOST, PARTS, Film, cached, stage_file
from vap_make.recipe import every, filmed_task

if TYPE_CHECKING:
    import pyarrow as pa
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

IMAGES = "observation.images."
STATE = "observation.state"
ACTION = "action"
IDS = "vap.ids."
PLACES = "vap.places"
ABOUT = "meta/demonstrations.json"
VERSION = 1
"""Of meta/demonstrations.json."""
CARD = {"suite": str, "seed": int, "stages": int, "episodes": list}
"""What meta/demonstrations.json holds beside its version, and of which type."""
LEROBOT = "v3.0"
"""The version of the LeRobotDataset format."""
PART = 10
"""Stages that are written at a time: so much is written again after an interruption."""
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
"""Lossless video with a key frame at least every 16, a third of the size of PNGs.

x265's preset "slow" changes pixels of noise all the same, and lerobot cannot join short clips with
B-frames.
"""
AGAIN = "write it again with: ./vap train demonstrations --suite NAME --out OTHER_FOLDER"


def data_sha256(films: Iterable[Film]) -> str:
    """A checksum of what the films hold, in their order, whatever files they come from."""
    return _hash_all(map(film_sha256, films))


def film_sha256(film: Film) -> str:
    """A checksum of every array's numbers, shape and type, and of every word."""
    digest = hashlib.sha256()
    for part in PARTS:
        content = getattr(film, part)
        if isinstance(content, np.ndarray):
            little = np.ascontiguousarray(content, content.dtype.newbyteorder("<"))
            header = f"{part} {little.dtype.str} {little.shape} "
            digest.update(header.encode() + little.tobytes())
        else:
            digest.update(f"{part} {json.dumps(content)} ".encode())
    return digest.hexdigest()


def write(
    suite_name: str,
    stages: int,
    out: Path,
    *,
    cache: Path,
    seed: int = 0,
    jobs: int | None = None,
    part: int = PART,
) -> dict[str, Any]:
    """Film the stages that `cache` lacks, and write the dataset into `out`.

    An earlier call that was stopped goes on. Returns meta/demonstrations.json. `out` is a dataset
    once all of it is there; until then it holds `part` stages each in datasets of their own.

    Raises: BadOutput when `out` holds something else or cannot be written, or when no film
        succeeded.
    """
    from tqdm import tqdm

    known = suite(suite_name)
    open_run(out, {"demonstrations": suite_name, "stages": stages, "seed": seed})
    with locked(out):
        if not (out / ABOUT).exists():
            shoot_stages(suite_name, stages, cache, seed=seed, jobs=jobs)
            folders = []
            for first in tqdm(range(0, stages, part), f"dataset of {suite_name}", mininterval=10):
                after = min(first + part, stages)
                folder = out / "parts" / f"{first:05d}-{after:05d}"
                _write_part(
                    known=known,
                    seed=seed,
                    numbers=range(first, after),
                    cache=cache,
                    folder=folder,
                )
                folders.append(folder)
            recipe = {"suite": suite_name, "seed": seed, "stages": stages}
            _join(known, recipe, folders, out)
        shutil.rmtree(out / "parts", ignore_errors=True)
    return about(out)


def shoot_stages(
    suite_name: str, stages: int, cache: Path, *, seed: int = 0, jobs: int | None = None
) -> None:
    """Shoot the stages that `cache` lacks, in processes. Raises: WorkerDied, as `results`."""
    from tqdm import tqdm

    missing = []
    for number in range(stages):
        if not stage_file(cache, suite_name, seed, number).exists():
            missing.append(number)
    if missing:
        work = results(
            work=partial(_shoot, cache, suite_name, seed),
            jobs=missing,
            workers=jobs or os.cpu_count() or 1,
            remedy="jobs",
        )
        for _ in tqdm(work, desc=f"films of {suite_name}", total=len(missing), mininterval=10):
            pass


def features(
    known: Suite, side: int, state_size: int, action_size: int
) -> dict[str, dict[str, Any]]:
    """What a frame holds, as lerobot wants it described."""
    joints = robots.get(known.robot).joints
    actions = EE_ACTION if known.control == "ee" else (*joints, "gripper")
    states = ("x", "y", "z", "rx", "ry", "rz", "gripper", *joints)
    places = []
    for i in range(MOST):
        places += [f"x_{i}", f"y_{i}", f"z_{i}"]
    described: dict[str, dict[str, Any]] = {}
    for camera in known.cameras:
        described[IMAGES + camera] = {
            "dtype": "video",
            "shape": (side, side, 3),
            "names": ["height", "width", "channels"],
        }
    described[STATE] = {"dtype": "float32", "shape": (state_size,), "names": list(states)}
    described[ACTION] = {"dtype": "float32", "shape": (action_size,), "names": list(actions)}
    described[PLACES] = {"dtype": "float32", "shape": (3 * MOST,), "names": places}
    for camera in known.cameras:
        described[IDS + camera] = {"dtype": "string", "shape": (1,), "names": None}
    return described


def generic_instruction(known: Suite, task: str) -> str:
    """The task in generic words.

    Raises: UnknownName for a task that the suite's films do not show.
    """
    return filmed_task(known.name, task).instruction.replace("my ", "the ", 1)


def about(folder: Path) -> dict[str, Any]:
    """meta/demonstrations.json: the films' origin, what each is about, and their checksum.

    Raises: BadOutput.
    """
    if not (folder / ABOUT).exists():
        if (folder / "parts").exists():
            raise BadOutput(
                f"read: {folder} holds half-written demonstrations; "
                "run the command that began it again."
            )
        raise BadOutput(
            f"read: {folder} holds no demonstrations; make them with: "
            "./vap train demonstrations --suite NAME --out FOLDER."
        )
    try:
        card = parse_json(read_file(folder / ABOUT))
        info = parse_json(read_file(folder / "meta" / "info.json"))
        lerobot = info["codebase_version"]
        version = card["version"]
        for name, kind in CARD.items():
            if not isinstance(card[name], kind):
                raise TypeError(f"{name} of {ABOUT} is no {kind.__name__}")
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise BadOutput(
            f"read: meta/ of {folder} is absent or damaged ({_line(error)}); {AGAIN}."
        ) from error
    if (version, lerobot) != (VERSION, LEROBOT):
        raise BadOutput(
            f"read: {folder} has version {version} of a LeRobotDataset {lerobot}, "
            f"not {VERSION} of {LEROBOT}; {AGAIN}."
        )
    return dict(card)


def read(folder: Path, keep: Callable[[int], bool] = lambda stage: True) -> list[Film]:
    """The films of the stages that `keep` wants, in their order, exactly as they were shot.

    Each is compared with its checksum.

    Raises: BadOutput for a folder that is absent, half-written, damaged or of another version.
    """
    card = about(folder)
    try:
        known = suite(card["suite"])
        return list(_films(known, folder, card["episodes"], keep))
    except (BadPhoto, OSError, ValueError, LookupError, TypeError, RuntimeError) as error:
        # ArrowException and FFmpegError are among them.
        raise BadOutput(f"read: {folder} is damaged ({_line(error)}); {AGAIN}.") from error


def _hash_all(hashes: Iterable[str]) -> str:
    return hashlib.sha256("".join(hashes).encode()).hexdigest()


def _shoot(cache: Path, suite_name: str, seed: int, number: int) -> None:
    cached(cache, suite_name, seed, number)


def _write_part(known: Suite, seed: int, numbers: Sequence[int], cache: Path, folder: Path) -> None:
    """Write a dataset of some stages, read back and whole or not there.

    One without a film is a folder with its list of none.
    """
    if folder.exists():
        return
    scratch = folder.with_name(f".{folder.name}")
    shutil.rmtree(scratch, ignore_errors=True)
    try:
        with writing(folder, "demonstrations"):
            scratch.parent.mkdir(parents=True, exist_ok=True)
            with _quiet():
                episodes = _write_stages(
                    known=known, seed=seed, numbers=numbers, cache=cache, folder=scratch
                )
                if episodes:
                    for _ in _films(known, scratch, episodes):
                        pass
            (scratch / ABOUT).parent.mkdir(parents=True, exist_ok=True)
            (scratch / ABOUT).write_text(json.dumps(episodes))
            os.replace(scratch, folder)
    except ValueError as error:
        raise BadOutput(
            f"demonstrations: {folder} was not written as it was filmed ({_line(error)}); "
            "install PyAV's own build of FFmpeg."
        ) from error


def _write_stages(
    known: Suite, seed: int, numbers: Sequence[int], cache: Path, folder: Path
) -> list[dict[str, Any]]:
    """Write a dataset of the stages' films into `folder`; returns what each film is about."""
    dataset = None
    episodes = []
    for number in numbers:
        for shot in cached(cache, known.name, seed, number):
            if dataset is None:
                dataset = _create_dataset(known, shot, folder)
            for frame in _frames(known, shot):
                dataset.add_frame(frame)
            dataset.save_episode(parallel_encoding=False)
            episodes.append(
                {
                    "stage": number,
                    "task": shot.task,
                    "names": shot.names,
                    "goal": shot.goal,
                    "sha256": film_sha256(shot),
                }
            )
    if dataset is not None:
        dataset.finalize()
    return episodes


def _create_dataset(known: Suite, shot: Film, folder: Path) -> "LeRobotDataset":
    """An empty dataset for films with the sizes of `shot`."""
    from lerobot.configs import RGBEncoderConfig
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    described = features(
        known=known,
        side=shot.images.shape[2],
        state_size=shot.state.shape[1],
        action_size=shot.action.shape[1],
    )
    return LeRobotDataset.create(
        repo_id=f"vap/{known.name}",
        fps=round(known.hz),
        features=described,
        root=folder,
        robot_type=known.robot,
        video_backend="pyav",
        rgb_encoder=RGBEncoderConfig(**CODEC),
        encoder_threads=1,
    )


def _frames(known: Suite, shot: Film) -> Iterator[dict[str, Any]]:
    """The frames of a film, as lerobot takes them."""
    places = np.zeros((len(shot.action), MOST, 3), np.float32)
    places[:, : len(shot.names)] = shot.places
    for t in range(len(shot.action)):
        picture = t // every(known.name)
        frame: dict[str, Any] = {}
        for i, camera in enumerate(known.cameras):
            frame[IMAGES + camera] = shot.images[picture, i]
        for i, camera in enumerate(known.cameras):
            frame[IDS + camera] = _encode_png(shot.ids[picture, i])
        frame[STATE] = shot.state[t]
        frame[ACTION] = shot.action[t]
        frame[PLACES] = places[t].reshape(-1)
        frame["task"] = generic_instruction(known, shot.task)
        yield frame


def _encode_png(ids: UInt8[np.ndarray, "s s"]) -> str:
    sink = io.BytesIO()
    Image.fromarray(ids).save(sink, "png")
    return base64.b64encode(sink.getvalue()).decode()


def _decode_png(text: str) -> UInt8[np.ndarray, "s s"]:
    source = io.BytesIO(base64.b64decode(text))
    return np.asarray(Image.open(source, formats=["PNG"]))


def _join(known: Suite, recipe: dict[str, Any], folders: Sequence[Path], out: Path) -> None:
    """Write one dataset of all parts.

    meta/ comes last, so that whatever was cut short is joined anew.
    """
    from lerobot.datasets.aggregate import aggregate_datasets

    full = []
    episodes: list[dict[str, Any]] = []
    for folder in folders:
        part = json.loads((folder / ABOUT).read_text())
        if part:
            full.append(folder)
            episodes += part
    if not full:
        raise BadOutput(
            f"demonstrations: no film of {recipe} succeeded; "
            "ask for more stages, with another --out."
        )
    for name in ("data", "videos", ".whole"):
        shutil.rmtree(out / name, ignore_errors=True)
    whole = out / ".whole"
    with writing(out, "demonstrations"):
        with _quiet():
            aggregate_datasets(
                repo_ids=[f"vap/{known.name}"] * len(full),
                aggr_repo_id=f"vap/{known.name}",
                roots=full,
                aggr_root=whole,
            )
        _write_card(recipe, episodes, whole / ABOUT)
        for name in ("data", "videos", "meta"):
            os.replace(whole / name, out / name)
        shutil.rmtree(whole)


def _write_card(recipe: dict[str, Any], episodes: Sequence[dict[str, Any]], path: Path) -> None:
    """Write meta/demonstrations.json."""
    card = {
        "version": VERSION,
        **recipe,
        "written_by": code_version(),
        "data_sha256": _hash_all(episode["sha256"] for episode in episodes),
        "episodes": episodes,
    }
    text = json.dumps(card, indent=1) + "\n"
    write_atomic(path, text.encode())


@contextmanager
def _quiet() -> Iterator[None]:
    """Without the bars of Hugging Face's datasets and the notes of libav on every episode."""
    import av
    import datasets

    disabled = datasets.are_progress_bars_disabled()
    datasets.disable_progress_bars()
    av.logging.set_libav_level(av.logging.ERROR)
    try:
        yield
    finally:
        av.logging.set_libav_level(av.logging.INFO)
        if not disabled:
            datasets.enable_progress_bars()


def _films(
    known: Suite,
    folder: Path,
    episodes: Sequence[dict[str, Any]],
    keep: Callable[[int], bool] = lambda stage: True,
) -> Iterator[Film]:
    """The films that `episodes` lists.

    Raises: ValueError for one that is not what its checksum says, and whatever damaged files raise.
    """
    frames = _table(folder, "data")
    rows = _table(folder, "meta/episodes").sort_by("episode_index").to_pylist()
    for row, episode in zip(rows, episodes, strict=True):
        if keep(episode["stage"]):
            shot = _film(known=known, folder=folder, row=row, episode=episode, frames=frames)
            if film_sha256(shot) != episode["sha256"]:
                raise ValueError(f"episode {row['episode_index']} is not what its checksum says")
            yield shot


def _line(error: Exception) -> str:
    return f"{type(error).__name__}: {error}".strip().splitlines()[0]


def _table(folder: Path, kind: str) -> "pa.Table":
    """The rows of all files of a kind, in the order of their numbers."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    paths = sorted((folder / kind).glob("*/*.parquet"))
    return pa.concat_tables([pq.read_table(path) for path in paths])


def _film(
    known: Suite,
    folder: Path,
    row: dict[str, Any],
    episode: dict[str, Any],
    frames: "pa.Table",
) -> Film:
    """The film of one episode: its row in meta/episodes, and what it is about."""
    steps = row["length"]
    names = tuple(episode["names"])
    table = frames.slice(row["dataset_from_index"], steps)
    if len(table) != steps or set(table["episode_index"].to_pylist()) != {row["episode_index"]}:
        raise ValueError(f"frames of episode {row['episode_index']} are missing")
    interval = every(known.name)
    images = []
    ids = []
    for camera in known.cameras:
        images.append(_read_video(known, folder, row, camera))
        pngs = table[IDS + camera].to_pylist()
        ids.append(np.stack([_decode_png(png) for png in pngs[::interval]]))
    places = _read_numbers(table, PLACES).reshape(steps, MOST, 3)
    return Film(
        images=np.stack(images, 1),
        ids=np.stack(ids, 1),
        state=_read_numbers(table, STATE),
        action=_read_numbers(table, ACTION),
        places=np.ascontiguousarray(places[:, : len(names)]),
        names=names,
        task=episode["task"],
        goal=episode["goal"],
    )


def _read_video(
    known: Suite, folder: Path, row: dict[str, Any], camera: str
) -> UInt8[np.ndarray, "f s s 3"]:
    """The pictures of one camera in an episode."""
    from lerobot.datasets.video_utils import decode_video_frames

    from vap_core.policies.lerobot.datasets import bounded

    video = f"videos/{IMAGES}{camera}"
    chunk = f"chunk-{row[f'{video}/chunk_index']:03d}"
    file = f"file-{row[f'{video}/file_index']:03d}.mp4"
    times = []
    for t in range(0, row["length"], every(known.name)):
        times.append(row[f"{video}/from_timestamp"] + t / round(known.hz))
    with bounded(folder):
        frames = decode_video_frames(
            video_path=folder / video / chunk / file,
            timestamps=times,
            tolerance_s=0.1 / known.hz,
            backend="pyav",
            return_uint8=True,
        )
    return frames.permute(0, 2, 3, 1).numpy()


def _read_numbers(table: "pa.Table", name: str) -> Float32[np.ndarray, "t n"]:
    """A column of vectors, one row per step."""
    return np.stack(table[name].to_numpy()).astype(np.float32)
