"""Figures and tables that take long to make and change only with the code and weights behind them.

What is kept names the digest of what it was made from. It is made again when that has changed.
"""

import hashlib
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

from vap_core.analysis.plots import keep, small_jpeg
from vap_core.base.files import code_digest, write_atomic
from vap_core.study.store import encode_table

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

KEY = "vap_core.made_from"
"""The text chunk of a PNG and the metadata of a table that hold the digest."""


SOURCES = ("simulation/assets", "simulation/studio.py", "perception/embedded", "memory.py")
"""The code that decides how an object looks, and how its photos are cropped and embedded."""


@cache
def source_digest() -> str:
    """A digest of `SOURCES`, of the shipped objects and of the shipped weights."""
    import vap_core
    from vap_core.perception.embedded.networks import FOLDER
    from vap_core.simulation.assets.objects import FORMS, ROWS

    package = Path(vap_core.__file__).parent
    found = hashlib.sha256((FOLDER / "manifest.json").read_bytes())
    for file in (ROWS, FORMS):
        found.update(file.read_bytes())
    for part in SOURCES:
        found.update(code_digest(package / part).encode())
    return found.hexdigest()[:16]


def kept_figure(
    path: Path, draw: Callable[[], "Figure"], *, again: bool = False, small: int = 115_000
) -> bytes:
    """The figure of a PNG as a JPEG for a notebook; drawn where it is stale, or `again`.

    The JPEG has at most `small` bytes: more for a figure with small words.
    """
    from PIL import Image

    if not again and path.exists():
        with Image.open(path) as picture:
            if picture.info.get(KEY) == source_digest():
                return small_jpeg(picture.convert("RGB"), small)
    return keep(draw(), path, small=small, about={KEY: source_digest()})


def kept_table(
    path: Path, make: Callable[[], "pd.DataFrame"], *, again: bool = False
) -> "pd.DataFrame":
    """The table of a Parquet file; made where it is stale, or `again`."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    key = KEY.encode()
    if not again and path.exists():
        table = pq.read_table(path)
        if (table.schema.metadata or {}).get(key) == source_digest().encode():
            return table.to_pandas()
    made = pa.Table.from_pandas(make(), preserve_index=False)
    about = {**(made.schema.metadata or {}), key: source_digest().encode()}
    write_atomic(path, encode_table(made.replace_schema_metadata(about)))
    return made.to_pandas()
