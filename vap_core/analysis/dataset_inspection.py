"""What the method would show a policy over a dataset's recorded episodes, and where it fails there.

Every episode is grounded in its first frame and tracked through the others, as in the closed loop.
There is no ground truth: what can be told is whether views elect something and keep it.
"""

import hashlib
import json
from collections.abc import Iterable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict
from pathlib import Path
from typing import Any

from tqdm import tqdm

from vap_core import __version__
from vap_core.attend import Attender, AttendState
from vap_core.base.errors import BadDataset, BadOutput
from vap_core.base.files import Rows, align, parse_json, write_atomic, writing
from vap_core.base.types import Attended, PersonalObject, value
from vap_core.memory import load_bank
from vap_core.perception.stacks import checksums, load_own
from vap_core.policies.lerobot.datasets import Copy, Recorded, open_dataset

CALLER = "inspect-dataset"
TABLE = "views.csv"


@value
class ViewReport:
    """One camera of one episode.

    `grounded` says whether the first frame has the object here, `likeness` how like the references
    the best candidate is, `margin` the vote's. Of `frames` it is tracked in `tracked`; `losses` are
    the stretches without it after it was grounded, `longest` the frames of the longest.
    """

    episode: int
    camera: str
    frames: int
    grounded: bool
    likeness: float
    margin: float
    tracked: int
    losses: int
    longest: int


def inspect_dataset(
    path: Path,
    instruction: str,
    memory: Path,
    stack: str,
    out: Path,
    *,
    objects: Sequence[str] | None = None,
    speaker: str = "",
    episodes: int | None = None,
    copy: Path | None = None,
    masks: bool = False,
) -> list[ViewReport]:
    """Ground and track the first `episodes` episodes (None: all) of a dataset.

    Writes a recording of each into `out`, and the table; with `copy` the dataset with prompted
    pictures and rewritten tasks, and with `masks` the target's masks in it. Interrupted, the same
    call goes on with the episode that was not finished; a copy is written in one go.

    Raises: BadDataset, which a copy of several tasks is, too: one instruction is not theirs all;
        BadInstruction, UnknownName, BadOutput, BadMemory.
    """
    recorded = open_dataset(path)
    count = recorded.episodes if episodes is None else min(episodes, recorded.episodes)
    if copy is not None:
        _check_one_task(recorded, count)
    models = load_own(stack)
    bank = load_bank(memory, models.encoder.name)
    attender = Attender(models, bank, speaker=speaker)
    about = {
        "dataset": [str(path.resolve()), recorded.digest()],
        "instruction": instruction,
        "objects": None if objects is None else list(objects),
        "stack": [models.name, models.encoder.name],
        "thresholds": None if models.thresholds is None else asdict(models.thresholds),
        "memory": _memory_digest(bank),
        "version": __version__,
        **checksums(stack, kept=False),  # the thresholds themselves are above
    }
    if speaker:
        about["speaker"] = speaker
    _check_folder(out, about)
    reports: list[ViewReport] = []
    with ExitStack() as files:
        writer = None if copy is None else files.enter_context(Copy(recorded, copy, masks))
        for episode in tqdm(range(count), unit="episode"):
            done = out / f"episode_{episode:06d}.json"
            found = _read_reports(done)
            if found is None or writer is not None:
                found = _inspect_episode(
                    recorded, episode, attender, instruction, objects, out, writer
                )
                text = json.dumps([asdict(report) for report in found])
                with writing(out, CALLER):
                    write_atomic(done, text.encode())
            reports += found
    with writing(out, CALLER):
        write_atomic(out / TABLE, _csv(reports).encode())
    return reports


def _check_one_task(recorded: Recorded, episodes: int) -> None:
    """Raises: BadDataset: the episodes are of several tasks."""
    tasks = recorded.tasks(episodes)
    if len(tasks) > 1:
        named = ", ".join(map(repr, tasks[:4])) + (", ..." if len(tasks) > 4 else "")
        raise BadDataset(
            f"inspect-dataset: {recorded.folder} has {len(tasks)} tasks ({named}), and --copy "
            "writes one instruction over all; split it by task (lerobot-edit-dataset), copy each."
        )


def report_table(reports: Iterable[ViewReport]) -> str:
    """Every view that lost the object, or did not find it; and the totals."""
    rows: list[list[str]] = [_HEADER]
    seen = list(reports)
    for report in seen:
        if not report.grounded or report.losses:
            rows.append(_cells(report))
    lines = []
    if len(rows) > 1:
        lines.append(align(rows))
    grounded = [report for report in seen if report.grounded]
    frames = sum(report.frames for report in grounded)
    tracked = sum(report.tracked for report in grounded)
    lines.append(
        f"{len(grounded)} of {len(seen)} views find the object in their first frame; these track "
        f"it in {tracked} of {frames} frames, with {sum(r.losses for r in grounded)} losses"
    )
    return "\n".join(lines)


