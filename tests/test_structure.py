"""The structure of the package: few entries at the top, imports in one direction."""

import ast
import builtins
import dis
import json
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from types import CodeType

import pytest

import vap_core

ROOT = Path(vap_core.__file__).parent
MAKE = ROOT.parent / "vap_make"
"""How shipped parts are made: no module of the core imports it but commands, when they are called."""
METHOD = ("memory", "instruction", "vote", "associate", "prompt", "attend")
LAYERS = (
    ("base",),
    ("perception",),
    METHOD,
    ("simulation",),
    ("environments",),
    ("policies",),
    ("rollout",),
    ("recording",),
    ("study",),
    ("serve",),
    ("contracts",),
    ("notebook",),
    ("cli",),
)
"""From the bottom up: a module imports from its own layer and those before it."""
SOLE_IMPORTERS = {
    "rerun": ("recording",),
    "lerobot": ("policies", "cli"),
    "transformers": ("perception.foundation", "policies"),
}


def modules(root: Path = ROOT) -> dict[str, Path]:
    found = {}
    for path in root.rglob("*.py"):
        parts = path.relative_to(root).with_suffix("").parts
        found[".".join(part for part in parts if part != "__init__")] = path
    return found


@cache
def imported(path: Path) -> set[str]:
    """Every module or name that a file imports, in dotted form; those for type checkers only count as well."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
        elif isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
    return names


def arrows() -> dict[str, set[str]]:
    """Which modules of the package each module imports."""
    known = modules()
    graph: dict[str, set[str]] = {}
    for name, path in known.items():
        if name in ("", "__main__"):  # the public names of everything, and the command line
            continue
        graph[name] = set()
        for dotted in imported(path):
            if not dotted.startswith("vap_core."):
                continue
            inside = dotted.removeprefix("vap_core.")
            target = inside if inside in known else inside.rpartition(".")[0]
            if target in known and target not in ("", name):
                graph[name].add(target)
    return graph


def layer(module: str) -> int:
    top = module.partition(".")[0]
    return next(i for i, names in enumerate(LAYERS) if top in names)


def test_the_package_shows_at_most_20_entries() -> None:
    entries = {path.name for path in ROOT.iterdir()} - {"__pycache__", "py.typed"}
    assert len(entries) <= 20, sorted(entries)
    folders = {path.name for path in ROOT.iterdir() if path.is_dir()} - {"__pycache__"}
    assert folders == {name for names in LAYERS if names != METHOD for name in names} - {
        "notebook"
    } | {"instruction"}


def test_imports_point_to_lower_layers_only() -> None:
    wrong = []
    for module, targets in arrows().items():
        wrong += [f"{module} -> {name}" for name in targets if layer(name) > layer(module)]
    assert not wrong, "\n".join(sorted(wrong))


def test_no_module_imports_itself_by_a_detour() -> None:
    graph = arrows()
    done: set[str] = set()

    def visit(module: str, path: tuple[str, ...]) -> None:
        assert module not in path, " -> ".join([*path[path.index(module) :], module])
        if module in done:
            return
        for target in sorted(graph[module]):
            if not module.startswith(f"{target}.") and not target.startswith(f"{module}."):
                visit(target, (*path, module))
        done.add(module)

    for module in sorted(graph):
        visit(module, ())


def test_heavy_libraries_have_their_place() -> None:
    for name, path in modules().items():
        for dotted in imported(path):
            assert not dotted.startswith("vap_make") or name.startswith("cli."), name
            places = SOLE_IMPORTERS.get(dotted.partition(".")[0])
            assert places is None or name.startswith(places), f"{name} imports {dotted}"


def test_a_notebook_imports_the_surface_and_at_most_three_more_modules() -> None:
    for path in sorted((ROOT.parent / "notebooks").glob("*.ipynb")):
        used = set()
        for cell in json.loads(path.read_text())["cells"]:
            if cell["cell_type"] != "code":
                continue
            for line in cell["source"]:
                if line.startswith("from vap_core"):
                    used.add(line.split()[1])
        assert len(used - {"vap_core"}) <= 3, (path.name, sorted(used))


def test_every_module_named_outside_the_package_is_there() -> None:
    """The set-up, the pages and the build name modules in text that no import checks."""
    root = ROOT.parent
    texts = [*(root / ".ci").iterdir(), *root.glob("docs/*.md"), *root.glob("*.md")]
    texts += [root / name for name in ("Makefile", "pyproject.toml", "setup.py")]
    known = modules() | {f"vap_make.{name}": path for name, path in modules(MAKE).items()}
    missing = set()
    for path in texts:
        for dotted in re.findall(r"\b(vap_(?:core|make)(?:\.\w+)+)\b", path.read_text()):
            name = dotted.removeprefix("vap_core.")
            if name not in known and dotted != "vap_make.py":
                at, _, leaf = name.rpartition(".")
                if at not in known or leaf not in known[at].read_text().split():
                    missing.add(f"{path.name}: {dotted}")
    assert not missing, sorted(missing)


def codes(code: CodeType) -> Iterator[CodeType]:
    yield code
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from codes(constant)


def undefined(source: str) -> set[str]:
    """The names that functions of a module read and nothing in it defines; imports for type checkers alone define nothing."""
    tree = ast.parse(source)
    tree.body = [
        node
        for node in tree.body
        if not (isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING")
    ]
    module = compile(tree, "module", "exec")
    defined = {*vars(builtins), "__file__"}
    read = set()
    for code in codes(module):
        for each in dis.get_instructions(code):
            if each.opname == "STORE_GLOBAL" or (code is module and each.opname == "STORE_NAME"):
                defined.add(each.argval)
            elif each.opname == "LOAD_GLOBAL":
                read.add(each.argval)
    return read - defined


def test_every_name_is_defined() -> None:
    """The linter and the type checker are not asked: shapes in annotations are names to them."""
    both = modules() | {f"vap_make.{name}": path for name, path in modules(MAKE).items()}
    found = {name: undefined(path.read_text()) for name, path in both.items()}
    assert {name: names for name, names in found.items() if names} == {}


@pytest.mark.parametrize(
    ("source", "names"),
    [
        ("import sys\ndef f(): return sys", set()),
        ("def f(): return sys", {"sys"}),
        ("class A:\n    def f(self): return [sys for _ in self]", {"sys"}),
        ("if TYPE_CHECKING:\n    import sys\ndef f(x: 'sys'): return 1", set()),
        ("if TYPE_CHECKING:\n    import sys\ndef f(): return sys", {"sys"}),
    ],
)
def test_a_name_without_a_definition_is_found(source: str, names: set[str]) -> None:
    assert undefined(source) == names
