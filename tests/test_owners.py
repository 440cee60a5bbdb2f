"""Whose object is meant, what a memory keeps about owners, and the history of uses."""

import json
import struct
from dataclasses import replace
from datetime import datetime
from pathlib import Path

import pytest

from tests.full_disk import full_disk
from tests.toys import TOYS, personal, scene
from vap_core.attend import Attender
from vap_core.base.errors import BadInstruction, BadMemory, BadOutput, UnknownName
from vap_core.base.types import Instruction, PersonalObject
from vap_core.instruction import parse, rewrite
from vap_core.instruction.context import FILE, MAX_USES, Context, add_uses, owners_of, read_uses
from vap_core.instruction.implicit import EmbeddingParser
from vap_core.instruction.parsers import Parsing, rule_parser
from vap_core.memory import load, load_bank, recall, save
from vap_core.perception.text_encoder import embed_text
from vap_core.prompt import PALETTE

TEAL = (40, 120, 110)
RUST = (160, 60, 20)


def cup(name: str, owner: str = "", *known_as: str, category: str = "cup") -> PersonalObject:
    return replace(personal(name, category, TEAL), owner=owner, known_as=known_as)


HOUSE = {
    obj.name: obj
    for obj in (
        cup("a", "Anna", "ben's sister"),
        cup("b", "ben", "brother", "anna's brother"),
        cup("n"),
        cup("lamp-b", "ben", category="lamp"),
        cup("vase-c", "carl", "zoe's brother", category="vase"),
        cup("vase-b", "ben", category="vase"),
        cup("pot", category="pot"),
    )
}


@pytest.mark.parametrize(
    ("text", "name", "rewritten"),
    [
        ("bring James' cup", "j", "bring the red cup"),
        ("bring James's cup", "j", "bring the red cup"),
        ("Bring Mary Jane's cup", "m", "Bring the red cup"),
        ("Mary  Jane’s cup, please", "m", "The red cup, please"),
        ("put Jane's pot on the plate", "p", "put the red pot on the plate"),
    ],
)
def test_every_name_that_can_be_registered_can_be_said(
    text: str, name: str, rewritten: str
) -> None:
    known = (cup("j", "James"), cup("m", "Mary Jane"), cup("p", "jane", category="pot"))
    bank = {obj.name: obj for obj in known}
    context = Context(bank)
    for parser in (rule_parser(bank), EmbeddingParser(context, embed_text)):
        parsed = parser(text, {"cup", "pot"})
        (target,) = parsed.targets
        assert recall(bank, target).name == name
        assert rewrite(parsed, PALETTE[:1]) == rewritten


@pytest.mark.parametrize(
    ("text", "names", "rewritten"),
    [
        ("bring the neighbour's cup", "n", "bring the red cup"),
        ("Bring the  doctor’s cup, please", "d", "Bring the red cup, please"),
        ("The neighbour's cup, please", "n", "The red cup, please"),
        ("bring a neighbour's cup", "n", "bring the red cup"),
        ("bring the boss's pot", "b", "bring the red pot"),
        ("put Anna's cup near the doctor's cup", "ad", "put the red cup near the blue cup"),
        ("give the doctor Anna's cup", "a", "give the doctor the red cup"),
        ("bring my neighbour's cup", "n", "bring the red cup"),
    ],
)
def test_the_article_of_a_person_is_rewritten_with_the_person(
    text: str, names: str, rewritten: str
) -> None:
    """ "the neighbour's cup" becomes "the red cup", with one article."""
    known = (
        cup("n", "nils", "neighbour"),
        cup("d", "dora", "doctor"),
        cup("a", "anna"),
        cup("b", "the boss", category="pot"),
    )
    bank = {obj.name: obj for obj in known}
    for parser in (rule_parser(bank), EmbeddingParser(Context(bank), embed_text)):
        parsed = parser(text, {"cup", "pot"})
        assert "".join(recall(bank, target).name for target in parsed.targets) == names
        assert rewrite(parsed, PALETTE[: len(names)]) == rewritten