_HEADER = [
    "episode",
    "camera",
    "found",
    "likeness",
    "margin",
    "tracked",
    "losses",
    "longest",
]


def _cells(report: ViewReport) -> list[str]:
    return [
        str(report.episode),
        report.camera,
        "yes" if report.grounded else "no",
        f"{report.likeness:.2f}",
        f"{report.margin:.2f}",
        f"{report.tracked}/{report.frames}",
        str(report.losses),
        str(report.longest),
    ]


def _csv(reports: Sequence[ViewReport]) -> str:
    rows: Rows = [_HEADER, *map(_cells, reports)]
    return "".join(",".join(row) + "\n" for row in rows)


def _inspect_episode(
    recorded: Recorded,
    episode: int,
    attender: Attender,
    instruction: str,
    objects: Sequence[str] | None,
    out: Path,
    writer: Copy | None,
) -> list[ViewReport]:
    """Ground, track, record and perhaps copy one episode."""
    from vap_core.recording import DatasetRecorder

    _, (obj, *_) = attender.understand(instruction, objects)
    rrd = out / f"episode_{episode:06d}.rrd"
    rrd.unlink(missing_ok=True)  # of an inspection that was interrupted, or is copied anew
    state: AttendState | None = None
    first: Attended | None = None
    visible: dict[str, list[bool]] = {camera: [] for camera in recorded.keys}
    with DatasetRecorder(rrd, list(recorded.keys), obj.name, recorded.hz) as recorder:
        for frame in recorded.frames(episode):
            if state is None:
                state, attended = attender.start(frame.views, instruction, objects=objects)
                first = attended
                recorder.ground(frame.views, attended, obj, instruction)
            else:
                state, attended = attender.step(state, frame.views)
            recorder.add(frame.number, frame.at_s, frame.views, attended)
            for camera, seen in visible.items():
                seen.append(attended.tracks[camera][0].mask is not None)
            if writer is not None:
                tracked = {camera: attended.tracks[camera][0].mask for camera in visible}
                writer.add(frame, attended.images, attended.text, tracked)
    if first is None:
        raise BadDataset(f"dataset: episode {episode} of {recorded.folder} has no frame.")
    if writer is not None:
        writer.end_episode()
    reports = []
    for camera, seen in visible.items():
        reports.append(_report(episode, camera, first, seen))
    return reports


def _report(episode: int, camera: str, first: Attended, seen: Sequence[bool]) -> ViewReport:
    grounding = first.groundings[camera][0]
    chosen = grounding.chosen
    stretches = _stretches(seen) if grounding.winner is not None else []
    return ViewReport(
        episode=episode,
        camera=camera,
        frames=len(seen),
        grounded=grounding.winner is not None,
        likeness=0.0 if chosen is None else float(grounding.likeness[chosen]),
        margin=float(grounding.ballot.margin),
        tracked=sum(seen),
        losses=len(stretches),
        longest=max(stretches, default=0),
    )


def _stretches(seen: Sequence[bool]) -> list[int]:
    """The lengths of the stretches without the object."""
    lengths: list[int] = []
    before = True
    for here in seen:
        if not here:
            if before:
                lengths.append(0)
            lengths[-1] += 1
        before = here
    return lengths


def _memory_digest(bank: Mapping[str, PersonalObject]) -> str:
    """What is remembered, as one number."""
    digest = hashlib.sha256()
    for name, obj in sorted(bank.items()):
        about = [name, obj.category, obj.owner, obj.known_as, obj.embeddings.shape]
        digest.update(json.dumps(about).encode())
        digest.update(obj.embeddings.tobytes())
    return digest.hexdigest()[:16]


def _check_folder(out: Path, about: Mapping[str, Any]) -> None:
    """Begin in `out`, or go on there with the same question. Raises: BadOutput."""
    file = out / "inspection.json"
    try:
        out.mkdir(parents=True, exist_ok=True)
        if file.is_file():
            found = dict(parse_json(file.read_text()))
            keys = dict.fromkeys([*about, *found])
            differing = [key for key in keys if found.get(key) != about.get(key)]
            if differing:
                raise BadOutput(
                    f"inspect-dataset: {out} holds another inspection ({', '.join(differing)} "
                    "differ); choose another --out."
                )
            return
        write_atomic(file, json.dumps(about).encode())
    except (OSError, ValueError, TypeError) as error:
        raise BadOutput(
            f"inspect-dataset: {out} cannot be used ({error}); choose another --out."
        ) from error


def _read_reports(done: Path) -> list[ViewReport] | None:
    """The reports of an episode that was inspected; None where it was not."""
    if not done.is_file() or not done.with_suffix(".rrd").is_file():
        return None
    try:
        return [ViewReport(**fields) for fields in parse_json(done.read_text())]
    except (ValueError, TypeError):
        return None
