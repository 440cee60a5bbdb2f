"""A personal object in words: the short and the long description of a hard prompt (P appendix).

A captioner is any function (reference crops, category) -> Description. `AttributeCaptioner` counts
colours, patterns and proportions: offline, always the same, in the words of `WORDS` alone.
`ChatCaptioner` sends the crops to a vision-language model, as the paper does with GPT-5.1.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol, runtime_checkable

import numpy as np

from vap_core.base.errors import BadEndpoint
from vap_core.base.types import Description, PersonalObject, Rgb
from vap_core.perception.attributes import PATTERNS, SHAPES, CropAttributes, measure_crop
from vap_core.perception.chat import (
    ChatEndpoint,
    endpoint_from_environment,
    question_message,
    request_answer,
)
from vap_core.perception.colours import COLOURS, SHADES, add_shade
from vap_core.perception.protocols import Segmenter

PROMINENT_SHARE = 0.06
"""Share of an object's pixels that a colour needs to be in the short description."""
MINOR_SHARE = 0.025
"""Share of an object's pixels that a colour needs to be in the long description."""
GREY_SHARE = 0.3
"""Share that grey needs: less of it is shade, or table."""
CONNECTIVES = ("mostly", "and", "with", "a", "little", "patterned", "plain", "all", "over")
WORDS = (*COLOURS, *PATTERNS, *SHAPES, *SHADES, *CONNECTIVES)
"""Every word of the descriptions of `AttributeCaptioner`, besides the category's."""
SHORT_QUESTION = (
    "All pictures show one and the same {category}. Say in one short English noun phrase what "
    "distinguishes it from others of its kind: form, colour, material. No sentence. Leave out "
    "where it stands, how it is turned, and what is around it."
)
LONG_QUESTION = (
    "All pictures show one and the same {category}. Describe it in one long English noun phrase, "
    "so exactly that it could be picked out among similar ones: form and proportions, material and "
    "finish, every colour, pattern and decoration, rims, openings and other parts. No sentence. "
    "Leave out where it stands, how it is turned, and what is around it."
)
"""What the paper asks its model, in other words."""
MAX_CHARACTERS = 1000
"""Length of a description."""


@runtime_checkable
class Captioner(Protocol):
    """Describes one object from its reference crops, in words that can follow "my cup is"."""

    def __call__(self, crops: Sequence[Rgb], category: str) -> Description: ...


def load_captioner(segmenter: Segmenter, where: str = "offline") -> Captioner:
    """The captioner called `where`.

    "offline" counts attributes; "chat" uses the chat endpoint of the environment's variables, and
    anything else is the address of one.

    Raises: BadEndpoint.
    """
    if where == "offline":
        return AttributeCaptioner(segmenter)
    if where == "chat":
        return ChatCaptioner(endpoint_from_environment())
    return ChatCaptioner(endpoint_from_environment(where))


def with_description(obj: PersonalObject, captioner: Captioner) -> PersonalObject:
    """The object with the captioner's description of it."""
    return replace(obj, description=captioner(obj.crops, obj.category))


@dataclass(frozen=True)
class AttributeCaptioner:
    """The offline captioner: colours, patterns and proportions of the segmented object.

    short: "white with blue spots"; long: "a tall vase, mostly white with blue spots and a little
    black, patterned all over".
    """

    segmenter: Segmenter

    def __call__(self, crops: Sequence[Rgb], category: str) -> Description:
        measured: list[CropAttributes] = []
        for rgb in crops:
            measured.append(measure_crop(rgb, self.segmenter))
        return phrase_attributes(measured, category)


@dataclass(frozen=True)
class ChatCaptioner:
    """The captioner behind a chat endpoint: one question for each length, with all crops."""

    endpoint: ChatEndpoint

    def __call__(self, crops: Sequence[Rgb], category: str) -> Description:
        """Ask for the short description, then for the long one.

        Raises: BadEndpoint: the endpoint fails, or its answer is no short line of text.
        """
        return Description(
            short=self._request_phrase(SHORT_QUESTION.format(category=category), crops),
            long=self._request_phrase(LONG_QUESTION.format(category=category), crops),
        )

    def _request_phrase(self, question: str, crops: Sequence[Rgb]) -> str:
        """The model's answer as one line, without quotes or a full stop."""
        answer = request_answer(
            self.endpoint,
            [question_message(question, crops)],
            doing="describe",
            instead="another server whose model sees pictures",
        )
        phrase = " ".join(answer.split()).strip(" \"'`.“”")
        if not phrase or len(phrase) > MAX_CHARACTERS or not phrase.isprintable():
            raise BadEndpoint(
                f"describe: {self.endpoint.model} at {self.endpoint.url} gives no phrase of "
                f"1 to {MAX_CHARACTERS} characters, but {phrase[:60]!r}; try another model."
            )
        return phrase


def phrase_attributes(measured: Sequence[CropAttributes], category: str) -> Description:
    """Put what was measured of an object's crops into words."""
    share = _mean_shares(measured)
    main_colour, *others = sorted(COLOURS, key=share.__getitem__, reverse=True)
    main = add_shade(main_colour, _median_lightness(measured, main_colour))
    prominent: list[str] = []
    minor: list[str] = []
    other_shares: list[float] = []
    busy_pattern = False
    for name in others:
        if not share[name] >= MINOR_SHARE:
            continue
        pattern = _usual_pattern(measured, name)
        busy_pattern |= pattern in ("stripes", "spots", "patches")
        other_shares.append(share[name])
        if share[name] >= PROMINENT_SHARE:
            prominent.append(f"{name} {pattern}")
        else:
            minor.append(name)
    prominent = prominent[:2]

    short = main
    details = list(prominent)
    ending = ""
    if prominent:
        short = f"{main} with {' and '.join(prominent)}"
    if minor:
        details.append(f"a little {' and '.join(minor[:2])}")
    if busy_pattern and sum(other_shares) > 1.5 * PROMINENT_SHARE:
        ending = ", patterned all over"
    elif not prominent:
        ending = ", plain"
    if details:
        main = f"{main} with {' and '.join(details)}"
    return Description(short, f"a {_usual_shape(measured)} {category}, mostly {main}{ending}")


def _mean_shares(measured: Sequence[CropAttributes]) -> dict[str, float]:
    """Every colour's share of the object, over all crops."""
    share: dict[str, float] = {}
    for name in COLOURS:
        share[name] = float(np.mean([crop.share[name] for crop in measured]))
    if share["grey"] < GREY_SHARE:
        share["grey"] = 0.0
    return share


def _median_lightness(measured: Sequence[CropAttributes], name: str) -> float:
    shown = [crop.lightness[name] for crop in measured if crop.share[name] > MINOR_SHARE]
    return float(np.median(shown))


def _usual_pattern(measured: Sequence[CropAttributes], name: str) -> str:
    """The most frequent pattern of a colour; "parts" when no crop shows enough of it."""
    shown = Counter(crop.pattern[name] for crop in measured if crop.share[name] > MINOR_SHARE)
    if not shown:
        return "parts"
    return shown.most_common(1)[0][0]


def _usual_shape(measured: Sequence[CropAttributes]) -> str:
    """The most frequent shape; "parts" when there is no crop."""
    shapes = Counter(crop.shape for crop in measured)
    if not shapes:
        return "parts"
    return shapes.most_common(1)[0][0]
