"""The foundation stack's weights: pinned, pulled from the hub or from a folder, and verified before every use.

Each model is one folder of the store, which holds safetensors, JSON and text only, and a lock file that lists the SHA-256 of
every file. The weights' own SHA-256 is pinned here; the small files' are taken from the pinned revision when they are pulled.
"""

import hashlib
import json
import os
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from vap_core.errors import MissingWeights, one_of
from vap_core.files import write_atomic

STORE = Path(__file__).resolve().parent.parent / "data" / "weights-hub"
HUB = "https://huggingface.co"
VARIABLE, ENDPOINT = "VAP_WEIGHTS", "HF_ENDPOINT"
"""Environment variables: another store, and a mirror of the hub."""
TIMEOUT_S, PARTIAL = 30.0, 206
TENSORS, LOCK = "model.safetensors", "lock.json"
TOKENIZER = ("tokenizer.json", "tokenizer_config.json")


@dataclass(frozen=True)
class Source:
    """Where a model comes from: a repository at one commit, the files wanted of it, and what the tensors must hash to."""

    repo: str
    revision: str
    sha256: str
    beside: tuple[str, ...] = ("config.json",)

    @property
    def files(self) -> tuple[str, ...]:
        return (*self.beside, TENSORS)

    @property
    def folder(self) -> str:
        return self.repo.replace("/", "--")


MODELS = {
    "grounding-dino-base": Source(
        "IDEA-Research/grounding-dino-base",
        "12bdfa3120f3e7ec7b434d90674b3396eccf88eb",
        "5548f844c928c4b6f411fa8cbcc2bfa8dbbba437cb1d513975519f93c2a9ed21",
        ("config.json", *TOKENIZER),
    ),
    "grounding-dino-tiny": Source(
        "IDEA-Research/grounding-dino-tiny",
        "a2bb814dd30d776dcf7e30523b00659f4f141c71",
        "1a2412ef99bd74bcd3c2a246fa1e48581f8889a1300c9051974741314fc042f3",
        ("config.json", *TOKENIZER),
    ),
    "dinov2-base": Source(
        "facebook/dinov2-base",
        "f9e44c814b77203eaa57a6bdbbd535f21ede1415",
        "d73036b56966966d07975d696bde331762f37297e2f095de8cea0040c3aa0841",
    ),
    "dinov2-small": Source(
        "facebook/dinov2-small",
        "ed25f3a31f01632728cabb09d1542f84ab7b0056",
        "ae1e99fcefd534ed978cdeb8326f08030c96e28b7a81ffcbc98a857c84d14be1",
    ),
    "sam2.1-hiera-large": Source(
        "facebook/sam2.1-hiera-large",
        "665f8e2ad61cf5f53d65644ff27c8ee525124610",
        "dc407dce21301fd94abb395c5099b4f2c455fdc8a8f261ac3d0ea6d4cd197230",
    ),
    "sam2.1-hiera-tiny": Source(
        "facebook/sam2.1-hiera-tiny",
        "de431c4043854a71d8101e17995dfe596bf101a5",
        "48c14467e5cf9e51870511feb72c89688e82dd74523142c0538b663e193ac2a7",
    ),
}
KINDS = {
    "foundation": ("grounding-dino-base", "dinov2-base", "sam2.1-hiera-large"),
    "foundation-small": ("grounding-dino-tiny", "dinov2-small", "sam2.1-hiera-tiny"),
}
"""Detector, encoder, and segmenter with tracker of each stack."""


@dataclass(frozen=True)
class Weights:
    """A verified folder of one model. `identity` names these very weights."""

    folder: Path
    identity: str


def home() -> Path:
    """Where weights are kept: `VAP_WEIGHTS`, or data/weights-hub."""
    return Path(os.environ.get(VARIABLE) or STORE)


def names(kind: str) -> tuple[str, ...]:
    """The models of a stack. Raises: UnknownName."""
    if kind not in KINDS:
        raise one_of("weights: stack", kind, KINDS)
    return KINDS[kind]


def ready(kind: str, store: Path | None = None) -> tuple[Weights, ...]:
    """The verified folders of a stack's models; hashing takes about a second per gigabyte.

    Raises:
        MissingWeights: names everything that is absent or damaged, and both ways to get it.
    """
    store = store or home()
    wanted = names(kind)
    if wrong := [f"{name} ({fault})" for name in wanted if (fault := problem(name, store))]:
        raise MissingWeights(f"--stack {kind}: {', '.join(wrong)} not usable in {store}; {mend(kind)}.")
    found = []
    for name in wanted:
        digest = _lock(store / MODELS[name].folder)[TENSORS]
        identity = name if digest == MODELS[name].sha256 else f"{name}-{digest[:12]}"
        found.append(Weights(store / MODELS[name].folder, identity))
    return tuple(found)


def mend(kind: str) -> str:
    """How to get a stack's weights, online and offline."""
    pull_it = f"python -m vap_core weights pull --stack {kind}"
    return f"run `{pull_it}`, without internet `{pull_it} --from DIR` with a copy of another machine's, or point {VARIABLE} at a folder that has them"


def problem(name: str, store: Path, quick: bool = False) -> str | None:
    """What is wrong with a model's folder, None when nothing is; `quick` compares no checksums."""
    source, folder = MODELS[name], store / MODELS[name].folder
    lock = _lock(folder)
    if absent := [file for file in source.files if not (folder / file).is_file()]:
        return f"lacks {', '.join(absent)}"
    if unlisted := [file for file in source.files if file not in lock]:
        return f"{LOCK} lacks {', '.join(unlisted)}"
    wrong = [] if quick else [file for file in source.files if _sha256(folder / file) != lock[file]]
    return f"SHA-256 of {', '.join(wrong)} differs from {LOCK}" if wrong else None


