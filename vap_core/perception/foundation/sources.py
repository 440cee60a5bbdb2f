"""Where weights that do not ship come from: repositories of the Hugging Face hub, pinned.

Those without a pin are options (`stacks.mixed`) whose files nobody has seen here: they are taken as
the hub gives them, on purpose (`weights pull --unpinned`), and their SHA-256 is kept then.
"""

from dataclasses import dataclass

from vap_core.base.errors import one_of

TENSORS = "model.safetensors"
TOKENIZER = ("tokenizer.json", "tokenizer_config.json")


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
        small_files=("config.json", *TOKENIZER),
    ),
    "grounding-dino-tiny": Source(
        repo="IDEA-Research/grounding-dino-tiny",
        revision="a2bb814dd30d776dcf7e30523b00659f4f141c71",
        sha256="1a2412ef99bd74bcd3c2a246fa1e48581f8889a1300c9051974741314fc042f3",
        small_files=("config.json", *TOKENIZER),
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
    "llmdet-tiny": Source(
        repo="iSEE-Laboratory/llmdet_tiny", small_files=("config.json", *TOKENIZER)
    ),
    "llmdet-base": Source(
        repo="iSEE-Laboratory/llmdet_base", small_files=("config.json", *TOKENIZER)
    ),
    "mm-grounding-dino-tiny": Source(
        repo="openmmlab-community/mm_grounding_dino_tiny_o365v1_goldg_v3det",
        small_files=("config.json", *TOKENIZER),
    ),
    "mm-grounding-dino-base": Source(
        repo="openmmlab-community/mm_grounding_dino_base_all",
        small_files=("config.json", *TOKENIZER),
    ),
    "dinov3-small": Source(
        repo="facebook/dinov3-vits16-pretrain-lvd1689m",
        needs="accept Meta's DINOv3 licence on its page and log in with `hf auth login`",
    ),
    "siglip2-base": Source(repo="google/siglip2-base-patch16-224"),
    "sam3": Source(
        repo="facebook/sam3",
        small_files=("config.json", *TOKENIZER),
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
