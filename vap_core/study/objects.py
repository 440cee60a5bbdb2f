"""Objects of one's own, measured in a suite's episodes: found, and fetched among look-alikes.

    objects.csv   file,category,height_cm,groups
    *.glb ...     the files

`height_cm` is empty where a file's units are metres; `groups` are words of one's own, joined by
semicolons, by which the report is split, or empty. A folder without objects.csv holds imported
objects, as `objects import --out` writes them.
"""

import hashlib
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vap_core import __version__
from vap_core.attend import Attender
from vap_core.base.errors import BadObject, BadStudy, command
from vap_core.base.files import Rows, align, read_rows, write_atomic, writing
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
from vap_core.study import engine, store
from vap_core.study.perception import (
    SAME_BOX,
    USUAL_K,
    View,
    find_candidates,
    object_under_box,
    opening_views,
    registered_object,
)
from vap_core.study.processes import results_here
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
from vap_core.study.stats import clustered_share
from vap_core.study.trials import Study, default_policy, feasible
from vap_core.vote import nominate

if TYPE_CHECKING:
    import pandas as pd
    from tqdm import tqdm

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
            f"measure objects: {folder} is no folder; see python -m vap_core measure objects "
            "--help."
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
        _check_category(row["category"], where)
        _check_height(row["height_cm"], where)
        groups[name] = tuple(word for word in map(str.strip, row["groups"].split(";")) if word)
        files[name] = row
        digest.update(f"{name} {row}".encode() + hashlib.sha256(path.read_bytes()).digest())
    if not groups:
        raise BadObject(f"measure objects: {folder / TABLE} names no file; give one in each line.")
    return Source(groups=groups, files=files, sha256=digest.hexdigest())


def import_missing(
    source: Source, folder: Path, target: Path, report: Callable[[str], None]
) -> dict[str, str]:
    """Import the files of a source that `target` lacks; why others cannot be, by name.

    Some ten seconds of CPU an object.

    Raises: BadOutput when `target` cannot be written.
    """
    refused = {}
    for name, row in source.files.items():
        if (target / name / storage.METADATA_FILE).exists():
            continue
        report(f"importing {name}")
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


def _check_category(text: str, where: str) -> None:
    kind = kind_instead(text)
    if kind:
        raise BadObject(
            f"measure objects: {where} has the category {text!r}; name the kind of thing alone, in "
            f"words, for example {kind}."
        )


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


Row = dict[str, Any]
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
        for view, offered in zip(episode, find_candidates(episode, stack), strict=True):
            few = nominate(view.rgb, personal, offered, stack)
            candidates = segment(view.rgb, few, stack)
            grounding = attender.reject(attender.ground(view.camera, personal, candidates))
            row = _view_row(view, offered, grounding)
            table.append(row)
            if view.row == rows[0]:
                tiles.append(_tile(view, grounding, row))
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
        "elected": _elected(view, grounding),
        "likeness": None,
        "mask_iou": None,
    }
    chosen = grounding.chosen
    if chosen is not None:
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


def _elected(view: View, grounding: Grounding) -> str:
    """The object under the elected box; "" where there is none."""
    if grounding.chosen is None:
        return ""
    return object_under_box(view, grounding.candidates.xyxy[grounding.chosen])


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


@value
class Tables:
    """A row per view and per episode, the groups of every object, and why some were left out."""

    views: "pd.DataFrame"
    episodes: "pd.DataFrame"
    groups: Mapping[str, tuple[str, ...]]
    refused: Mapping[str, str]


def text_report(tables: Tables) -> str:
    """What the command prints."""
    parts = []
    if len(tables.views):
        parts += [align(object_rows(tables)), align(group_rows(tables))]
    if tables.refused:
        lines = [f"left out: {name}: {why}" for name, why in tables.refused.items()]
        parts.append("\n".join(lines))
    if len(tables.views):
        parts.append(NOTE)
    return "\n\n".join(parts)


