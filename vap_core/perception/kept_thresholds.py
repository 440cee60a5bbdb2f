"""Thresholds of a stack that ships none, measured on this machine: a file beside its weights."""

import json
import math
import re
from pathlib import Path

from vap_core.base.errors import BadOutput
from vap_core.base.files import parse_json, write_atomic, writing
from vap_core.perception.protocols import Thresholds


def thresholds_file(folder: Path, kind: str) -> Path:
    """Where the thresholds of a stack are kept."""
    return folder / f"thresholds-{re.sub(r'[^\w.=-]+', '_', kind)}.json"


def keep_command(kind: str, photos: bool) -> str:
    """The command that measures a stack's thresholds and keeps them, on photos too where asked."""
    on_photos = " --photos SET" if photos else ""
    return f"python -m vap_core measure calibration --stack {kind}{on_photos} --keep"


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
    from vap_core.perception.foundation.sources import needs_photos

    path = thresholds_file(folder, kind)
    if not path.is_file():
        return None
    try:
        about = parse_json(path.read_bytes())
        if about["encoder"] != encoder:
            return None
        thresholds = Thresholds(float(about["familiar"]), float(about["unfamiliar"]))
        if not (math.isfinite(thresholds.familiar) and math.isfinite(thresholds.unfamiliar)):
            raise ValueError(f"{thresholds} are no thresholds")
        return thresholds
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise BadOutput(
            f"load_stack: {path} is damaged; delete it and run "
            f"{keep_command(kind, needs_photos(kind))}."
        ) from error
