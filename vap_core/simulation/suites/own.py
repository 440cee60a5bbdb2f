"""Suites of one's own, each from a Python file that defines `SUITE` and `rows()`.

A file is opened by name (`open_file`), or found in the environment variable VAP_SUITES, which holds
paths with the system's separator between them. It is executed: open only your own.
"""

import hashlib
import os
import re
import sys
from collections.abc import Callable, Iterable, Sequence
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType
from typing import Any

from vap_core.base.errors import BadInstruction, BadSuite, VapError, one_of
from vap_core.base.types import value
from vap_core.instruction import parse
from vap_core.simulation import robots
from vap_core.simulation.assets import objects
from vap_core.simulation.cameras import add_rigs
from vap_core.simulation.robots import Robot, mjcf
from vap_core.simulation.suites import lists
from vap_core.simulation.suites.suite import Suite, Task
from vap_core.simulation.types import AS_LISTED, EpisodeRow

VARIABLE = "VAP_SUITES"
FILES = ".suites"
"""The file of a run's folder that names those of its own suites."""
NAME = re.compile(r"[\w-]+")


@value
class OwnSuite:
    """A suite from a file: its list, and the list's sha256."""

    suite: Suite
    rows: tuple[EpisodeRow, ...]
    sha256: str
    file: Path


OPENED: dict[str, OwnSuite] = {}
"""The suites of one's own that are open in this process."""


def environment(files: Sequence[str]) -> dict[str, str]:
    """The variables by which another process finds the suites of some files."""
    return {VARIABLE: os.pathsep.join(files)} if files else {}


def find(name: str, taken: Iterable[str], endings: tuple[str, ...]) -> OwnSuite | None:
    """The suite of that name that was opened, or that a file of VAP_SUITES defines.

    `taken` and `endings` are `open_file`'s. Raises: BadSuite.
    """
    if name not in OPENED:
        open_listed(taken, endings)
    return OPENED.get(name)


def open_listed(taken: Iterable[str], endings: tuple[str, ...]) -> None:
    """Open every file of VAP_SUITES that is not open. Raises: BadSuite."""
    opened = {own.file for own in OPENED.values()}
    for part in os.environ.get(VARIABLE, "").split(os.pathsep):
        if part and Path(part).resolve() not in opened:
            open_file(Path(part), taken, endings)


def open_file(path: Path, taken: Iterable[str], endings: tuple[str, ...]) -> Suite:
    """Execute a file, check its suite and list, and make the suite known by its name.

    The same file is executed once in a process. Names in `taken` are other suites', names with one
    of the `endings` their variants'.
    Raises: BadSuite, which names the file and what is wrong in it.
    """
    file = path.resolve()
    for own in OPENED.values():
        if own.file == file:
            return own.suite
    module = _execute(file, path)
    suite = getattr(module, "SUITE", None)
    make_rows = getattr(module, "rows", None)
    if not isinstance(suite, Suite) or not callable(make_rows):
        raise BadSuite(
            f"suites: {path} must define SUITE, a Suite, and rows(), which returns its episodes; "
            "docs/extend.md has one."
        )
    if suite.name in taken or suite.name in OPENED:
        raise BadSuite(f"suites: {path}: there is another suite {suite.name!r}; rename this one.")
    if not NAME.fullmatch(suite.name) or suite.name.endswith(endings):
        raise BadSuite(
            f"suites: {path}: the name {suite.name!r} will not do; take letters, digits and "
            f"hyphens, and none of the endings {', '.join(endings)}."
        )
    rows = _checked_rows(suite, make_rows, path)
    OPENED[suite.name] = OwnSuite(suite, rows, _digest(rows), file)
    return suite


def _execute(file: Path, path: Path) -> ModuleType:
    """The module that a file makes. Raises: BadSuite."""
    name = f"vap_own_suite_{hashlib.sha256(str(file).encode()).hexdigest()[:12]}"
    spec = spec_from_file_location(name, file)
    if not file.is_file() or spec is None or spec.loader is None:
        raise BadSuite(f"suites: {path} is no Python file; name one that ends in .py.")
    module = module_from_spec(spec)
    sys.modules[name] = module
    try:
        spec.loader.exec_module(module)
    except (Exception, SystemExit) as error:  # the file is the user's: anything may come of it
        del sys.modules[name]
        raise BadSuite(f"suites: {_place(path, file, error)}: {_said(error)}") from error
    return module


def _place(path: Path, file: Path, error: BaseException) -> str:
    """The file and, where the error passed through it, its line."""
    line = None
    traceback = error.__traceback__
    while traceback is not None:
        if traceback.tb_frame.f_code.co_filename == str(file):
            line = traceback.tb_lineno
        traceback = traceback.tb_next
    if isinstance(error, SyntaxError):
        line = error.lineno
    return str(path) if line is None else f"{path}, line {line}"