def object_rows(tables: Tables) -> Rows:
    """One line per object: counts."""
    head = ["object", "views", "proposed", "right", "not in view", "wrong tint", "mask IoU"]
    rows = [[*head, "expert", "VAP"]]
    for name, part in tables.views.groupby("target", sort=True):
        seen = part[part.counts]
        wrong = part.tinted & (part.elected != part.target)
        right = _right(seen)
        refused = ~right.tinted
        counts = [len(seen), seen.proposed.sum(), len(right), refused.sum(), wrong.sum()]
        cells = [str(name), *(str(int(count)) for count in counts), _mean(seen.mask_iou)]
        if len(tables.episodes):
            of_object = tables.episodes[tables.episodes.object == name]
            can = of_object[of_object.expert]
            cells += [f"{len(can)} of {len(of_object)}", f"{int(can.success.sum())} of {len(can)}"]
        else:
            cells += ["-", "-"]
        rows.append(cells)
    return rows


def group_rows(tables: Tables) -> Rows:
    """All objects, by camera, and by group: shares."""
    head = ["", "proposed", "right", "not in view", "wrong tint", "mask IoU"]
    rows = [
        [*head, "expert", "VAP", "touches first"],
        _shares("all", tables, tables.groups),
    ]
    for camera, part in tables.views.groupby("camera", sort=True):
        cells = _view_cells(part)
        rows.append([f"- {camera} views", *cells, "", "", ""])
    for group in sorted({word for words in tables.groups.values() for word in words}):
        members = [name for name, words in tables.groups.items() if group in words]
        rows.append(_shares(f"- {group}", tables, members))
    return rows


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


def _shares(title: str, tables: Tables, members: Iterable[str]) -> list[str]:
    names = list(members)
    cells = _view_cells(tables.views[tables.views.target.isin(names)])
    if not len(tables.episodes):
        return [title, *cells, "-", "-", "-"]
    part = tables.episodes[tables.episodes.object.isin(names)]
    can = part[part.expert]
    return [
        title,
        *cells,
        _share(part.expert, part.object),
        _share(can.success, can.object),
        _share(can.first_object_correct, can.object),
    ]


def _view_cells(part: "pd.DataFrame") -> list[str]:
    seen = part[part.counts]
    right = _right(seen)
    wrong = part.tinted & (part.elected != part.target)
    return [
        _share(seen.proposed, seen.target),
        _share(seen.right, seen.target),
        _share(~right.tinted, right.target),
        _share(wrong, part.target),
        _mean(seen.mask_iou),
    ]


def _right(seen: "pd.DataFrame") -> "pd.DataFrame":
    """The views in which the object is elected, tinted or not."""
    return seen[seen.right.astype("boolean").fillna(False).astype(bool)]


def _share(hits: "pd.Series", clusters: "pd.Series") -> str:
    """The share of hits with its interval, objects as clusters."""
    known = hits.astype("boolean").fillna(False).to_numpy(float)
    return clustered_share(known, clusters).text(digits=0)


def _mean(values: "pd.Series") -> str:
    known = values.dropna().to_numpy(np.float64)
    if not len(known):
        return "-"
    return f"{known.mean():.2f}"


CALLER = "measure objects"
METHOD = "vap"


@value
class ObjectSurvey:
    """What is asked for: `episodes` of every task that fits, spread over its list.

    `policy` "" takes the shipped one of the suites; `views_only` runs no episodes.
    """

    suites: tuple[str, ...] = ("tabletop",)
    episodes: int = 4
    stack: str = "embedded"
    policy: str = ""
    views_only: bool = False

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


def measure_objects(folder: Path, out: Path, asked: ObjectSurvey) -> str:
    """Do what `out` lacks of the measurement, write tables and sheets, and return the report.

    Raises: BadObject, also where every object was left out; UnknownName; MissingWeights; BadOutput
        when `out` holds another run.
    """
    from tqdm import tqdm

    check_stack(asked.stack, CALLER)
    source = read_source(folder)
    store.open_run(out, _configuration(source, asked))
    shelf = out / "objects" if source.files else folder
    with store.locked(out), objects_in(shelf):
        with tqdm(total=len(source.groups), unit="object") as bar:
            refused = import_missing(source, folder, shelf, bar.set_postfix_str)
            views, episodes = _measure(source, out, asked, refused, bar)
        tables = Tables(views=views, episodes=episodes, groups=source.groups, refused=refused)
        written = _write(tables, out)
        report = text_report(tables)
        with writing(out, CALLER):
            write_atomic(out / "report.txt", f"{report}\n".encode())
        if not len(views):
            raise _nothing_measured(refused, out)
    names = ", ".join(map(str, [*written, *write_sheets(out)]))
    return f"{report}\n\nwrote {names}"


