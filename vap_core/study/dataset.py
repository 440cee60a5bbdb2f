"""What the method would show a policy over a dataset's recorded episodes, and where it fails there.

Every episode is grounded in its first frame and tracked through the others, as in the closed loop.
There is no ground truth: what can be told is whether views elect something and keep it.
"""

import hashlib
import json
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

from tqdm import tqdm

from vap_core import __version__
from vap_core.attend import Attender, AttendState
from vap_core.base.errors import BadDataset
from vap_core.base.files import write_atomic, writing
from vap_core.base.types import Attended, PersonalObject
from vap_core.memory import load_bank
from vap_core.perception.stacks import checksums, load_own
from vap_core.policies.lerobot.datasets import Copy, Recorded, open_dataset
from vap_core.study import store
from vap_core.study.cases import true_runs
from vap_core.study.measurement import Row
from vap_core.study.table import printed

if TYPE_CHECKING:
    import pandas as pd

CALLER = "inspect-dataset"
TABLE = "views.csv"


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
) -> list[Row]:
    """Ground and track the first `episodes` episodes (None: all) of a dataset.

    A row is one camera of one episode: `grounded` says whether the first frame has the object here,
    `likeness` how like the references the best candidate is, `margin` the vote's. Of `frames` it is
    tracked in `tracked`; `losses` are the stretches without it after it was grounded, `longest` the
    frames of the longest.

    Writes a recording of each into `out`, and the table; with `copy` the dataset with prompted
    pictures and rewritten tasks, and with `masks` the target's masks in it. Interrupted, the same
    call goes on with the episode that was not finished; a copy is written in one go.

    Raises: BadDataset, which a copy of several tasks is, too: one instruction is not theirs all;
        BadInstruction, UnknownName, BadOutput, BadMemory.
    """
    recorded = open_dataset(path)
    count = recorded.episodes if episodes is None else min(episodes, recorded.episodes)
    tasks = () if copy is None else recorded.tasks(count)
    if len(tasks) > 1:
        named = ", ".join(map(repr, tasks[:4])) + (", ..." if len(tasks) > 4 else "")
        raise BadDataset(
            f"inspect-dataset: {recorded.folder} has {len(tasks)} tasks ({named}), and --copy "
            "writes one instruction over all; split it by task (lerobot-edit-dataset), copy each."
        )
    models = load_own(stack)
    bank = load_bank(memory, models.encoder.name, "inspect-dataset")
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
    store.open_run(out, about)
    reports: list[Row] = []
    with ExitStack() as files:
        files.enter_context(store.locked(out))
        writer = None if copy is None else files.enter_context(Copy(recorded, copy, masks))
        for episode in tqdm(range(count), "inspect-dataset", unit="episode"):
            done = out / f"episode_{episode:06d}.json"
            if writer is not None or not (done.is_file() and done.with_suffix(".rrd").is_file()):
                found = _inspect_episode(
                    recorded, episode, attender, instruction, objects, out, writer
                )
                store.write_json_part(done, found, CALLER)
            reports += store.read_json_part(done, CALLER)
    with writing(out, CALLER):
        write_atomic(out / TABLE, printed(_shown(reports), "csv").encode())
    return reports


def report_table(reports: Sequence[Row]) -> str:
    """Every view that lost the object, or did not find it; and the totals."""
    shown = [row for row in reports if not row["grounded"] or row["losses"]]
    grounded = [row for row in reports if row["grounded"]]
    frames, tracked, losses = (
        sum(row[name] for row in grounded) for name in ("frames", "tracked", "losses")
    )
    totals = (
        f"{len(grounded)} of {len(reports)} views find the object in their first frame; these "
        f"track it in {tracked} of {frames} frames, with {losses} losses"
    )
    return "\n".join([*([printed(_shown(shown))] if shown else []), totals])


def _shown(rows: Sequence[Row]) -> "pd.DataFrame":
    import pandas as pd

    return pd.DataFrame(
        {
            "episode": row["episode"],
            "camera": row["camera"],
            "found": "yes" if row["grounded"] else "no",
            "likeness": f"{row['likeness']:.2f}",
            "margin": f"{row['margin']:.2f}",
            "tracked": f"{row['tracked']}/{row['frames']}",
            "losses": row["losses"],
            "longest": row["longest"],
        }
        for row in rows
    )


def _inspect_episode(
    recorded: Recorded,
    episode: int,
    attender: Attender,
    instruction: str,
    objects: Sequence[str] | None,
    out: Path,
    writer: Copy | None,
) -> list[Row]:
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
        grounding = first.groundings[camera][0]
        chosen = grounding.chosen
        absent = [not here for here in seen] if grounding.winner is not None else []
        stretches = [stop - start for start, stop in true_runs(absent)]
        row: Row = {"episode": episode, "camera": camera, "frames": len(seen)}
        row |= {"grounded": grounding.winner is not None, "margin": float(grounding.ballot.margin)}
        row["likeness"] = 0.0 if chosen is None else float(grounding.likeness[chosen])
        row |= {"tracked": sum(seen), "losses": len(stretches)}
        reports.append({**row, "longest": max(stretches, default=0)})
    return reports


def _memory_digest(bank: Mapping[str, PersonalObject]) -> str:
    """What is remembered, as one number."""
    digest = hashlib.sha256()
    for name, obj in sorted(bank.items()):
        about = [name, obj.category, obj.owner, obj.known_as, obj.embeddings.shape]
        digest.update(json.dumps(about).encode())
        digest.update(obj.embeddings.tobytes())
    return digest.hexdigest()[:16]
