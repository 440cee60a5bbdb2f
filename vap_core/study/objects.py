"""Objects of one's own, measured in a suite's episodes: found, and fetched among look-alikes.

    objects.csv   file,category,height_cm,groups
    *.glb ...     the files

`height_cm` is empty where a file's units are metres; `groups` are words of one's own, joined by
semicolons, by which the report is split, or empty. A folder without objects.csv holds imported
objects, as `objects import --out` writes them.
"""

import hashlib
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from vap_core import __version__
from vap_core.attend import Attender
from vap_core.base.errors import BadObject, BadStudy, an, command
from vap_core.base.files import read_rows
from vap_core.base.media import load_photo
from vap_core.base.types import Grounding, Rgb, value
from vap_core.memory import kind_instead
from vap_core.perception.boxes import box_iou, mask_iou
from vap_core.perception.candidates import Proposals, segment
from vap_core.perception.protocols import Stack
from vap_core.perception.stacks import check_stack, checksums, load_stack
from vap_core.simulation import suites
from vap_core.simulation.assets.objects import get_object
from vap_core.simulation.assets.scans import import_scan, storage
from vap_core.simulation.types import EpisodeRow
from vap_core.study import engine, measurement
from vap_core.study.measurement import Measurement, Row, Tables
from vap_core.study.perception import (
    SAME_BOX,
    USUAL_K,
    View,
    find_candidates,
    object_under_box,
    opening_views,
    registered_object,
)
from vap_core.study.register import (
    RIGHT,
    SILENT,
    TRUTH,
    WRONG,
    draw_box,
    fit,
    join_tiles,
    labelled,
    write_picture,
)
from vap_core.study.stats import share_by
from vap_core.study.table import printed
from vap_core.study.trials import Study, default_policy, feasible
from vap_core.study.workers import results_here
from vap_core.vote import nominate

if TYPE_CHECKING:
    import pandas as pd

TABLE = "objects.csv"
COLUMNS = ("file", "category", "height_cm", "groups")


@value
class Source:
    """The objects of a folder by name, the files of those to be imported, and a checksum of all."""

    groups: Mapping[str, tuple[str, ...]]
    files: Mapping[str, Mapping[str, str]]
    sha256: str


def read_source(folder: Path) -> Source:
    """Read a folder in either form. Raises: BadObject, which names the line."""
    if not folder.is_dir():
        raise BadObject(
            f"measure objects: {folder} is no folder; see ./vap measure objects --help."
        )
    if not (folder / TABLE).exists():
        return _imported(folder)
    groups: dict[str, tuple[str, ...]] = {}
    files: dict[str, Mapping[str, str]] = {}
    digest = hashlib.sha256()
    rows = read_rows(
        folder / TABLE, COLUMNS[:2], optional=COLUMNS[2:], caller="measure objects", error=BadObject
    )
    for line, row in rows:
        path = folder / row["file"]
        where = f"{folder / TABLE} line {line}"
        if not path.is_file():
            raise BadObject(f"measure objects: {where} names {row['file']!r}, which is not there.")
        name = import_scan.default_name(path)
        if name in groups:
            raise BadObject(f"measure objects: {where} names a second {name!r}; rename the file.")
        kind = kind_instead(row["category"])
        if kind:
            raise BadObject(
                f"measure objects: {where} has the category {row['category']!r}; name the kind of "
                f"thing alone, in words, for example {kind}."
            )
        _check_height(row["height_cm"], where)
        groups[name] = tuple(word for word in map(str.strip, row["groups"].split(";")) if word)
        files[name] = row
        digest.update(f"{name} {row}".encode() + hashlib.sha256(path.read_bytes()).digest())
    if not groups:
        raise BadObject(f"measure objects: {folder / TABLE} names no file; give one in each line.")
    return Source(groups=groups, files=files, sha256=digest.hexdigest())


