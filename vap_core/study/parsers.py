"""Paraphrased instructions, and how well parsers find the object each means (P tab:llm_parser).

A family is one sentence with places to fill in (data/paraphrases). Its part says what it was used
for: the parser `embedding` was made with "tune"; "check-1" to "check-4" were held out, scored once,
and then looked at; "test" is held out.
"""

import csv
import json
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from datetime import datetime, timedelta
from functools import cache
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vap_core.base.errors import BadEndpoint, BadStudy, VapError, one_of
from vap_core.base.files import DATA, code_version
from vap_core.base.types import Description, Instruction, PersonalObject, value
from vap_core.instruction import Parser
from vap_core.instruction.context import Context, Use
from vap_core.instruction.parsers import load_parser
from vap_core.memory import recall
from vap_core.simulation.types import EpisodeRow
from vap_core.study import charts
from vap_core.study.measurement import Row
from vap_core.study.stats import resampled_mean, share
from vap_core.study.store import encode_table, publish_tables
from vap_core.study.table import printed

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

FOLDER = DATA / "paraphrases"
KINDS = ("explicit", "implicit", "negated", "owner", "history", "none")
PARTS = ("tune", "check-1", "check-2", "check-3", "check-4", "test")
SENTENCES_EACH = 4
"""So many sentences of a family are made in a suite, or one for every object if these are more."""
NOW = datetime(2026, 6, 12, 15, 0)


@value
class Paraphrase:
    """One instruction in its context, and what it means.

    `object` is the name of the object that is meant, None where there is none. `start` is where its
    expression begins, and `kept` the part of the command that a rewrite must keep.
    """

    suite: str
    family: str
    kind: str
    part: str
    text: str
    object: str | None
    start: int
    kept: str
    context: Context


@cache
def read_vocabulary() -> dict[str, Any]:
    """The suites' objects, what they are for and look like, and other things."""
    return json.loads((FOLDER / "objects.json").read_text("utf-8"))


def suite_names() -> tuple[str, ...]:
    """The suites that have paraphrases."""
    return tuple(read_vocabulary()["suites"])


def read_families() -> list[dict[str, str]]:
    """Every template family, a row of families.csv each."""
    with (FOLDER / "families.csv").open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def paraphrases(suite: str, part: str) -> list[Paraphrase]:
    """Every paraphrase of a suite's personal instructions from the families of one part."""
    found = []
    for number, family in enumerate(read_families()):
        if family["part"] == part:
            found += list(_of_family(suite, family, number))
    return found


ALONE = re.compile(r"[^{]*\{do\} \[(.+)\] \{where\}[^{]*")
"""A sentence whose expression says by itself what is meant."""


def implicit_instruction(row: EpisodeRow) -> tuple[str, Context]:
    """A row's instruction with an expression in place of "my CATEGORY", and its context.

    The expression says what the object is for, or when it was used; its family is held out, and
    each episode of a task has the next one.

    Raises: BadStudy: the target has no paraphrases.
    """
    vocabulary = read_vocabulary()
    of_target = {about["first"]["object"]: key for key, about in vocabulary["objects"].items()}
    key = of_target.get(row.target)
    if key is None:
        raise BadStudy(f"vap-implicit: {FOLDER} has no paraphrases of {row.target}.")
    suite = next(s for s, about in vocabulary["suites"].items() if key in about["objects"])
    alone = [
        (family, found[1])
        for family in read_families()
        if (family["part"], family["memory"]) == ("test", "own")
        and family["kind"] in ("implicit", "history")
        and (found := ALONE.fullmatch(family["text"]))
    ]
    family, template = alone[row.episode % len(alone)]
    said = _fill(template, _words(key, family, False, row.episode))
    category = vocabulary["objects"][key]["category"]
    text = row.instruction.replace(f"my {category}", said, 1)
    return text, _context(suite, family, row.target)


