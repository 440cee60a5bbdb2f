"""Remembers the objects of a photo set from their reference photos."""

from collections.abc import Iterable
from pathlib import Path

from vap_core.base.errors import BadPhotoSet
from vap_core.base.photos import load_photo
from vap_core.base.types import PersonalObject, Rgb
from vap_core.evaluation.photos.folder import ReferencePhoto, Subject
from vap_core.memory import load_bank, register, remember, save
from vap_core.perception.boxes import crop
from vap_core.perception.protocols import Stack


def remember_subjects(
    subjects: Iterable[Subject], stack: Stack, bank: Path
) -> dict[str, PersonalObject]:
    """Every subject as an object of `bank`; those that it holds already are kept.

    A photo with a box is cropped to it, any other one as `register` crops it.

    Raises: BadPhoto, BadPhotoSet.
    """
    known = load_bank(bank, stack.encoder.name)
    memory = {}
    for subject in subjects:
        obj = known.get(subject.name)
        if obj is None:
            obj = _remember(subject, stack)
            save(bank, obj)
        memory[subject.name] = obj
    return memory


def _remember(subject: Subject, stack: Stack) -> PersonalObject:
    crops = []
    for photo in subject.photos:
        rgb = load_photo(photo.path, long_side=None)
        if photo.box is not None:
            crops.append(_cut(rgb, photo))
        else:
            obj, _ = register("x", subject.category, [rgb], stack.detector, stack.encoder)
            crops.append(obj.crops[0])
    return remember(subject.name, subject.category, crops, stack.encoder)


def _cut(rgb: Rgb, photo: ReferencePhoto) -> Rgb:
    """A reference photo's own box. Raises: BadPhotoSet when it lies outside of the photo."""
    height, width = rgb.shape[:2]
    box = photo.box
    assert box is not None
    if box[0] >= width or box[1] >= height or box[2] <= 0 or box[3] <= 0:
        raise BadPhotoSet(
            f"eval-photos: the box {box.tolist()} lies outside {photo.path}, which has "
            f"{width}x{height} pixels when upright; mend references/boxes.csv."
        )
    return crop(rgb, box)
