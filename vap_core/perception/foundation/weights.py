"""Weights that do not ship: repositories of the Hugging Face hub, pinned, and their local store.

Those without a pin are options (`stacks.mixed`) whose files nobody has seen here: they are taken as
the hub gives them, on purpose (`weights pull --unpinned`), and their SHA-256 is kept then.

In the store each model is one folder, which holds safetensors, JSON and text only, and lock.json,
which lists the SHA-256 of every file; they are verified before every use. The tensors' SHA-256 is
pinned here; the small files' are taken from the pinned revision when they are pulled.
"""

import json
import os
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

from vap_core.base.errors import MissingWeights, one_of
from vap_core.base.files import kept_folder, parse_json, read_file, sha256_of, write_atomic

TENSORS = "model.safetensors"
WORDS = ("config.json", "tokenizer.json", "tokenizer_config.json")
"""The small files of a model that reads words."""


@dataclass(frozen=True)
class Source:
    """One model: a repository at one commit, and the SHA-256 of its tensors there, "" for no pin.

    `small_files` are what is needed besides the tensors. `needs` says what the hub asks for first.
    """

    repo: str
    revision: str = "main"
    sha256: str = ""
    small_files: tuple[str, ...] = ("config.json",)
    needs: str = ""

    @property
    def files(self) -> tuple[str, ...]:
        return (*self.small_files, TENSORS)

    @property
    def folder(self) -> str:
        """The name of the model's folder in a store."""
        return self.repo.replace("/", "--")


MODELS = {
    "grounding-dino-base": Source(
        repo="IDEA-Research/grounding-dino-base",
        revision="12bdfa3120f3e7ec7b434d90674b3396eccf88eb",
        sha256="5548f844c928c4b6f411fa8cbcc2bfa8dbbba437cb1d513975519f93c2a9ed21",
        small_files=WORDS,
    ),
    "grounding-dino-tiny": Source(
        repo="IDEA-Research/grounding-dino-tiny",
        revision="a2bb814dd30d776dcf7e30523b00659f4f141c71",
        sha256="1a2412ef99bd74bcd3c2a246fa1e48581f8889a1300c9051974741314fc042f3",
        small_files=WORDS,
    ),
    "dinov2-base": Source(
        repo="facebook/dinov2-base",
        revision="f9e44c814b77203eaa57a6bdbbd535f21ede1415",
        sha256="d73036b56966966d07975d696bde331762f37297e2f095de8cea0040c3aa0841",
    ),
    "dinov2-small": Source(
        repo="facebook/dinov2-small",
        revision="ed25f3a31f01632728cabb09d1542f84ab7b0056",
        sha256="ae1e99fcefd534ed978cdeb8326f08030c96e28b7a81ffcbc98a857c84d14be1",
    ),
    "sam2.1-hiera-large": Source(
        repo="facebook/sam2.1-hiera-large",
        revision="665f8e2ad61cf5f53d65644ff27c8ee525124610",
        sha256="dc407dce21301fd94abb395c5099b4f2c455fdc8a8f261ac3d0ea6d4cd197230",
    ),
    "sam2.1-hiera-tiny": Source(
        repo="facebook/sam2.1-hiera-tiny",
        revision="de431c4043854a71d8101e17995dfe596bf101a5",
        sha256="48c14467e5cf9e51870511feb72c89688e82dd74523142c0538b663e193ac2a7",
    ),
    "llmdet-tiny": Source(repo="iSEE-Laboratory/llmdet_tiny", small_files=WORDS),
    "llmdet-base": Source(repo="iSEE-Laboratory/llmdet_base", small_files=WORDS),
    "mm-grounding-dino-tiny": Source(
        repo="openmmlab-community/mm_grounding_dino_tiny_o365v1_goldg_v3det",
        small_files=WORDS,
    ),
    "mm-grounding-dino-base": Source(
        repo="openmmlab-community/mm_grounding_dino_base_all",
        small_files=WORDS,
    ),
    "dinov3-small": Source(
        repo="facebook/dinov3-vits16-pretrain-lvd1689m",
        needs="accept Meta's DINOv3 licence on its page and log in with `hf auth login`",
    ),
    "siglip2-base": Source(repo="google/siglip2-base-patch16-224"),
    "sam3": Source(
        repo="facebook/sam3",
        small_files=WORDS,
        needs="accept Meta's SAM licence on its page and log in with `hf auth login`",
    ),
    "edgetam": Source(repo="yonigozlan/EdgeTAM-hf"),
    "all-minilm-l6-v2": Source(
        repo="sentence-transformers/all-MiniLM-L6-v2",
        revision="1110a243fdf4706b3f48f1d95db1a4f5529b4d41",
        sha256="53aa51172d142c89d9012cce15ae4d6cc0ca6895895114379cacb4fab128d9db",
        small_files=("tokenizer.json",),
    ),
}
TEXT = "all-minilm-l6-v2"
"""The text encoder of the embedded stack, for an installation without the pip package of it."""
KINDS = {
    "foundation": ("grounding-dino-base", "dinov2-base", "sam2.1-hiera-large"),
    "foundation-small": ("grounding-dino-tiny", "dinov2-small", "sam2.1-hiera-tiny"),
}
"""Detector, encoder, and segmenter with tracker of each stack."""
PARTS = {
    "detector": (
        "grounding-dino-tiny",
        "grounding-dino-base",
        "llmdet-tiny",
        "llmdet-base",
        "mm-grounding-dino-tiny",
        "mm-grounding-dino-base",
        "sam3",
    ),
    "encoder": ("dinov2-small", "dinov2-base", "dinov3-small", "siglip2-base"),
    "tracker": ("sam2.1-hiera-tiny", "sam2.1-hiera-large", "sam3", "edgetam"),
}
"""What may stand for each part of a mixed stack; the tracker brings the segmenter."""
EMBEDDED = "embedded"


