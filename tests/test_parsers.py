"""Parsers behind one protocol: implicit references by a real MiniLM, and a chat model behind a real server on this machine."""

import json
import socket
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.chat_server import says, serving
from tests.toys import personal
from vap_core.base.errors import BadEndpoint, BadInstruction, UnknownName, VapError
from vap_core.base.types import Description, Instruction, PersonalObject
from vap_core.instruction import Parser, parse, rewrite
from vap_core.instruction.context import MAX_USES, Context, Use, add_uses
from vap_core.instruction.expressions import find_exclusions, find_expressions
from vap_core.instruction.implicit import EmbeddingParser, fit
from vap_core.instruction.parsers import ChatParser, Parsing, load_parser, rule_parser
from vap_core.instruction.rule import MAX_CHARACTERS
from vap_core.perception.chat import ChatEndpoint
from vap_core.perception.text_encoder import embed_text
from vap_core.prompt import PALETTE

RED = PALETTE[0]
WHITE = (240, 240, 240)


def thing(
    name: str, owner: str = "", looks: str = "", note: str = "", **more: Any
) -> PersonalObject:
    description = Description(looks, looks) if looks else None
    obj = personal(name, more.pop("category", name.split("-")[0]), WHITE)
    return replace(obj, owner=owner, description=description, note=note, **more)


OBJECTS = [
    thing("shaver", "anna", "dark teal with white bands", "for the beard before work"),
    thing("camera", "anna", "grey with black parts", "for the holiday pictures"),
    thing("cup-spots", "anna", "white with blue spots", "for the morning coffee"),
    thing("cup-bands", "anna", "white with black bands"),
    thing("cup-ben", "ben", "dark brown", known_as=("brother", "anna's brother")),
]
USES = (
    Use("shaver", "anna", "2026-06-11T08:00:00"),
    Use("camera", "anna", "2026-06-12T09:00:00"),
    Use("cup-spots", "anna", "2026-06-12T10:00:00"),
    Use("cup-ben", "ben", "2026-06-12T11:00:00"),
)
CONTEXT = Context({obj.name: obj for obj in OBJECTS}, "anna", USES, datetime(2026, 6, 12, 15))


def found(instruction: Instruction) -> list[str | None]:
    return [target.object for target in instruction.targets]


@pytest.mark.parametrize(
    ("text", "name", "rewritten"),
    [
        ("bring my camera", "camera", "bring the red camera"),
        ("put the thing for shaving on the plate", "shaver", "put the red shaver on the plate"),
        ("Hand me what I take pictures with.", "camera", "Hand me the red camera."),
        ("bring the one I used earlier", "cup-spots", "bring the red cup"),
        ("bring the one I used yesterday", "shaver", "bring the red shaver"),
        ("bring the one Ben used before", "cup-ben", "bring the red cup"),
        ("bring my brother's cup", "cup-ben", "bring the red cup"),
        ("bring the cup that belongs to Ben", "cup-ben", "bring the red cup"),
        ("bring my cup, not the striped one", "cup-spots", "bring the red cup"),
        (
            "put my cup but not the spotted one on the plate",
            "cup-bands",
            "put the red cup on the plate",
        ),
        ("bring the cup with blue dots", "cup-spots", "bring the red cup"),
    ],
)
def test_every_kind_of_reference(text: str, name: str, rewritten: str) -> None:
    parsed = EmbeddingParser(CONTEXT, embed_text)(text)
    assert found(parsed) == [name]
    assert rewrite(parsed, [RED]) == rewritten


def test_two_targets_of_two_owners() -> None:
    parsed = EmbeddingParser(CONTEXT, embed_text)("put my camera near Ben's cup")
    assert found(parsed) == ["camera", "cup-ben"]
    assert (
        rewrite(parsed, PALETTE[:2]) == f"put the {RED.name} camera near the {PALETTE[1].name} cup"
    )


THINGS = [thing("cup", "james"), thing("bag"), thing("pen"), thing("mug", "mary jane")]


