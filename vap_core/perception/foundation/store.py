"""The store of the foundation stacks' weights, verified before every use.

Each model is one folder, which holds safetensors, JSON and text only, and lock.json, which lists
the SHA-256 of every file. The tensors' SHA-256 is pinned in `sources`; the small files' are taken
from the pinned revision when they are pulled.
"""

import json
import os
import shutil
from collections.abc import Callable, Sequence
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


HUB = "https://huggingface.co"
ENDPOINT_VARIABLE = "HF_ENDPOINT"
"""Environment variable that names a mirror of the hub."""
HEADERS = {"User-Agent": "vap_core", "Accept-Encoding": "identity"}
"""Sizes are those of the files, and nothing is said of this machine or its user."""


def pull(
    names: Sequence[str],
    store: Path,
    *,
    origin: Path | None = None,
    unpinned: bool = False,
    say: Callable[[str], None] = print,
) -> None:
    """Bring models into the store, from the hub or from `origin`.

    Models that are complete and undamaged are left alone. `origin` may be another store, a hub
    cache, or hold owner/name folders; it is checked before anything in the store changes.
    `unpinned` takes other weights of the same kind. A second process that pulls the same model
    waits for the first.

    Raises: MissingWeights: unreachable, absent, or with another checksum than the pinned one.
    """
    for name in names:
        folder = store / MODELS[name].folder
        if not _pull_model(name, store, origin, unpinned):
            say(f"{name}: whole, in {folder}")
            continue
        size = sum((folder / file).stat().st_size for file in MODELS[name].files)
        say(f"{name}: {size / 1e6:.1f} MB in {folder}")


def find_folder(source: Source, origin: Path) -> Path:
    """The folder below `origin` that holds a model: a store's, a hub cache's snapshot, owner/name.

    Raises: MissingWeights: none of them is there.
    """
    revision = source.revision
    ref = origin / f"models--{source.folder}" / "refs" / revision
    if ref.is_file():  # a branch; the cache has its commit
        revision = ref.read_text().strip()
    below = (
        source.folder,
        f"models--{source.folder}/snapshots/{revision}",
        source.repo,
    )
    for path in below:
        if (origin / path / TENSORS).is_file():
            return origin / path
    raise MissingWeights(
        f"weights pull: no {TENSORS} of {source.repo} in {origin}; looked into {', '.join(below)}."
    )


def endpoint() -> str:
    """The hub's address, or its mirror's."""
    return (os.environ.get(ENDPOINT_VARIABLE) or HUB).rstrip("/")


def transfer(url: str, part: Path, name: str) -> None:
    """Download into `part`, from where an earlier try stopped; `name` is shown meanwhile.

    Raises: OSError, httpx.HTTPError.
    """
    from huggingface_hub.file_download import http_get

    with part.open("ab") as out:
        http_get(url, out, resume_size=out.tell(), headers=HEADERS, displayed_filename=name)


def _pull_model(name: str, store: Path, origin: Path | None, unpinned: bool) -> bool:
    """Bring one model into the store; False when it is complete there already."""
    from huggingface_hub.utils import WeakFileLock

    source = MODELS[name]
    folder = store / source.folder
    if not source.sha256 and not unpinned:
        first = f"; first {source.needs}" if source.needs else ""
        raise MissingWeights(
            f"weights pull: no checksum of {name} ({source.repo}) is pinned here; pass --unpinned "
            f"to take it as it is there{first}."
        )
    copied = None
    if origin is not None:
        copied = find_folder(source, origin)
        _check_origin(source, copied, unpinned)
    elif find_problem(name, store) is None:
        return False
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with WeakFileLock(store / f".{source.folder}.lock"):
            if copied is not None:
                _copy_model(source, copied, folder)
            elif find_problem(name, store) is None:  # another process has just pulled it
                return False
            else:
                _download_model(source, folder)
            _check_and_lock(source, folder, unpinned)
    except OSError as error:
        raise MissingWeights(
            f"weights pull: {folder} cannot be written ({error.strerror or error}); "
            f"choose another folder with {VARIABLE}."
        ) from error
    return True


