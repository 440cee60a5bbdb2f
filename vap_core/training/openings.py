"""The embedded stack on the suites' opening frames, with evaluation objects that nothing was trained on.

python -m vap_core.training.openings data/weights --episodes 6
"""

from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from vap_core import suites
from vap_core.detect import Detector, box_iou
from vap_core.embed import Encoder, crop
from vap_core.memory import register
from vap_core.segment import Segmenter, bounds, iou
from vap_core.sim import objects, scenes
from vap_core.sim.env import Env
from vap_core.sim.studio import reference_views
from vap_core.training.evaluation import LEAST_PX, Figures, average_precision, share
from vap_core.values import PersonalObject
from vap_core.vote import similarity, vote


def openings(detector: Detector, encoder: Encoder, segmenter: Segmenter, *, episodes: int = 6, seed: int = 0, size: int = 224, k: int = 5) -> Figures:
    """Per suite and camera: average precision, recall, mask IoU, and how often the vote elects the right instance.

    `right_instance` counts views that show the target; `right_given_boxes` votes over the true boxes instead, which tells the
    encoder's share of the misses from the detector's.
    """
    memory: dict[str, PersonalObject] = {}
    whole = 0
    for category in suites.pick.CATEGORIES:
        memory[category], uncropped = register(category, category, reference_views(objects.personal(category), k), detector, encoder)
        whole += len(uncropped)
    figures: Figures = {"references_cropped": share(k * len(memory) - whole, k * len(memory)), "image_size": size}
    for name, suite in suites.WARM_UPS.items():
        views: dict[str, dict[str, list[Any]]] = defaultdict(lambda: defaultdict(list))
        for task in suite.tasks:
            rows = suites.rows(name, task.name, episodes, seed)
            with scenes.build(suite.robot, list(dict.fromkeys(place.model for row in rows for place in row.placements))) as scene:
                env = Env(scene, image_size=size)
                for row in rows:
                    env.reset(row)
                    images, masks = env.observe().images, env.truth(masks=True).masks
                    for camera, rgb in images.items():
                        seen = {model: mask for model, mask in masks[camera].items() if mask.sum() >= LEAST_PX * (size / 224) ** 2}
                        _view(views[camera], rgb, seen, row.target, memory[row.category], detector, encoder, segmenter)
        figures[name] = {camera: _summary(found) for camera, found in views.items()}
    return figures


def _view(
    into: dict[str, list[Any]], rgb: np.ndarray, seen: dict[str, np.ndarray], target: str, mine: PersonalObject,
    detector: Detector, encoder: Encoder, segmenter: Segmenter,
) -> None:  # fmt: skip
    found = detector([rgb], mine.category)[0]
    names = list(seen)
    wanted = np.array([bounds(seen[name]) for name in names], np.float64).reshape(-1, 4)
    into["found"].append(((found.xyxy.astype(np.float64), found.score), wanted, np.zeros((0, 4))))
    into["recalled"] += [len(found) > 0 and bool(box_iou(box[None], found.xyxy.astype(np.float64)).max() >= 0.5) for box in wanted]
    if target not in seen:
        return
    for mask, box in zip(segmenter(rgb, found), found.xyxy, strict=True):
        overlap = box_iou(box[None].astype(np.float64), wanted)[0]
        if overlap.max() >= 0.5:
            into["iou"].append(iou(mask, seen[names[int(overlap.argmax())]]))
    into["right"].append(_elected(rgb, found.xyxy, wanted[names.index(target)], encoder, mine))
    into["right_given_boxes"].append(_elected(rgb, wanted.astype(np.float32), wanted[names.index(target)], encoder, mine))


def _elected(rgb: np.ndarray, boxes: np.ndarray, target_box: np.ndarray, encoder: Encoder, mine: PersonalObject) -> bool:
    """Whether the vote's winner lies on the target (IoU of at least 0.5)."""
    winner = vote(similarity(encoder([crop(rgb, box) for box in boxes]), mine.embeddings)).winner
    return winner is not None and bool(box_iou(boxes[[winner]].astype(np.float64), target_box[None])[0, 0] >= 0.5)


def _summary(views: dict[str, list[Any]]) -> Figures:
    def of(key: str) -> Figures:
        return share(int(np.sum(views[key])), len(views[key]))

    return {
        "views": len(views["found"]),
        "ap50": average_precision(views["found"], 0.5),
        "recall": of("recalled"),
        "right_instance": of("right"),
        "right_given_boxes": of("right_given_boxes"),
        "mask_iou": round(float(np.mean(views["iou"])), 4) if views["iou"] else None,
    }


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure the shipped weights and add the figures to their manifest entry."""
    import argparse
    import json

    from vap_core import detect, embed, segment, track
    from vap_core.training.clips import measure
    from vap_core.weights import MANIFEST, manifest

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("weights", type=Path)
    parser.add_argument("--episodes", type=int, default=6)
    parser.add_argument("--sizes", type=int, nargs="+", default=[224, 448])
    chosen = parser.parse_args(arguments)
    stack = detect.load(), embed.load(), segment.load()
    figures: Figures = {f"{size}px": openings(*stack, episodes=chosen.episodes, size=size) for size in chosen.sizes}
    figures["tracking"] = measure(track.load())
    entries = manifest(chosen.weights)
    entries["perception.safetensors"]["measured"]["openings"] = figures
    (chosen.weights / MANIFEST).write_text(json.dumps(entries, indent=1, sort_keys=True) + "\n")
    print(json.dumps(figures, indent=1))


if __name__ == "__main__":
    main()
