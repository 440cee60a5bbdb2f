"""README, docs/ and the cards: their links lead somewhere, their commands and code are there."""

import ast
import importlib
import re
import shlex
from itertools import pairwise
from pathlib import Path, PurePosixPath
from typing import Any

import pytest
import typer

from tests.pages import FENCE, PAGES, ROOT, blocks, commands, spans
from tests.test_notebooks import anchors as headings
from tests.test_stills import COMMITTED
from vap_core.cli import app
from vap_core.contracts import plugin
from vap_core.perception.stacks import STACKS, check_stack
from vap_core.simulation.suites import ELSEWHERE, SUITES
from vap_core.study import methods
from vap_core.study.methods import known_methods

MADE_LATER = ("data/runs", "data/memory", "data/objects", "data/cache", "data/photos")
"""Folders that commands make, and that do not ship."""
RECORD = "data/policies/README.md"
"""The card of the shipped policies names the commands of their day, which are no more."""
HISTORY = "CHANGELOG.md"
HUB_OPTIONS = {"--repo-type", "--local-dir"}
"""Of `hf download`."""
CONTRACT_OPTIONS = set(re.findall(r'"(--[a-z-]+)"', Path(plugin.__file__).read_text()))
LINK = re.compile(r"\]\(([^)\s]+)\)")


def slug(heading: str) -> str:
    """The anchor that GitHub gives a heading."""
    plain = re.sub(r"[^\w\- ]", "", heading.strip().lower())
    return plain.replace(" ", "-")


def anchors(text: str) -> set[str]:
    found = re.findall(r"^#+ (.+)$", FENCE.sub("", text), re.MULTILINE)
    return {slug(heading) for heading in found}


def test_readme_leads_to_the_notebooks_that_its_steps_open() -> None:
    linked = set(LINK.findall(PAGES["README.md"]))
    assert {
        "notebooks/00_tour.ipynb",
        "notebooks/02_grounding_inspection.ipynb",
        "notebooks/00_tour.ipynb#All-notebooks",
    } <= linked
    assert "`notebooks/" not in PAGES["README.md"], "a name that is no link"


def test_the_methods_of_the_first_figure_are_named_below_it() -> None:
    result = PAGES["README.md"].split("## Start")[0]
    for method in ("generic", "hard-short", "hard-long", "soft", "oracle-mask", "wrong-mask"):
        assert method in result, method


def test_readme_names_every_page() -> None:
    linked = set(LINK.findall(PAGES["README.md"]))
    for page in PAGES:
        if page.startswith("docs/") or page.endswith("/README.md") or page == "CHANGELOG.md":
            assert page in linked


@pytest.mark.parametrize("page", PAGES)
def test_links_lead_somewhere(page: str) -> None:
    for link in LINK.findall(FENCE.sub("", PAGES[page])):
        if link.startswith("https://"):
            continue
        path, _, anchor = link.partition("#")
        target = (ROOT / page).parent / path if path else ROOT / page
        assert target.exists(), link
        if anchor and target.suffix == ".ipynb":
            assert anchor in headings(target), link
        elif anchor:
            assert anchor in anchors(target.read_text()), link


def find_command(words: list[str]) -> tuple[Any, list[str]]:
    """The command that the words name, and its arguments."""
    command: Any = typer.main.get_command(app)
    while hasattr(command, "commands"):
        name, *words = words
        assert name in command.commands, name
        command = command.commands[name]
    return command, words


def check_names(values: dict[str, object]) -> None:
    """Suites, methods and stacks exist; words in capitals, and Python files, stand for any."""
    methods = set(known_methods())
    known = {
        "suite": {*SUITES, *ELSEWHERE, "all"},
        "methods": methods,
        "method": methods,
        "stack": {*STACKS},
    }
    for option, names in known.items():
        given = values.get(option) or ()
        for text in (given,) if isinstance(given, str) else given:
            if option == "stack" and ":" in text:
                check_stack(text)
                continue
            for name in text.split(","):
                stands_for_any = name.isupper() or name.endswith(".py")
                assert stands_for_any or name in names, (option, name)


@pytest.mark.parametrize("page", [page for page in PAGES if page.startswith("docs/")])
def test_a_colon_is_followed_by_what_it_announces(page: str) -> None:
    paragraphs = re.split(r"\n\s*\n", FENCE.sub("```", PAGES[page]))
    for one, following in pairwise(paragraphs):
        if one.rstrip().endswith(":"):
            assert re.match(r"```|\||[-*>] |\d+\.|!\[", following.strip()), one[-80:]


@pytest.mark.parametrize("page", [page for page in PAGES if commands(page) and page != RECORD])
def test_commands_are_there(page: str) -> None:
    for line in commands(page):
        words = [word for word in shlex.split(line) if word != "..."]
        if not words:
            continue
        command, arguments = find_command(words)
        check_names(command.make_context(command.name, arguments).params)


def options(command: Any) -> set[str]:
    """All options of a command and of those below it."""
    found = {"--help"}
    for parameter in command.params:
        found.update(parameter.opts, parameter.secondary_opts)
    for each in getattr(command, "commands", {}).values():
        found |= options(each)
    return found


@pytest.mark.parametrize("page", [page for page in PAGES if page not in (RECORD, HISTORY)])
def test_options_are_there(page: str) -> None:
    known = options(typer.main.get_command(app)) | CONTRACT_OPTIONS | HUB_OPTIONS
    for span in spans(page):
        for option in re.findall(r"(?<!\S)--[a-z][\w.-]*", span):
            assert option in known or "." in option, span  # lerobot's have a dot


@pytest.mark.parametrize("page", [page for page in PAGES if blocks(page, "python")])
def test_imports_of_the_code_are_there(page: str) -> None:
    for block in blocks(page, "python"):
        if "import " not in block:
            continue
        for node in ast.walk(ast.parse(block)):
            if isinstance(node, ast.ImportFrom) and node.module:
                module = importlib.import_module(node.module)
                for name in node.names:
                    assert hasattr(module, name.name), (node.module, name.name)
            if isinstance(node, ast.Import):
                for name in node.names:
                    importlib.import_module(name.name)


def test_the_ablation_of_five_lines_is_one() -> None:
    (block,) = (block for block in blocks("docs/extend.md", "python") if "Ablation(" in block)
    assert len(block.splitlines()) == 5
    ((name, ablation),) = eval(f"{{{block}}}", vars(methods)).items()
    assert isinstance(ablation, methods.Ablation)
    assert name not in methods.ABLATIONS
    assert not set(ablation.arms) & set(known_methods())
    assert set(ablation.methods) <= set(known_methods())


@pytest.mark.parametrize("page", PAGES)
def test_files_are_there(page: str) -> None:
    for span in spans(page):
        path = PurePosixPath(span)
        if " " in span or path.parts[0] not in ("data", "notebooks", "tests", "figures", "docs"):
            continue
        if not span.startswith(MADE_LATER):
            assert list(ROOT.glob(span.rstrip("/"))), span


@pytest.mark.parametrize("page", [page for page in PAGES if "figures/" in PAGES[page]])
def test_a_page_names_the_notebook_or_command_that_draws_its_figures(page: str) -> None:
    for figure in re.findall(r"figures/([\w.]+\.png)", PAGES[page]):
        if figure.startswith("bench_"):
            assert f"bench {figure.removeprefix('bench_').removesuffix('.png')}`" in PAGES[page]
            continue
        (notebook,) = (ROOT / "notebooks").glob(f"{figure[:2]}_*.ipynb")
        assert f"notebooks/{notebook.name})" in PAGES[page], figure
        assert figure in COMMITTED or figure in notebook.read_text(), figure
