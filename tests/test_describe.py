"""Objects put into words: exact ones for pictures whose every pixel is known, and a model's behind a real server on this machine."""

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.chat_server import says, serving
from tests.toys import personal
from vap_core.base.errors import BadEndpoint
from vap_core.base.types import Boxes, Description
from vap_core.perception.chat import (
    ChatEndpoint,
    answer_in_time,
    data_url,
    endpoint_from_environment,
    question_message,
    request_answer,
)
from vap_core.perception.describe import (
    COLOURS,
    WORDS,
    AttributeCaptioner,
    Captioner,
    ChatCaptioner,
    colour_indices,
    load_captioner,
    pattern_of,
    with_description,
)

TABLE = (150, 148, 145)
INKS = {
    "black": (20, 20, 22), "white": (238, 236, 232), "brown": (105, 70, 45), "beige": (205, 185, 150), "pink": (240, 150, 170),
    "red": (200, 35, 40), "orange": (240, 130, 30), "yellow": (240, 215, 50), "green": (50, 150, 70), "teal": (30, 140, 140), "blue": (45, 85, 180),
    "purple": (130, 60, 160),
}  # fmt: skip


def everything_but_the_table(image: np.ndarray, boxes: Boxes) -> np.ndarray:
    """Exact: an object is whatever is not the table."""
    return np.repeat((np.abs(image.astype(int) - TABLE).max(axis=2) > 12)[None], len(boxes), axis=0)


TELL = AttributeCaptioner(everything_but_the_table)


def words(told: Description | None) -> tuple[str, str]:
    assert told is not None
    return told.short, told.long


def thing(
    base: str, height: int = 120, width: int = 120, pattern: str = "", ink: str = "white"
) -> np.ndarray:
    """A painted block on the table, 10 pixels of which show all around."""
    block = np.full((height, width, 3), INKS[base], np.uint8)
    y, x = np.mgrid[0:height, 0:width]
    painted = {
        "stripes": x % 24 < 9, "bands": y % 30 < 9, "spots": (x % 24 - 12) ** 2 + (y % 24 - 12) ** 2 < 30, "parts": y < 2 * height // 5, "": x < 0,
        "patches": ((x - 25) ** 2 + (y - 30) ** 2 < 400) | ((x - 90) ** 2 + (y - 90) ** 2 < 400),
    }[pattern]  # fmt: skip
    block[painted] = INKS[ink]
    out = np.full((height + 20, width + 20, 3), TABLE, np.uint8)
    out[10:-10, 10:-10] = block
    return out


@pytest.mark.parametrize("name", sorted(INKS))
def test_plain_things_have_the_colour_that_they_have(name: str) -> None:
    told = TELL([thing(name)], "cup")
    assert told.short.removeprefix("dark ").removeprefix("light ") == name
    assert told.long == f"a compact cup, mostly {told.short}, plain"


@pytest.mark.parametrize("pattern", ["stripes", "bands", "spots", "patches", "parts"])
@pytest.mark.parametrize(("base", "ink"), [("blue", "white"), ("white", "red"), ("green", "black")])
def test_patterns_are_named(base: str, ink: str, pattern: str) -> None:
    told = TELL([thing(base, pattern=pattern, ink=ink)], "cup")
    first, _, rest = told.short.partition(" with ")
    assert (first.removeprefix("dark ").removeprefix("light "), rest) == (base, f"{ink} {pattern}")
    assert told.long.startswith(f"a compact cup, mostly {told.short}")


def test_bands_turned_a_quarter_are_stripes() -> None:
    banded = thing("blue", pattern="bands")
    assert TELL([banded], "cup").short == "blue with white bands"
    assert TELL([np.ascontiguousarray(np.rot90(banded))], "cup").short == "blue with white stripes"


def test_proportions_are_those_of_the_object() -> None:
    assert [
        TELL([thing("red", h, w)], "cup").long.split()[1]
        for h, w in ((180, 90), (110, 120), (60, 150))
    ] == ["tall", "compact", "wide"]


