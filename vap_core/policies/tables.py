"""A model's table of word embeddings, read by name from its safetensors files in blocks of rows.

    table = open_table(Path("data/policies/mini-paligemma"))
    table.block(0, 64)                                # 64 x width, float32

It works on a folder of a PaliGemma, of a pi0, pi0.5 or SmolVLA as lerobot saves it, and of the
small ones that ship. Files are parsed, never executed, and no more than a block is in memory.
"""

import json
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Int64

from vap_core.base.errors import BadPolicy, first_line
from vap_core.base.files import parse_json

INPUT = re.compile(r"(.*\.)?(language|text)_model\.(model\.)?embed_tokens\.weight")
"""The table that the decoder reads, by every name that lerobot and transformers give it."""
TIED = re.compile(r"(.*\.)?(paligemma\.|language_model\.)lm_head\.weight|lm_head\.weight")
"""The same table under its output's name: a file with tied weights may hold this one alone."""
TYPES = ("F32", "F16", "BF16")


@dataclass(frozen=True)
class EmbeddingTable:
    """Where a table lies: rows are tokens, columns features."""

    file: Path
    name: str
    shape: tuple[int, int]

    def block(self, start: int, stop: int) -> Float32[np.ndarray, "r d"]:
        """Rows `start` to `stop`, without the last."""
        from safetensors import safe_open

        with safe_open(self.file, "pt") as stored:
            return stored.get_slice(self.name)[start : min(stop, self.shape[0])].float().numpy()

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
    from safetensors import SafetensorError, safe_open

    found: dict[re.Pattern[str], tuple[Path, str, str, list[int]]] = {}
    for file in sorted(folder.glob("*.safetensors")):
        try:
            with safe_open(file, "np") as stored:
                for name in list(stored.keys()):
                    for pattern in (INPUT, TIED):
                        if pattern.fullmatch(name):
                            part = stored.get_slice(name)
                            about = file, name, part.get_dtype(), part.get_shape()
                            found.setdefault(pattern, about)
        except (OSError, SafetensorError) as error:
            raise BadPolicy(
                f"embeddings: {file} is damaged ({first_line(error):.120}); copy or download it "
                "again."
            ) from error
    if not found:
        raise BadPolicy(
            f"embeddings: {folder} holds no table of word embeddings; give the folder of a "
            "PaliGemma, pi0, pi0.5 or mini-pi0 in safetensors."
        )
    file, name, kind, shape = found.get(INPUT) or found[TIED]
    if kind not in TYPES or len(shape) != 2 or 0 in shape:
        raise BadPolicy(
            f"embeddings: {name} in {file} is {kind} of {tuple(shape)}; save it as rows and "
            f"columns of one of {', '.join(TYPES)}."
        )
    return EmbeddingTable(file, name, (shape[0], shape[1]))


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
        used = {token for text in texts for token in encode(text)}
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
        known = {word: token for token, word in enumerate(words)}
        return known, lambda text: [known[word] for word in words_of(text) if word in known]
    for file in (folder / name for name in TOKENIZERS):
        if file.is_file():
            from tokenizers import Tokenizer

            try:
                tokenizer = Tokenizer.from_str(json.dumps(parse_json(file.read_text())))
            except Exception as error:  # the library raises no narrower kind
                raise BadPolicy(
                    f"embeddings: {file} is no tokenizer ({type(error).__name__}); download it "
                    "again."
                ) from error

            def encode(text: str, of: Tokenizer = tokenizer) -> list[int]:
                return of.encode(text, add_special_tokens=False).ids

            return tokenizer.get_vocab(with_added_tokens=True), encode
    return None


def words_of(text: str) -> list[str]:
    """The words of a text as a small model reads them, in lower case."""
    return re.findall(r"<\w+>|[\w']+", text.lower())
