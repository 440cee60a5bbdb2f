"""Does the prompt reach the policy? Every policy call is made twice, with the prompted and with the raw input, and what was consumed is compared.

The second call's answer is thrown away: an audited run ends as the same run without audit does.
"""

import copy
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vap_core.errors import BadOutput, BadPolicy
from vap_core.policies import Policy
from vap_core.policies.witness import TEXT, Heard, listening
from vap_core.store import KEY, add
from vap_core.values import Attended, Call, Chunk, Episode, PolicyInput

if TYPE_CHECKING:
    import pandas as pd


def plan(
    policy: Policy[Any], states: Sequence[Any], prompted: Sequence[PolicyInput], raw: Sequence[PolicyInput]
) -> tuple[list[Any], list[Chunk], Heard, Heard]:
    """The policy's answer to the prompted inputs, and what it consumed of these and of the raw ones. Raises: BadPolicy when it tells nothing."""
    spare = copy.deepcopy(list(states))
    with listening() as heard:
        after, chunks = policy.plan(states, prompted)
    with listening() as plain:
        policy.plan(spare, raw)
    if len(heard) != len(prompted):
        raise BadPolicy(f"audit: {policy.label} does not tell what it consumes; call vap_core.policies.witness.tell where it uses its inputs.")
    return after, chunks, heard, plain


def calls(step: int, attended: Attended, raw: PolicyInput, consumed: Mapping[str, str], plain: Mapping[str, str]) -> list[Call]:
    """What one episode consumed in one call; views that the policy does not read are left out."""
    found = []
    for name, digest in consumed.items():
        if name == TEXT:
            pixels, changed = 0, attended.text != raw.text
        else:
            pixels = int((attended.images[name] != raw.images[name]).any(axis=2).sum())
            changed = pixels > 0
        found.append(Call(step, name, changed, pixels, digest, plain[name]))
    return found


def write(folder: Path, episodes: Sequence[Episode]) -> None:
    """Add the calls of some finished episodes to a run. Raises: BadOutput."""
    lines = [
        {**dict(zip(KEY, episode.key, strict=True)), **asdict(call), "sound": call.sound} for episode in episodes for call in episode.calls
    ]  # fmt: skip
    if lines:
        add(folder, "audit", lines, "audit")


def read(folder: Path) -> "pd.DataFrame":
    """Every audited call of a run. Raises: BadOutput when the run was not audited."""
    import pandas as pd

    parts = sorted((folder / "audit").glob("*.parquet"))
    if not parts:
        raise BadOutput(f"audit: {folder} was not audited; run it with --audit into another folder.")
    whole = pd.concat([pd.read_parquet(part) for part in parts], ignore_index=True)
    return whole.drop_duplicates([*KEY, "step", "name"], ignore_index=True)  # a killed run may have made a call that its successor made again


def verdict(folder: Path) -> str:
    """A line per method: what the policy consumed, where the prompt changed it, and whether any of it went wrong."""
    table, lines = read(folder), []
    for method, of_method in table.groupby("method"):
        images, words = of_method[of_method.name != TEXT], of_method[of_method.name == TEXT]
        wrong = of_method[~of_method.sound]
        lines.append(
            f"audit {method}: {len(of_method.drop_duplicates([*KEY, 'step']))} policy calls; "
            f"{images.changed.sum()} of {len(images)} images tinted ({images.pixels.sum()} pixels), "
            f"{words.changed.sum()} of {len(words)} texts rewritten; {len(wrong)} reached the policy otherwise"
        )
        lines += [
            f"  {w.suite}/{w.task} episode {w.episode} step {w.step}: {w.name} {'is missing' if w.changed else 'changed'}"
            for w in wrong[:5].itertuples()
        ]
    return "\n".join(lines)