def _said(error: BaseException) -> str:
    """An error as one line."""
    if isinstance(error, SystemExit):
        called = f"sys.exit({error.code!r}) was called"
        return f"{called}; let the file end by itself, with SUITE and rows()."
    if isinstance(error, VapError):
        return f"{' '.join(str(error).split()).removesuffix('.')}."
    return lists.said(error)


def _check_home(robot: Robot, model: Any) -> None:
    """Raises: BadSuite: a joint begins outside its range."""
    for name, angle in zip(robot.joints, robot.home.tolist(), strict=True):
        joint = model.joint(name)
        low, high = joint.range.tolist()
        if joint.limited[0] and not low - 1e-6 <= angle <= high + 1e-6:
            raise BadSuite(
                f"{robot.name}'s home has {angle:g} for joint {name}, outside its range "
                f"{low:g} to {high:g}; give radians"
            )


def _check_robot(suite: Suite) -> None:
    """Raises: BadSuite, UnknownName: the suite does not fit its robot."""
    robot = robots.get(suite.robot)
    if suite.hz != robot.hz:
        raise BadSuite(f"{robot.name} is controlled at hz={robot.hz:g}, and not {suite.hz:g}")
    spec = mjcf.load(robot)
    rigs = add_rigs(spec, robot.name)
    _check_home(robot, spec.compile())
    if not suite.cameras:
        raise BadSuite(f"cameras is empty; {robot.name} has {', '.join(sorted(rigs))}")
    for camera in suite.cameras:
        if camera not in rigs:
            raise one_of(f"suite {suite.name}: camera", camera, sorted(rigs))


def _checked_rows(
    suite: Suite, make_rows: Callable[[], object], path: Path
) -> tuple[EpisodeRow, ...]:
    """The suite's list, once it names only what exists. Raises: BadSuite."""
    try:
        if not suite.environment:
            _check_robot(suite)
        for task in suite.tasks:
            check_wording(task)
        names = [task.name for task in suite.tasks]
        if len(set(names)) < len(names):
            raise BadSuite(f"two tasks of {', '.join(names)} have one name; rename one")
        mend = "return episodes made by SUITE.row(task, episode, placements)"
        made = make_rows()
        if not isinstance(made, Iterable):
            raise BadSuite(f"rows() returned {type(made).__name__}; {mend}")
        rows = []
        for row in made:
            if not isinstance(row, EpisodeRow):
                raise BadSuite(f"rows() returned {type(row).__name__} as an episode; {mend}")
            rows.append(row)
        lists.check(rows, suite)
        keys = [row.key for row in rows]
        for i, row in enumerate(rows):
            suite.task(row.task)
            if suite.environment:
                continue
            first, *_ = [objects.get_object(place.model) for place in row.placements]
            if first.category != row.category:
                raise BadSuite(
                    f"row {row.key}: its first object, the target, is {first.name}, a "
                    f"{first.category}, and the task's category is {row.category!r}; place the "
                    "target first, or correct the category"
                )
            if row.suite != suite.name or keys.index(row.key) < i:
                raise BadSuite(f"row {row.key} is there twice, or of another suite; {mend}")
            if row.seed != 0:
                raise BadSuite(
                    f"row {row.key} has seed={row.seed}; leave it 0: seeds come from --seed"
                )
        for name in set(names) - {row.task for row in rows}:
            raise BadSuite(f"task {name} has no row")
    except (Exception, SystemExit) as error:  # rows() is the user's: anything may come of it
        raise BadSuite(f"suites: {_place(path, path.resolve(), error)}: {_said(error)}") from error
    return tuple(rows)


def _digest(rows: Iterable[EpisodeRow]) -> str:
    digest = hashlib.sha256()
    for row in rows:
        digest.update(lists.to_line(row).encode())
        start = repr(row.start)
        if start != repr(AS_LISTED):
            digest.update(start.encode())
    return digest.hexdigest()


def check_wording(task: Task) -> None:
    """Refuse an instruction that does not name one personal object, of the task's category.

    Raises: BadSuite, naming the task.
    """
    where = f"task {task.name}: the instruction {task.instruction!r}"
    mend = f'write "my {task.category}" in it once, or correct the category'
    try:
        targets = parse(task.instruction, (task.category,)).targets
    except BadInstruction:
        raise BadSuite(f"{where} names no personal object; {mend}.") from None
    named = [target.category for target in targets]
    if named != [task.category]:
        asked = " and ".join(f"my {category}" for category in named)
        raise BadSuite(f"{where} asks for {asked}, and the category is {task.category!r}; {mend}.")
