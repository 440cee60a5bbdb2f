"""Paraphrased instructions, and how well parsers find the object each means (P tab:llm_parser).

A family is one sentence with places to fill in (data/paraphrases). Its part says what it was used
for: the parser `embedding` was made with "tune"; "check-1" to "check-4" were held out, scored once,
and then looked at; "test" is held out.
"""

import csv
import json
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict
from datetime import datetime, timedelta
from functools import cache
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vap_core.base.errors import BadEndpoint, VapError
from vap_core.base.files import DATA, Rows, align, code_version
from vap_core.base.types import Description, Instruction, PersonalObject, value
from vap_core.instruction import Parser
from vap_core.instruction.context import Context, Use
from vap_core.memory import recall
from vap_core.study.stats import bootstrap_interval, rate
from vap_core.study.store import encode_table, publish_tables

if TYPE_CHECKING:
    import pandas as pd

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
    vocabulary: dict[str, Any] = json.loads((FOLDER / "objects.json").read_text("utf-8"))
    return vocabulary


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


def _of_family(suite: str, family: Mapping[str, str], number: int) -> Iterator[Paraphrase]:
    vocabulary = read_vocabulary()
    keys = vocabulary["suites"][suite]["objects"]
    actions = vocabulary["suites"][suite]["actions"]
    said = set()
    for i in range(max(SENTENCES_EACH, len(keys))):
        key = keys[i % len(keys)]
        action = actions[(i // len(keys) + i + number) % len(actions)]
        second = family["memory"] == "double" and (i // len(keys) + i + number) % 2 == 1
        words = _words(key, family, second, i + number) | action
        marked = _fill(family["text"], words)
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


@value
class Answer:
    """What a parser makes of one paraphrase.

    `found` are the names of the objects that it finds, with commas; "" where it abstains, and
    `error` says why. `right` says whether that is the object that is meant, or whether it abstains
    where none is. `kept` says whether the expression begins where it should and leaves the rest of
    the command.
    """

    parser: str
    suite: str
    part: str
    kind: str
    family: str
    text: str
    meant: str
    found: str
    right: bool
    kept: bool
    error: str


def measure(
    name: str,
    load: Callable[[Context], Parser],
    suites: Sequence[str],
    parts: Sequence[str],
    limit: int | None = None,
) -> list[Answer]:
    """The answers of a parser to every paraphrase; to the first `limit` of a suite and part.

    Raises: BadEndpoint: the parser's server fails, which is no abstention.
    """
    answers = []
    for suite in suites:
        for part in parts:
            for paraphrase in paraphrases(suite, part)[:limit]:
                answers.append(_answer(name, load(paraphrase.context), paraphrase))
    return answers


def answer_table(answers: Sequence[Answer]) -> "pd.DataFrame":
    """One row an answer."""
    import pandas as pd

    return pd.DataFrame([asdict(answer) for answer in answers])


def paraphrase_digest() -> str:
    """A digest of what the paraphrases are made from."""
    found = sha256()
    for path in (FOLDER / "families.csv", FOLDER / "objects.json"):
        found.update(path.read_bytes())
    return found.hexdigest()[:16]


def _answer(name: str, parser: Parser, paraphrase: Paraphrase) -> Answer:
    context = paraphrase.context
    categories = {obj.category for obj in context.objects.values()}
    found: list[str] = []
    error = ""
    kept = True
    try:
        parsed = parser(paraphrase.text, categories)
        for target in parsed.targets:
            found.append(recall(context.objects, target, speaker=context.speaker).name)
        kept = _keeps(parsed, paraphrase)
    except BadEndpoint:
        raise
    except VapError as problem:
        error = str(problem)
        found = []
    meant = [] if paraphrase.object is None else [paraphrase.object]
    return Answer(
        parser=name,
        suite=paraphrase.suite,
        part=paraphrase.part,
        kind=paraphrase.kind,
        family=paraphrase.family,
        text=paraphrase.text,
        meant=paraphrase.object or "",
        found=",".join(found),
        right=found == meant,
        kept=kept,
        error=error,
    )


def _keeps(parsed: Instruction, paraphrase: Paraphrase) -> bool:
    target = parsed.targets[0]
    rest = f"{parsed.text[: target.start]}|{parsed.text[target.stop :]}"
    return target.start == paraphrase.start and paraphrase.kept in rest


TABLE = "parsers.parquet"
ALL = "all"


def text(table: "pd.DataFrame") -> str:
    """Accuracy by parser, part and kind, and what happens where no personal object is meant."""
    notes = (
        "right: the object that is meant is found, or none where none is meant; [95 %: Wilson; "
        "families resampled]. wrong object: another is found. kept: of those right, the rewrite "
        "keeps the rest of the command."
    )
    return f"{align(rows(table))}\n{notes}"


def rows(table: "pd.DataFrame") -> Rows:
    """A line per parser, part and kind; the header first."""
    lines = [
        ["parser", "part", "kind", "families", "n", "right", "abstains", "wrong object", "kept"]
    ]
    for (parser, part), group in table.groupby(["parser", "part"], sort=False):
        for kind in (*KINDS, ALL):
            of_kind = group if kind == ALL else group[group["kind"] == kind]
            if len(of_kind):
                lines.append([str(parser), str(part), kind, *_cells(of_kind)])
    return lines


def publish(table: "pd.DataFrame", to: Path) -> list[Path]:
    """Write every answer, with its provenance, as parsers.parquet. Raises: BadOutput."""
    import pyarrow as pa

    about = {"code": code_version(), "paraphrases": paraphrase_digest()}
    arrow = pa.Table.from_pandas(table, preserve_index=False)
    metadata = {**(arrow.schema.metadata or {}), b"about": json.dumps(about).encode()}
    data = encode_table(arrow.replace_schema_metadata(metadata))
    return publish_tables({TABLE: data}, to, "measure parsers")


def _cells(group: "pd.DataFrame") -> list[str]:
    families = group.groupby("family")["right"].agg(["sum", "count"])
    gain = families["sum"].to_numpy(float)
    n = families["count"].to_numpy(float)
    low, high = bootstrap_interval(gain, n, least=0.0)
    right = rate(int(group["right"].sum()), len(group))
    silent = group["found"] == ""
    wrong = ~silent & ~group["right"]
    kept = group[group["right"] & ~silent]["kept"]
    whole = np.round(100 * np.clip([low, high], 0, 1)).astype(int)
    return [
        str(len(families)),
        str(len(group)),
        f"{right} [{whole[0]}, {whole[1]}]",
        f"{100 * silent.mean():.0f} %",
        f"{100 * wrong.mean():.0f} %",
        f"{100 * kept.mean():.0f} %" if len(kept) else "-",
    ]
