"""Pulling the foundation stacks' weights into the store, from the hub or from a folder.

huggingface_hub transfers the files, retries and locks. Half a file stays beside its final place, so
that an interrupted pull goes on where it stopped; `hf_hub_download` would resume within one call
only.
"""

import os
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path

from vap_core.base.errors import MissingWeights
from vap_core.base.files import sha256_of
from vap_core.perception.foundation.sources import MODELS, TENSORS, Source
from vap_core.perception.foundation.store import (
    LOCK,
    VARIABLE,
    find_problem,
    read_lock,
    write_lock,
)

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
