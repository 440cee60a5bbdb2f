"""docs/measured.md and its picture, made from the measurements that ship in data/results."""

from collections.abc import Callable
from pathlib import Path

from vap_core.base.files import DATA, write_atomic, writing
from vap_core.cli.bench import embeddings, eval_report, profile, scale_report
from vap_core.cli.bench.measurement import Measurement, Table, as_markdown, read

ROOT = DATA.parent
PAGE = ROOT / "docs" / "measured.md"
PICTURE = ROOT / "figures" / "bench_scale.png"
SECTIONS: dict[str, tuple[str, Callable[[Measurement], list[Table]]]] = {
    "eval": ("Against lerobot's own loop", eval_report.tables),
    "profile": ("Where the time of a control step goes", profile.tables),
    "scale": ("How the cost grows", scale_report.tables),
    "embeddings": ("Tables of PaliGemma's size", embeddings.tables),
}
"""The benchmarks of the page, in order: a heading, and the tables of a measurement."""
HEADER = """# What is measured

Made by `python -m vap_core bench measured` from `data/results/bench_*.json`; the commands below
write these by `--json FILE`, and what has not been measured is left out. Times are of the machine
that is named; compare ratios."""


CAPTION = "A bar stacks the medians of the parts; every black dot is one repeat as a whole."
"""Of the picture of `bench scale`."""


def shipped(bench: str) -> Path:
    """Where the measurement of a benchmark ships."""
    return DATA / "results" / f"bench_{bench}.json"


def page() -> str:
    """The text of docs/measured.md; what does not ship is left out. Raises: BadOutput."""
    parts = [HEADER]
    for bench, (heading, tables) in SECTIONS.items():
        if not shipped(bench).exists():
            continue
        measurement = read(shipped(bench))
        parts += [f"## {heading}", as_markdown(measurement, tables(measurement))]
        if bench == "scale":
            parts.append(f"![How the cost grows](../figures/{PICTURE.name})")
            parts.append(CAPTION)
    return "\n\n".join(parts) + "\n"


def run() -> str:
    """Write the page and the picture. Raises: BadOutput."""
    from vap_core.base.figures import write_png

    with writing(PAGE, "bench"):
        PAGE.parent.mkdir(exist_ok=True)
        write_atomic(PAGE, page().encode())
    if not shipped("scale").exists():
        return f"wrote {PAGE}"
    write_png(scale_report.figure(read(shipped("scale"))), PICTURE)
    return f"wrote {PAGE} and {PICTURE}"
