"""Measures the objects of a folder one by one; what an interrupted run had finished is kept."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vap_core import __version__
from vap_core.base.errors import BadObject, BadStudy
from vap_core.base.files import write_atomic, writing
from vap_core.base.types import value
from vap_core.evaluation import engine, measurements, store
from vap_core.evaluation.feasibility import feasible
from vap_core.evaluation.jobs import Rows
from vap_core.evaluation.own_objects.folder import (
    Source,
    import_missing,
    objects_in,
    read_source,
)
from vap_core.evaluation.own_objects.openings import measure_openings
from vap_core.evaluation.own_objects.report import Tables, text_report, write_sheets
from vap_core.evaluation.photos.pictures import write_picture
from vap_core.evaluation.policy_names import default_policy
from vap_core.evaluation.processes import results_here
from vap_core.evaluation.study import Study
from vap_core.perception.stacks import check_stack, checksums, load_stack
from vap_core.simulation import suites
from vap_core.simulation.assets.objects import get_object

if TYPE_CHECKING:
    import pandas as pd
    from tqdm import tqdm

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
    views: Rows = []
    episodes: Rows = []
    for name in source.groups:
        bar.set_postfix_str(name)
        if name not in refused:
            seen: Rows = []
            played: Rows = []
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


def _views(study: Study, out: Path, stack: Any) -> Rows:
    """The rows of the opening views, measured or read again."""
    path = out / "parts" / f"{_slug(study)}.views.json"
    if not path.exists():
        (task,) = study.tasks
        table, picture = measure_openings(study.rows(*task), stack)
        write_picture(path.with_name(f"{_slug(study)}.png"), picture)
        measurements.write_json_part(path, table, caller=CALLER)
    rows: Rows = measurements.read_json_part(path, caller=CALLER)
    return rows


def _episodes(study: Study, out: Path) -> Rows:
    """What became of each episode, and whether the expert can do it."""
    path = out / "parts" / f"{_slug(study)}.expert.json"
    (task,) = study.tasks
    rows = study.rows(*task)
    if not path.exists():
        measurements.write_json_part(path, list(feasible(rows)), caller=CALLER)
    expert = measurements.read_json_part(path, caller=CALLER)
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
    found: Rows = []
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
            paths += measurements.write_table(table, out, name)
    return paths