def read_implicit(row: EpisodeRow) -> Instruction:
    """What the parser `embedding` reads in `implicit_instruction` of the row.

    Raises: as that; BadInstruction, UnknownName, where the parser abstains.
    """
    text, context = implicit_instruction(row)
    return load_parser("embedding", context)(text)


def _of_family(suite: str, family: Mapping[str, str], number: int) -> Iterator[Paraphrase]:
    vocabulary = read_vocabulary()
    keys = vocabulary["suites"][suite]["objects"]
    actions = vocabulary["suites"][suite]["actions"]
    said = set()
    for i in range(max(SENTENCES_EACH, len(keys))):
        key = keys[i % len(keys)]
        action = actions[(i // len(keys) + i + number) % len(actions)]
        second = family["memory"] == "double" and (i // len(keys) + i + number) % 2 == 1
        marked = _fill(family["text"], _words(key, family, second, i + number) | action)
        if marked in said:
            continue
        said.add(marked)
        meant = _meant(key, family, second)
        yield Paraphrase(
            suite=suite,
            family=family["family"],
            kind=family["kind"],
            part=family["part"],
            text=marked.replace("[", "").replace("]", ""),
            object=meant,
            start=max(marked.find("["), 0),
            kept=action["where"] if "{where}" in family["text"] else "",
            context=_context(suite, family, meant),
        )


def _fill(template: str, words: Mapping[str, str]) -> str:
    """The sentence, with a capital only where the template has one, and single spaces."""
    text = " ".join(template.format(**words).split())
    text = re.sub(r"\s+([,.;:?!])", r"\1", text)
    text = re.sub(r",(?=[.]|$)", "", text)
    return text


def _words(key: str, family: Mapping[str, str], second: bool, turn: int) -> dict[str, str]:
    vocabulary = read_vocabulary()
    about = vocabulary["objects"][key]
    part = family["part"]
    this, other = ("second", "first") if second else ("first", "second")
    category = about["category"]
    words = {
        "category": category,
        "plural": f"{category}es" if category.endswith("ch") else f"{category}s",
        "adjective": about[this]["adjective"],
        "with": about[this]["with"],
        "other_adjective": about[other]["adjective"],
        "other_with": about[other]["with"],
        **about["purpose"][part],
    }
    for one, many in (
        ("prop", "props"),
        ("absent", "absent"),
        ("room", "rooms"),
        ("unknown", "unknown"),
    ):
        words[one] = vocabulary[many][part][turn % len(vocabulary[many][part])]
    words["question"] = vocabulary["questions"][part][turn % len(vocabulary["questions"][part])]
    return words


def _meant(key: str, family: Mapping[str, str], second: bool) -> str | None:
    """The name of the object that is meant."""
    about = read_vocabulary()["objects"][key]
    if not family["means"]:
        return None
    if family["memory"] == "double":
        return str(about["second" if second else "first"]["object"])
    owner = family["speaker"]
    if family["means"] == "theirs":
        owner = "anna" if owner == "ben" else "ben"
    return str(about["second" if owner == "ben" else "first"]["object"])


def _context(suite: str, family: Mapping[str, str], meant: str | None) -> Context:
    """The memory, and a history in which the object that is meant was used as the family says."""
    vocabulary = read_vocabulary()
    objects = {}
    for other in vocabulary["suites"][suite]["objects"]:
        which = ["first"] if family["memory"] == "own" else ["first", "second"]
        for place in which:
            owner = "ben" if family["memory"] == "shared" and place == "second" else "anna"
            obj = _object(other, place, owner)
            objects[obj.name] = obj
    return Context(
        objects=objects,
        speaker=family["speaker"],
        uses=_uses(objects, meant, family) if family["kind"] == "history" else (),
        now=NOW,
    )


def _uses(
    objects: Mapping[str, PersonalObject], meant: str | None, family: Mapping[str, str]
) -> tuple[Use, ...]:
    """Uses of everything: the one that is meant is its user's last, on the day that is said.

    Whoever else there is used other things afterwards; where a category is said, so did the user.
    """
    assert meant is not None
    user = objects[meant].owner if family["memory"] == "shared" else family["speaker"]
    yesterday = NOW - timedelta(days=1)
    said_day = yesterday if "yesterday" in family["text"].lower() else NOW
    uses = []
    others = [name for name in objects if name != meant]
    for i, name in enumerate(others):
        uses.append(Use(name, user, (said_day - timedelta(hours=5, minutes=i)).isoformat()))
    uses.append(Use(meant, user, (said_day - timedelta(hours=3)).isoformat()))
    different = [name for name in others if objects[name].category != objects[meant].category]
    if said_day == yesterday and different:
        uses.append(Use(different[0], user, (NOW - timedelta(hours=4)).isoformat()))
    if "{category}" in family["text"] and different:
        uses.append(Use(different[-1], user, (said_day - timedelta(hours=2)).isoformat()))
    if family["memory"] == "shared":
        theirs = [name for name in others if objects[name].owner != user]
        them = objects[theirs[0]].owner
        uses.append(Use(theirs[0], them, (NOW - timedelta(hours=1)).isoformat()))
    return tuple(sorted(uses, key=lambda use: use.at))


@cache
def _object(key: str, place: str, owner: str) -> PersonalObject:
    """A remembered object in words; its one reference is empty."""
    about = read_vocabulary()["objects"][key]
    people = read_vocabulary()["people"]
    return PersonalObject(
        name=about[place]["object"],
        category=about["category"],
        embeddings=np.ones((1, 1), np.float32),
        crops=(np.zeros((1, 1, 3), np.uint8),),
        encoder="none",
        description=Description(about[place]["short"], about[place]["long"]),
        owner=owner,
        known_as=tuple(people[owner]),
        note=about["note"] if place == "first" else "",
    )


@dataclass(frozen=True)
class ParserMeasurement:
    """The answers of parsers to every paraphrase; to the first `limit` of a suite and part.

    A parser is a name that `load_parser` knows.

    Raises: UnknownName for a suite or a part that there is not; BadStudy for no parser.
    """

    parsers: tuple[str, ...] = ("rule", "embedding")
    suites: tuple[str, ...] = ()
    parts: tuple[str, ...] = PARTS
    limit: int | None = None

    def __post_init__(self) -> None:
        if not self.parsers:
            raise BadStudy(
                "measure parsers: no parser is named; name one, or leave the option out for the "
                "default, rule,embedding."
            )
        for what, given, known in (
            ("suite", self.suites, suite_names()),
            ("part", self.parts, PARTS),
        ):
            for name in given:
                if name not in known:
                    raise one_of(f"measure parsers: {what}", name, known)

    def rows(self) -> list[Row]:
        """A row per parser and paraphrase: `found` are the names of the objects that it finds, with
        commas; "" where it abstains, and `error` says why. `right` says whether that is the object
        that is meant, or whether it abstains where none is. `kept` says whether the expression
        begins where it should and leaves the rest of the command.

        Raises: BadEndpoint: a parser's server fails, which is no abstention.
        """
        return [
            _answer(name, load_parser(name, paraphrase.context), paraphrase)
            for name in self.parsers
            for suite in self.suites or suite_names()
            for part in self.parts
            for paraphrase in paraphrases(suite, part)[: self.limit]
        ]


def paraphrase_digest() -> str:
    """A digest of what the paraphrases are made from."""
    found = sha256()
    for path in (FOLDER / "families.csv", FOLDER / "objects.json"):
        found.update(path.read_bytes())
    return found.hexdigest()[:16]


def _answer(name: str, parser: Parser, paraphrase: Paraphrase) -> Row:
    context = paraphrase.context
    categories = {obj.category for obj in context.objects.values()}
    found: list[str] = []
    error = ""
    kept = True
    try:
        parsed = parser(paraphrase.text, categories)
        found = [
            recall(context.objects, target, speaker=context.speaker).name
            for target in parsed.targets
        ]
        kept = _keeps(parsed, paraphrase)
    except BadEndpoint:
        raise
    except VapError as problem:
        error = str(problem)
        found = []
    meant = paraphrase.object or ""
    about = {
        name: getattr(paraphrase, name) for name in ("suite", "part", "kind", "family", "text")
    }
    answer = {"meant": meant, "found": ",".join(found), "right": found == [meant][: bool(meant)]}
    return {"parser": name, **about, **answer, "kept": kept, "error": error}


def _keeps(parsed: Instruction, paraphrase: Paraphrase) -> bool:
    target = parsed.targets[0]
    rest = f"{parsed.text[: target.start]}|{parsed.text[target.stop :]}"
    return target.start == paraphrase.start and paraphrase.kept in rest


TABLE = "parsers.parquet"
ALL = "all"
NOTE = (
    "right: the object that is meant is found, or none where none is meant; [95 %: Wilson; "
    "families resampled]. wrong object: another is found. kept: of those right, the rewrite "
    "keeps the rest of the command."
)


def accuracy(answers: "pd.DataFrame") -> "pd.DataFrame":
    """A line per parser, part and kind: how often it is `right` (with Wilson's interval; `low` and
    `high` resample whole template families), abstains, finds a wrong object, and, of those right,
    keeps the rest of the command.
    """
    import pandas as pd

    lines = []
    for (parser, part), group in answers.groupby(["parser", "part"], sort=False):
        for kind in (*KINDS, ALL):
            rows = group if kind == ALL else group[group["kind"] == kind]
            if rows.empty:
                continue
            silent, right = rows["found"] == "", rows["right"].astype(bool)
            families = right.groupby(rows["family"]).agg(["sum", "size"])
            over = resampled_mean(families, least=0.0)
            line = dict(parser=parser, part=part, kind=kind, families=len(families), n=len(rows))
            line |= dict(right=share(right), abstains=share(silent))
            line["wrong object"] = share(~silent & ~right)
            line["kept"] = share(rows["kept"][right & ~silent])
            lines.append({**line, "low": max(over.low, 0.0), "high": min(over.high, 1.0)})
    return pd.DataFrame(lines)


def text(answers: "pd.DataFrame") -> str:
    """Accuracy by parser, part and kind, and what happens where no personal object is meant."""
    found = accuracy(answers)
    shown = found.drop(columns=["low", "high"])
    ends = zip(found["right"], found["low"], found["high"], strict=True)
    shown["right"] = [f"{right} [{100 * low:.0f}, {100 * high:.0f}]" for right, low, high in ends]
    for name in ("abstains", "wrong object", "kept"):
        shown[name] = ["-" if not each.n else f"{100 * each.value:.0f} %" for each in found[name]]
    return f"{printed(shown)}\n{NOTE}"


def accuracy_figure(found: "pd.DataFrame", theirs: "pd.Series[float]", title: str) -> "Figure":
    """Accuracy of every parser by kind, 95 % over families; `theirs` are the paper's of implicit
    instructions by task, in %, drawn at their mean.
    """
    shown = found.assign(value=[each.value for each in found["right"]], paper=float("nan"))
    shown.loc[shown["kind"] == "implicit", "paper"] = theirs.mean() / 100
    shown["kind"] += ", n " + shown["n"].astype(str)
    label = (
        "% of held-out sentences that are understood, 95 % interval over families\n"
        f"diamond: the paper's GPT-4o-mini, {theirs.min()} to {theirs.max()} by task"
    )
    return charts.dots(shown, "kind", series="parser", label=label, title=title)


def publish(table: "pd.DataFrame", to: Path) -> list[Path]:
    """Write every answer, with its provenance, as parsers.parquet. Raises: BadOutput."""
    import pyarrow as pa

    about = {"code": code_version(), "paraphrases": paraphrase_digest()}
    arrow = pa.Table.from_pandas(table, preserve_index=False)
    metadata = {**(arrow.schema.metadata or {}), b"about": json.dumps(about).encode()}
    data = encode_table(arrow.replace_schema_metadata(metadata))
    return publish_tables({TABLE: data}, to, "measure parsers")
