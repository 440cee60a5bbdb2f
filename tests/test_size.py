"""How much there is to read may only fall: lower a limit when a change has made it true."""

import ast
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest
import typer

from vap_core.cli import app

ROOT = Path(__file__).resolve().parents[1]
LIMITS = {
    "= vap_core": {"files": 196, "nodes": 243_340, "functions": 2_795},
    "= vap_make": {"files": 65, "nodes": 74_850, "functions": 790},
}
COMMANDS, OPTIONS = 21, 234


COUNTED = ("files", "code", "nodes", "functions")


def count(folders: Sequence[Path]) -> dict[str, dict[str, int]]:
    """Files, code lines, AST nodes and functions by folder, and their sum as "=".

    Docstrings are no code and no nodes, and Load, Store and Del no nodes: formatting changes
    nothing but the lines.
    """
    found: dict[str, dict[str, int]] = {}
    for top in folders:
        for path in sorted(top.rglob("*.py")):
            inner = path.relative_to(top).parts
            name = f"{top.name}/{inner[0]}" if len(inner) > 1 else top.name
            sizes = _size(path.read_text(encoding="utf-8"))
            for key in (name, f"= {top.name}"):
                row = found.setdefault(key, dict.fromkeys(COUNTED, 0))
                for column, value in sizes.items():
                    row[column] += value
    return found


def _size(text: str) -> dict[str, int]:
    tree, skipped, documented = ast.parse(text), set(), set()
    for node in ast.walk(tree):
        if not isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            continue
        if ast.get_docstring(node, clean=False) is not None:
            first = node.body[0]
            assert isinstance(first, ast.Expr)
            skipped |= {id(first), id(first.value)}
            documented |= set(range(first.lineno, (first.end_lineno or first.lineno) + 1))
    nodes = [
        node
        for node in ast.walk(tree)
        if id(node) not in skipped and not isinstance(node, ast.Load | ast.Store | ast.Del)
    ]
    lines = enumerate(text.splitlines(), 1)
    code = [s for n, line in lines if (s := line.strip()) and s[0] != "#" and n not in documented]
    functions = [n for n in nodes if isinstance(n, ast.FunctionDef | ast.AsyncFunctionDef)]
    return {"files": 1, "code": len(code), "nodes": len(nodes), "functions": len(functions)}


def commands() -> dict[str, list[str]]:
    """Every command, and its options as --help shows them."""

    def leaves(command: Any, *above: str) -> Iterator[tuple[str, list[str]]]:
        inner = getattr(command, "commands", {})
        for name, each in inner.items():
            yield from leaves(each, *above, name)
        if not inner:
            options = [p.opts[0] for p in command.params if p.param_type_name == "option"]
            yield " ".join(above), options

    return dict(leaves(typer.main.get_command(app)))


def test_nodes_do_not_change_by_formatting_and_docstrings() -> None:
    one = _size('"""A module."""\ndef f(a, b):\n    """Adds."""\n    return a + b\n')
    other = _size("def f(\n    a,\n    b,\n):\n    return (\n        a + b\n    )\n")
    assert (one["nodes"], one["functions"], one["code"]) == (10, 1, 2)
    assert (other["nodes"], other["code"]) == (one["nodes"], 7)


@pytest.mark.parametrize("folder", LIMITS)
def test_the_code_does_not_grow(folder: str) -> None:
    found = count([ROOT / folder.removeprefix("= ")])[folder]
    for name, limit in LIMITS[folder].items():
        assert found[name] <= limit, f"{found[name]:,} {name} in {folder}"


def test_commands_and_options_do_not_grow() -> None:
    listed = commands()
    assert len({name.split()[0] for name in listed}) <= COMMANDS
    assert sum(map(len, listed.values())) <= OPTIONS