def _check_origin(source: Source, origin: Path, unpinned: bool) -> None:
    """Raises: MissingWeights: a folder to copy from lacks a file, or holds another than expected.

    Its tensors are compared with their pin, and all files with its own lock.json where it has one,
    unless `unpinned`.
    """
    absent = [file for file in source.files if not (origin / file).is_file()]
    if absent:
        raise MissingWeights(
            f"weights pull: {origin} lacks {', '.join(absent)} of {source.repo}; "
            f"copy all of {', '.join(source.files)}."
        )
    if unpinned:
        return
    expected = read_lock(origin) | {TENSORS: source.sha256}
    try:
        digests = {file: sha256_of(origin / file) for file in source.files}
    except OSError as error:
        raise MissingWeights(
            f"weights pull: {origin} cannot be read ({error.strerror or error}); copy it again."
        ) from error
    for file, digest in digests.items():
        if digest != expected.get(file, digest):
            raise MissingWeights(
                f"weights pull: {file} of {source.repo} in {origin} has SHA-256 {digest[:12]}.., "
                f"{expected[file][:12]}.. is expected; nothing was changed. Copy it again, or pass "
                "--unpinned to use other weights on purpose."
            )


def _copy_model(source: Source, origin: Path, folder: Path) -> None:
    """Every file, copied beside its place first: an error while copying leaves the model whole."""
    scratches: dict[Path, Path] = {}
    try:
        for file in source.files:
            path = folder / file
            if (origin / file).resolve() != path.resolve():
                scratches[path] = folder / f".{file}.part"
                shutil.copyfile(origin / file, scratches[path])
        (folder / LOCK).unlink(missing_ok=True)
        for path, scratch in scratches.items():
            os.replace(scratch, path)
    finally:
        for scratch in scratches.values():
            scratch.unlink(missing_ok=True)


def _download_model(source: Source, folder: Path) -> None:
    """Every file of the pinned revision; tensors that are the pinned ones already are kept."""
    (folder / LOCK).unlink(missing_ok=True)
    for file in source.files:
        path = folder / file
        if file == TENSORS and path.is_file() and sha256_of(path) == source.sha256:
            continue
        _download(source, file, path)


def _download(source: Source, file: str, path: Path) -> None:
    """One file of the pinned revision; half a file of an earlier pull is completed.

    Raises: MissingWeights.
    """
    from httpx import HTTPError
    from huggingface_hub import hf_hub_url
    from huggingface_hub.errors import HfHubHTTPError

    url = hf_hub_url(source.repo, file, revision=source.revision, endpoint=endpoint())
    part = path.with_name(f".{file}.{source.revision[:8]}.part")
    try:
        transfer(url, part, f"{source.repo}/{file}")
        os.replace(part, path)
        return
    except HfHubHTTPError as error:
        reason = f"HTTP {error.response.status_code}"
        if source.needs:
            raise MissingWeights(
                f"weights pull: {url} cannot be had ({reason}): {source.needs}, run `hf download "
                f"{source.repo}`, and pull it with --from and the cache's folder "
                "(~/.cache/huggingface/hub)."
            ) from error
    except (HTTPError, OSError) as error:
        reason = " ".join(str(error).split()) or type(error).__name__
    raise MissingWeights(
        f"weights pull: {url} cannot be had ({reason}); run it again to go on, "
        "or pull on a machine with internet and pass its folder with --from."
    )


def _check_and_lock(source: Source, folder: Path, unpinned: bool) -> None:
    """Compare the tensors with their pin, and record every file's SHA-256.

    Raises: MissingWeights: other tensors than the pinned ones, which are then removed.
    """
    digests: dict[str, str] = {}
    for file in source.files:
        digests[file] = sha256_of(folder / file)
    digest = digests[TENSORS]
    if digest != source.sha256 and not unpinned:
        (folder / TENSORS).unlink()
        raise MissingWeights(
            f"weights pull: {TENSORS} of {source.repo} has SHA-256 {digest[:12]}.., "
            f"{source.sha256[:12]}.. is pinned; it was removed, pull it again, "
            "or pass --unpinned to use other weights on purpose."
        )
    write_lock(folder, source, digests)
