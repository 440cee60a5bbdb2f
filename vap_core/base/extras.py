"""The optional parts of an installation: extras of pyproject.toml, and the modules of each."""

from importlib.util import find_spec

from vap_core.base.errors import MissingPart

EXTRAS = {
    "policy": ("torch", "torchvision", "lerobot", "transformers", "datasets"),
    "foundation": ("torch", "torchvision", "transformers", "timm"),
    "notebooks": ("rerun_notebook", "jupyter_bbox_widget", "ipykernel"),
    "ray": ("ray",),
    "export": ("torch", "onnx"),
}


def require(extra: str, what: str) -> None:
    """`what` needs an extra. Raises: MissingPart: a module of it is not installed."""
    for module in EXTRAS[extra]:
        if find_spec(module) is None:
            raise MissingPart(_message(what, module, extra))


def missing_part(error: ModuleNotFoundError) -> MissingPart | None:
    """The error for an import that failed, if an extra brings that module."""
    module = (error.name or "").partition(".")[0]
    for extra, modules in EXTRAS.items():
        if module in modules:
            return MissingPart(_message("this", module, extra))
    return None


def _message(what: str, module: str, extra: str) -> str:
    return f"{what} needs {module}, which is not installed; run: pip install 'vap-core[{extra}]'"
