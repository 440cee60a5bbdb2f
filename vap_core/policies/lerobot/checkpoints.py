"""A policy's checkpoint as files: where it lies, what it builds on, and no code in it runs."""

import hashlib
import re
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from vap_core.base.errors import BadPolicy
from vap_core.base.files import DATA, SHIPPED, parse_json

WEIGHTS = "model.safetensors"
CONFIG = "config.json"
PIPELINES = ("policy_preprocessor.json", "policy_postprocessor.json")
STEP_NAME = "vap_prompt"
"""The registered name of the step that prompts inside lerobot's own loops."""
STEP_CLASS = "vap_core.policies.lerobot.step.VapPrompt"
"""Its class."""
ANY_STEP_CLASS = re.compile(r"vap_core\.(\w+\.)*VapPrompt")
"""Its class in this version or an earlier one."""
TRAINING_CARD, RECIPE = "training.json", "recipe.json"
CAPTIONS, WORDS = "captions.json", "words"
"""How a checkpoint was trained, and what a training leaves beside it: none decides what it does."""
RUN = "run.json"
"""The manifest of a run, whose folder may be in a checkpoint's (study.store)."""
WANTED_FILES = ("*.json", "*.safetensors", "*.model", "*.txt")


def local_folder(checkpoint: str | Path) -> Path | None:
    """The checkpoint's folder, where it names one that exists.

    data/policies/NAME is a policy that ships, wherever the command is run: tables that are
    published name it so.
    """
    folder = Path(checkpoint).expanduser()
    if not folder.is_dir() and folder.parts[:2] == (DATA.name, SHIPPED.name):
        folder = DATA.joinpath(*folder.parts[1:])
    return folder if folder.is_dir() else None


def is_checkpoint_name(policy: str) -> bool:
    """Whether a policy's name means a checkpoint: a folder that exists, or owner/name."""
    return local_folder(policy) is not None or bool(re.fullmatch(r"[\w.-]+/[\w.-]+", policy))


def locate(checkpoint: str | Path) -> Path:
    """The folder of a checkpoint on this machine. Raises: BadPolicy when a file is missing."""
    folder = local_folder(checkpoint) or _downloaded(str(checkpoint))
    missing = [name for name in (CONFIG, WEIGHTS, *PIPELINES) if not (folder / name).is_file()]
    if missing:
        raise BadPolicy(
            f"load: {folder} lacks {', '.join(missing)}; give the folder that lerobot's "
            "save_pretrained wrote, processors included."
        )
    return folder


def config_field(checkpoint: str | Path, name: str) -> str:
    """A field of a checkpoint's config.json; "" when it is not there. Raises: BadPolicy."""
    file = locate(checkpoint) / CONFIG
    try:
        return str(parse_json(file.read_text()).get(name, ""))
    except (ValueError, AttributeError) as error:
        raise BadPolicy(
            f"load: {file} is no configuration ({type(error).__name__}); save the checkpoint again "
            "with lerobot 0.6."
        ) from error


def trained_for(checkpoint: str | Path) -> str:
    """The suite whose recipe trained a checkpoint; "" where its folder does not say.

    Raises: BadPolicy when a file of the checkpoint is missing.
    """
    try:
        card = parse_json((locate(checkpoint) / TRAINING_CARD).read_text())
        return str(card["recipe"]["suite"])
    except (OSError, ValueError, LookupError, TypeError):
        return ""


def base_models(folder: Path) -> list[str]:
    """Models of the hub that a checkpoint builds on.

    These are the backbone whose sizes it takes, and the tokenizer that reads its commands.

    Raises: BadPolicy when a file is missing or damaged.
    """
    names = [config_field(folder, "vlm_model_name")]
    for step in _steps(folder / PIPELINES[0]):
        config = step.get("config")
        if isinstance(config, dict):
            names.append(str(config.get("tokenizer_name", "")))
    return [name for name in dict.fromkeys(names) if name and not Path(name).is_dir()]