def import_missing(source: Source, folder: Path, target: Path) -> dict[str, str]:
    """Import the files of a source that `target` lacks; why others cannot be, by name.

    Some ten seconds of CPU an object.

    Raises: BadOutput when `target` cannot be written.
    """
    refused = {}
    for name, row in source.files.items():
        if (target / name / storage.METADATA_FILE).exists():
            continue
        height_cm = float(row["height_cm"]) if row["height_cm"] else None
        try:
            metadata, scan = import_scan.import_scan(
                folder / row["file"],
                name,
                row["category"],
                height_cm=height_cm,
                report=lambda line: None,
            )
        except BadObject as error:
            refused[name] = f"{error}{_by_itself(folder, row, str(error))}"
            continue
        storage.save_scan(target, metadata, scan, replace=True)
    return refused


def _by_itself(folder: Path, row: Mapping[str, str], error: str) -> str:
    """How to import a file with the option that an error names; "" where it names none."""
    if " --" not in error:
        return ""
    words = ["objects", "import", str(folder / row["file"]), "--category", row["category"]]
    if row["height_cm"]:
        words += ["--height-cm", row["height_cm"]]
    if "pass --repair" in error:
        words.append("--repair")
    return f" Run: {command(*words, '--out', 'DIR')}; then measure objects DIR."


@contextmanager
def objects_in(folder: Path) -> Iterator[None]:
    """Look own objects up in `folder`, in this process and in those that it starts."""
    before = os.environ.get(storage.VARIABLE)
    os.environ[storage.VARIABLE] = str(folder.resolve())
    try:
        yield
    finally:
        if before is None:
            del os.environ[storage.VARIABLE]
        else:
            os.environ[storage.VARIABLE] = before


def _imported(folder: Path) -> Source:
    """A folder of imported objects."""
    groups: dict[str, tuple[str, ...]] = {}
    digest = hashlib.sha256()
    for path in sorted(folder.glob(f"[!.]*/{storage.METADATA_FILE}")):
        groups[path.parent.name] = ()
        digest.update(path.parent.name.encode() + path.read_bytes())
    if not groups:
        raise BadObject(
            f"measure objects: {folder} holds neither {TABLE} nor imported objects; write a line "
            f"{','.join(COLUMNS)} for every 3-D file into {folder / TABLE}."
        )
    return Source(groups=groups, files={}, sha256=digest.hexdigest())


def _check_height(text: str, where: str) -> None:
    if not text:
        return
    try:
        fits = 0 < float(text) < 1000
    except ValueError:
        fits = False
    if not fits:
        raise BadObject(
            f"measure objects: {where} has the height {text!r}; give centimetres, or nothing where "
            "the file's units are metres."
        )


TILE_PX = 224


def measure_openings(rows: Sequence[EpisodeRow], stack: Stack) -> tuple[list[Row], Rgb]:
    """A row for every camera of every episode, and a picture: a reference, and the first episode's
    views with the true box (white) and the elected one.

    Raises: UnknownName, BadObject, as `registered_object`; BadEncoder, as `Attender.ground`.
    """
    personal, _ = registered_object(stack, rows[0].target, USUAL_K)
    attender = Attender(stack, {personal.name: personal})
    table = []
    tiles = [_square(personal.crops[0])]
    for episode in opening_views(rows):
        offered = find_candidates(episode, stack)
        elected = {}
        for view, of_view in zip(episode, offered, strict=True):
            few, cosine = nominate(view.rgb, personal, of_view, stack)
            candidates = segment(view.rgb, few, stack)
            elected[view.camera] = attender.ground(view.camera, personal, candidates, cosine)
        judged = attender.reject(personal, elected)
        for view, of_view in zip(episode, offered, strict=True):
            row = _view_row(view, of_view, judged[view.camera])
            table.append(row)
            if view.row == rows[0]:
                tiles.append(_tile(view, judged[view.camera], row))
    first = table[0]
    title = f"{personal.name} ({first['suite']}/{first['task']})"
    return table, labelled(np.concatenate(tiles, axis=1), [title])


