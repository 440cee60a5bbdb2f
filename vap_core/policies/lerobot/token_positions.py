"""Where the phrases of an instruction stand among its tokens."""

from collections.abc import Sequence
from typing import Any

import torch

from vap_core.policies.hooks import Phrases

Positions = dict[str, list[int]]
"""The places of every query's tokens, by query."""


def positions(preprocessor: Any, tokens: torch.Tensor, phrases: Phrases) -> Positions:
    """The places of every query's phrases in one row of tokens; a query that is not there is out.

    `preprocessor` is the policy's, which has the tokenizer.
    """
    row = tokens.tolist()
    found: Positions = {}
    for query, alternatives in phrases.items():
        places: set[int] = set()
        for phrase in alternatives:
            for spelled in _spellings(preprocessor, phrase):
                places.update(_occurrences(row, spelled))
        if places:
            found[query] = sorted(places)
    return found


def _occurrences(row: Sequence[int], spelled: Sequence[int]) -> set[int]:
    """The places of every token of every occurrence of `spelled` in `row`."""
    width = len(spelled)
    places: set[int] = set()
    for start in range(len(row) - width + 1):
        if list(row[start : start + width]) == list(spelled):
            places.update(range(start, start + width))
    return places


def _spellings(preprocessor: Any, phrase: str) -> list[list[int]]:
    """The tokens of a phrase, at the beginning of a text and after a blank.

    A phrase that the vocabulary lacks has none.
    """
    from vap_core.policies.mini_pi0.processor_mini_pi0 import SPLIT, UNKNOWN, Words  # lerobot's

    for step in preprocessor.steps:
        if isinstance(step, Words):
            known = step._vocabulary
            spelled = [known.get(word, known[UNKNOWN]) for word in SPLIT.findall(phrase.lower())]
            return [] if known[UNKNOWN] in spelled else [spelled]
        tokenizer = getattr(step, "input_tokenizer", None)
        if tokenizer is not None:
            spellings = []
            for text in (phrase, f" {phrase}"):
                spelled = list(tokenizer.encode(text, add_special_tokens=False))
                known_all = tokenizer.unk_token_id not in spelled
                if spelled and known_all and spelled not in spellings:
                    spellings.append(spelled)
            return spellings
    return []
