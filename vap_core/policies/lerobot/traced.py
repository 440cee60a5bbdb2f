"""A policy's call as one traced graph: the same actions, in about half of the time.

Half of a call of a small pi0 is Python around small layers. `torch.jit.trace` writes down the
tensor operations of one call, and the graph runs them without that Python. Nothing is fused or
reordered, so the actions are the same bits.

- A trace costs as much as some forty calls save, so it waits for CALLS_BEFORE_TRACE eager calls: a
  process that runs a job or two does not pay for it.
- One graph serves every batch size, and every length of text of a mini-pi0. The first call of every
  shape runs eagerly as well and is compared; only then does the graph serve that shape.
- Sampling noise is an input of the graph. The configuration (temperature, denoising steps) is part
  of it: when it changes, the graphs are made again.
- The graph has no copies of the weights: a weight that is written to in place changes its actions,
  too. A weight that is replaced by another tensor does not, but the checksum of weight_guard, which
  reads the policy itself, refuses the episodes in both cases.
- While something watches the call (hooks on modules, which learned tokens and attention maps need,
  or an observer of policies.hooks) it runs eagerly.
"""

import copy
import sys
import warnings
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any
from unittest.mock import patch

import torch
from torch.nn.modules import module as torch_module

from vap_core.base.errors import first_line
from vap_core.policies.protocol import attention_observed, inputs_observed

if TYPE_CHECKING:
    from lerobot.policies.pretrained import PreTrainedPolicy

CALLS_BEFORE_TRACE = 20
"""Eager calls before a trace is made; see above."""
NOISE = "noise"
"""The key of the sampling noise among a graph's inputs."""
Inputs = dict[str, torch.Tensor]
"""A preprocessed batch, of which only the tensors are kept, and the sampling noise."""
Signature = tuple[tuple[str, torch.dtype, tuple[int, ...]], ...]
"""The name, the type and the shape of every input."""
Graph = Callable[[Inputs], torch.Tensor]


class ChunkPredictor:
    """`predict_action_chunk` of a policy, traced once it was called often.

    It is for policies whose chunk is a function of the batch and the noise alone.
    """

    def __init__(self, policy: "PreTrainedPolicy", label: str) -> None:
        self.policy = policy
        self.label = label
        self.stays_eager = False
        self._modules = list(policy.modules())
        self._restart()

    def __call__(self, batch: Mapping[str, Any], noise: torch.Tensor | None) -> torch.Tensor:
        """The next chunks, episodes x steps x actions, still normalised."""
        inputs = {name: part for name, part in batch.items() if isinstance(part, torch.Tensor)}
        if noise is not None:
            inputs[NOISE] = noise
        if any(module.training for module in self._modules):
            self.policy.eval()
        if self.stays_eager or self._watched():
            return _call(self.policy, inputs)
        if self.policy.config != self._config:
            self._restart()
        signature = tuple((name, part.dtype, tuple(part.shape)) for name, part in inputs.items())
        graph = self._graphs.get(signature)
        if graph is None:
            chunks = _call(self.policy, inputs)
            self._look_for_graph(signature, inputs, chunks)
            return chunks
        with torch.jit.optimized_execution(False):
            return graph(inputs)

    def stay_eager(self, reason: str) -> None:
        """Never trace, and say so once."""
        if not self.stays_eager:
            self.stays_eager = True
            print(
                f"note: {self.label} runs as it is, not as a traced graph, which takes about half "
                f"of the time: {reason:.150}.",
                file=sys.stderr,
            )

    def _restart(self) -> None:
        """Forget all graphs."""
        self._config = copy.deepcopy(self.policy.config)
        self._graphs: dict[Signature, Graph] = {}
        self._last: Graph | None = None
        self._compared: set[Signature] = set()
        self._eager_calls = 0

    def _watched(self) -> bool:
        """Whether somebody would miss what a graph does not do, which is to run the modules."""
        if inputs_observed() or attention_observed() or torch_module._has_any_global_hook():
            return True
        return any(m._forward_hooks or m._forward_pre_hooks for m in self._modules)

    def _look_for_graph(self, signature: Signature, inputs: Inputs, chunks: torch.Tensor) -> None:
        """Give the shape of `inputs` the last graph where that agrees, else a new one, when due."""
        self._eager_calls += 1
        if self._last is not None and signature not in self._compared:
            self._compared.add(signature)
            if not _difference(self._last, inputs, chunks):
                self._graphs[signature] = self._last
                return
        if self._eager_calls < CALLS_BEFORE_TRACE:
            return
        self._eager_calls = 0
        device = self.policy.config.device
        if device != "cpu":
            self.stay_eager(f"tracing was tried on the CPU only, not on {device}")
            return
        others = {}
        for name, part in inputs.items():
            if part.dtype == torch.bool and part.ndim > 1:
                kept = torch.arange(part.shape[-1]) < (part.shape[-1] + 1) // 2
                others[name] = part & kept
            else:
                others[name] = part.flip(-1)
        try:
            graph = _trace(self.policy, inputs)
            of_others = _call(self.policy, others)
        except Exception as error:
            self.stay_eager(f"tracing failed ({type(error).__name__}: {first_line(error)})")
            return
        difference = _difference(graph, inputs, chunks) or _difference(graph, others, of_others)
        if difference:
            self.stay_eager(difference)
            return
        self._last = graph
        self._graphs[signature] = graph


def _call(policy: Any, inputs: Inputs) -> torch.Tensor:
    """lerobot's call, without its `eval()`, which would set every module at every call."""
    batch = dict(inputs)
    options = {}
    if NOISE in batch:
        options[NOISE] = batch.pop(NOISE)
    with patch.object(policy, "eval", lambda: policy):
        return policy.predict_action_chunk(batch, **options)


def _trace(policy: Any, inputs: Inputs) -> Graph:
    def call(inputs: Inputs) -> torch.Tensor:
        return _call(policy, inputs)

    with warnings.catch_warnings():
        # It warns of every size that Python reads; what the graph gives is compared instead.
        warnings.simplefilter("ignore")
        return torch.jit.trace(call, (inputs,), check_trace=False, strict=False)


def _difference(graph: Graph, inputs: Inputs, chunks: torch.Tensor) -> str:
    """How the graph's chunks differ from `chunks`; "" when they are the same bits."""
    try:
        with torch.jit.optimized_execution(False):
            traced = graph(inputs)
    except RuntimeError as error:
        return f"the graph failed ({first_line(error)})"
    if torch.equal(traced, chunks):
        return ""
    return "the graph gives other actions"