def _view_row(view: View, offered: Proposals, grounding: Grounding) -> Row:
    """`proposed` and `right` are None in a view that shows less of the target than counts."""
    row: Row = {
        **view.key,
        "counts": view.row.target in view.visible(),
        "familiar": offered.boxes.familiar,
        "proposed": None,
        "right": None,
        "tinted": grounding.winner is not None,
        "elected": "",
        "likeness": None,
        "mask_iou": None,
    }
    chosen = grounding.chosen
    if chosen is not None:
        row["elected"] = object_under_box(view, grounding.candidates.xyxy[chosen])
        row["likeness"] = float(grounding.likeness[chosen])
    if not row["counts"]:
        return row
    target = view.row.target
    overlap = box_iou(offered.boxes.xyxy, view.boxes()[target][None])
    row["proposed"] = bool(overlap.max(initial=0.0) >= SAME_BOX)
    row["right"] = row["elected"] == target
    if row["right"] and chosen is not None:
        row["mask_iou"] = mask_iou(grounding.masks[chosen], view.masks[target])
    return row


def _tile(view: View, grounding: Grounding, row: Row) -> Rgb:
    tile = view.rgb.copy()
    box = view.boxes().get(view.row.target)
    if box is not None:
        draw_box(tile, box.tolist(), TRUTH, 1)
    if grounding.chosen is not None:
        colour = RIGHT if row["elected"] == view.row.target else WRONG
        if not row["tinted"]:
            colour = SILENT
        draw_box(tile, grounding.candidates.xyxy[grounding.chosen].tolist(), colour, 1)
    return _square(tile)


def _square(rgb: Rgb) -> Rgb:
    tile, _ = fit(rgb, TILE_PX, TILE_PX)
    return tile


TILES, SHEET_COLUMNS = 12, 2
NOTE = (
    "value [95 % interval] n, in %; Wilson's interval with n reduced to what the objects, which "
    "are the independent units, are worth.\n"
    "views: those that show 100 pixels of the object or more, of 224 x 224. proposed: some box "
    "overlaps it by IoU .5. right: the elected box does; not in view: of the right ones, those too "
    "unlike the references to be tinted; mask IoU: of the right ones, mean. wrong tint: another "
    "thing is tinted.\n"
    "expert: episodes in which it succeeds. VAP: successes of these; touches first: the first "
    "object that the robot touches in these is the right one."
)


def text_report(tables: "Mapping[str, pd.DataFrame]", groups: Mapping[str, Sequence[str]]) -> str:
    """What the command prints; `groups` are the words of each object."""
    parts = []
    if len(tables["views"]):
        parts += [printed(object_table(tables)), printed(group_table(tables, groups))]
    left_out = [f"left out: {row.object}: {row.why}" for row in tables["refused"].itertuples()]
    parts += ["\n".join(left_out)] if left_out else []
    return "\n\n".join([*parts, NOTE] if len(tables["views"]) else parts)


def _judged(views: "pd.DataFrame") -> "pd.DataFrame":
    """What became of the views; of those that count, and of the right ones, nothing of others."""
    seen = views.counts.astype(bool)
    right = views.right.astype("boolean").fillna(False).astype(bool)
    wrong = views.tinted.astype(bool) & (views.elected != views.target)
    proposed = views.proposed.astype("boolean").fillna(False).astype(bool)
    return views.assign(
        **{
            "views": seen,
            "proposed": proposed.where(seen),
            "right": right.where(seen),
            "not in view": (~views.tinted.astype(bool)).where(seen & right),
            "wrong tint": wrong,
        }
    )


def _mean(values: "pd.Series") -> str:
    known = values.dropna()
    return f"{known.mean():.2f}" if len(known) else "-"


