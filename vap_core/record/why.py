"""The evidence that decides why an episode failed, drawn into its recording: who is highlighted, what was compared, where the hand was."""

from collections.abc import Mapping, Sequence
from typing import Any

import cv2
import numpy as np
import rerun as rr

from vap_core.failures import Course, Diagnosis
from vap_core.record.blueprint import QUIET, SERIES, TARGET
from vap_core.record.evidence import contact_sheet, jpeg, picture, send_classes, send_jpegs
from vap_core.record.file import put
from vap_core.record.pictures import time_index
from vap_core.values import Camera, Event, Frame, Grounding, Opening, Rgb

NOBODY, FIRST = 8, 10
"""Class of a prompt on no object; class of the first object's inside. An inside is even, its rim the number after it."""
IDENTITIES = [colour for colour in SERIES if colour != TARGET]
CROSS = np.array([[0, 1, 0], [1, 1, 1], [0, 1, 0]], np.uint8)
SIDE, BAND = 120, 20
"""Pixels of a crop in the sheet, and of the line of words over it."""


def identity_classes(opening: Opening) -> list[rr.AnnotationInfo]:
    """One colour for each object of the episode, the target's first: an inside for the prompt that covers it, a rim for where it is."""
    colours = {name: identity_colour(opening, name) for name in opening.target_sizes_m}
    named = [
        rr.AnnotationInfo(id=FIRST + 2 * i + rim, label=f"{name}{', edge' if rim else ''}", color=(*colour, 255 if rim else 170))
        for i, (name, colour) in enumerate(colours.items())
        for rim in (0, 1)
    ]
    return [rr.AnnotationInfo(id=NOBODY, label="no object", color=(255, 255, 255, 190)), *named]


def identity_colour(opening: Opening, name: str) -> tuple[int, int, int]:
    """The target's orange, or a colour of its own for every other object."""
    others = [each for each in opening.target_sizes_m if each != opening.row.target]
    return TARGET if name == opening.row.target else IDENTITIES[others.index(name) % len(IDENTITIES)]


def identity(opening: Opening, frame: Frame, camera: Camera) -> np.ndarray:
    """Class image of one view: the prompt filled with the colour of what it covers, and the rims of all objects in theirs."""
    masks, tracks = frame.truth.masks.get(camera.name, {}), frame.tracks.get(camera.name, ())
    names = list(opening.target_sizes_m)
    image = np.zeros((camera.height, camera.width), np.uint8)
    on = next((view.object for view in frame.shown if view.camera == camera.name), None)
    if tracks and tracks[0].mask is not None and on is not None:
        image[tracks[0].mask] = FIRST + 2 * names.index(on) if on in names else NOBODY
    whose = np.zeros_like(image)
    for i, name in enumerate(names):
        if name in masks:
            whose |= masks[name].view(np.uint8) * np.uint8(FIRST + 2 * i + 1)  # visible pixels belong to one object each
    inner = cv2.erode(whose, CROSS) == cv2.dilate(whose, CROSS)
    return np.where((whose > 0) & ~inner, whose, image)


def send_identities(rec: rr.RecordingStream, opening: Opening, index: Sequence[rr.TimeColumn], frames: Sequence[Frame]) -> None:
    """One class image per view and step; the steps are those that have truth and pictures."""
    for i, camera in enumerate(frames[0].cameras):
        images = [identity(opening, frame, frame.cameras[i]) for frame in frames]
        send_classes(rec, f"/observation.images.{camera.name}/identity", index, images)


def send_attention(rec: rr.RecordingStream, frames: Sequence[Frame], quality: int) -> None:
    """The share of the policy's attention that every image patch got, as numbers, and as a glow over what the policy saw."""
    when = [(frame.frame_index, frame.timestamp_s) for frame in frames]
    for cam in frames[0].attention:
        for frame, at in zip(frames, when, strict=True):  # rerun has no columns of tensors
            put(rec, f"/vap/attention/{cam}", rr.Tensor(frame.attention[cam], dim_names=("row", "column")), at=time_index([at]))
        glows = [jpeg(glowing(frame.prompted[cam], frame.attention[cam]), quality) for frame in frames]
        send_jpegs(rec, f"/observation.images.{cam}/attention", time_index(when), glows)


def glowing(rgb: Rgb, heat: np.ndarray) -> Rgb:
    """The picture, dimmed, lit up by its most attended patch's share and less."""
    height, width = rgb.shape[:2]
    share = cv2.resize(heat / max(float(heat.max()), 1e-9), (width, height), interpolation=cv2.INTER_LINEAR)
    colour = cv2.cvtColor(cv2.applyColorMap((255 * share).astype(np.uint8), cv2.COLORMAP_INFERNO), cv2.COLOR_BGR2RGB)
    weight = (0.4 + 0.35 * share)[..., None]
    return ((1 - weight) * rgb + weight * colour).astype(np.uint8)


