"""SAM 2.1 and SAM 3 on a stream: identities followed by memory attention (P 3.3).

A frame is compared with the first frame and the last few, so memory stays constant. The state of a
view is a value: what one step returns is all that the next one needs. On a GPU all views of a step
share one pass of the backbone; all identities of a view share one pass of the rest.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional as F  # noqa: N812

from vap_core.base.types import Rgb, Track
from vap_core.perception.foundation.models import DecodedMasks, ImageFeatures, Sam, to_pixels

CERTAIN_LOGIT = 10.0
"""Mask logit of what the first masks cover; minus that outside."""
ABSENT_LOGIT = -1024.0
"""Mask logit of an identity that is not in view."""
LONGEST_PERIOD = 10000.0
"""Of positional encodings, in units of 2 pi."""


@dataclass(frozen=True, slots=True, eq=False)
class MemoryEntry:
    """One frame in memory: of each of n identities a map of p cells, and a pointer."""

    cells: Float[Tensor, "p n m"]
    pointer: Float[Tensor, "n c"]


@dataclass(frozen=True, slots=True, eq=False)
class SamTrackState:
    """One view. `recent` is oldest first; `pointers` are kept for more frames than maps are."""

    hw: tuple[int, int]
    frame_index: int
    first: MemoryEntry | None
    """The first frame; None where nothing is followed."""
    recent: tuple[MemoryEntry, ...]
    pointers: tuple[Float[Tensor, "n c"], ...]


class SamTracker:
    """The foundation tracker. Views are independent; the same frames give the same bits."""

    def __init__(self, sam: Sam) -> None:
        self.sam = sam
        config = sam.model.config
        self.recent = int(config.num_maskmem) - 1
        self.max_pointers = int(config.max_object_pointers_in_encoder)
        h, w = sam.model.backbone_feature_sizes[-1]
        m = int(config.memory_encoder_output_channels)
        with torch.inference_mode():
            positions = sam.model.memory_encoder.position_encoding(
                torch.Size((1, m, h, w)), sam.runtime.device, torch.float32
            )
            self.map_positions: Float[Tensor, "1 m h w"] = positions
            self.positions: Float[Tensor, "p 1 m"] = self._cell_positions()

    def start(
        self, images: Sequence[Rgb], masks: Sequence[Bool[np.ndarray, "_n _h _w"]]
    ) -> list[SamTrackState]:
        return [self._start(*view) for view in zip(images, masks, strict=True)]

    def step(
        self, states: Sequence[SamTrackState], images: Sequence[Rgb]
    ) -> tuple[list[SamTrackState], list[tuple[Track, ...]]]:
        for state, image in zip(states, images, strict=True):
            if state.hw != image.shape[:2]:
                raise ValueError(
                    f"SamTracker.step: an image of {image.shape[:2]} after one of {state.hw}; "
                    "a view keeps its size"
                )
        tracked = [i for i, state in enumerate(states) if state.first is not None]
        features = self.sam.encode([images[i] for i in tracked])
        new_states = list(states)
        tracks: list[tuple[Track, ...]] = [()] * len(states)
        for i, of_view in zip(tracked, features, strict=True):
            new_states[i], tracks[i] = self._step(states[i], of_view)
        return new_states, tracks

    def _start(self, image: Rgb, masks: Bool[np.ndarray, "n h w"]) -> SamTrackState:
        hw = (image.shape[0], image.shape[1])
        if masks.shape[1:] != hw:
            raise ValueError(
                f"SamTracker.start: masks of {masks.shape[1:]} pixels for an image of {hw}; "
                "they must agree"
            )
        if not len(masks):
            return SamTrackState(hw, 0, None, (), ())
        features = self.sam.encode_first_frame(image)
        coarse = features.coarse.expand(len(masks), -1, -1, -1)
        with torch.inference_mode():
            # Zeros and ones at the model's resolution, and at that of the prompt encoder.
            planes = torch.from_numpy(masks.copy()).to(self.sam.runtime.device)[:, None].float()
            planes = (_resized(planes, (self.sam.side, self.sam.side)) >= 0.5).float()
            visible = planes.flatten(1).any(dim=1)
            prompt = self.sam.model.mask_downsample(planes)
            prompt = _resized(prompt, self.sam.model.prompt_encoder.mask_input_size)
            decoded = self._decode(features, coarse, prompt)
            first = self._memory_entry(
                features=features,
                logits=CERTAIN_LOGIT * (2 * planes - 1),
                pointer=self._pointer(decoded, visible),
                visible=visible,
                certain=True,
            )
        return SamTrackState(hw, 0, first, (), ())

    def _step(
        self, state: SamTrackState, features: ImageFeatures
    ) -> tuple[SamTrackState, tuple[Track, ...]]:
        side = self.sam.side
        with torch.inference_mode():
            decoded = self._decode(features, self._attend(state, features), None)
            visible = decoded.presence > 0
            best = _best_alternative(decoded, decoded.logits)[:, None]
            best = torch.where(visible[:, None, None, None], best, ABSENT_LOGIT)
            entry = self._memory_entry(
                features=features,
                logits=F.interpolate(best, (side, side), mode="bilinear"),
                pointer=self._pointer(decoded, visible),
                visible=visible,
                certain=False,
            )
            masks = (to_pixels(best, state.hw)[:, 0] > 0).cpu().numpy()
            scores = decoded.presence.sigmoid().cpu().numpy()
        tracks = tuple(
            Track(mask if mask.any() else None, float(score))
            for mask, score in zip(masks, scores, strict=True)
        )
        new_state = SamTrackState(
            hw=state.hw,
            frame_index=state.frame_index + 1,
            first=state.first,
            recent=(*state.recent, entry)[-self.recent :],
            pointers=(*state.pointers, entry.pointer)[-(self.max_pointers - 1) :],
        )
        return new_state, tracks

    def _decode(
        self,
        features: ImageFeatures,
        coarse: Float[Tensor, "n c h w"],
        mask_prompt: Float[Tensor, "n 1 y x"] | None,
    ) -> DecodedMasks:
        """The mask decoder without points or boxes.

        There is one identity per coarse map, and three alternative masks of each.
        """
        n = len(coarse)
        device = self.sam.runtime.device
        no_points = torch.zeros(n, 1, 1, 2, device=device)
        unused = -torch.ones(n, 1, 1, dtype=torch.int32, device=device)
        sparse, dense = self.sam.model.prompt_encoder(no_points, unused, None, mask_prompt)
        return self.sam.decode(features, coarse, sparse, dense, alternatives=True)

    def _pointer(self, decoded: DecodedMasks, visible: Bool[Tensor, " n"]) -> Float[Tensor, "n c"]:
        """The projected token of the best mask, or the learned pointer of an absent identity."""
        model = self.sam.model
        with self.sam.runtime.inference():
            pointer = model.object_pointer_proj(_best_alternative(decoded, decoded.tokens)).float()
        present = (visible & (decoded.presence > 0))[:, None]
        return torch.where(present, pointer, model.no_object_pointer)

    def _memory_entry(
        self,
        features: ImageFeatures,
        logits: Float[Tensor, "n 1 s s"],
        pointer: Float[Tensor, "n c"],
        visible: Bool[Tensor, " n"],
        certain: bool,
    ) -> MemoryEntry:
        """This frame and its masks as memory.

        Masks that are `certain` are thresholded; others keep their probabilities.
        """
        model = self.sam.model
        config = model.config
        h, w = self.map_positions.shape[-2:]
        logits = _resized(logits, (16 * h, 16 * w))  # as the memory encoder takes it
        planes = (logits > 0).float() if certain else logits.sigmoid()
        planes = planes * config.sigmoid_scale_for_mem_enc + config.sigmoid_bias_for_mem_enc
        coarse = features.coarse.expand(len(logits), -1, -1, -1)
        with self.sam.runtime.inference():
            cells, _ = model.memory_encoder(coarse, planes)
        cells = cells.float()
        if model.occlusion_spatial_embedding_parameter is not None:
            occluded = cells + model.occlusion_spatial_embedding_parameter[..., None, None]
            cells = torch.where(visible[:, None, None, None], cells, occluded)
        return MemoryEntry(self._stored(cells), pointer)

    def _stored(self, maps: Float[Tensor, "n m h w"]) -> Float[Tensor, "p n m"]:
        """What is kept of each identity's map of a frame, in half precision."""
        return maps.to(torch.bfloat16).flatten(2).permute(2, 0, 1)

    def _cell_positions(self) -> Float[Tensor, "p 1 m"]:
        """The positional encoding of what `_stored` keeps."""
        return self.map_positions.flatten(2).permute(2, 0, 1)

    def _attention_options(self, maps: int) -> dict[str, int]:
        """What the memory attention asks for besides memory; `maps` are the frames in it."""
        return {}

    def _attend(self, state: SamTrackState, features: ImageFeatures) -> Float[Tensor, "n c h w"]:
        """The coarse map after attention to each identity's memory."""
        assert state.first is not None
        n = state.first.cells.shape[1]
        c = state.first.pointer.shape[1]
        map_keys, map_positions = self._memory_maps(state)
        pointer_keys, pointer_positions = self._memory_pointers(state)
        flat = features.coarse.flatten(2).permute(2, 0, 1).expand(-1, n, -1)
        with self.sam.runtime.inference():
            out = self.sam.model.memory_attention(
                current_vision_features=flat,
                current_vision_position_embeddings=features.positions.expand(-1, n, -1),
                memory=torch.cat([*map_keys, pointer_keys]),
                memory_posision_embeddings=torch.cat([*map_positions, pointer_positions]),
                num_object_pointer_tokens=len(pointer_keys),
                **self._attention_options(len(map_keys)),
            )
        size = features.coarse.shape[-2:]
        return out.float().reshape(n, -1, c).transpose(1, 2).reshape(n, c, *size)

    def _memory_maps(self, state: SamTrackState) -> tuple[list[Tensor], list[Tensor]]:
        """The maps in memory, and their positional encodings, which say how long ago they were."""
        assert state.first is not None
        n = state.first.cells.shape[1]
        times = self.sam.model.memory_temporal_positional_encoding
        keys = [state.first.cells.float()]
        positions = [(self.positions + times[-1]).expand(-1, n, -1)]
        for frames_ago, entry in zip(range(len(state.recent), 0, -1), state.recent, strict=True):
            keys.append(entry.cells.float())
            positions.append((self.positions + times[frames_ago - 1]).expand(-1, n, -1))
        return keys, positions

    def _memory_pointers(self, state: SamTrackState) -> tuple[Tensor, Tensor]:
        """The pointers in memory, and their positional encodings.

        A pointer is wider than a cell of memory, and is read as several. A model may have been
        trained without these encodings.
        """
        assert state.first is not None
        n = state.first.cells.shape[1]
        c = state.first.pointer.shape[1]
        m = state.first.cells.shape[2]
        pieces = c // m
        pointers = torch.stack([state.first.pointer, *reversed(state.pointers)])
        frames_ago = torch.tensor(
            [state.frame_index + 1, *range(1, len(state.pointers) + 1)], device=pointers.device
        )
        keys = pointers.unflatten(2, (pieces, m)).transpose(1, 2).flatten(0, 1)
        if not self.sam.model.config.enable_temporal_pos_encoding_for_object_pointers:
            return keys, torch.zeros_like(keys)
        times = self.sam.model.temporal_positional_encoding_projection_layer(
            sines(frames_ago / (self.max_pointers - 1), c)
        )
        positions = times.repeat_interleave(pieces, 0)[:, None].expand(-1, n, -1)
        return keys, positions


