"""What README and docs/ say, taken apart for the tests that check it."""

import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


def read_pages() -> dict[str, str]:
    """Every page by its path in the repository: README, docs/, the changes and the data's cards."""
    found = [ROOT / "README.md", ROOT / "CHANGELOG.md"]
    found += sorted((ROOT / "docs").glob("*.md"))
    found += sorted((ROOT / "data").glob("*/*.md"))
    return {path.relative_to(ROOT).as_posix(): path.read_text() for path in found}


PAGES = read_pages()
TEXT = "\n\n".join(PAGES.values())
PROSE = " ".join(TEXT.split())
"""All pages without line breaks."""
FENCE = re.compile(r"^ *```(\w*)\n(.*?)^ *```$", re.DOTALL | re.MULTILINE)


def blocks(page: str, language: str) -> list[str]:
    """The fenced blocks of a page in one language."""
    return [text for found, text in FENCE.findall(PAGES[page]) if found == language]


def spans(page: str) -> list[str]:
    """The inline code of a page; lines are broken anywhere in it."""
    found = []
    for paragraph in re.split(r"\n\n|\n(?=\|)", FENCE.sub("", PAGES[page])):
        found += re.findall(r"`([^`]+)`", " ".join(paragraph.split()))
    return found


def commands(page: str) -> list[str]:
    """Every command of this package that a page names, without its comment."""
    lines = spans(page)
    for block in blocks(page, "bash") + blocks(page, ""):
        lines += block.splitlines()
    found = []
    for line in lines:
        said = re.search(r"\./vap (.*)", line)
        if said is not None:
            found.append(re.split(r"\s#\s", said[1])[0].strip())
    return found


def table(heading: str) -> list[list[str]]:
    """The cells of the one table that begins so, header first."""
    assert TEXT.count(heading) == 1, heading
    lines = TEXT[TEXT.index(heading) :].split("\n\n")[0].splitlines()
    cells = []
    for line in (lines[0], *lines[2:]):
        cells.append([cell.strip() for cell in line.strip("|").split("|")])
    return cells