def test_the_embedding_parser_knows_a_person_by_article() -> None:
    bank = {"n": cup("n", "nils", "neighbour"), "a": cup("a", "anna")}
    parser = EmbeddingParser(Context(bank), embed_text)
    for text in ("bring the cup of the neighbour", "bring the cup that belongs to the neighbour"):
        (target,) = parser(text, {"cup"}).targets
        assert target.object == "n"


NFD = "J\u0075\u0308rgen"  # u and a diaeresis: two characters


@pytest.mark.parametrize(
    "name", ["O'Brien", "J.R.", "Dr. Smith", "D'Angelo", "Smith Jr.", "Jürgen", NFD]
)
def test_names_of_any_spelling_are_names(name: str, tmp_path: Path) -> None:
    """Their capital is not the sentence's, and ’ is '."""
    save(tmp_path, cup("mug", name))
    attender = Attender(TOYS, load_bank(tmp_path))
    for said in (name, name.replace("'", "’"), name.replace(NFD, "Jürgen")):
        for text, rewritten in (
            (f"bring {said}'s cup to me", "bring the red cup to me"),
            (f"{said}’s cup", "The red cup"),
            (f"Wait. {said}'s cup, please", "Wait. The red cup, please"),
        ):
            parsed, (obj,) = attender.understand(text)
            assert obj.name == "mug"
            assert rewrite(parsed, PALETTE[:1]) == rewritten


def test_an_unknown_name_with_an_apostrophe_is_said_whole() -> None:
    with pytest.raises(UnknownName, match='nobody is "o\'brien"; the memory knows anna'):
        meant("bring O'Brien's cup", "anna")


def meant(text: str, speaker: str) -> str:
    categories = {obj.category for obj in HOUSE.values()}
    (target,) = rule_parser(HOUSE)(text, categories).targets
    return recall(HOUSE, target, speaker=speaker).name


@pytest.mark.parametrize(
    ("text", "speaker", "name"),
    [
        ("bring my cup", "anna", "a"),
        ("bring my cup", "ANNA", "a"),
        ("bring my cup", "ben", "b"),
        ("bring my cup", "", "n"),
        ("bring my cup", "zoe", "n"),
        ("bring my pot", "anna", "pot"),
        ("bring our cup", "anna", "n"),
        ("bring Anna's cup", "ben", "a"),
        ("bring anna’s cup", "", "a"),
        ("bring my brother's cup", "anna", "b"),
        ("bring my brother's vase", "zoe", "vase-c"),
        ("bring my brother's cup", "", "b"),
        ("bring Anna's brother's cup", "carl", "b"),
        ("bring my sister's cup", "ben", "a"),
        ("bring her cup", "ben", "a"),
        ("bring his lamp", "anna", "lamp-b"),
    ],
)
def test_whom_my_means(text: str, speaker: str, name: str) -> None:
    assert meant(text, speaker) == name


@pytest.mark.parametrize(
    ("text", "speaker", "error", "said"),
    [
        ("bring Carla's cup", "anna", UnknownName, "nobody is 'carla'; the memory knows anna"),
        ("bring my uncle's cup", "anna", UnknownName, "nobody is 'my uncle'"),
        ("bring my lamp", "anna", UnknownName, "no 'lamp' is 'my' where anna speaks"),
        ("bring my lamp", "", UnknownName, "where nobody is named with --speaker"),
        ("bring his vase", "anna", BadInstruction, "'his' could be ben or carl; say the name"),
        ("bring Anna's lamp", "ben", UnknownName, "no 'lamp' is \"Anna's\""),
    ],
)
def test_what_is_nobodys_is_one_line(
    text: str, speaker: str, error: type[Exception], said: str
) -> None:
    with pytest.raises(error, match=said) as caught:
        meant(text, speaker)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) <= 300


BROTHERS = {
    obj.name: obj
    for obj in (cup("a", "anna"), cup("b", "ben", "brother"), cup("d", "dan", "anna's brother"))
}


def meant_by(kind: str, bank: dict[str, PersonalObject], text: str, speaker: str) -> str:
    """The objects' names that a parser, "rule" or "embedding", finds."""
    targets = parsed_by(kind, bank, text, speaker).targets
    return " ".join(recall(bank, target, speaker=speaker).name for target in targets)


