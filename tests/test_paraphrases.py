"""Paraphrased instructions by families, and the command that scores parsers on them."""

import json
import re
from collections import Counter
from pathlib import Path

import pandas as pd
import pyarrow.parquet as pq
import pytest

from tests.command import refused, vap
from vap_core.base.errors import BadEndpoint, BadInstruction, BadStudy, MissingWeights
from vap_core.base.types import Instruction, Target
from vap_core.instruction.context import Context
from vap_core.instruction.parsers import load_parser
from vap_core.rollout.prompters import TextPrompter
from vap_core.simulation import scenes, suites
from vap_core.simulation.assets.objects import get_object
from vap_core.simulation.suites import BENCHMARKS
from vap_core.study import parsers
from vap_core.study.methods import make_prompter
from vap_core.study.parsers import (
    KINDS,
    PARTS,
    Paraphrase,
    ParserMeasurement,
    implicit_instruction,
    paraphrase_digest,
    paraphrases,
    read_families,
    read_implicit,
    read_vocabulary,
    suite_names,
)

ROOT = Path(__file__).resolve().parents[1]
PUBLISHED = ROOT / "data" / "results" / parsers.TABLE


@pytest.fixture(scope="module")
def every() -> dict[str, list[Paraphrase]]:
    """The paraphrases of every suite."""
    found = {}
    for suite in suite_names():
        found[suite] = [one for part in PARTS for one in paraphrases(suite, part)]
    return found


def test_every_benchmark_has_over_200_paraphrases_of_every_kind(
    every: dict[str, list[Paraphrase]],
) -> None:
    assert set(every) == set(BENCHMARKS)
    for suite, found in every.items():
        assert len(found) >= 200
        assert len({(one.text, one.family) for one in found}) == len(found)
        held_out = Counter(one.kind for one in found if one.part == "test")
        assert set(held_out) == set(KINDS), suite


def test_no_family_and_no_purpose_is_in_two_parts() -> None:
    families = read_families()
    assert len({row["family"] for row in families}) == len(families)
    assert len({row["text"] for row in families}) >= len(families) - 8  # "{room}", "{question}"
    assert {row["part"] for row in families} == set(PARTS)
    for about in read_vocabulary()["objects"].values():
        said = Counter(phrase for part in PARTS for phrase in set(about["purpose"][part].values()))
        assert sum(said.values()) - len(said) <= 3, said


def test_what_is_meant_is_in_the_memory_and_in_the_catalogue(
    every: dict[str, list[Paraphrase]],
) -> None:
    for found in every.values():
        for one in found:
            assert (one.object is None) == (one.kind == "none")
            assert one.object is None or one.object in one.context.objects
            assert one.kept in one.text or one.kind == "none"
            assert "{" not in one.text
            assert "[" not in one.text
    for about in read_vocabulary()["objects"].values():
        for which in ("first", "second"):
            assert get_object(about[which]["object"]).category == about["category"]


def test_what_was_used_is_the_users_last_on_that_day(every: dict[str, list[Paraphrase]]) -> None:
    for found in every.values():
        for one in found:
            if one.kind != "history":
                continue
            used = one.context.objects[one.object or ""]
            day = 1 if "yesterday" in one.text.lower() else None
            names = one.context.latest(used.owner.lower(), day)
            fitting = [
                name for name in names
                if used.category not in one.text or one.context.objects[name].category == used.category
            ]  # fmt: skip
            assert fitting[0] == one.object, one.text


def oracle(one: Paraphrase) -> Instruction:
    assert one.object is not None
    obj = one.context.objects[one.object]
    return Instruction(one.text, (Target(one.start, one.start + 2, "", obj.category, obj.name),))