def fingerprint(checkpoint: str | Path) -> str:
    """SHA-256 of everything in a checkpoint that decides what it does, without loading it.

    Raises: BadPolicy when a file is missing.
    """
    folder = locate(checkpoint)
    digest = hashlib.sha256()
    for name in deciding_files(folder):
        digest.update(name.as_posix().encode())
        with (folder / name).open("rb") as stream:
            digest.update(hashlib.file_digest(stream, "sha256").digest())
    return digest.hexdigest()


def stamp(checkpoint: str | Path) -> tuple[object, ...]:
    """What differs once a file that `fingerprint` reads was replaced or written, without reading.

    Raises: BadPolicy when a file is missing.
    """
    folder = locate(checkpoint)
    found: list[object] = [folder.resolve()]
    for name in deciding_files(folder):
        about = (folder / name).stat()
        found.append((name, about.st_ino, about.st_size, about.st_mtime_ns))
    return tuple(found)


def is_vap_step(step: Mapping[str, Any]) -> bool:
    """Whether a step of a checkpoint's pipeline is VAP's, of this version or an earlier one."""
    name = str(step.get("class", ""))
    return step.get("registry_name") == STEP_NAME or ANY_STEP_CLASS.fullmatch(name) is not None


def refuse_code(folder: Path) -> None:
    """Check that the pipelines of a checkpoint name steps of lerobot only.

    lerobot imports and calls whatever a pipeline names.

    Raises: BadPolicy for another step, or for a checkpoint with VAP attached.
    """
    from lerobot.processor import ProcessorStep

    for file in PIPELINES:
        for step in _steps(folder / file):
            name = str(step.get("class", ""))
            module, _, attribute = name.rpartition(".")
            found = getattr(sys.modules.get(module), attribute, None)  # nothing is imported
            ours = isinstance(found, type) and issubclass(found, ProcessorStep)
            if is_vap_step(step):
                raise BadPolicy(
                    f"load: {folder} has VAP attached for lerobot's own loops; here give the plain "
                    "checkpoint, and the method by --method."
                )
            ours = ours and module.startswith("lerobot.processor")
            state = str(step.get("state_file") or "")
            if Path(state).name != state:
                raise BadPolicy(
                    f"load: {folder / file} reads {state!r}, outside of its folder; copy it there."
                )
            if step.get("registry_name") is None and not ours:
                raise BadPolicy(
                    f"load: {folder / file} asks to run {name!r}, which is no step of lerobot; "
                    "files are parsed here, never executed."
                )


def _downloaded(name: str) -> Path:
    """The folder of a model that was downloaded before. Raises: BadPolicy."""
    from huggingface_hub import snapshot_download
    from huggingface_hub.errors import HFValidationError, LocalEntryNotFoundError

    try:
        folder = snapshot_download(name, allow_patterns=list(WANTED_FILES), local_files_only=True)
    except (HFValidationError, LocalEntryNotFoundError) as error:
        raise BadPolicy(
            f"load: {name} is no folder and no model on this machine; download it with "
            f"`hf download {name}`, or give a folder."
        ) from error
    return Path(folder)


def deciding_files(folder: Path) -> list[Path]:
    """The files of a checkpoint that decide what it does, by their names in its folder."""
    found = []
    for file in sorted(folder.rglob("*")):
        name = file.relative_to(folder)
        inner = list(name.parents)[:-1]
        # In a hidden folder, as what a killed save leaves, or in a run's.
        beside = any(part.name.startswith(".") or (folder / part / RUN).is_file() for part in inner)
        beside |= name.name in (TRAINING_CARD, RECIPE) or name.parts[0] in (CAPTIONS, WORDS)
        if file.is_file() and not beside and any(map(name.match, WANTED_FILES)):
            found.append(name)
    return found


def _steps(file: Path) -> list[dict[str, Any]]:
    """The steps of a processor pipeline. Raises: BadPolicy."""
    try:
        return [dict(step) for step in parse_json(file.read_text())["steps"]]
    except (ValueError, KeyError, TypeError) as error:
        raise BadPolicy(
            f"load: {file} is no processor pipeline ({type(error).__name__}); save it again with "
            "lerobot 0.6."
        ) from error