def rewritten_by(kind: str, bank: dict[str, PersonalObject], text: str, speaker: str) -> str:
    parsed = parsed_by(kind, bank, text, speaker)
    return rewrite(parsed, PALETTE[: len(parsed.targets)])


def parsed_by(kind: str, bank: dict[str, PersonalObject], text: str, speaker: str) -> Instruction:
    parser = rule_parser(bank)
    if kind == "embedding":
        parser = EmbeddingParser(Context(bank, speaker), embed_text)
    return parser(text, {obj.category for obj in bank.values()})


@pytest.mark.parametrize("kind", ["rule", "embedding"])
@pytest.mark.parametrize("speaker", ["carl", "anna", "ben", "dan", ""])
def test_annas_brother_is_not_somebody_elses(kind: str, speaker: str) -> None:
    """Whoever is known as exactly that; the last word alone is another person's."""
    assert meant_by(kind, BROTHERS, "bring Anna's brother's cup", speaker) == "d"
    text = "put Anna's cup next to Anna's brother's cup"
    assert meant_by(kind, BROTHERS, text, speaker) == "a d"


@pytest.mark.parametrize("kind", ["rule", "embedding"])
def test_annas_brother_needs_no_second_name(kind: str) -> None:
    bank = {"a": cup("a", "anna"), "b": cup("b", "ben", "anna's brother")}
    for speaker in ("carl", "anna", ""):
        assert meant_by(kind, bank, "bring Anna's brother's cup", speaker) == "b"


@pytest.mark.parametrize(
    "text",
    ["bring the cup that's Ben's", "bring the cup, it's Ben's", "the cup's Ben's, bring it"],
)
def test_a_shortened_is_names_the_owner(text: str) -> None:
    assert meant_by("embedding", BROTHERS, text, "carl") == "b"


HERS = {
    obj.name: obj
    for obj in (
        cup("a", "anna"),
        cup("b", "ben", "anna's brother"),
        cup("n", "nils", "neighbour"),
        cup("pot", category="pot"),
    )
}


@pytest.mark.parametrize("kind", ["rule", "embedding"])
@pytest.mark.parametrize(
    ("text", "name", "rewritten"),
    [
        ("give her Ben's cup", "b", "give her the red cup"),
        ("give her my brother's cup", "b", "give her the red cup"),
        ("bring her the neighbour's cup", "n", "bring her the red cup"),
        ("give her my cup", "a", "give her the red cup"),
        ("give her our pot", "pot", "give her the red pot"),
        ("bring her neighbour's cup", "n", "bring the red cup"),
    ],
)
def test_her_before_another_owner_is_who_gets_it(
    kind: str, text: str, name: str, rewritten: str
) -> None:
    assert meant_by(kind, HERS, text, "anna") == name
    assert rewritten_by(kind, HERS, text, "anna") == rewritten


@pytest.mark.parametrize("kind", ["rule", "embedding"])
def test_my_friends_brother_has_a_cup(kind: str) -> None:
    """He is known as exactly that; another's brother is somebody else."""
    known = (cup("l", "lea", "friend's brother"), cup("b", "ben", "brother", "carl's brother"))
    bank = {obj.name: obj for obj in (*known, cup("x"))}
    for speaker in ("carl", "anna", ""):
        assert meant_by(kind, bank, "bring my friend's brother's cup", speaker) == "l"
        text = "put my friend's brother's cup on my brother's cup"
        assert meant_by(kind, bank, text, speaker) == "l b"
    assert rewritten_by(kind, bank, "bring my friend’s brother’s cup", "") == "bring the red cup"
    del bank["l"]
    with pytest.raises(UnknownName, match='nobody is "my friend\'s brother"; the memory knows ben'):
        meant_by(kind, bank, "bring my friend's brother's cup", "carl")


def test_the_speakers_friends_brother_can_have_her_name() -> None:
    bank = {obj.name: obj for obj in (cup("l", "lea", "anna's friend's brother"), cup("x"))}
    assert meant_by("rule", bank, "bring my friend's brother's cup", "anna") == "l"
    with pytest.raises(UnknownName, match="nobody is"):
        meant_by("rule", bank, "bring my friend's brother's cup", "carl")