@pytest.mark.parametrize(
    ("text", "names", "rewritten"),
    [
        ("bring my bag and my pen", ["bag", "pen"], "bring the red bag and the blue pen"),
        ("bring my bag & James' cup", ["bag", "cup"], "bring the red bag & the blue cup"),
        (
            "put both my pen and Mary Jane's mug into the box",
            ["pen", "mug"],
            "put both the red pen and the blue mug into the box",
        ),
        (
            "bring James' cup, my bag and my pen",
            ["cup", "bag", "pen"],
            "bring the red cup, the blue bag and the green pen",
        ),
        ("bring my pen, my bag is dirty", ["pen"], "bring the red pen, my bag is dirty"),
        ("bring my bag for my cup and my pen", ["bag"], "bring the red bag"),
    ],
)
def test_a_list_of_objects_is_every_one_of_them(
    text: str, names: list[str], rewritten: str
) -> None:
    parsed = EmbeddingParser(Context({obj.name: obj for obj in THINGS}), embed_text)(text)
    assert found(parsed) == names
    assert rewrite(parsed, PALETTE[: len(names)]) == rewritten


@pytest.mark.parametrize(
    ("text", "rewritten"),
    [
        (
            "pick up my bag, then put my bag on the shelf",
            "pick up the red bag, then put the red bag on the shelf",
        ),
        ("My bag is dirty. Bring my bag.", "The red bag is dirty. Bring the red bag."),
        ("take James' cup, then lift his cup", "take the red cup, then lift the red cup"),
        ("take my bag, then lift the bag", "take the red bag, then lift the bag"),
        ("bring my bag, my favourite one", "bring the red bag, my favourite one"),
        ("bring my bag and use it", "bring the red bag and use it"),
    ],
)
def test_an_object_that_is_named_twice_is_one_target(text: str, rewritten: str) -> None:
    """Both its names are rewritten; other words for it stay."""
    parsed = EmbeddingParser(Context({obj.name: obj for obj in THINGS}), embed_text)(text)
    assert len(parsed.targets) == 1
    assert rewrite(parsed, [RED]) == rewritten


def test_one_of_a_list_that_nobody_remembers_is_named() -> None:
    parser = EmbeddingParser(Context({obj.name: obj for obj in THINGS}), embed_text)
    with pytest.raises(UnknownName, match="'my hat' is remembered"):
        parser("bring my hat and my bag")


@pytest.mark.parametrize(
    ("text", "error", "said"),
    [
        ("open the drawer", BadInstruction, "no personal object"),
        ("bring a cup", BadInstruction, "no personal object"),
        ("bring it", BadInstruction, "'it' in 'bring it' could be any of camera, cup-"),
        ("bring my cup", BadInstruction, "could be cup-spots or cup-bands; say whose it is"),
        ("bring my guitar", UnknownName, "nothing like 'my guitar' is remembered"),
        ("bring Carla's cup", UnknownName, "nobody is 'carla'"),
        ("put my camera near Carla's cup", UnknownName, "nobody is 'carla'"),
        ("bring Ben's camera", UnknownName, "no 'camera' of 'ben' is remembered"),
        ("bring the camera Ben used last", UnknownName, "no earlier use by ben"),
        ("put the thing for ironing curtains on the plate", BadInstruction, "no personal object"),
    ],
)
def test_what_cannot_be_resolved_is_one_line(text: str, error: type[VapError], said: str) -> None:
    with pytest.raises(error, match=said) as caught:
        EmbeddingParser(CONTEXT, embed_text)(text)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) <= 300


def test_every_parser_refuses_an_instruction_that_is_too_long() -> None:
    said = []
    chat = ChatEndpoint("http://127.0.0.1:9/v1", "nobody")
    text = "bring my camera ".ljust(MAX_CHARACTERS, "!")
    for parser in (
        rule_parser(CONTEXT.objects),
        EmbeddingParser(CONTEXT, embed_text),
        ChatParser(CONTEXT, chat),
    ):
        with pytest.raises(BadInstruction, match="are 501 characters; an instruction") as caught:
            parser(f"{text}!")
        said.append(str(caught.value))
    assert len(set(said)) == 1
    assert "\n" not in said[0]
    assert len(said[0]) <= 200
    assert len(parse(text).targets) == 1
    assert found(EmbeddingParser(CONTEXT, embed_text)(text)) == ["camera"]