def mixed(stack: str, **parts: str) -> str:
    """The name of a stack with some of `PARTS` replaced: "embedded:encoder=dinov2-small".

    Empty names leave a part as it is. Raises: UnknownName.
    """
    changed = []
    for role, name in parts.items():
        if name:
            known = (EMBEDDED, *PARTS[role])
            if name not in known:
                raise one_of(f"load_stack: {role}", name, known)
            changed.append(f"{role}={name}")
    if not changed:
        return stack
    return f"{stack}:{','.join(changed)}"


def parts_of(name: str) -> dict[str, str]:
    """The model of each role of a stack, mixed or not. Raises: UnknownName."""
    base, _, changes = name.partition(":")
    if base not in (EMBEDDED, *KINDS):
        raise one_of("load_stack: base of a mixed stack", base, [EMBEDDED, *KINDS])
    models = KINDS.get(base, (EMBEDDED,) * len(PARTS))
    parts = dict(zip(PARTS, models, strict=True))
    for change in filter(None, changes.split(",")):
        role, _, model = change.partition("=")
        if role not in PARTS:
            raise one_of("load_stack: part of a mixed stack", role, PARTS)
        mixed(base, **{role: model or "nothing"})
        parts[role] = model
    return parts


def needs_photos(name: str) -> bool:
    """Whether `measure calibration --keep` needs photos of a stack.

    It does where a part is embedded: rendered scenes give too few views that are not familiar. A
    stack of another name than those here is the caller's, with its own thresholds for other views.

    Raises: UnknownName.
    """
    if ":" not in name and name not in KINDS:
        return True
    return EMBEDDED in parts_of(name).values()


def models_of(kind: str) -> tuple[str, ...]:
    """The models of a stack, of a mixed one those that do not ship. Raises: UnknownName."""
    if kind == EMBEDDED:
        return (TEXT,)
    if ":" in kind:
        names = parts_of(kind).values()
        return tuple(name for name in dict.fromkeys(names) if name != EMBEDDED)
    if kind not in KINDS:
        raise one_of("weights: stack", kind, ["embedded", *KINDS])
    return KINDS[kind]


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
    check_present(kind, store, quick=False)
    verified: list[VerifiedWeights] = []
    for name in models_of(kind):
        folder = store / MODELS[name].folder
        digest = read_lock(folder)[TENSORS]
        # Other weights, or a model without a pin, carry their digest in the name.
        other = digest != MODELS[name].sha256
        verified.append(VerifiedWeights(folder, f"{name}-{digest[:12]}" if other else name))
    return tuple(verified)


def check_present(kind: str, store: Path | None = None, quick: bool = True) -> None:
    """What takes long asks this first: the files of a stack's models are there.

    None is hashed when `quick`. Raises: MissingWeights, as `verify_stack`.
    """
    if kind == EMBEDDED and quick:  # whose text encoder may be a package's
        return
    store = store or store_folder()
    found = {name: find_problem(name, store, quick) for name in models_of(kind)}
    problems = [f"{name} ({problem})" for name, problem in found.items() if problem]
    if problems:
        raise MissingWeights(
            f"--stack {kind}: {', '.join(problems)} not usable in {store}; {remedy(kind)}."
        )


def locked_sha256(kind: str) -> dict[str, str]:
    """The SHA-256 in lock.json of every file of a stack's models, by "MODEL/FILE"; hashes none.

    Raises: UnknownName; MissingWeights, as `verify_stack`, for what is absent.
    """
    check_present(kind)
    digests: dict[str, str] = {}
    for name in models_of(kind):
        lock = read_lock(store_folder() / MODELS[name].folder)
        digests |= {f"{name}/{file}": lock[file] for file in MODELS[name].files}
    return digests


