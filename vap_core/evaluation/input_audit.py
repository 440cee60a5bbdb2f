"""The audited policy calls of a run: what each consumed of the prompted and of the raw input."""

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

from vap_core.base.errors import BadOutput
from vap_core.base.parquet import read_parquet
from vap_core.evaluation.store import KEY, write_part
from vap_core.policies.hooks import TEXT
from vap_core.rollout.types import Episode

if TYPE_CHECKING:
    import pandas as pd


def write(folder: Path, episodes: Sequence[Episode]) -> None:
    """Add the calls of some finished episodes to a run. Raises: BadOutput."""
    lines = []
    for episode in episodes:
        key = dict(zip(KEY, episode.key, strict=True))
        for call in episode.consumed:
            lines.append({**key, **asdict(call), "sound": call.sound})
    if lines:
        write_part(folder, "audit", lines, caller="audit")


def read(folder: Path) -> "pd.DataFrame":
    """Every audited call of a run. Raises: BadOutput when the run was not audited."""
    import pandas as pd

    parts = sorted((folder / "audit").glob("*.parquet"))
    if not parts:
        raise BadOutput(
            f"audit: {folder} was not audited; run it with --audit into another folder."
        )
    remedy = "delete it; its calls are not shown"
    tables = [read_parquet(part, "audit", remedy) for part in parts]
    whole = pd.concat(tables, ignore_index=True)
    # A killed run may hold calls that the resumed run made again.
    return whole.drop_duplicates([*KEY, "step", "name"], ignore_index=True)


def verdict(folder: Path) -> str:
    """A line per method: what the policy consumed, and where it is not as the prompt says.

    Raises: BadOutput, as `read`.
    """
    table = read(folder)
    lines = []
    for method, of_method in table.groupby("method"):
        images = of_method[of_method.name != TEXT]
        texts = of_method[of_method.name == TEXT]
        wrong = of_method[~of_method.sound]
        calls = len(of_method.drop_duplicates([*KEY, "step"]))
        lines.append(
            f"audit {method}: {calls} policy calls; {images.changed.sum()} of {len(images)} images "
            f"tinted ({images.pixels.sum()} pixels), {texts.changed.sum()} of {len(texts)} texts "
            f"rewritten; {len(wrong)} reached the policy otherwise"
        )
        for call in wrong[:5].itertuples():
            what = "is missing" if call.changed else "changed"
            lines.append(
                f"  {call.suite}/{call.task} episode {call.episode} step {call.step}: "
                f"{call.name} {what}"
            )
    return "\n".join(lines)
