"""SAM 2.1 on a stream: every identity followed by memory attention, with a memory that does not grow (P 3.3).

A frame is compared with the opening frame and the last few. The state of a view is a value: what one step returns is all that
the next one needs. On a GPU all views of a step share one pass of the backbone; all identities of a view share one pass of the rest.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional as F  # noqa: N812

from vap_core.foundation.sam import Decoded, Features, Sam, to_pixels
from vap_core.values import Rgb, Track

CERTAIN = 10.0
"""Mask logit of what the opening masks cover; minus that outside."""


@dataclass(frozen=True, slots=True, eq=False)
class Remembered:
    """One frame in memory: of each of n identities a map of p cells, and a pointer."""

    cells: Float[Tensor, "p n m"]
    pointer: Float[Tensor, "n c"]


@dataclass(frozen=True, slots=True, eq=False)
class Stream:
    """Everything known about one view. `recent` is oldest first, and `pointers` reach further back than maps do."""

    hw: tuple[int, int]
    frame_index: int
    first: Remembered | None
    """The opening frame; None where nothing is followed."""
    recent: tuple[Remembered, ...]
    pointers: tuple[Float[Tensor, "n c"], ...]


class SamTracker:
    """The foundation tracker. Views are independent; the same frames give the same bits."""

    def __init__(self, sam: Sam) -> None:
        self.sam = sam
        config = sam.model.config
        self.recent = int(config.num_maskmem) - 1
        self.reach = int(config.max_object_pointers_in_encoder)
        h, w = sam.model.backbone_feature_sizes[-1]
        m = int(config.memory_encoder_output_channels)
        with torch.inference_mode():
            places = sam.model.memory_encoder.position_encoding(torch.Size((1, m, h, w)), sam.runtime.device, torch.float32)
        self.places: Float[Tensor, "p 1 m"] = places.flatten(2).permute(2, 0, 1)

    def start(self, images: Sequence[Rgb], masks: Sequence[Bool[np.ndarray, "_n _h _w"]]) -> list[Stream]:
        return [self._start(image, of_view) for image, of_view in zip(images, masks, strict=True)]

    def step(self, states: Sequence[Stream], images: Sequence[Rgb]) -> tuple[list[Stream], list[tuple[Track, ...]]]:
        for state, image in zip(states, images, strict=True):
            if state.hw != image.shape[:2]:
                raise ValueError(f"SamTracker.step: an image of {image.shape[:2]} after one of {state.hw}; a view keeps its size")
        busy = [i for i, state in enumerate(states) if state.first is not None]
        seen = dict(zip(busy, self.sam.look([images[i] for i in busy]), strict=True))
        done = [self._step(state, seen[i]) if i in seen else (state, ()) for i, state in enumerate(states)]
        return [state for state, _ in done], [tracks for _, tracks in done]

    def _start(self, image: Rgb, masks: Bool[np.ndarray, "n h w"]) -> Stream:
        hw = (image.shape[0], image.shape[1])
        if masks.shape[1:] != hw:
            raise ValueError(f"SamTracker.start: masks of {masks.shape[1:]} pixels for an image of {hw}; they must agree")
        if not len(masks):
            return Stream(hw, 0, None, (), ())
        sam, side = self.sam, self.sam.side
        seen = sam.recall(image)
        with torch.inference_mode():
            given = torch.from_numpy(masks.copy()).to(sam.runtime.device)[:, None].float()
            if hw != (side, side):
                given = (F.interpolate(given, (side, side), mode="bilinear", antialias=True) >= 0.5).float()
            told = sam.model.mask_downsample(given)
            size = sam.model.prompt_encoder.mask_input_size
            told = F.interpolate(told, size, mode="bilinear", antialias=True) if told.shape[-2:] != torch.Size(size) else told
            said = self._decode(seen, seen.coarse.expand(len(masks), -1, -1, -1), told)
            there = given.flatten(1).any(dim=1)
            first = self._remember(seen, CERTAIN * (2 * given - 1), self._pointer(said, there), there, sure=True)
        return Stream(hw, 0, first, (), ())

    def _step(self, state: Stream, seen: Features) -> tuple[Stream, tuple[Track, ...]]:
        assert state.first is not None
        side = self.sam.side
        with torch.inference_mode():
            said = self._decode(seen, self._attend(state, seen), None)
            there = said.presence > 0
            best = _best(said, said.logits)[:, None]
            best = torch.where(there[:, None, None, None], best, -1024.0)
            now = self._remember(seen, F.interpolate(best, (side, side), mode="bilinear"), self._pointer(said, there), there, sure=False)
            masks = (to_pixels(best, state.hw)[:, 0] > 0).cpu().numpy()
            score = said.presence.sigmoid().cpu().numpy()
        recent, pointers = (*state.recent, now)[-self.recent :], (*state.pointers, now.pointer)[-(self.reach - 1) :]
        tracks = tuple(Track(mask if mask.any() else None, float(chance)) for mask, chance in zip(masks, score, strict=True))
        return Stream(state.hw, state.frame_index + 1, state.first, recent, pointers), tracks

    def _decode(self, seen: Features, coarse: Float[Tensor, "n c h w"], told: Float[Tensor, "n 1 y x"] | None) -> Decoded:
        """The mask decoder without points or boxes, one identity per coarse map; three alternative masks each."""
        n, device = len(coarse), self.sam.runtime.device
        nowhere, unused = torch.zeros(n, 1, 1, 2, device=device), -torch.ones(n, 1, 1, dtype=torch.int32, device=device)
        sparse, dense = self.sam.model.prompt_encoder(nowhere, unused, None, told)
        return self.sam.decode(seen, coarse, sparse, dense, several=True)

    def _pointer(self, said: Decoded, there: Bool[Tensor, " n"]) -> Float[Tensor, "n c"]:
        """What the best mask's token says about the identity, or the learned word for its absence."""
        model = self.sam.model
        with self.sam.runtime.inference():
            spoken = model.object_pointer_proj(_best(said, said.tokens)).float()
        return torch.where((there & (said.presence > 0))[:, None], spoken, model.no_object_pointer)

    def _remember(
        self, seen: Features, logits: Float[Tensor, "n 1 s s"], pointer: Float[Tensor, "n c"], there: Bool[Tensor, " n"], sure: bool
    ) -> Remembered:
        """This frame and its masks as memory; `sure` masks are taken as they are, others with their doubt."""
        model, config = self.sam.model, self.sam.model.config
        shown = (logits > 0).float() if sure else logits.sigmoid()
        shown = shown * config.sigmoid_scale_for_mem_enc + config.sigmoid_bias_for_mem_enc
        with self.sam.runtime.inference():
            cells, _ = model.memory_encoder(seen.coarse.expand(len(logits), -1, -1, -1), shown)
        cells = cells.float()
        if model.occlusion_spatial_embedding_parameter is not None:
            cells = torch.where(there[:, None, None, None], cells, cells + model.occlusion_spatial_embedding_parameter[..., None, None])
        return Remembered(cells.to(torch.bfloat16).flatten(2).permute(2, 0, 1), pointer)

    def _attend(self, state: Stream, seen: Features) -> Float[Tensor, "n c h w"]:
        """The coarse map as each identity's memory sees it; maps and pointers carry how long ago they were."""
        assert state.first is not None
        model, n = self.sam.model, state.first.cells.shape[1]
        ago = [0, *range(len(state.recent), 0, -1)]
        time = model.memory_temporal_positional_encoding
        keys = [frame.cells.float() for frame in (state.first, *state.recent)]
        places = [(self.places + time[k - 1]).expand(-1, n, -1) for k in ago]
        c, m = state.first.pointer.shape[1], state.first.cells.shape[2]
        pointers = torch.stack([state.first.pointer, *reversed(state.pointers)])
        offsets = torch.tensor([state.frame_index + 1, *range(1, len(state.pointers) + 1)], device=pointers.device)
        pieces = c // m  # a pointer is wider than a cell of memory, and is read as several
        keys.append(pointers.unflatten(2, (pieces, m)).transpose(1, 2).flatten(0, 1))
        when = model.temporal_positional_encoding_projection_layer(sines(offsets / (self.reach - 1), c))
        places.append(when.repeat_interleave(pieces, 0)[:, None].expand(-1, n, -1))
        flat = seen.coarse.flatten(2).permute(2, 0, 1).expand(-1, n, -1)
        with self.sam.runtime.inference():
            out = model.memory_attention(
                current_vision_features=flat,
                current_vision_position_embeddings=seen.places.expand(-1, n, -1),
                memory=torch.cat(keys),
                memory_posision_embeddings=torch.cat(places),
                num_object_pointer_tokens=pieces * len(pointers),
            )
        return out.float().reshape(n, -1, c).transpose(1, 2).reshape(n, c, *seen.coarse.shape[-2:])


def _best(said: Decoded, values: Float[Tensor, "n k *v"]) -> Float[Tensor, "n *v"]:
    """Of each identity's alternatives, the one that promises the best mask."""
    return values[torch.arange(len(values), device=values.device), said.quality.argmax(dim=1)]


def sines(at: Float[Tensor, " t"], width: int, temperature: float = 10000.0) -> Float[Tensor, "t c"]:
    """Sine and cosine of each position at `width / 2` frequencies."""
    half = torch.arange(width // 2, device=at.device)
    angle = at[:, None] / temperature ** (2 * (half // 2) / (width // 2))
    return torch.cat([angle.sin(), angle.cos()], dim=1)