def _nothing_measured(refused: Mapping[str, str], out: Path) -> BadObject:
    """Why the first object was left out, and where the report has the others."""
    name, why = next(iter(refused.items()))
    others = ""
    if len(refused) > 1:
        others = f" report.txt in {out.name} says why of {len(refused) - 1} more."
    return BadObject(f"measure objects: every object was left out. {name}: {why}{others}")


def _configuration(source: Source, asked: ObjectSurvey) -> dict[str, Any]:
    """What the results depend on."""
    lists = {name: suites.digest(name) for name in asked.suites if suites.has_list(name)}
    return {
        "measurement": "objects",
        "objects": source.sha256,
        **asdict(asked),
        "suites": list(asked.suites),
        "lists": lists,
        "version": __version__,
        **checksums(asked.stack),
    }


def _measure(
    source: Source, out: Path, asked: ObjectSurvey, refused: dict[str, str], bar: "tqdm"
) -> "tuple[pd.DataFrame, pd.DataFrame]":
    """A row per view, and a row per episode. Objects that cannot be measured go to `refused`."""
    import pandas as pd

    stack = load_stack(asked.stack)
    views: list[Row] = []
    episodes: list[Row] = []
    for name in source.groups:
        bar.set_postfix_str(name)
        if name not in refused:
            seen: list[Row] = []
            played: list[Row] = []
            try:
                for suite, task in _tasks(name, asked.suites):
                    study = asked.study(suite, task, name)
                    seen += _views(study, out, stack)
                    if not asked.views_only:
                        played += _episodes(study, out)
                views += seen
                episodes += played
            except (BadObject, BadStudy) as error:
                refused[name] = str(error)
        bar.update()
    return pd.DataFrame(views), pd.DataFrame(episodes)


def _tasks(name: str, names: Sequence[str]) -> tuple[tuple[str, str], ...]:
    """The tasks for an object of its category. Raises: BadObject where there is none."""
    found = suites.tasks_of(names, name)
    if not found:
        raise BadObject(f"no task of {', '.join(names)} asks for a {get_object(name).category}")
    return found


def _views(study: Study, out: Path, stack: Any) -> list[Row]:
    """The rows of the opening views, measured or read again."""
    path = out / "parts" / f"{_slug(study)}.views.json"
    if not path.exists():
        (task,) = study.tasks
        table, picture = measure_openings(study.rows(*task), stack)
        write_picture(path.with_name(f"{_slug(study)}.png"), picture)
        store.write_json_part(path, table, caller=CALLER)
    rows: list[Row] = store.read_json_part(path, caller=CALLER)
    return rows


def _episodes(study: Study, out: Path) -> list[Row]:
    """What became of each episode, and whether the expert can do it."""
    path = out / "parts" / f"{_slug(study)}.expert.json"
    (task,) = study.tasks
    rows = study.rows(*task)
    if not path.exists():
        store.write_json_part(path, list(feasible(rows)), caller=CALLER)
    expert = store.read_json_part(path, caller=CALLER)
    can = {row.episode: good for row, good in zip(rows, expert, strict=True)}
    # In this process, models and policy are loaded once for all objects.
    table = engine.run(
        study,
        out / "episodes" / _slug(study),
        workers=1,
        record="none",
        progress=False,
        executor=results_here,
    )
    found: list[Row] = []
    for row in table.to_dict("records"):
        found.append({**row, "object": study.object, "expert": can[row["episode"]]})
    return found


def _slug(study: Study) -> str:
    ((suite, task),) = study.tasks
    return f"{study.object}.{suite}.{task}"


def _write(tables: Tables, out: Path) -> list[Path]:
    paths = []
    for name, table in (("views", tables.views), ("episodes", tables.episodes)):
        if len(table):
            paths += store.write_table(table, out, name)
    return paths
