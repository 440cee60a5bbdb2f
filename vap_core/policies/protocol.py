"""What a policy is: it maps prompted images, text and proprioception to chunks of actions.

Also the optional abilities of a policy, the shipped policies by name, and a check of its weights.
"""

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import field
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable
from weakref import WeakKeyDictionary

import numpy as np
from jaxtyping import Float32

from vap_core.base.errors import BadPolicy
from vap_core.base.files import SHIPPED as SHIPPED
from vap_core.base.types import Views, value
from vap_core.simulation.types import Pose

if TYPE_CHECKING:
    from torch import nn


Chunk = Float32[np.ndarray, "t a"]
"""Future actions, one row per control step, with a number for each of `Env.action_names`."""


@value
class PolicyInput:
    """All that a policy may read: images, text and proprioception. Never simulator state.

    `state` is that of simulation.types.Observation. `places` are the objects' poses by name, for a
    policy that declares `needs_places`: a motion that is not what is tested.
    """

    images: Views
    text: str
    state: Float32[np.ndarray, " s"]
    places: Mapping[str, Pose] = field(default_factory=dict)


@runtime_checkable
class Policy[S](Protocol):
    """A frozen policy over a batch of episodes.

    What one episode carries is state, an argument and a result. `plan` leaves the states that it is
    given as they are: where one episode fails a batch, the others are asked again. `label` names it
    wherever its numbers appear. `execute` rows of every chunk are executed before it is called
    again. A rollout needs all four, and ends with an error at a chunk of another shape or type than
    `Chunk`.
    """

    label: str
    execute: int

    def start(self, rng: np.random.Generator) -> S:
        """The state of a new episode; `rng` is that episode's own generator."""
        ...

    def plan(
        self, states: Sequence[S], inputs: Sequence[PolicyInput]
    ) -> tuple[list[S], list[Chunk]]:
        """The next chunk of every episode in the batch."""
        ...


@runtime_checkable
class PrivilegedPolicy[S](Protocol):
    """A stand-in for a policy that reads the simulator instead of images.

    The expert and the random control are such. Their results are bounds, never results of a method.
    """

    label: str
    execute: int

    def start(self, rng: np.random.Generator) -> S:
        """The state of a new episode; `rng` is that episode's own generator."""
        ...

    def plan_from_simulation(
        self, states: Sequence[S], envs: Sequence[Any]
    ) -> tuple[list[S], list[Chunk]]:
        """The next chunk of every episode in the batch."""
        ...


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
    data = consumed.encode() if isinstance(consumed, str) else b""
    if not isinstance(consumed, str):
        data = str((consumed.dtype, consumed.shape)).encode()
        data += np.ascontiguousarray(consumed).tobytes()
    _inputs.report(episode, name, hashlib.sha256(data).hexdigest())


@runtime_checkable
class Weighted(Protocol):
    """A policy that has parameters."""

    label: str

    def sha256(self) -> str:
        """Checksum of all parameters and buffers as they stand."""
        ...


_first_checksums: WeakKeyDictionary[Any, str] = WeakKeyDictionary()
"""Of every policy in this process, the checksum that it had when its first episodes began."""


def checksum(policy: object) -> str:
    """The first 16 hex digits of a policy's checksum; "" of one that has no parameters."""
    if not isinstance(policy, Weighted):
        return ""
    return policy.sha256()[:16]


def state_sha256(module: "nn.Module") -> str:
    """Checksum of a module's parameters and buffers as they stand, in the order of their names."""
    import torch

    digest = hashlib.sha256()
    for name, tensor in sorted(module.state_dict().items()):
        flat = tensor.detach().cpu().contiguous().reshape(-1)
        digest.update(name.encode())
        digest.update(flat.view(torch.uint8).numpy().tobytes())
    return digest.hexdigest()


@contextmanager
def unchanged_weights(policy: object) -> Iterator[str]:
    """Inside, episodes run; gives the checksum that the policy had when the first ones began.

    The first ones are those of this process.

    Raises: BadPolicy, on leaving, when it has another one now.
    """
    if not isinstance(policy, Weighted):
        yield ""
        return
    parameters = getattr(policy, "policy", policy)  # several policies may share one set of them
    if parameters not in _first_checksums:
        _first_checksums[parameters] = checksum(policy)
    before = _first_checksums[parameters]
    yield before
    after = checksum(policy)
    if after != before:
        raise BadPolicy(
            f"unchanged_weights: the parameters of {policy.label} changed while episodes ran "
            f"({before} before, {after} now); these are no results. Find out what trains it or "
            "writes to it, and run the same command again."
        )