@pytest.mark.parametrize("kind", ["rule", "embedding"])
@pytest.mark.parametrize("whose", ["my", "my brother's", "Ben's"])
def test_a_part_of_an_object_is_no_further_owner(kind: str, whose: str) -> None:
    bank = {"b": cup("b", "ben", "brother")}
    speaker = "ben" if whose == "my" else "anna"
    assert meant_by(kind, bank, f"bring {whose} cup's lid", speaker) == "b"


def test_two_brothers_are_ambiguous() -> None:
    objects = {obj.name: obj for obj in (cup("b", "ben", "brother"), cup("c", "carl", "brother"))}
    (target,) = parse("bring my brother's cup").targets
    with pytest.raises(BadInstruction, match="could be ben or carl"):
        recall(objects, target, speaker="anna")


def test_without_owners_nothing_changes() -> None:
    objects = {"mug": cup("mug")}
    for text in ("bring my cup", "bring my brother's cup"):
        (target,) = parse(text).targets
        assert recall(objects, target).name == "mug"
    assert rule_parser(objects)("bring my cup near Anna's cup", ["cup"]).targets[-1].owner == "my"


def test_names_are_targets_only_where_there_are_owners() -> None:
    text = "put Anna's cup near what's my cup"
    assert [target.owner for target in parse(text, ["cup"]).targets] == ["my"]
    parsed = parse(text, ["cup"], owners_of(HOUSE.values()))
    assert [target.owner for target in parsed.targets] == ["Anna's", "my"]
    assert rewrite(parsed, PALETTE[:2]).startswith(f"put the {PALETTE[0].name} cup near what's")
    with pytest.raises(BadInstruction):
        parse("bring Anna's sandwich", ["cup"], ["anna"])


def test_the_method_grounds_the_speakers_object() -> None:
    objects = {
        "a": replace(personal("a", "cup", TEAL), owner="anna"),
        "b": replace(personal("b", "cup", RUST), owner="ben"),
    }
    views = {"front": scene([(4, 8, TEAL), (30, 30, RUST)])}
    for speaker, text, name in (
        ("anna", "bring my cup", "a"),
        ("ben", "bring my cup", "b"),
        ("anna", "bring Ben's cup", "b"),
    ):
        _, attended = Attender(TOYS, objects, speaker=speaker).start(views, text)
        assert attended.groundings["front"][0].object == name


def test_an_owner_who_is_remembered_later_can_be_named() -> None:
    """By an Attender that was made before; the memory is read at every start."""
    memory = {"a": personal("a", "cup", TEAL)}
    views = {"front": scene([(4, 8, TEAL), (30, 30, RUST)])}
    attender = Attender(TOYS, memory)
    memory["b"] = replace(personal("b", "cup", RUST), owner="ben")
    _, attended = attender.start(views, "bring Ben's cup")
    assert attended.groundings["front"][0].object == "b"
    own = rule_parser({})
    assert Attender(TOYS, memory, parser=own).parser is own


def test_owner_and_note_are_kept(tmp_path: Path) -> None:
    obj = replace(cup("mug", "Anna", "ben's sister", "Mama"), note="for the morning ☕ coffee")
    back = load(save(tmp_path, obj))
    assert (back.owner, back.known_as, back.note) == (obj.owner, obj.known_as, obj.note)


def test_an_object_without_an_owner_is_the_file_that_it_was(tmp_path: Path) -> None:
    data = save(tmp_path, cup("mug")).read_bytes()
    (size,) = struct.unpack("<Q", data[:8])
    about = json.loads(data[8 : 8 + size])["__metadata__"]
    assert set(about) == {"format", "version", "name", "category", "encoder"}
    back = load_bank(tmp_path)["mug"]
    assert (back.owner, back.known_as, back.note) == ("", (), "")


