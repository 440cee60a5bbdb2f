"""Thresholds of a stack that ships none, measured on this machine: a file beside its weights."""

import json
import re
from pathlib import Path

from vap_core.base.errors import BadOutput
from vap_core.base.files import parse_json, write_atomic, writing
from vap_core.perception.protocols import Thresholds


def thresholds_file(folder: Path, kind: str) -> Path:
    """Where the thresholds of a stack are kept."""
    return folder / f"thresholds-{re.sub(r'[^\w.=-]+', '_', kind)}.json"


def keep_thresholds(folder: Path, kind: str, encoder: str, thresholds: Thresholds) -> Path:
    """Write a stack's thresholds, which hold for one encoder. Raises: BadOutput."""
    path = thresholds_file(folder, kind)
    about = {
        "encoder": encoder,
        "familiar": thresholds.familiar,
        "unfamiliar": thresholds.unfamiliar,
    }
    with writing(path, "calibrate", "make room, or point VAP_WEIGHTS at another folder"):
        folder.mkdir(parents=True, exist_ok=True)
        write_atomic(path, (json.dumps(about, indent=1) + "\n").encode())
    return path


def read_thresholds(folder: Path, kind: str, encoder: str) -> Thresholds | None:
    """What `keep_thresholds` wrote; None where there is nothing, or nothing for this encoder.

    Raises: BadOutput: the file is damaged.
    """
    path = thresholds_file(folder, kind)
    if not path.is_file():
        return None
    try:
        about = parse_json(path.read_bytes())
        if about["encoder"] != encoder:
            return None
        return Thresholds(float(about["familiar"]), float(about["unfamiliar"]))
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise BadOutput(
            f"load_stack: {path} is damaged; delete it and run python -m vap_core calibrate "
            f"--stack {kind} --keep."
        ) from error