def object_table(tables: "Mapping[str, pd.DataFrame]") -> "pd.DataFrame":
    """One line per object: counts."""
    import pandas as pd

    lines = []
    episodes = tables["episodes"]
    for name, part in _judged(tables["views"]).groupby("target", sort=True):
        line: dict[str, Any] = {"object": name}
        for column in ("views", "proposed", "right", "not in view", "wrong tint"):
            line[column] = int(part[column].dropna().astype(bool).sum())
        line |= {"mask IoU": _mean(part[part.views].mask_iou), "expert": "-", "VAP": "-"}
        if len(episodes):
            of_object = episodes[episodes.object == name]
            can = of_object[of_object.expert]
            line["expert"] = f"{len(can)} of {len(of_object)}"
            line["VAP"] = f"{int(can.success.sum())} of {len(can)}"
        lines.append(line)
    return pd.DataFrame(lines)


def group_table(
    tables: "Mapping[str, pd.DataFrame]", groups: Mapping[str, Sequence[str]]
) -> "pd.DataFrame":
    """All objects, by camera, and by group: shares."""
    import pandas as pd

    views, episodes = _judged(tables["views"]), tables["episodes"]
    members = {"all": list(groups)}
    cameras = sorted(views.camera.unique())
    for group in sorted({word for words in groups.values() for word in words}):
        members[f"- {group}"] = [name for name, words in groups.items() if group in words]
    parts = [("all", views)]
    parts += [(f"- {camera} views", views[views.camera == camera]) for camera in cameras]
    parts += [(title, views[views.target.isin(members[title])]) for title in list(members)[1:]]
    lines = []
    for title, part in parts:
        line = {"": title}
        for column in ("proposed", "right", "not in view", "wrong tint"):
            line[column] = share_by(part, column, ["target"]).text(digits=0)
        line["mask IoU"] = _mean(part[part.views].mask_iou)
        blank = "" if title not in members else "-"
        line |= dict.fromkeys(("expert", "VAP", "touches first"), blank)
        if title in members and len(episodes):
            played = episodes[episodes.object.isin(members[title])]
            played = played.assign(
                VAP=played.success.where(played.expert),
                first=played.first_object_correct.astype("boolean")
                .fillna(False)
                .where(played.expert),
            )
            for column, name in (("expert", "expert"), ("VAP", "VAP"), ("first", "touches first")):
                line[name] = share_by(played, column, ["object"]).text(digits=0)
        lines.append(line)
    return pd.DataFrame(lines)


def write_sheets(out: Path) -> list[Path]:
    """Join the pictures of all objects into sheet-01.png and so on. Raises: BadOutput."""
    tiles = []
    for path in sorted((out / "parts").glob("*.png")):
        tiles.append(load_photo(path, long_side=None))
    widest = max((tile.shape[1] for tile in tiles), default=0)
    for i, tile in enumerate(tiles):  # suites differ in cameras
        beside = ((0, 0), (0, widest - tile.shape[1]), (0, 0))
        tiles[i] = np.pad(tile, beside, constant_values=255)
    paths = []
    for first in range(0, len(tiles), TILES):
        path = out / f"sheet-{1 + first // TILES:02}.png"
        write_picture(path, join_tiles(tiles[first : first + TILES], SHEET_COLUMNS))
        paths.append(path)
    return paths


METHOD = "vap"


@dataclass(frozen=True)
class Job:
    """One object."""

    name: str


