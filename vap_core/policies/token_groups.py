"""Which tokens of a model are the words of some texts, and which are reserved."""

import json
import re
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Int64

from vap_core.base.errors import BadPolicy
from vap_core.base.files import parse_json

RESERVED = re.compile(r"<(my_|unused|loc|seg)\d+>")
"""Words without a meaning in texts: ours, and PaliGemma's."""
TOKENIZERS = ("tokenizer.json", "tokenizer/tokenizer.json")
Encode = Callable[[str], Sequence[int]]


def token_groups(
    folders: Iterable[Path], texts: Sequence[str]
) -> dict[str, Int64[np.ndarray, " t"]]:
    """Tokens of the texts, and reserved ones, by the first folder that says what its tokens are.

    That is a small model's config.json or a tokenizer.json. Empty where no folder has one.

    Raises: BadPolicy for a damaged file.
    """
    for folder in folders:
        found = vocabulary_of(folder)
        if found is None:
            continue
        vocabulary, encode = found
        used: set[int] = set()
        for text in texts:
            used |= set(encode(text))
        reserved = [token for word, token in vocabulary.items() if RESERVED.fullmatch(word)]
        groups = {"words": sorted(used), "reserved": sorted(reserved)}
        return {name: np.array(tokens, np.int64) for name, tokens in groups.items() if tokens}
    return {}


def vocabulary_of(folder: Path) -> tuple[dict[str, int], Encode] | None:
    """The token of every word, and what encodes a text; None where the folder does not say.

    Raises: BadPolicy for a damaged file.
    """
    config = folder / "config.json"
    try:
        words = parse_json(config.read_text()).get("words") if config.is_file() else None
    except (OSError, ValueError, AttributeError) as error:
        raise BadPolicy(
            f"embeddings: {config} is no configuration ({type(error).__name__}); save it again."
        ) from error
    if words:
        vocabulary = {word: token for token, word in enumerate(words)}

        def encode_words(text: str) -> list[int]:
            return [vocabulary[word] for word in words_of(text) if word in vocabulary]

        return vocabulary, encode_words
    for name in TOKENIZERS:
        if (folder / name).is_file():
            return _tokenizer(folder / name)
    return None


def words_of(text: str) -> list[str]:
    """The words of a text as a small model reads them, in lower case."""
    return re.findall(r"<\w+>|[\w']+", text.lower())


def _tokenizer(file: Path) -> tuple[dict[str, int], Encode]:
    """A tokenizer file, which is parsed, not executed. Raises: BadPolicy."""
    from tokenizers import Tokenizer

    try:
        tokenizer = Tokenizer.from_str(json.dumps(parse_json(file.read_text())))
    except Exception as error:  # the library raises no narrower kind
        raise BadPolicy(
            f"embeddings: {file} is no tokenizer ({type(error).__name__}); download it again."
        ) from error

    def encode(text: str) -> list[int]:
        return tokenizer.encode(text, add_special_tokens=False).ids

    return tokenizer.get_vocab(with_added_tokens=True), encode