def _resized(maps: Float[Tensor, "n 1 h w"], size: Sequence[int]) -> Float[Tensor, "n 1 y x"]:
    """Planes at another resolution; those that have it already stay as they are."""
    if maps.shape[-2:] == torch.Size(size):
        return maps
    return F.interpolate(maps, tuple(size), mode="bilinear", antialias=True)


def _best_alternative(
    decoded: DecodedMasks, values: Float[Tensor, "n k *v"]
) -> Float[Tensor, "n *v"]:
    """Of each identity's alternatives, the one whose mask has the best predicted quality."""
    rows = torch.arange(len(values), device=values.device)
    return values[rows, decoded.quality.argmax(dim=1)]


def sines(positions: Float[Tensor, " t"], width: int) -> Float[Tensor, "t c"]:
    """Sine and cosine of each position at `width / 2` frequencies."""
    half = torch.arange(width // 2, device=positions.device)
    angle = positions[:, None] / LONGEST_PERIOD ** (2 * (half // 2) / (width // 2))
    return torch.cat([angle.sin(), angle.cos()], dim=1)


class EdgeTamTracker(SamTracker):
    """EdgeTAM's tracker."""

    def _stored(self, maps: Float[Tensor, "n m h w"]) -> Float[Tensor, "p n m"]:
        """The resampler takes one identity at a time; its tokens stay in single precision."""
        kept: list[Tensor] = []
        with self.sam.runtime.inference():
            for one in maps:
                tokens, _ = self.sam.model.spatial_perceiver(one[None], self.map_positions)
                kept.append(tokens.float())
        return torch.cat(kept).transpose(0, 1)

    def _cell_positions(self) -> Float[Tensor, "p 1 m"]:
        """Tokens of windows have one, those of whole maps none; they depend on no image."""
        nothing = torch.zeros_like(self.map_positions)
        _, positions = self.sam.model.spatial_perceiver(nothing, self.map_positions)
        return positions.float().transpose(0, 1)

    def _attention_options(self, maps: int) -> dict[str, int]:
        return {"num_spatial_memory_tokens": maps}


REPVIT: dict[str, Any] = {"in_chans": 3, "features_only": True, "out_indices": [0, 1, 2, 3]}
"""How EdgeTAM takes timm's network of that name."""


@contextmanager
def backbone_without_hub() -> Iterator[None]:
    """EdgeTAM's configurations are made without a question to the hub.

    transformers (5.5) compares a configuration with the default one whenever it describes it, also
    while it reads one from a folder, and takes the default's backbone from the hub.
    """
    import transformers
    from transformers.models.edgetam import configuration_edgetam

    hf: Any = transformers
    module: Any = configuration_edgetam

    class Local:
        @staticmethod
        def from_pretrained(name: str, model_args: dict[str, Any]) -> Any:
            architecture = name.rpartition("/")[2].partition(".")[0]
            return hf.TimmWrapperConfig(architecture=architecture, model_args=model_args)

    hub = module.AutoConfig
    module.AutoConfig = Local
    try:
        yield
    finally:
        module.AutoConfig = hub