@dataclass(frozen=True)
class ObjectMeasurement(Measurement):
    """What is asked for: `episodes` of every task that fits, spread over its list.

    `policy` "" takes the shipped one of the suites; `views_only` runs no episodes.
    """

    folder: Path
    suites: tuple[str, ...] = ("tabletop",)
    episodes: int = 4
    stack: str = "embedded"
    policy: str = ""
    views_only: bool = False
    caller: ClassVar[str] = "measure objects"

    def settings(self) -> dict[str, Any]:
        """Raises: BadObject; UnknownName; MissingWeights."""
        check_stack(self.stack, self.caller)
        about = asdict(self) | {"suites": list(self.suites)}
        del about["folder"]
        lists = {name: suites.digest(name) for name in self.suites if suites.has_list(name)}
        return {
            "measurement": "objects",
            "objects": read_source(self.folder).sha256,
            **about,
            "lists": lists,
            "version": __version__,
            **checksums(self.stack),
        }

    def jobs(self) -> list[Job]:
        return [Job(name) for name in read_source(self.folder).groups]

    def shelf(self, out: Path) -> Path:
        """Where the objects are."""
        return out / "objects" if read_source(self.folder).files else self.folder

    def prepare(self, folder: Path) -> None:
        """Import what is not there; jobs whose object cannot be say why."""
        source = read_source(self.folder)
        refused = import_missing(source, self.folder, self.shelf(folder))
        for name, why in refused.items():
            part = measurement.Part(self, Job(name), folder)
            tables: Tables = {
                "views": [],
                "episodes": [],
                "refused": [{"object": name, "why": why}],
            }
            measurement.store.write_json_part(part.path, tables, self.caller)

    def run(self, job: Job, folder: Path) -> Tables:
        """The rows of the opening views, and of each episode with whether the expert can do it; or
        why the object cannot be measured."""
        tables: Tables = {"views": [], "episodes": [], "refused": []}
        try:
            tasks = suites.tasks_of(self.suites, job.name)
            if not tasks:
                kind = get_object(job.name).category
                raise BadObject(f"no task of {', '.join(self.suites)} asks for {an(kind)}")
            for suite, task in tasks:
                study = self.study(suite, task, job.name)
                slug = f"{job.name}.{suite}.{task}"
                rows = study.rows(suite, task)
                seen, picture = measure_openings(rows, _load_stack(self.stack))
                write_picture(folder / "parts" / f"{slug}.png", picture)
                tables["views"] += seen
                if not self.views_only:
                    tables["episodes"] += self.played(study, rows, folder / "episodes" / slug)
        except (BadObject, BadStudy) as error:
            return {
                "views": [],
                "episodes": [],
                "refused": [{"object": job.name, "why": str(error)}],
            }
        return tables

    def study(self, suite: str, task: str, name: str) -> Study:
        """The study of one task with an object in its target's place. Raises: as `Study`."""
        return Study(
            tasks=((suite, task),),
            methods=(METHOD,),
            episodes=self.episodes,
            policy=self.policy or default_policy([suite]),
            stack=self.stack,
            follow="call",
            object=name,
        )

    def played(self, study: Study, rows: Sequence[EpisodeRow], folder: Path) -> list[Row]:
        """What became of each episode, and whether the expert can do it."""
        can = {row.episode: good for row, good in zip(rows, feasible(rows), strict=True)}
        # In this process, models and policy are loaded once for all objects.
        here: dict[str, Any] = dict(workers=1, executor=results_here)
        table = engine.run(study, folder, record="none", progress=False, **here)
        return [
            {**row, "object": study.object, "expert": can[row["episode"]]}
            for row in table.to_dict("records")
        ]


_load_stack = cache(load_stack)


def measure_objects(asked: ObjectMeasurement, out: Path) -> str:
    """Do what `out` lacks of the measurement, write tables and sheets, and return the report.

    Raises: BadObject, also where every object was left out; UnknownName; MissingWeights; BadOutput
        when `out` holds another run.
    """
    source = read_source(asked.folder)
    with objects_in(asked.shelf(out)):
        tables = measurement.measure(asked, out)
        report = measurement.report(asked, text_report(tables, source.groups), out)
    if not len(tables["views"]):
        first, *more = tables["refused"].itertuples()
        others = f" report.txt in {out.name} says why of {len(more)} more." if more else ""
        raise BadObject(
            f"measure objects: every object was left out. {first.object}: {first.why}{others}"
        )
    write_sheets(out)
    return report
