"""The store of the foundation stacks' weights, verified before every use.

Each model is one folder, which holds safetensors, JSON and text only, and lock.json, which lists
the SHA-256 of every file. The tensors' SHA-256 is pinned in `sources`; the small files' are taken
from the pinned revision when they are pulled.
"""

import json
import os
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

from vap_core.base.errors import MissingWeights
from vap_core.base.files import kept_folder, parse_json, read_file, sha256_of, write_atomic
from vap_core.perception.foundation.sources import (
    EMBEDDED,
    KINDS,
    MODELS,
    PARTS,
    TENSORS,
    Source,
    models_of,
)

STORE = kept_folder("weights-hub")
VARIABLE = "VAP_WEIGHTS"
"""Environment variable that names another store."""
LOCK = "lock.json"


@dataclass(frozen=True)
class VerifiedWeights:
    """A verified folder of one model. `identity` names these very weights."""

    folder: Path
    identity: str


def store_folder() -> Path:
    """Where weights are kept: `VAP_WEIGHTS`, or data/weights-hub (`base.files.kept_folder`)."""
    return Path(os.environ.get(VARIABLE) or STORE)


def verify_stack(kind: str, store: Path | None = None) -> tuple[VerifiedWeights, ...]:
    """The verified folders of a stack's models; hashing takes about a second per gigabyte.

    Raises: MissingWeights: names everything that is absent or damaged, and both ways to get it.
    """
    store = store or store_folder()
    names = models_of(kind)
    _refuse_problems(kind, names, store, quick=False)
    verified: list[VerifiedWeights] = []
    for name in names:
        folder = store / MODELS[name].folder
        digest = read_lock(folder)[TENSORS]
        identity = name
        if digest != MODELS[name].sha256:  # other weights, or a model without a pin
            identity = f"{name}-{digest[:12]}"
        verified.append(VerifiedWeights(folder, identity))
    return tuple(verified)


def check_present(kind: str) -> None:
    """What takes long asks this first: the files of a stack's models are there; none is hashed.

    Raises: MissingWeights, as `verify_stack`.
    """
    if kind != EMBEDDED:  # whose text encoder may be a package's
        _refuse_problems(kind, models_of(kind), store_folder(), quick=True)


def locked_sha256(kind: str) -> dict[str, str]:
    """The SHA-256 in lock.json of every file of a stack's models, by "MODEL/FILE"; hashes none.

    Raises: UnknownName; MissingWeights, as `verify_stack`, for what is absent.
    """
    check_present(kind)
    digests: dict[str, str] = {}
    for name in models_of(kind):
        lock = read_lock(store_folder() / MODELS[name].folder)
        for file in MODELS[name].files:
            digests[f"{name}/{file}"] = lock[file]
    return digests


def _refuse_problems(kind: str, names: tuple[str, ...], store: Path, quick: bool) -> None:
    problems: list[str] = []
    for name in names:
        problem = find_problem(name, store, quick)
        if problem:
            problems.append(f"{name} ({problem})")
    if problems:
        raise MissingWeights(
            f"--stack {kind}: {', '.join(problems)} not usable in {store}; {remedy(kind)}."
        )


def remedy(kind: str) -> str:
    """How to get a stack's weights, online and offline. Raises: UnknownName: no such stack."""
    pull = f"python -m vap_core weights pull --stack {kind}"
    if any(not MODELS[name].sha256 for name in models_of(kind)):
        pull += " --unpinned"
    return (
        f"run `{pull}`, without internet `{pull} --from DIR` with a copy of another machine's, "
        f"or point {VARIABLE} at a folder that has them"
    )


def find_problem(name: str, store: Path, quick: bool = False) -> str | None:
    """What is wrong with a model's folder, None when nothing is; `quick` compares no checksums."""
    source = MODELS[name]
    folder = store / source.folder
    lock = read_lock(folder)
    absent = [file for file in source.files if not (folder / file).is_file()]
    if absent:
        return f"lacks {', '.join(absent)}"
    unlisted = [file for file in source.files if file not in lock]
    if unlisted:
        return f"{LOCK} lacks {', '.join(unlisted)}"
    if quick:
        return None
    wrong = [file for file in source.files if sha256_of(folder / file) != lock[file]]
    if wrong:
        return f"SHA-256 of {', '.join(wrong)} differs from {LOCK}"
    return None


def weights_table(store: Path | None = None) -> str:
    """What is there, what is missing and how to get it; checks presence, not checksums."""
    store = store or store_folder()
    lines = [f"weights in {store}"]
    remedies: list[str] = []
    for kind, names in KINDS.items():
        complete = True
        for name in names:
            source = MODELS[name]
            problem = find_problem(name, store, quick=True)
            complete &= problem is None
            where = f"{source.repo}@{source.revision[:8]}"
            lines.append(f"{kind:<17} {name:<20} {where}: {problem or 'here'}")
        if not complete:
            remedies.append(f"{kind}: {remedy(kind)}")
    for role, models in PARTS.items():
        for name in models:
            source = MODELS[name]
            if name in chain.from_iterable(KINDS.values()):
                continue
            problem = find_problem(name, store, quick=True)
            asks = f"; first {source.needs}" if problem and source.needs else ""
            lines.append(f"embedded:{role}={name:<24} {source.repo}: {problem or 'here'}{asks}")
    return "\n".join([*lines, *remedies])


def read_lock(folder: Path) -> dict[str, str]:
    """SHA-256 by file of a model's folder; empty when its lock.json is absent or damaged."""
    try:
        return dict(parse_json(read_file(folder / LOCK))["sha256"])
    except (OSError, ValueError, KeyError, TypeError):
        return {}


def write_lock(folder: Path, source: Source, digests: dict[str, str]) -> None:
    """Record the SHA-256 of every file; the revision only where the tensors are the pinned ones."""
    revision = None
    if digests[TENSORS] == source.sha256:
        revision = source.revision
    about = {"repo": source.repo, "revision": revision, "sha256": digests}
    write_atomic(folder / LOCK, (json.dumps(about, indent=1) + "\n").encode())