@pytest.mark.parametrize(
    ("owner", "known_as", "note", "said"),
    [
        ("../x", (), "", "cannot be a person"),
        ("an\x1bna", (), "", "cannot be a person"),
        ("anna", ("3",), "", "cannot be a person"),
        ("", ("brother",), "", "name one by --owner"),
        ("anna", (), "two\nlines", "a note is one line"),
        ("anna", (), "x" * 201, "of at most 200 characters"),
    ],
)
def test_an_odd_owner_is_neither_saved_nor_read(
    tmp_path: Path, owner: str, known_as: tuple[str, ...], note: str, said: str
) -> None:
    obj = replace(cup("mug"), owner=owner, known_as=known_as, note=note)
    with pytest.raises(BadMemory, match=said):
        save(tmp_path / "bank", obj)
    path = save(tmp_path, cup("mug"))
    data = path.read_bytes()
    (size,) = struct.unpack("<Q", data[:8])
    header = json.loads(data[8 : 8 + size])
    header["__metadata__"] |= {"owner": owner, "known_as": json.dumps(known_as), "note": note}
    text = json.dumps(header).encode()
    path.write_bytes(struct.pack("<Q", len(text)) + text + data[8 + size :])
    with pytest.raises(BadMemory, match="register the object again") as caught:
        load(path)
    assert "\x1b" not in str(caught.value)


NOON = datetime.fromisoformat("2026-06-12T12:00:00+02:00")


def test_uses_are_appended_and_read(tmp_path: Path) -> None:
    bank = tmp_path / "bank"
    assert read_uses(bank) == ()
    add_uses(bank, ["mug", "owl"], "anna", NOON)
    add_uses(bank, [], "ben", NOON)
    add_uses(bank, ["mug"], "", NOON)
    uses = [(use.object, use.by, use.at) for use in read_uses(bank)]
    at = "2026-06-12T12:00:00+02:00"
    assert uses == [("mug", "anna", at), ("owl", "anna", at), ("mug", "", at)]
    assert load_bank(bank) == {}


@pytest.mark.parametrize(
    "line", ["{", "[]", '{"object": "mug"}', '{"object": "m", "by": "", "at": "noon"}', "[" * 100_000,
             '{"object": 3, "by": "", "at": "2026-06-12"}', "\udcff"],
)  # fmt: skip
def test_a_damaged_history_is_one_line(tmp_path: Path, line: str) -> None:
    (tmp_path / FILE).write_bytes(f"{line}\n".encode(errors="surrogateescape"))
    with pytest.raises(BadMemory, match="is damaged .*; delete it to start a new one"):
        read_uses(tmp_path)
    with pytest.raises(BadMemory, match="is damaged"):
        Parsing("embedding").load(tmp_path, {"mug": cup("mug")})
    assert Parsing("rule").load(tmp_path, {})("bring my cup").targets


def test_a_write_of_the_history_that_fails_leaves_the_earlier_uses(tmp_path: Path) -> None:
    add_uses(tmp_path, ["mug"], "anna", NOON)
    with pytest.raises(BadOutput, match="history: .* cannot be written"), full_disk(90):
        add_uses(tmp_path, ["mug", "lamp", "dish"], "ben", NOON)
    assert [use.object for use in read_uses(tmp_path)] == ["mug"]
    with (tmp_path / FILE).open("a") as file:  # as versions that appended left it
        file.write('\n{"object": "la')
    assert [use.object for use in read_uses(tmp_path)] == ["mug"]
    add_uses(tmp_path, ["dish"], "ben\u2028jr.", NOON)
    assert [(use.object, use.by) for use in read_uses(tmp_path)] == [
        ("mug", "anna"),
        ("dish", "ben\u2028jr."),
    ]


def test_a_history_keeps_the_last_uses(tmp_path: Path) -> None:
    add_uses(tmp_path, ["mug", *["lamp"] * MAX_USES], "", NOON)
    add_uses(tmp_path, ["dish"], "", NOON)
    assert [use.object for use in read_uses(tmp_path)] == [*["lamp"] * (MAX_USES - 1), "dish"]
    assert len((tmp_path / FILE).read_text().splitlines()) == MAX_USES


def test_a_history_that_cannot_be_read_is_not_to_be_deleted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    add_uses(tmp_path, ["mug"], "anna", NOON)

    def refuse(path: Path) -> bytes:
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr(Path, "read_bytes", refuse)
    with pytest.raises(BadMemory, match=r"cannot be read \(Permission denied\); check its perm"):
        read_uses(tmp_path)


def test_a_bank_that_cannot_be_written_is_said(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(BadOutput, match="choose another folder with --memory"):
        add_uses(tmp_path / "file", ["mug"], "anna", NOON)
