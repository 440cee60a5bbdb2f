"""Measures development scenes one by one, and photo sets; what a run had finished is kept."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from vap_core import __version__
from vap_core.base.errors import BadOutput, BadPhotoSet
from vap_core.base.files import read_parquet, write_atomic, writing
from vap_core.perception.foundation.weights import needs_photos, store_folder
from vap_core.perception.protocols import FamiliarityJudge, Stack, keep_command, keep_thresholds
from vap_core.perception.stacks import checksums, is_own, load_stack, ships_thresholds
from vap_core.study import store
from vap_core.study.photos import TABLE, measure_photos
from vap_core.study.store import read_json_part, write_json_part
from vap_core.study.table import printed
from vap_make.calibration.report import PRICE, Choice, choose, text_report
from vap_make.calibration.scenes import SEED, Row, measure_scene

if TYPE_CHECKING:
    import pandas as pd

SCENES = 24
"""Rendered scenes by default: 48 views that show the target."""
RENDERED = "rendered scenes"


def calibrate(
    stack_name: str,
    out: Path,
    *,
    scenes: int = SCENES,
    photos: Sequence[Path] = (),
    price: float = PRICE,
    progress: bool = True,
) -> tuple[str, Choice]:
    """Do what `out` lacks of the measurement; the report, and the thresholds that it chooses.

    Raises: BadPhotoSet, BadPhoto; BadOutput when `out` holds another run, or nothing is measured.
    """
    if not scenes and not photos:
        raise BadOutput(
            "calibrate: no scenes and no photos; take --scenes 24, or name a photo set with "
            "--photos."
        )
    stack = load_stack(stack_name)
    store.open_run(out, _configuration(stack))
    with store.locked(out):
        table = _measure(stack, out, scenes, photos, progress)
        chosen = choose(table, price)
        report = text_report(table, chosen, stack)
        with writing(out, "calibrate"):
            write_atomic(out / "report.txt", f"{report}\n".encode())
            write_atomic(out / "answers.csv", printed(table.round(4), "csv").encode())
    return f"{report}\n\nwrote {out / 'report.txt'} and {out / 'answers.csv'}", chosen


def refuse_keep(stack_name: str, photos: Sequence[Path] = ()) -> None:
    """Raises: BadOutput without own photos, for a stack that has thresholds or needs photos; for a
    stack of the caller's own, which is loaded to see, as `load_stack`.
    """
    if photos:
        return
    has_thresholds, photos_needed = ships_thresholds(stack_name), needs_photos(stack_name)
    if is_own(stack_name):
        stack = load_stack(stack_name)
        has_thresholds = stack.thresholds is not None
        photos_needed = isinstance(stack.detector, FamiliarityJudge)
    if has_thresholds:
        raise BadOutput(
            f"calibrate: the stack {stack_name} ships its thresholds, so that results stay "
            "comparable; name photos of your own with --photos to keep a threshold for photos, or "
            "leave --keep out."
        )
    if photos_needed:
        raise BadOutput(
            f"calibrate: the stack {stack_name} has a threshold of its own for photos, and "
            f"rendered scenes are no photos; run {keep_command(stack_name, photos=True)}."
        )


def keep_choice(stack_name: str, chosen: Choice) -> Path:
    """Write the chosen thresholds beside the stack's weights.

    Of a stack that ships thresholds it is that of unfamiliar views. `load_own` reads it, and those
    of a stack of the caller's own.

    Raises: BadOutput.
    """
    stack = load_stack(stack_name)
    thresholds = chosen.thresholds(stack)
    if ships_thresholds(stack_name) and stack.thresholds is not None:
        thresholds = None
        if chosen.unfamiliar is not None:
            thresholds = replace(stack.thresholds, unfamiliar=chosen.unfamiliar)
    if thresholds is None:
        raise BadOutput(
            f"calibrate: too few objects were elected rightly to choose a threshold of "
            f"{stack_name}; run it again with more --scenes, or more photos in the set."
        )
    return keep_thresholds(store_folder(), stack_name, stack.encoder.name, thresholds)


def _configuration(stack: Stack) -> dict[str, object]:
    """What the answers depend on; more scenes and photo sets only add some.

    Thresholds are what is measured here: those that were kept do not count.
    """
    return {
        "measurement": "calibration",
        "stack": stack.name,
        "encoder": stack.encoder.name,
        "seed": SEED,
        "version": __version__,
        **checksums(stack.name, kept=False),
    }


def _measure(
    stack: Stack, out: Path, scenes: int, photos: Sequence[Path], progress: bool
) -> "pd.DataFrame":
    """One row per view and question; `source` is a photo set's name or RENDERED."""
    import pandas as pd
    from tqdm import tqdm

    tables = []
    rows: list[Row] = []
    for number in tqdm(range(scenes), unit="scene", desc=RENDERED, disable=not progress):
        path = out / "scenes" / f"{number:05d}.json"
        if not path.exists():
            write_json_part(path, measure_scene(number, stack), caller="calibrate")
        rows.extend(read_json_part(path, caller="calibrate"))
    if rows:
        tables.append(pd.DataFrame(rows).assign(source=RENDERED))
    for folder in photos:
        name = folder.resolve().name
        run = out / f"photos-{name}"
        measure_photos(folder, run, stack.name, kept=False, progress=progress)
        if not (run / f"{TABLE}.parquet").exists():
            raise BadPhotoSet(
                f"calibrate: {folder} has no references; put each object's photos into "
                f"{folder}/references/OBJECT."
            )
        answers = read_parquet(
            run / f"{TABLE}.parquet", "calibrate", "delete it and run the same command again"
        )
        tables.append(_photo_rows(answers).assign(source=name))
    table = pd.concat(tables, ignore_index=True)
    return table.assign(likeness=table.likeness.astype(float))


def _photo_rows(answers: "pd.DataFrame") -> "pd.DataFrame":
    """The answers of a photo set in the form of the scenes'."""
    from vap_core.study.photos import RIGHT_IOU

    cases = []
    for present, lookalikes in zip(answers.present, answers.lookalikes, strict=True):
        if present:
            cases.append("present")
        else:
            cases.append("look-alikes" if lookalikes else "absent")
    rows = answers[["scene", "familiar", "likeness"]]
    right = answers.present & (answers.chosen_iou >= RIGHT_IOU)
    return rows.assign(camera="photo", case=cases, right=right)
