"""The learned word of a personal object as a value, and as a small file beside the memory."""

import struct
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from vap_core.base.errors import BadMemory
from vap_core.base.files import encode_tensors, parse_json, read_file, write_atomic
from vap_core.base.types import value

SUFFIX = ".token.safetensors"
"""Of a word that was learned in the model that policies are initialised from."""
OWN_SUFFIX = ".own.token.safetensors"
"""Of a word that was learned in a policy's own weights."""


@value
class Token:
    """A learned word: its embedding in the model's space, and its accuracy on held-out photos.

    In `accuracy` positives and negatives have equal weight. `model` is the SHA-256 of the model in
    which it was learned: it means nothing in another.
    """

    object: str
    embedding: Float32[np.ndarray, " d"]
    accuracy: float
    model: str


def save(folder: Path, token: Token, suffix: str = SUFFIX) -> Path:
    """Write the object's name and `suffix`. Raises: OSError."""
    header = {"object": token.object, "accuracy": repr(token.accuracy), "model": token.model}
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{token.object}{suffix}"
    write_atomic(path, encode_tensors({"embedding": token.embedding}, header))
    return path


def load(folder: Path, name: str, model: str, suffix: str = SUFFIX) -> Token:
    """The word of that object.

    Raises: BadMemory when it is absent, damaged, of another object, or was learned in another
        model.
    """
    from safetensors import SafetensorError

    path = folder / f"{name}{suffix}"
    try:
        token = _read(path)
    except (OSError, SafetensorError, struct.error, ValueError, KeyError, TypeError) as error:
        raise BadMemory(
            f"tokens.load: {path} holds no learned word ({type(error).__name__}); learn it again."
        ) from error
    fault = _fault(token, name)
    if fault:
        raise BadMemory(f"tokens.load: {path} {fault}; learn it again.")
    if token.model != model:
        raise BadMemory(
            f"tokens.load: {path} was learned in model {token.model[:8]}, this is {model[:8]}; "
            "learn it again."
        )
    return token


def _fault(token: Token, name: str) -> str:
    """What is wrong with the word of object `name`, "" where nothing is."""
    if token.object != name:
        return f"is the word of {token.object!r}, not of {name!r}"
    if not np.isfinite(token.embedding).all():
        return "has numbers that are not finite"
    if not 0 <= token.accuracy <= 1:
        return f"has an accuracy of {token.accuracy:g}, not from 0 to 1"
    return ""


def _read(path: Path) -> Token:
    """The token in a file that `save` wrote."""
    from safetensors.numpy import load as decode

    data = read_file(path)
    (length,) = struct.unpack("<Q", data[:8])
    header = parse_json(data[8 : 8 + length])["__metadata__"]
    return Token(
        object=header["object"],
        embedding=decode(data)["embedding"],
        accuracy=float(header["accuracy"]),
        model=header["model"],
    )