def test_rates_are_counted_exactly(
    every: dict[str, list[Paraphrase]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A parser that knows the answers to implicit ones, takes the first object elsewhere, and so on."""
    by_text = {one.text: one for one in every["simpler-bridge"] if one.part == "tune"}

    def load(context: Context):
        def parser(text: str, categories: object = ()) -> Instruction:
            one = by_text[text]
            if one.kind == "none":
                return Instruction(text, (Target(0, 1, "", "x", next(iter(context.objects))),))
            return oracle(one)

        return parser

    monkeypatch.setattr(parsers, "load_parser", lambda name, context: load(context))
    asked = ParserMeasurement(("known",), ("simpler-bridge",), ("tune",))
    table = pd.DataFrame(asked.rows())
    personal = table[table["kind"] != "none"]
    assert personal["right"].all()
    assert personal["kept"].all()
    assert not table[table["kind"] == "none"]["right"].any()
    found = parsers.accuracy(table).set_index("kind")
    none, whole, n = found.loc["none"], found.loc["all"], len(table)
    assert str(none["right"]) == "0 % [0, 14]"
    assert (none["low"], round(none["high"], 2)) == (0, 0.41)
    assert (none["abstains"].value, none["wrong object"].value, whole["n"]) == (0, 1, n)
    assert whole["wrong object"].k == n - len(personal)


def test_a_server_that_fails_is_no_abstention(monkeypatch: pytest.MonkeyPatch) -> None:
    def load(context: Context):
        def parser(text: str, categories: object = ()) -> Instruction:
            raise BadEndpoint("down")

        return parser

    monkeypatch.setattr(parsers, "load_parser", lambda name, context: load(context))
    with pytest.raises(BadEndpoint, match="down"):
        ParserMeasurement(("down",), ("tabletop",), ("tune",), 1).rows()


def test_the_command_prints_and_publishes(tmp_path: Path) -> None:
    some = ("--suite", "simpler-fractal", "--part", "tune", "--limit", "9")
    done = vap("measure", "parsers", *some, "--publish", tmp_path)
    assert done.returncode == 0, done.stderr
    assert "embedding  tune    explicit" in done.stdout
    table = pq.read_table(tmp_path / parsers.TABLE)
    assert table.num_rows == 18
    about = json.loads((table.schema.metadata or {})[b"about"])
    assert about["paraphrases"] == paraphrase_digest()
    assert "suite 'lab' is unknown; known: " in refused("measure", "parsers", "--suite", "lab")
    assert "no parser is named" in refused("measure", "parsers", "--parser", ",")
    assert "part 'all' is unknown; known: check-1" in refused("measure", "parsers", "--part", "all")
    assert "'magic' is unknown; known: rule" in refused(
        "measure", "parsers", *some, "--parser", "magic"
    )


def test_the_published_table_is_of_these_paraphrases(every: dict[str, list[Paraphrase]]) -> None:
    arrow = pq.read_table(PUBLISHED)
    about = json.loads((arrow.schema.metadata or {})[b"about"])
    assert about["paraphrases"] == paraphrase_digest(), "run measure parsers --publish data/results"
    table: pd.DataFrame = arrow.to_pandas()
    assert len(table) == 2 * sum(map(len, every.values()))


def test_the_page_quotes_the_published_table() -> None:
    page = (ROOT / "docs" / "photos.md").read_text()
    table: pd.DataFrame = pq.read_table(PUBLISHED).to_pandas()
    held_out = table[table["part"] == "test"]
    rows = [
        [cell.strip() for cell in line.strip("|").split("|")]
        for line in page.splitlines()
        if re.match(r"\| (rule|embedding) \| (?!test)", line)
    ]
    shown = {(row[0], row[1]): row[2:] for row in rows if len(row) == 7}
    found = parsers.accuracy(held_out)
    found = found[(found.parser == "embedding") | (found.kind == "all")]
    assert len(shown) == len(found)
    for line in found.to_dict("records"):
        families, n, right, silent, wrong = shown[line["parser"], line["kind"]]
        assert (families, n) == (str(line["families"]), str(line["n"]))
        ends = f"[{100 * line['low']:.0f}, {100 * line['high']:.0f}]"
        assert right == f"{line['right']} {ends}"
        for text, share in ((silent, line["abstains"]), (wrong, line["wrong object"])):
            assert text == f"{100 * share.value:.0f} %"


@pytest.mark.parametrize("suite", ["simpler-bridge", "simpler-fractal"])
def test_an_implicit_instruction_of_an_episode_means_its_target(suite: str) -> None:
    """It does not say "my cup", and what stands around the expression is the task's own sentence."""
    said = set()
    for task in suites.suite(suite).tasks:
        for row in suites.rows(suite, task.name)[:12]:
            text, _ = implicit_instruction(row)
            (target,) = read_implicit(row).targets
            assert target.object == row.target
            assert f"my {target.category}" not in text
            found = f"{text[: target.start]}my {target.category}{text[target.stop :]}"
            assert found == row.instruction
            said.add(text)
    assert len(said) > 10
    dev = f"{suite}-dev"
    row = suites.rows(dev, suites.suite(dev).tasks[0].name)[0]
    with pytest.raises(BadStudy, match=f"no paraphrases of {row.target}"):
        implicit_instruction(row)


def test_it_is_what_was_named_before() -> None:
    """ "I want the vase from earlier: put it into the bowl" once had two targets."""
    (one,) = [each for each in paraphrases("simpler-bridge", "test") if each.text == EARLIER]
    (target,) = load_parser("embedding", one.context)(EARLIER).targets
    assert (target.object, target.start) == (one.object, one.start)


EARLIER = "I want the camera from earlier: put it on the plate."


def test_where_the_parser_abstains_the_policy_reads_what_was_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    row = suites.rows("simpler-bridge", "pick-shaver")[0]

    def fails(error: Exception) -> None:
        def read(row: object) -> None:
            raise error

        monkeypatch.setattr(parsers, "read_implicit", read)

    with scenes.build("wx250s", ["shaver-personal"]) as scene:
        fails(BadInstruction("parse: several fit"))
        prompter = make_prompter("vap-implicit", row, tmp_path, scene, None)
        assert isinstance(prompter, TextPrompter)
        assert prompter.rewrite(row.instruction) == implicit_instruction(row)[0]
        fails(MissingWeights("text encoder"))
        with pytest.raises(MissingWeights):
            make_prompter("vap-implicit", row, tmp_path, scene, None)