def test_who_speaks_decides_whose_it_is() -> None:
    objects = [thing("a", "anna", category="cup"), thing("b", "ben", category="cup")]
    for speaker, name in (("anna", "a"), ("Ben", "b")):
        context = Context({obj.name: obj for obj in objects}, speaker)
        assert found(EmbeddingParser(context, embed_text)("bring my cup")) == [name]


def test_the_words_alone_decide_about_meaning() -> None:
    """With an encoder for which all texts are alike, only grammar, owners and history are left."""

    def alike(texts: Any) -> np.ndarray:
        return np.ones((len(texts), 1), np.float32)

    parser = EmbeddingParser(CONTEXT, alike)
    assert found(parser("bring the one I used earlier")) == ["cup-spots"]
    with pytest.raises(BadInstruction, match="could be"):
        parser("bring the thing for shaving")


def test_a_tie_among_what_is_excluded_is_ambiguous() -> None:
    alike = {name: thing(name, looks="white with blue spots", category="cup") for name in "ab"}
    with pytest.raises(BadInstruction, match="could be a or b"):
        EmbeddingParser(Context(alike), embed_text)("bring my cup, not the spotted one")


def test_expressions_end_before_the_place() -> None:
    text = "put the thing I put flowers in on the plate"
    (said, *_) = [one.said for one in find_expressions(text, ())]
    assert said == "the thing I put flowers in"
    assert [one.said for one in find_exclusions("my cup, not the striped one, now")] == [
        "the striped one"
    ]


def test_looks_are_read_in_the_words_of_the_captioner() -> None:
    bands, spots = OBJECTS[3], OBJECTS[2]
    assert fit("striped", bands) > fit("striped", spots) == 0
    assert fit("with black bands", bands) > fit("with bands", bands)
    assert fit("without any bands", bands) < 0 == fit("anything", bands)


def answer(*targets: tuple[str, str]) -> tuple[int, Any]:
    rows = [{"expression": said, "object": name} for said, name in targets]
    return says(json.dumps({"targets": rows}))


@pytest.fixture(autouse=True)
def _no_proxy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("no_proxy", "127.0.0.1")
    for name in ("OPENAI_BASE_URL", "OPENAI_MODEL", "OPENAI_API_KEY"):
        monkeypatch.delenv(name, raising=False)


def test_a_chat_model_gets_the_memory_in_words_and_answers_by_schema() -> None:
    text = "Put the thing for shaving near my brother's cup"
    said = answer(("my brother's cup", "cup-ben"), ("the thing for shaving", "shaver"))
    with serving(said) as server:
        parsed = ChatParser(CONTEXT, ChatEndpoint(server.url, "reader-1", "secret"))(text)
    assert found(parsed) == ["shaver", "cup-ben"]
    assert (
        rewrite(parsed, PALETTE[:2]) == f"Put the {RED.name} shaver near the {PALETTE[1].name} cup"
    )
    ((path, key, body),) = server.asked
    assert (path, key, body["model"]) == ("/v1/chat/completions", "Bearer secret", "reader-1")
    form = body["response_format"]
    assert (form["type"], form["json_schema"]["strict"]) == ("json_schema", True)
    rows = form["json_schema"]["schema"]["properties"]["targets"]["items"]
    assert rows["properties"]["object"]["enum"] == sorted(CONTEXT.objects)
    system, user = body["messages"]
    about = json.loads(user["content"])
    assert system["role"] == "system"
    assert (about["instruction"], about["speaker"]) == (text, "anna")
    assert about["people"]["ben"] == ["brother", "anna's brother"]
    assert about["objects"][2] == {
        "object": "cup-spots", "category": "cup", "owner": "anna", "note": "for the morning coffee",
        "looks": "white with blue spots",
    }  # fmt: skip
    assert about["earlier uses, last one last"][-1]["object"] == "cup-ben"


