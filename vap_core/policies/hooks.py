"""What a policy consumed and what it attended to, observed while it plans.

Without an observer a policy does no extra work.

    with observe_inputs() as digests:
        policy.plan(states, inputs)
    digests[0]["front"]       # first episode of the batch: SHA-256 of the tensor of camera "front"

    with observe_attention([{"colour": ("red", "blue")}]) as maps:
        policy.plan(states, inputs)
    maps[0]["front"]["colour"]    # first episode: layers x heads x rows x columns of patches

A policy that reports nothing leaves `digests` or `maps` empty.
"""

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar

import numpy as np
from jaxtyping import Float32

TEXT = "text"
"""The name under which a policy reports its text or tokens.

Images are reported under their camera's name.
"""
ACTION = "action"
"""The query of the action expert's tokens; the other queries are words of the instruction."""
Phrases = Mapping[str, tuple[str, ...]]
"""The phrases of every query that is words."""
AttentionMap = Float32[np.ndarray, "layers heads rows columns"]
"""The share of a query's attention that every image patch gets.

It is the mean over the query's tokens; that of ACTION over the chunk's actions and the denoising
steps, too.
"""
AttentionMaps = dict[int, dict[str, Mapping[str, AttentionMap]]]
"""By episode of the batch, then by camera, then by query.

A query whose words are not in the text is left out.
"""


class Hook[T]:
    """One kind of report. The first report of an episode under a name is kept."""

    def __init__(self, name: str) -> None:
        self._reports: ContextVar[dict[int, dict[str, T]] | None] = ContextVar(name, default=None)

    @contextmanager
    def observe(self) -> Iterator[dict[int, dict[str, T]]]:
        """Collect what policies report inside the block."""
        reports: dict[int, dict[str, T]] = {}
        token = self._reports.set(reports)
        try:
            yield reports
        finally:
            self._reports.reset(token)

    def observed(self) -> bool:
        """Whether a report would be collected; what is costly to compute is computed only then."""
        return self._reports.get() is not None

    def report(self, episode: int, name: str, value: T) -> None:
        """Report `value` for episode number `episode` of the batch."""
        reports = self._reports.get()
        if reports is not None:
            reports.setdefault(episode, {}).setdefault(name, value)


_inputs: Hook[str] = Hook("inputs")
observe_inputs = _inputs.observe
inputs_observed = _inputs.observed

_attention: Hook[Mapping[str, AttentionMap]] = Hook("attention")
_phrases: ContextVar[Sequence[Phrases]] = ContextVar("phrases", default=())
attention_observed = _attention.observed
report_attention = _attention.report


@contextmanager
def observe_attention(phrases: Sequence[Phrases] = ()) -> Iterator[AttentionMaps]:
    """Collect where policies look inside the block.

    `phrases` has an entry per episode of the batch; without it only ACTION is a query.
    """
    token = _phrases.set(phrases)
    try:
        with _attention.observe() as maps:
            yield maps
    finally:
        _phrases.reset(token)


def layer_shown(query: str, n_layers: int) -> int:
    """The last layer in which what a query attends to has an effect on the actions.

    The action expert reads keys and values of the vision-language model's layers, which a layer
    computes before it attends: what the words of the last layer attend to reaches no action. So it
    is the last layer but one for words, and the expert's last for its own tokens. A model of one
    layer has none for words; its only layer is returned.
    """
    return n_layers - 1 if query == ACTION else max(n_layers - 2, 0)


def heat_map(weights: AttentionMap, query: str) -> Float32[np.ndarray, "rows columns"]:
    """The mean over heads of the layer shown."""
    return weights[layer_shown(query, len(weights))].mean(0)


def phrases_of(episode: int) -> Phrases:
    """The phrases that are observed in one episode of the batch."""
    phrases = _phrases.get()
    return phrases[episode] if phrases else {}


def report_input(episode: int, name: str, consumed: np.ndarray | str) -> None:
    """Report the digest of an array, or of a text, that the policy consumes for one episode."""
    if not inputs_observed():
        return
    if isinstance(consumed, str):
        data = consumed.encode()
    else:
        header = str((consumed.dtype, consumed.shape)).encode()
        data = header + np.ascontiguousarray(consumed).tobytes()
    _inputs.report(episode, name, hashlib.sha256(data).hexdigest())