def test_shade_and_darkness_are_told_apart() -> None:
    assert TELL([thing("white")], "cup").short == "white"
    half = thing("white")
    half[:, 70:] = (half[:, 70:] * 0.6).astype(np.uint8)
    assert TELL([half], "cup").short == "white"
    assert TELL([(thing("blue") * 0.5).astype(np.uint8)], "cup").short == "dark blue"


@settings(max_examples=8)
@given(st.permutations(range(4)), st.sampled_from(["blue", "red", "white"]), st.integers(100, 400))
def test_neither_order_nor_size_of_the_pictures_matters(
    order: list[int], base: str, side: int
) -> None:
    crops = [
        thing(base, pattern=pattern, ink="black")
        for pattern in ("spots", "spots", "parts", "spots")
    ]
    told = TELL(crops, "cup")
    assert words(TELL([crops[i] for i in order], "cup")) == words(told)
    scaled = [
        cv2.resize(
            crop, (side, side), interpolation=cv2.INTER_AREA if side < 140 else cv2.INTER_NEAREST
        )
        for crop in crops
    ]
    assert TELL(scaled, "cup").short.split(" with ")[0] == told.short.split(" with ")[0]


@settings(max_examples=25)
@given(
    st.lists(st.tuples(*[st.integers(0, 255)] * 3), min_size=1, max_size=4),
    st.integers(1, 60),
    st.integers(1, 60),
)
def test_whatever_is_shown_is_put_into_known_words(
    colours: list[tuple[int, int, int]], h: int, w: int
) -> None:
    """Also a noisy crop of one pixel: the vocabulary of a policy can hold every word that will be said."""
    rng = np.random.default_rng(h)
    crops = [
        np.clip(np.full((h, w, 3), colour) + rng.integers(-40, 40, (h, w, 3)), 0, 255).astype(
            np.uint8
        )
        for colour in colours
    ]
    told = TELL(crops, "cup")
    for text in (told.short, told.long):
        assert set(text.replace(",", "").split()) <= {*WORDS, "cup"}
        assert text == text.strip()


def test_every_pixel_has_a_name_and_grey_needs_no_colour() -> None:
    ramp = np.repeat(np.arange(256, dtype=np.uint8)[None, :, None], 3, axis=2)
    found = [COLOURS[i] for i in colour_indices(ramp, np.ones((1, 256), bool))[0][0]]
    assert (found[0], found[255]) == ("black", "white")
    assert [name for i, name in enumerate(found) if i == 0 or name != found[i - 1]] == [
        "black",
        "grey",
        "white",
    ]


def test_nothing_is_part_of_nothing() -> None:
    assert pattern_of(np.zeros((9, 9), bool), np.ones((9, 9), bool)) == "parts"


def test_an_object_is_described_and_stays_itself() -> None:
    obj = personal("mug", "cup", (200, 35, 40))
    after = with_description(obj, TELL)
    assert words(after.description) == words(TELL(obj.crops, "cup"))
    assert (after.name, after.crops is obj.crops, after.embeddings is obj.embeddings) == (
        "mug",
        True,
        True,
    )


def test_the_shipped_segmenter_and_pictures_of_real_renders() -> None:
    from vap_core.perception.embedded.segmenter import load
    from vap_core.simulation.assets.objects import get_object
    from vap_core.simulation.studio import reference_views

    tell = load_captioner(load())
    told = {
        name: tell([view[60:-60, 60:-60] for view in reference_views(get_object(name))], "thing")
        for name in ("cat-figurine-personal", "scrubber-personal")
    }
    assert told["cat-figurine-personal"].short.startswith("black")
    assert "red with green" in told["scrubber-personal"].short


@pytest.fixture(autouse=True)
def _no_proxy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("no_proxy", "127.0.0.1")
    for name in ("OPENAI_BASE_URL", "OPENAI_MODEL", "OPENAI_API_KEY"):
        monkeypatch.delenv(name, raising=False)


