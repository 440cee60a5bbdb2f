"""What a still picture of a recording shows, kept in the PNG itself.

A picture that is committed would otherwise go on showing weights, objects or views that are no
longer so: `stale` says how it differs from what is here now.
"""

import json
from dataclasses import fields
from functools import cache
from pathlib import Path
from typing import Any

from vap_core.base.errors import BadOutput
from vap_core.base.version import code_digest, code_version
from vap_core.evaluation import store
from vap_core.evaluation.run_schema import EXECUTED
from vap_core.evaluation.study import Study

KEY = "vap_core"
"""The name of the text chunk in the PNG."""
NOT_DRAWN = {"__init__", "clips", "read", "stream"}
"""The modules of `vap_core.recording` that do not decide what a recording shows."""


def write_provenance(png: Path, study: Study) -> None:
    """Keep in a PNG what it shows: the study, with weights and world by digest, and the recorder.

    Raises: BadOutput for a file that is no PNG.
    """
    from PIL import Image
    from PIL.PngImagePlugin import PngInfo

    configuration = study.configuration()
    about = {
        "study": {
            field.name: configuration[field.name]
            for field in fields(Study)
            if field.name in configuration
        },
        "configuration": store.digest(configuration),
        "recorder": recorder_digest(),
        "code": code_version(),
    }
    info = PngInfo()
    info.add_text(KEY, json.dumps(about, sort_keys=True))
    try:
        with Image.open(png) as picture:
            picture.load()
            picture.save(png, "PNG", pnginfo=info, optimize=True)
    except OSError as error:
        raise BadOutput(
            f"write_provenance: {png} is no PNG ({error}); save the picture again."
        ) from error


def read_provenance(png: Path) -> dict[str, Any]:
    """What `write_provenance` kept in a PNG; empty for any other picture."""
    from PIL import Image

    with Image.open(png) as picture:
        text = picture.info.get(KEY)
    if text is None:
        return {}
    return dict(json.loads(text))


def stale(png: Path) -> str:
    """How what a still picture shows differs from what is here now, "" where it does not.

    Nothing is executed that the picture names.

    Raises: BadOutput for a picture without provenance.
    """
    about = read_provenance(png)
    if not about:
        raise BadOutput(f"stale: {png} does not say what it shows; take the picture again.")
    if about["recorder"] != recorder_digest():
        return "the recorder shows episodes otherwise now"
    settings = {name: value for name, value in about["study"].items() if name != EXECUTED}
    settings["tasks"] = tuple(tuple(task) for task in settings["tasks"])
    settings["methods"] = tuple(settings["methods"])
    if about["configuration"] != store.digest(Study(**settings).configuration()):
        return "weights, episode lists or objects are others now"
    return ""


@cache
def recorder_digest() -> str:
    """A digest of the code that decides what a recording shows, its colours and vote included.

    Comments, docstrings and line breaks do not count.
    """
    from vap_core import recording
    from vap_core.base import palette, vote_picture

    digests = [code_digest(Path(str(recording.__file__)).parent, without=NOT_DRAWN)]
    for module in (palette, vote_picture):
        digests.append(code_digest(Path(str(module.__file__))))
    return store.digest({"modules": digests})