def log_compared(rec: rr.RecordingStream, grounding: Grounding, rgb: Rgb, references: Sequence[Rgb], at: Sequence[rr.TimeColumn]) -> None:
    """The cosine of every candidate with every reference, and what was compared, side by side."""
    if len(grounding.candidates):
        put(rec, f"/vap/similarity/{grounding.camera}", rr.Tensor(grounding.similarity, dim_names=("candidate", "reference")), at=at)
    if references:
        put(rec, f"/vap/crops/{grounding.camera}", picture(jpeg(crops_sheet(grounding, rgb, references), 90)), at=at)


def crops_sheet(grounding: Grounding, rgb: Rgb, references: Sequence[Rgb]) -> Rgb:
    """References in the top row, candidates in the rows below, best first, each with its votes and mean cosine; the winner framed in orange."""
    k, cosine = len(references), grounding.similarity.mean(axis=1) if len(grounding.candidates) else np.zeros(0)
    order = sorted(range(len(cosine)), key=lambda i: (-int(grounding.votes[i]), -float(cosine[i])))
    rows = [_row([f"reference {i}" for i in range(k)], contact_sheet(references, SIDE), QUIET, k)]
    for first in range(0, len(order), k):
        part = order[first : first + k]
        crops = [_cut(rgb, grounding.candidates.xyxy[i]) for i in part]
        words = [f"#{i} v{grounding.votes[i]} {cosine[i]:.2f}" for i in part]
        row = _row(words, contact_sheet(crops, SIDE), QUIET, k)
        if grounding.winner in part:
            x = part.index(grounding.winner) * SIDE
            cv2.rectangle(row, (x + 1, BAND + 1), (x + SIDE - 2, BAND + SIDE - 2), TARGET, 3)
        rows.append(row)
    return np.concatenate(rows, axis=0)


def _row(words: Sequence[str], sheet: Rgb, colour: tuple[int, int, int], k: int) -> Rgb:
    row = np.full((BAND + SIDE, k * SIDE, 3), 24, np.uint8)
    row[BAND:, : sheet.shape[1]] = sheet
    for i, text in enumerate(words):
        cv2.putText(row, text, (i * SIDE + 4, BAND - 5), cv2.FONT_HERSHEY_SIMPLEX, 0.45, colour, 1, cv2.LINE_AA)
    return row


def _cut(rgb: Rgb, xyxy: np.ndarray) -> Rgb:
    x0, y0, x1, y1 = (int(v) for v in np.clip(np.round(xyxy), 0, [*rgb.shape[1::-1]] * 2))
    return rgb[y0 : max(y1, y0 + 1), x0 : max(x1, x0 + 1)]


def send_hand(rec: rr.RecordingStream, course: Course, index: Sequence[rr.TimeColumn]) -> None:
    """How far the gripper is from the target's bounding box, and how high the target is lifted, centimetres."""
    for name, path in (("gripper to target", course.gap_m), ("target lifted", course.lift_m[course.target])):
        entity = f"/vap/hand/{name.replace(' ', '_')}"
        put(rec, entity, rr.SeriesLines(names=[f"{name}, cm"], colors=[SERIES[0] if "grip" in name else TARGET], widths=[2.0]))
        rec.send_columns(entity, index, rr.Scalars.columns(scalars=100 * path))


def verdict(diagnosis: Diagnosis) -> str:
    """In a line: which case, and why."""
    return f"{diagnosis.case.capitalize()}, {diagnosis.sub_case}: {diagnosis.sentence}"


def event(diagnosis: Diagnosis) -> Event:
    """The deciding moment, for the list of events."""
    return Event(diagnosis.frame_index, "ERROR", verdict(diagnosis))


def property_of(diagnosis: Diagnosis | None) -> Mapping[str, Any]:
    """Its part of the recording's properties; empty words for a success."""
    if diagnosis is None:
        return {"failure_case": "", "sub_case": "", "deciding_frame": np.int64(-1), "deciding_camera": "", "confidence": 0.0, "why": ""}
    return {
        "failure_case": diagnosis.case, "sub_case": diagnosis.sub_case, "deciding_frame": np.int64(diagnosis.frame_index),
        "deciding_camera": diagnosis.camera, "confidence": diagnosis.confidence, "why": diagnosis.sentence,
    }  # fmt: skip