def test_a_model_sees_every_crop_and_is_asked_once_for_each_length() -> None:
    crops = [thing("red"), thing("blue")]
    with serving(says('"A red cup."'), says("a  red cup\nwith a thin rim")) as server:
        told = ChatCaptioner(ChatEndpoint(server.url, "seer-1", "secret"))(crops, "cup")
    assert words(told) == ("A red cup", "a red cup with a thin rim")
    (path, key, short), (_, _, long) = server.asked
    assert (path, key, short["model"]) == ("/v1/chat/completions", "Bearer secret", "seer-1")
    text, *pictures = short["messages"][0]["content"]
    assert "same cup" in text["text"]
    assert text["text"] != long["messages"][0]["content"][0]["text"]
    assert [picture["image_url"]["url"] for picture in pictures] == [
        data_url(crop) for crop in crops
    ]
    assert set(short) == {"model", "messages"}


def test_a_picture_as_an_address_is_the_picture() -> None:
    import base64

    rgb = np.random.default_rng(0).integers(0, 256, (7, 5, 3), np.uint8)
    data = np.frombuffer(
        base64.b64decode(data_url(rgb).removeprefix("data:image/png;base64,")), np.uint8
    )
    assert (cv2.cvtColor(cv2.imdecode(data, cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB) == rgb).all()


@pytest.mark.parametrize(
    ("answer", "said"),
    [
        (
            (401, {"error": {"message": "bad key\nsecond line"}}),
            r"refuses \(401: bad key second line\); check OPENAI_BASE_URL, OPENAI_MODEL and",
        ),
        ((500, b"<html>oops"), r"refuses \(500: <html>oops\)"),
        (
            (302, b"", ("Location", "http://127.0.0.1:9/elsewhere")),
            r"refuses \(302: it redirects to http://127.0.0.1:9/elsewhere, which is not",
        ),
        ((200, b"not json"), "does not answer as a chat endpoint does"),
        ((200, b"[" * 100_000), "does not answer as a chat endpoint does"),
        ((200, {"choices": []}), "does not answer as a chat endpoint does"),
        (says(None), "does not answer as a chat endpoint does"),
        (says("  "), "does not answer as a chat endpoint does"),
        (says("word " * 300), "gives no phrase of 1 to 1000 characters"),
        (says("\x1b[31mred"), "gives no phrase"),
    ],
)
def test_what_goes_wrong_is_one_line(answer: Any, said: str) -> None:
    with serving(answer) as server, pytest.raises(BadEndpoint, match=said) as caught:
        ChatCaptioner(ChatEndpoint(server.url, "seer-1", "secret"))([thing("red")], "cup")
    assert "\n" not in str(caught.value)
    assert "secret" not in str(caught.value)


def ask(endpoint: ChatEndpoint) -> str:
    return request_answer(
        endpoint, [question_message("what?")], doing="ask", instead="another server"
    )


def test_no_server_and_a_silent_one_are_said() -> None:
    with serving() as server:
        url = server.url
    with pytest.raises(BadEndpoint, match=r"gives no answer \(.*refused\); is the server up"):
        ask(ChatEndpoint(url, "seer-1"))
    import socket

    with (
        socket.create_server(("127.0.0.1", 0)) as mute,
        pytest.raises(BadEndpoint, match=r"gives no answer \(timed out\)"),
    ):
        ask(ChatEndpoint(f"http://127.0.0.1:{mute.getsockname()[1]}/v1", "seer-1", timeout_s=0.2))


@pytest.mark.parametrize("url", ["http://api..example.com/v1", "http://127.0.0.1:1/vü1"])
def test_an_address_that_cannot_be_asked_is_said_at_once(url: str) -> None:
    """It left the one who waits for the answer waiting ten minutes."""
    endpoint = ChatEndpoint(url, "seer-1", total_s=60.0)
    with pytest.raises(BadEndpoint, match="gives no answer"):
        ChatCaptioner(endpoint)([np.zeros((8, 8, 3), np.uint8)], "cup")


def test_whatever_ends_a_question_ends_the_wait() -> None:
    def ask() -> str:
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        answer_in_time(ChatEndpoint("http://127.0.0.1:1/v1", "m"), ask, doing="x", instead="y")


@contextmanager
def endless(head: bytes, drip: bytes, pause_s: float) -> Iterator[str]:
    """A server whose answer begins with `head` and goes on with `drip` for ever; its address."""
    import socket

    def answer(server: socket.socket) -> None:
        with suppress(OSError):
            connection, _ = server.accept()
            with connection:
                connection.settimeout(2)
                connection.sendall(head)
                while not stop.wait(pause_s):
                    connection.sendall(drip)

    stop = threading.Event()
    with socket.create_server(("127.0.0.1", 0)) as server:
        thread = threading.Thread(target=answer, args=(server,))
        thread.start()
        yield f"http://127.0.0.1:{server.getsockname()[1]}/v1"
        stop.set()
        thread.join()


@pytest.mark.parametrize(
    ("head", "drip", "pause_s", "said"),
    [
        (b"HTTP/1.1 200 OK\r\n\r\n", b"x" * 65536, 0.0, "answers with over 4 MB"),
        (b"HTTP/1.1 200 OK\r\n\r\n", b"x", 0.02, "no whole answer within 0.3 s"),
        (b"HTTP/1.1 200 OK\r\n", b"x", 0.02, "no whole answer within 0.3 s"),
        (b"HTTP/1.1 200 OK\r\n", b"a: b\r\n", 0.0, r"gives no answer \("),
        (b"HTTP/1.1 200 OK\r\nContent-Length: 9\r\n\r\n", b"", 0.02, "no whole answer|no answer"),
        (b"HTTP/1.1 200 OK\r\nContent-Length: 2\r\n\r\n{}", b"", 0.0, "does not answer as"),
    ],
)
def test_an_answer_without_end_is_given_up(
    head: bytes, drip: bytes, pause_s: float, said: str
) -> None:
    start = time.monotonic()
    with endless(head, drip, pause_s) as url:
        endpoint = ChatEndpoint(url, "seer-1", "secret", total_s=0.3 if pause_s else 20.0)
        with pytest.raises(BadEndpoint, match=said) as caught:
            ask(endpoint)
    assert time.monotonic() - start < 10
    assert "secret" not in str(caught.value)


def test_where_to_ask_comes_from_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(BadEndpoint, match="'' is no address"):
        endpoint_from_environment()
    with pytest.raises(BadEndpoint, match="set OPENAI_MODEL"):
        endpoint_from_environment("http://127.0.0.1:1/v1")
    for url in ("file:///etc/passwd", "ftp://host/v1", "http://"):
        with pytest.raises(BadEndpoint, match="is no address of a chat endpoint"):
            ChatEndpoint(url, "m")
    monkeypatch.setenv("OPENAI_BASE_URL", "http://127.0.0.1:1/v1")
    monkeypatch.setenv("OPENAI_MODEL", "seer-2")
    monkeypatch.setenv("OPENAI_API_KEY", "hush")
    found = load_captioner(everything_but_the_table, "chat")
    assert isinstance(found, ChatCaptioner)
    assert (found.endpoint.url, found.endpoint.model, found.endpoint.key) == (
        "http://127.0.0.1:1/v1",
        "seer-2",
        "hush",
    )
    assert "hush" not in repr(found)
    assert (
        load_captioner(everything_but_the_table, "http://127.0.0.1:2/v1").endpoint.url
        == "http://127.0.0.1:2/v1"
    )


@pytest.mark.parametrize(
    "one",
    [
        TELL,
        ChatCaptioner(ChatEndpoint("http://127.0.0.1:1/v1", "m")),
        lambda crops, category: Description("a", "b"),
    ],
)
def test_captioners_are_captioners(one: Any) -> None:
    assert isinstance(one, Captioner)
    assert load_captioner(everything_but_the_table) == TELL
