"""A model's table of word embeddings, read by name from its safetensors files in blocks of rows.

    table = open_table(Path("data/policies/mini-paligemma-tint-free"))
    table.block(0, 64)                                # 64 x width, float32

It works on a folder of a PaliGemma, of a pi0, pi0.5 or SmolVLA as lerobot saves it, and of the
small ones that ship. Files are parsed, never executed, and no more than a block is in memory.
"""

import json
import re
import struct
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32, Int64

from vap_core.base.errors import BadPolicy
from vap_core.base.files import parse_json

INPUT = re.compile(r"(.*\.)?(language|text)_model\.(model\.)?embed_tokens\.weight")
"""The table that the decoder reads, by every name that lerobot and transformers give it."""
TIED = re.compile(r"(.*\.)?(paligemma\.|language_model\.)lm_head\.weight|lm_head\.weight")
"""The same table under its output's name: a file with tied weights may hold this one alone."""
TYPES: dict[str, np.dtype[Any]] = {
    "F32": np.dtype("<f4"),
    "F16": np.dtype("<f2"),
    "BF16": np.dtype("<u2"),
}
LONGEST_HEADER = 100_000_000
"""Bytes; safetensors' own limit."""


@dataclass(frozen=True)
class EmbeddingTable:
    """Where a table lies: rows are tokens, columns features."""

    file: Path
    name: str
    kind: str
    shape: tuple[int, int]
    offset: int

    def block(self, start: int, stop: int) -> Float32[np.ndarray, "r d"]:
        """Rows `start` to `stop`, without the last."""
        stored = TYPES[self.kind]
        rows, width = self.shape
        start, stop, _ = slice(start, stop).indices(rows)
        mapped = np.memmap(
            self.file,
            dtype=stored,
            mode="r",
            offset=self.offset + start * width * stored.itemsize,
            shape=(stop - start, width),
        )
        if self.kind == "BF16":
            return (mapped.astype(np.uint32) << 16).view(np.float32)
        return np.array(mapped, np.float32)

    def rows(self) -> Float32[np.ndarray, "v d"]:
        """The whole table."""
        return self.block(0, self.shape[0])


def check_width(table: EmbeddingTable, width: int, of: str) -> None:
    """Raises: BadPolicy when a table does not have the `width` features that `of` has."""
    if table.shape[1] != width:
        raise BadPolicy(
            f"embeddings: {table.file.parent} has {table.shape[1]} features and {of} has {width}; "
            "take a model with a token that was learned in it, or a policy that grew from it."
        )


def open_table(folder: Path) -> EmbeddingTable:
    """The table of word embeddings of the model in a folder, whatever number of files it has.

    Raises: BadPolicy when there is none, or when a file is damaged.
    """
    tied = None
    for file in sorted(folder.glob("*.safetensors")):
        for name, about in _header(file).items():
            if INPUT.fullmatch(name):
                return _table(file, name, about)
            if TIED.fullmatch(name):
                tied = (file, name, about)
    if tied is None:
        raise BadPolicy(
            f"embeddings: {folder} holds no table of word embeddings; give the folder of a "
            "PaliGemma, pi0, pi0.5 or mini-pi0 in safetensors."
        )
    return _table(*tied)


def _header(file: Path) -> dict[str, Mapping[str, Any]]:
    """What a safetensors file says of its tensors, by name. Raises: BadPolicy."""
    try:
        with file.open("rb") as stream:
            (length,) = struct.unpack("<Q", stream.read(8))
            if length > LONGEST_HEADER:
                raise ValueError("its header is too long")
            header = parse_json(stream.read(length))
        header.pop("__metadata__", None)
        for about in header.values():
            begin, end = about["data_offsets"]
            if begin < 0:
                raise ValueError("a tensor lies before the data")
            about["data_offsets"] = (8 + length + begin, 8 + length + end)
    except (OSError, struct.error, ValueError, KeyError, TypeError, AttributeError) as error:
        raise _damaged(file, type(error).__name__) from error
    return header


def _table(file: Path, name: str, about: Mapping[str, Any]) -> EmbeddingTable:
    """The table that a header describes. Raises: BadPolicy when the file does not hold it."""
    kind = about.get("dtype")
    if kind not in TYPES:
        raise BadPolicy(
            f"embeddings: {name} in {file} is stored as {kind}; save it as one of "
            f"{', '.join(TYPES)}."
        )
    rows, width = _size(about.get("shape"))
    begin, end = about["data_offsets"]
    if rows * width == 0 or end - begin != rows * width * TYPES[kind].itemsize:
        raise _damaged(file, f"{name} does not have the bytes of its shape")
    if end > file.stat().st_size:
        raise _damaged(file, f"it ends before {name} does")
    return EmbeddingTable(file=file, name=name, kind=kind, shape=(rows, width), offset=begin)


def _size(shape: Any) -> tuple[int, int]:
    """Rows and columns; zeros when it is not two positive whole numbers."""
    if not isinstance(shape, list) or len(shape) != 2:
        return 0, 0
    for size in shape:
        if not isinstance(size, int) or size <= 0:
            return 0, 0
    return shape[0], shape[1]


def _damaged(file: Path, reason: str) -> BadPolicy:
    return BadPolicy(f"embeddings: {file} is damaged ({reason:.120}); copy or download it again.")


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
