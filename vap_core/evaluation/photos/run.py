"""Measures a photo set scene by scene; what an interrupted run had finished is kept."""

from pathlib import Path
from typing import TYPE_CHECKING

from vap_core import __version__
from vap_core.attend import Attender
from vap_core.base.files import write_atomic
from vap_core.evaluation import store
from vap_core.evaluation.measurements import read_json_part, write_json_part, write_table
from vap_core.evaluation.photos.clips import follow_scene
from vap_core.evaluation.photos.folder import PhotoSet, read_photo_set
from vap_core.evaluation.photos.measure import Row, measure_scene
from vap_core.evaluation.photos.register import remember_subjects
from vap_core.evaluation.photos.report import clip_report, text_report
from vap_core.evaluation.photos.sheet import write_sheets
from vap_core.perception.embedded.weights import weights_sha256
from vap_core.perception.stacks import load_stack

if TYPE_CHECKING:
    import pandas as pd

TABLE, CLIPS = "questions", "clips"


def measure_photos(
    folder: Path, out: Path, stack_name: str, *, clips: bool = False, progress: bool = True
) -> str:
    """Do what `out` lacks of the measurement, write tables and sheets, and return the report.

    With `clips` objects are followed through clips made of the scenes, too (clips.py).

    Raises: BadPhotoSet, BadPhoto; BadOutput when `out` holds another run.
    """
    photo_set = read_photo_set(folder)
    store.open_run(out, _configuration(photo_set, stack_name))
    with store.locked(out):
        table = _measure(photo_set, out, stack_name, progress)
        written = write_table(table, out, TABLE)
        sheets = write_sheets(photo_set, table, out)
        report = text_report(table)
        if clips:
            followed = _follow(photo_set, out, stack_name, progress)
            written += write_table(followed, out, CLIPS)
            report += f"\n\n{clip_report(followed)}"
        write_atomic(out / "report.txt", f"{report}\n".encode())
    names = ", ".join(str(path) for path in [*written, *sheets])
    return f"{report}\n\nwrote {names}"


def _configuration(photo_set: PhotoSet, stack_name: str) -> dict[str, object]:
    """What the results depend on."""
    return {
        "measurement": "photos",
        "photos": photo_set.sha256,
        "stack": stack_name,
        "version": __version__,
        "weights": weights_sha256(),
    }


def _measure(photo_set: PhotoSet, out: Path, stack_name: str, progress: bool) -> "pd.DataFrame":
    """One row per scene and object."""
    import pandas as pd
    from tqdm import tqdm

    stack = load_stack(stack_name)
    memory = remember_subjects(photo_set.subjects, stack, out / "memory")
    attender = Attender(stack, memory)
    rows: list[Row] = []
    for scene in tqdm(photo_set.scenes, unit="scene", desc="photos", disable=not progress):
        path = out / "parts" / f"{scene.name}.json"
        if not path.exists():
            measured = measure_scene(scene, photo_set, memory, attender)
            write_json_part(path, measured, caller="eval-photos")
        rows.extend(read_json_part(path, caller="eval-photos"))
    return pd.DataFrame(rows)


def _follow(photo_set: PhotoSet, out: Path, stack_name: str, progress: bool) -> "pd.DataFrame":
    """One row per object and scene that shows it."""
    import pandas as pd
    from tqdm import tqdm

    stack = load_stack(stack_name)
    rows: list[Row] = []
    for scene in tqdm(photo_set.scenes, unit="scene", desc="clips", disable=not progress):
        path = out / "parts" / f"{scene.name}.clips.json"
        if not path.exists():
            measured = follow_scene(scene, photo_set, stack)
            write_json_part(path, measured, caller="eval-photos")
        rows.extend(read_json_part(path, caller="eval-photos"))
    return pd.DataFrame(rows)