def pull(wanted: Sequence[str], store: Path, *, origin: Path | None = None, unpinned: bool = False, say: Callable[[str], None] = print) -> None:
    """Bring models into the store, from the hub or from `origin`; what is there and whole is left alone, what is half there goes on.

    `origin` may be another store, a hub cache, or hold owner/name folders. `unpinned` takes other weights of the same kind.

    Raises:
        MissingWeights: unreachable, absent, or with another checksum than the pinned one.
    """
    for name in wanted:
        source, folder = MODELS[name], store / MODELS[name].folder
        if problem(name, store) is None and origin is None:
            say(f"{name}: whole, in {folder}")
            continue
        try:
            folder.mkdir(parents=True, exist_ok=True)
            place = None if origin is None else locate(source, origin)
            (folder / LOCK).unlink(missing_ok=True)
            for file in source.files:
                _download(source, file, folder) if place is None else _copy(source, file, place, folder)
            found = {file: _sha256(folder / file) for file in source.files}
            if found[TENSORS] != source.sha256 and not unpinned:
                (folder / TENSORS).unlink()
                raise MissingWeights(
                    f"weights pull: {TENSORS} of {source.repo} has SHA-256 {found[TENSORS][:12]}.., {source.sha256[:12]}.. is pinned; "
                    "it was removed, pull it again, or pass --unpinned to use other weights on purpose."
                )
            about = {"repo": source.repo, "revision": source.revision if found[TENSORS] == source.sha256 else None, "sha256": found}
            write_atomic(folder / LOCK, (json.dumps(about, indent=1) + "\n").encode())
        except OSError as error:
            raise MissingWeights(
                f"weights pull: {folder} cannot be written ({error.strerror or error}); choose another folder with {VARIABLE}."
            ) from error
        say(f"{name}: {sum((folder / file).stat().st_size for file in source.files) / 1e6:.1f} MB in {folder}")


def locate(source: Source, origin: Path) -> Path:
    """The folder below `origin` that holds a model: a store's, a hub cache's snapshot, or owner/name.

    Raises:
        MissingWeights: none of them is there.
    """
    below = [origin / source.folder, origin / f"models--{source.folder}" / "snapshots" / source.revision, origin / source.repo]
    for folder in below:
        if (folder / TENSORS).is_file():
            return folder
    tried = ", ".join(str(folder.relative_to(origin)) for folder in below)
    raise MissingWeights(f"weights pull: no {TENSORS} of {source.repo} in {origin}; looked into {tried}.")


def table(store: Path | None = None) -> str:
    """What is there, what is missing and how to get it; checks presence, not checksums."""
    store = store or home()
    lines, missing = [f"weights in {store}"], []
    for kind, models in KINDS.items():
        faults = {name: problem(name, store, quick=True) for name in models}
        lines += [f"{kind:<17} {name:<20} {MODELS[name].repo}@{MODELS[name].revision[:8]}: {fault or 'here'}" for name, fault in faults.items()]
        missing += [f"{kind}: {mend(kind)}"] if any(faults.values()) else []
    return "\n".join([*lines, *missing])


def _download(source: Source, file: str, folder: Path) -> None:
    """One file of the pinned revision; a download that breaks off, now or in an earlier run, goes on where it stopped."""
    from urllib.error import HTTPError

    url = f"{(os.environ.get(ENDPOINT) or HUB).rstrip('/')}/{source.repo}/resolve/{source.revision}/{file}"
    if file == TENSORS and (folder / file).is_file() and _sha256(folder / file) == source.sha256:
        return
    part = folder / f".{file}.{source.revision[:8]}.part"
    try:
        have = -1
        while have < (have := part.stat().st_size if part.is_file() else 0):  # as long as every try brings something
            if _fetch(url, part, have):
                os.replace(part, folder / file)
                return
        reason = "it breaks off"
    except HTTPError as error:
        reason = f"HTTP {error.code}"
        error.close()
    except OSError as error:
        reason = str(error)
    raise MissingWeights(
        f"weights pull: {url} cannot be had ({reason}); run it again to go on, or pull on a machine with internet and pass its folder with --from."
    )


def _fetch(url: str, part: Path, have: int) -> bool:
    """Append what is missing of a file, and whether that was all of it."""
    from urllib.request import Request, urlopen

    from tqdm import tqdm

    wanted = Request(url, headers={"User-Agent": "vap_core", **({"Range": f"bytes={have}-"} if have else {})})
    with urlopen(wanted, timeout=TIMEOUT_S) as answer:
        have = have if answer.status == PARTIAL else 0
        total = have + int(answer.headers["Content-Length"])
        bar = tqdm(total=total, initial=have, unit="B", unit_scale=True, desc=url.rsplit("/resolve/", 1)[0].rsplit("/", 1)[1])
        with part.open("ab" if have else "wb") as out, bar:
            while block := answer.read(1 << 20):
                out.write(block)
                bar.update(len(block))
    return part.stat().st_size == total


def _copy(source: Source, file: str, origin: Path, folder: Path) -> None:
    if not (origin / file).is_file():
        raise MissingWeights(f"weights pull: {origin} lacks {file} of {source.repo}; copy all of {', '.join(source.files)}.")
    if (origin / file).resolve() != (folder / file).resolve():
        scratch = folder / f".{file}.part"
        shutil.copyfile(origin / file, scratch)
        os.replace(scratch, folder / file)


def _lock(folder: Path) -> dict[str, str]:
    try:
        return dict(json.loads((folder / LOCK).read_text())["sha256"])
    except (OSError, ValueError, KeyError, TypeError):
        return {}


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