def test_the_page_says_how_many_uses_each_parser_reads() -> None:
    uses = tuple(Use(object="cup-ben", by="ben", at=f"{2000 + i}-01-01") for i in range(30))
    with serving(answer(("my camera", "camera"))) as server:
        parser = ChatParser(replace(CONTEXT, uses=uses), ChatEndpoint(server.url, "reader-1"))
        parser("bring my camera")
    about = json.loads(server.asked[0][2]["messages"][1]["content"])
    sent = about["earlier uses, last one last"]
    assert [use["at"] for use in sent] == [use.at for use in uses[-len(sent) :]]
    page = Path(__file__).resolve().parents[1] / "docs" / "photos.md"
    words = " ".join(page.read_text().split())
    assert (
        f"`embedding` reads the last {MAX_USES} uses, and `chat` sends the last {len(sent)}"
        in words
    )


def test_without_a_key_no_stored_token_is_sent(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HF_TOKEN", "hf_secret")
    with serving(answer(("my camera", "camera"))) as server:
        ChatParser(CONTEXT, ChatEndpoint(server.url, "reader-1"))("bring my camera")
    assert "hf_secret" not in str(server.asked)


@pytest.mark.parametrize("status", [301, 302, 303, 307, 308])
def test_a_redirect_to_another_server_is_not_followed(status: int) -> None:
    """Neither the key nor the instruction and the people."""
    with serving((404, b"")) as other:
        moved = (status, b"", ("Location", f"{other.url}/chat/completions"))
        with serving(moved) as server, pytest.raises(BadEndpoint, match="refuses") as caught:
            ChatParser(CONTEXT, ChatEndpoint(server.url, "reader-1", "secret"))("bring my cup")
    assert "secret" not in str(other.asked)
    assert not other.asked
    assert f"({status}: it redirects to {other.url}" in str(caught.value)


def test_no_object_is_an_abstention() -> None:
    with (
        serving(answer()) as server,
        pytest.raises(BadInstruction, match="reader-1 finds no personal object in 'open the door'"),
    ):
        ChatParser(CONTEXT, ChatEndpoint(server.url, "reader-1"))("open the door")


def test_an_expression_is_whole_words_and_an_object_is_one_target() -> None:
    text = "open my cameraman's bag and bring my camera, the grey camera"
    said = answer(("my camera", "camera"), ("the grey camera", "camera"))
    with serving(said) as server:
        parsed = ChatParser(CONTEXT, ChatEndpoint(server.url, "reader-1", "secret"))(text)
    assert found(parsed) == ["camera"]
    assert (
        rewrite(parsed, [RED])
        == "open my cameraman's bag and bring the red camera, the grey camera"
    )


def test_what_a_chat_model_names_twice_is_one_target_in_one_colour() -> None:
    text = "take my camera, then put my camera near Ben's cup"
    said = answer(("my camera", "camera"), ("Ben's cup", "cup-ben"), ("my camera", "camera"))
    with serving(said) as server:
        parsed = ChatParser(CONTEXT, ChatEndpoint(server.url, "reader-1"))(text)
    assert found(parsed) == ["camera", "cup-ben"]
    assert rewrite(parsed, PALETTE[:2]) == (
        "take the red camera, then put the red camera near the blue cup"
    )


def test_one_expression_may_be_two_objects_in_turn() -> None:
    text = "put my cup near my cup"
    said = answer(("my cup", "cup-spots"), ("my cup", "cup-bands"))
    with serving(said) as server:
        parsed = ChatParser(CONTEXT, ChatEndpoint(server.url, "reader-1"))(text)
    assert found(parsed) == ["cup-spots", "cup-bands"]
    assert rewrite(parsed, PALETTE[:2]) == "put the red cup near the blue cup"


@pytest.mark.parametrize(
    ("said", "error"),
    [
        (answer(("my camera", "camera"), ("my camera", "camera")), "no part of the instruction"),
        ((401, {"error": {"message": "bad key\nsecond line"}}), r"refuses \(401: .*bad key"),
        ((500, b"<html>oops"), r"refuses \(500: <html>oops\)"),
        ((429, b""), r"refuses \(429: Too Many Requests\)"),
        (says(None, refusal="I cannot\nhelp"), "refuses: 'I cannot help'"),
        (says(None), "does not answer as a chat endpoint does"),
        ((200, b"not json"), "does not answer as a chat endpoint does"),
        ((200, b"[" * 100_000), "does not answer as a chat endpoint does"),
        ((200, {"choices": []}), "does not answer as a chat endpoint does"),
        ((200, {}), "does not answer as a chat endpoint does"),
        (says("x" * 20_000_000), "answers with over 4 MB"),
        (says("the cup"), "answers outside the form"),
        (says("[" * 100_000), "answers outside the form"),
        (says('{"targets": 3}'), "answers outside the form"),
        (says('{"targets": [{"expression": 3, "object": "camera"}]}'), "answers outside the form"),
        (answer(("my camera", "nothing")), "answers outside the form"),
        (answer(("my shoe", "camera")), "answers outside the form"),
        (answer((" ", "camera")), "answers outside the form"),
        (answer(("my camera", "camera"), ("camera", "camera")), "overlapping"),
    ],
)
def test_what_goes_wrong_with_a_server_is_one_line(said: Any, error: str) -> None:
    with serving(said) as server, pytest.raises(BadEndpoint, match=error) as caught:
        ChatParser(CONTEXT, ChatEndpoint(server.url, "reader-1", "secret"))("bring my camera")
    assert "\n" not in str(caught.value)
    assert "secret" not in str(caught.value)
    assert len(str(caught.value)) <= 300


def test_no_server_and_silent_ones_are_said() -> None:
    with serving() as server:
        url = server.url
    with pytest.raises(BadEndpoint, match=r"gives no answer \(.*refused"):
        ChatParser(CONTEXT, ChatEndpoint(url, "reader-1"))("bring my camera")
    for limit, said in (
        ({"timeout_s": 0.2}, r"gives no answer \(timed out\)"),
        ({"total_s": 0.2}, "within 0.2"),
    ):
        with socket.create_server(("127.0.0.1", 0)) as mute:
            url = f"http://127.0.0.1:{mute.getsockname()[1]}/v1"
            parser = ChatParser(CONTEXT, ChatEndpoint(url, "reader-1", **limit))
            with pytest.raises(BadEndpoint, match=said):
                parser("bring my camera")


def test_where_asked_for_the_rule_parses_instead(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("OPENAI_MODEL", "reader-1")
    with serving((500, b"oops"), (500, b"oops")) as server:
        with pytest.raises(BadEndpoint, match="500"):
            load_parser(server.url, CONTEXT)("bring Ben's cup", ["cup"])
        parsed = load_parser(server.url, CONTEXT, fall_back=True)("bring Ben's cup", ["cup"])
    assert (parsed.targets[0].owner, parsed.targets[0].object) == ("Ben's", None)
    noted = capsys.readouterr().err
    assert noted.startswith("note: parse: http://127.0.0.1")
    assert noted.endswith("The rule parses instead.\n")
    assert noted.count("\n") == 1


def test_an_abstention_is_no_reason_to_fall_back(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OPENAI_MODEL", "reader-1")
    with serving(answer()) as server, pytest.raises(BadInstruction, match="finds no personal"):
        load_parser(server.url, CONTEXT, fall_back=True)("bring my cup", ["cup"])


def test_parsers_by_name() -> None:
    parser = load_parser("rule", Context({}))
    assert parser("bring my cup").targets[0].category == "cup"
    assert isinstance(load_parser("embedding", CONTEXT), EmbeddingParser)
    for one in (parse, rule_parser({}), load_parser("embedding", CONTEXT)):
        assert isinstance(one, Parser)
    for name in ("embedding", "chat"):
        with pytest.raises(UnknownName, match="the memory is empty; register"):
            load_parser(name, Context({}))
    with pytest.raises(UnknownName, match="known: rule, embedding, chat, or the address"):
        load_parser("magic", CONTEXT)
    with pytest.raises(BadEndpoint, match="'' is no address"):
        load_parser("chat", CONTEXT)


def test_a_command_asks_a_server_once_for_a_text(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("OPENAI_MODEL", "reader-1")
    add_uses(tmp_path, ["camera"], "ben", datetime(2026, 6, 12))
    with serving(answer(("my camera", "camera"))) as server:
        parser = Parsing(server.url, speaker="anna").load(tmp_path, CONTEXT.objects)
        assert parser("bring my camera") is parser("bring my camera")
    ((_, _, body),) = server.asked
    about = json.loads(body["messages"][1]["content"])
    assert (about["speaker"], about["earlier uses, last one last"][0]["by"]) == ("anna", "ben")
