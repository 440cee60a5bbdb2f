"""Measures a photo set scene by scene; what an interrupted run had finished is kept."""

import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from vap_core import __version__
from vap_core.attend import Attender
from vap_core.base.files import write_atomic, writing
from vap_core.evaluation import store
from vap_core.evaluation.measurements import read_json_part, write_json_part, write_table
from vap_core.evaluation.photos.apart import mask_rows, single_rows
from vap_core.evaluation.photos.clips import follow_scene
from vap_core.evaluation.photos.folder import SCENES_CSV, PhotoSet, Scene, read_photo_set
from vap_core.evaluation.photos.measure import Row, measure_scene
from vap_core.evaluation.photos.register import remember_subjects
from vap_core.evaluation.photos.report import (
    clip_report,
    mask_report,
    single_report,
    text_report,
)
from vap_core.evaluation.photos.sheet import write_sheets
from vap_core.perception.stacks import checksums, load_stack, ships_thresholds

if TYPE_CHECKING:
    import pandas as pd

TABLE, CLIPS, MASKS, SINGLE = "questions", "clips", "masks", "single"


def measure_photos(
    folder: Path,
    out: Path,
    stack_name: str,
    *,
    clips: bool = False,
    kept: bool = True,
    progress: bool = True,
) -> str:
    """Do what `out` lacks of the measurement, write tables and sheets, and return the report.

    With `clips` objects are followed through clips made of the scenes, too (clips.py). Where not
    `kept`, thresholds that were kept on this machine do not count: the best candidate wins. With
    `progress` stderr has bars, and a note of the objects that have no references.

    Raises: BadPhotoSet, BadPhoto; MissingWeights; BadOutput when `out` holds another run.
    """
    import pandas as pd

    photo_set = read_photo_set(folder)
    if progress and photo_set.subjects and photo_set.rivals:
        print(_rivals_note(photo_set), file=sys.stderr)
    store.open_run(out, _configuration(photo_set, stack_name, kept))
    parts: list[str] = []
    written: list[Path] = []
    with store.locked(out):
        stack = load_stack(stack_name)
        if not kept and not ships_thresholds(stack_name):
            stack = replace(stack, thresholds=None)
        if photo_set.subjects:
            memory = remember_subjects(photo_set.subjects, stack, out / "memory")
            attender = Attender(stack, memory)
            table = _of_scenes(
                photo_set,
                out,
                "",
                progress,
                lambda scene: measure_scene(scene, photo_set, memory, attender),
            )
            single = pd.DataFrame(single_rows(memory, stack))
            written += write_table(table, out, TABLE)
            if len(single):
                written += write_table(single, out, SINGLE)
            written += write_sheets(photo_set, table, out)
            parts += [text_report(table), single_report(single)]
        if any(scene.masks for scene in photo_set.scenes):
            masks = _of_scenes(
                photo_set, out, MASKS, progress, lambda scene: mask_rows(scene, stack)
            )
            written += write_table(masks, out, MASKS)
            parts.append(mask_report(masks))
        if clips:
            followed = _of_scenes(
                photo_set, out, CLIPS, progress, lambda scene: follow_scene(scene, photo_set, stack)
            )
            written += write_table(followed, out, CLIPS)
            parts.append(clip_report(followed))
        report = "\n\n".join(part for part in parts if part)
        with writing(out, "measure photos"):
            write_atomic(out / "report.txt", f"{report}\n".encode())
    names = ", ".join(map(str, written))
    return f"{report}\n\nwrote {names}"


def _rivals_note(photo_set: PhotoSet) -> str:
    """A misspelt object is a rival, too, and no question then asks for it."""
    return (
        f"note: {SCENES_CSV} names {', '.join(photo_set.rivals)} without references: taken as "
        "rivals, not asked for; where one is misspelt, mend it and measure anew"
    )


def _configuration(photo_set: PhotoSet, stack_name: str, kept: bool) -> dict[str, object]:
    """What the results depend on."""
    return {
        "measurement": "photos",
        "photos": photo_set.sha256,
        "stack": stack_name,
        "version": __version__,
        **checksums(stack_name, kept),
    }


def _of_scenes(
    photo_set: PhotoSet,
    out: Path,
    what: str,
    progress: bool,
    measure: Callable[[Scene], list[Row]],
) -> "pd.DataFrame":
    """The rows of every scene, measured or read again."""
    import pandas as pd
    from tqdm import tqdm

    rows: list[Row] = []
    suffix = f".{what}.json" if what else ".json"
    bar = tqdm(photo_set.scenes, unit="scene", desc=what or "photos", disable=not progress)
    for scene in bar:
        path = out / "parts" / f"{scene.name}{suffix}"
        if not path.exists():
            write_json_part(path, measure(scene), caller="measure photos")
        rows.extend(read_json_part(path, caller="measure photos"))
    return pd.DataFrame(rows)
