"""Which code is running: results and recordings carry it beside their numbers."""

import ast
import hashlib
import inspect
import subprocess
from collections.abc import Collection
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any


@cache
def code_version(folder: Path | None = None) -> str:
    """The commit of a checkout (default: this one), with `+` when the tree differs.

    Where there is none, the installed version; "unknown" for a copy that is neither.
    """
    folder = folder or Path(__file__).resolve().parent
    try:
        if not _git(folder, "ls-files"):  # installed inside another project's repository
            return _installed_version()
        return _git(folder, "describe", "--always", "--dirty=+", "--abbrev=10")
    except (OSError, subprocess.SubprocessError):
        return _installed_version()


def _git(folder: Path, *words: str) -> str:
    done = subprocess.run(
        ["git", *words], cwd=folder, capture_output=True, text=True, timeout=10, check=True
    )
    return done.stdout.strip()


def code_digest(folder: Path, without: Collection[str] = ()) -> str:
    """A digest of a module, or of those below a folder but for the ones named in `without`.

    Comments, docstrings and line breaks do not count.
    """
    found = hashlib.sha256()
    paths = [folder] if folder.is_file() else sorted(folder.rglob("*.py"))
    for path in paths:
        if path.stem in without:
            continue
        found.update(path.relative_to(folder).as_posix().encode())
        found.update(ast.dump(_without_docstrings(ast.parse(path.read_text()))).encode())
    return found.hexdigest()[:16]


def source_digest(form: Any) -> str:
    """A digest of the source of a function, or of the class of a callable and of its bases.

    What has no source, because it is built in or typed into a console, is left out; "" where
    nothing has any.
    """
    if inspect.isroutine(form) or inspect.isclass(form):
        parts: tuple[Any, ...] = (form,)
    else:
        parts = type(form).__mro__
    source = ""
    for part in parts:
        try:
            source += inspect.getsource(part)
        except (OSError, TypeError):
            continue
    return hashlib.sha256(source.encode()).hexdigest()[:16] if source else ""


def _installed_version() -> str:
    try:
        return f"vap-core {version('vap-core')}"
    except PackageNotFoundError:
        return "unknown"


def _without_docstrings(tree: ast.Module) -> ast.Module:
    for node in ast.walk(tree):
        body = getattr(node, "body", None)
        if not isinstance(body, list):
            continue
        node.body = [part for part in body if not _is_string(part)]  # type: ignore[attr-defined]
    return tree


def _is_string(node: ast.AST) -> bool:
    return (
        isinstance(node, ast.Expr)
        and isinstance(node.value, ast.Constant)
        and isinstance(node.value.value, str)
    )