def remedy(kind: str) -> str:
    """How to get a stack's weights, online and offline. Raises: UnknownName: no such stack."""
    pull = f"./vap weights pull --stack {kind}"
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
    copied = None if origin is None else find_folder(source, origin)
    if copied is None and find_problem(name, store) is None:
        return False
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with WeakFileLock(store / f".{source.folder}.lock"):
            if copied is not None:
                digests = _copy_model(source, copied, folder, unpinned)
            elif find_problem(name, store) is None:  # another process has just pulled it
                return False
            else:
                digests = _download_model(source, folder, unpinned)
            # The revision only where the tensors are the pinned ones.
            revision = source.revision if digests[TENSORS] == source.sha256 else None
            about = {"repo": source.repo, "revision": revision, "sha256": digests}
            write_atomic(folder / LOCK, (json.dumps(about, indent=1) + "\n").encode())
    except OSError as error:
        raise MissingWeights(
            f"weights pull: {folder} cannot be written ({error.strerror or error}); "
            f"choose another folder with {VARIABLE}."
        ) from error
    return True


def _copy_model(source: Source, origin: Path, folder: Path, unpinned: bool) -> dict[str, str]:
    """Every file's SHA-256, copied beside its place first: until all are checked nothing changes.

    Tensors are compared with their pin, and all files with the origin's lock.json where it has one,
    unless `unpinned`. Raises: MissingWeights: a file is absent, or another than expected.
    """
    absent = [file for file in source.files if not (origin / file).is_file()]
    if absent:
        raise MissingWeights(
            f"weights pull: {origin} lacks {', '.join(absent)} of {source.repo}; "
            f"copy all of {', '.join(source.files)}."
        )
    expected = {} if unpinned else read_lock(origin) | {TENSORS: source.sha256}
    parts = {file: folder / f".{file}.part" for file in source.files}
    if origin.resolve() == folder.resolve():
        parts = {file: folder / file for file in source.files}
    digests: dict[str, str] = {}
    try:
        for file, part in parts.items():
            if part.name != file:
                shutil.copyfile(origin / file, part)
            digests[file] = sha256_of(part)
            if digests[file] != expected.get(file, digests[file]):
                raise MissingWeights(
                    f"weights pull: {file} of {source.repo} in {origin} has SHA-256 "
                    f"{digests[file][:12]}.., {expected[file][:12]}.. is expected; nothing was "
                    "changed. Copy it again, or pass --unpinned to use other weights on purpose."
                )
        (folder / LOCK).unlink(missing_ok=True)
        for file, part in parts.items():
            os.replace(part, folder / file)
    finally:
        for file, part in parts.items():
            if part.name != file:
                part.unlink(missing_ok=True)
    return digests


def _download_model(source: Source, folder: Path, unpinned: bool) -> dict[str, str]:
    """Every file's SHA-256, of the pinned revision; half a file of an earlier pull is completed.

    Tensors that are the pinned ones already are kept.

    Raises: MissingWeights: a file cannot be had, or the tensors are others than the pinned ones.
    """
    from httpx import HTTPError
    from huggingface_hub import hf_hub_url
    from huggingface_hub.errors import HfHubHTTPError
    from huggingface_hub.file_download import http_get

    (folder / LOCK).unlink(missing_ok=True)
    endpoint = (os.environ.get(ENDPOINT_VARIABLE) or HUB).rstrip("/")
    digests: dict[str, str] = {}
    for file in source.files:
        path = folder / file
        if file != TENSORS or not path.is_file() or sha256_of(path) != source.sha256:
            url = hf_hub_url(source.repo, file, revision=source.revision, endpoint=endpoint)
            part = path.with_name(f".{file}.{source.revision[:8]}.part")
            then = (
                "; run it again to go on, or pull on a machine with internet and pass its folder "
                "with --from"
            )
            try:
                with part.open("ab") as out:
                    name = f"{source.repo}/{file}"
                    http_get(
                        url,
                        out,
                        resume_size=out.tell(),
                        headers=HEADERS,
                        displayed_filename=name,
                    )
                os.replace(part, path)
            except (HTTPError, OSError) as error:  # the hub's own errors are such
                reason = " ".join(str(error).split()) or type(error).__name__
                if isinstance(error, HfHubHTTPError):
                    reason = f"HTTP {error.response.status_code}"
                    if source.needs:
                        then = (
                            f": {source.needs}, run `hf download {source.repo}`, and pull it with "
                            "--from and the cache's folder (~/.cache/huggingface/hub)"
                        )
                raise MissingWeights(
                    f"weights pull: {url} cannot be had ({reason}){then}."
                ) from error
        digests[file] = sha256_of(path)
    digest = digests[TENSORS]
    if digest != source.sha256 and not unpinned:
        (folder / TENSORS).unlink()
        raise MissingWeights(
            f"weights pull: {TENSORS} of {source.repo} has SHA-256 {digest[:12]}.., "
            f"{source.sha256[:12]}.. is pinned; it was removed, pull it again, "
            "or pass --unpinned to use other weights on purpose."
        )
    return digests
