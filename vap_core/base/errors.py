"""Errors with their remedy: one line that says where, what was possible and what to do next."""

import os
import resource
import shlex
import signal
import threading
import unicodedata
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from difflib import get_close_matches
from importlib.util import find_spec
from pathlib import Path


def printable(text: str, kept: str = "\n\t") -> str:
    """Text for a terminal: control characters as their escapes, but for those of `kept`.

    Text from files and messages may hold a terminal's commands, or turn its direction.
    """
    shown = [
        c
        if c.isprintable() or c in kept or unicodedata.category(c) == "Zs"
        else c.encode("unicode_escape").decode()
        for c in text
    ]
    return "".join(shown)


def number_of(n: int, noun: str) -> str:
    """ "1 candidate", "2 candidates"."""
    return f"{n} {noun}" if n == 1 else f"{n} {noun}s"


def an(noun: str) -> str:
    """The noun with its article, by its first letter."""
    return f"an {noun}" if noun[:1].lower() in tuple("aeiou") else f"a {noun}"


def first_line(error: BaseException | str) -> str:
    """The first line of an error's text, "" where it has none."""
    return (str(error).strip().splitlines() or [""])[0]


LONGEST = 600
"""Characters of an error's text; what a library says of a damaged file may be any bytes of it."""


class VapError(Exception):
    """Base of every error that the user can remedy; the command line prints it and exits with 2.

    Of a text above LONGEST the middle is left out: it begins with the place and ends with the
    remedy. Where `is_whole`, nothing is left out.
    """

    is_whole = False

    def __str__(self) -> str:
        text = super().__str__()
        if self.is_whole or len(text) <= LONGEST:
            return text
        half = (LONGEST - len(" ... ")) // 2
        return f"{text[:half]} ... {text[-half:]}"


class BadPhoto(VapError):
    """A reference photo that is absent, empty, not an image, or too large to decode safely."""


class BadPhotoSet(VapError):
    """References and scenes of a photo set that are incomplete, or boxes that do not fit them."""


class BadDataset(VapError):
    """A recorded dataset that is absent, damaged, without pictures, or cannot be written."""


class BadInstruction(VapError):
    """An instruction without a personal object, or with more of them than the palette has tints."""


class NothingPersonal(BadInstruction):
    """An instruction that names no personal object."""


class UnknownName(VapError):
    """A suite, task, object, category, robot, method, policy or stack that no registry holds.

    It lists what there is, however much.
    """

    is_whole = True


class BadMemory(VapError):
    """A memory file that is damaged, of another version, or made with another encoder."""


class BadObject(VapError):
    """A 3-D file that cannot become an object, or an object's folder that is damaged."""


class BadOutput(VapError):
    """An output folder that cannot be written, or already holds a different run."""


class BadRecording(VapError):
    """A recording that cannot be parsed."""


class MissingGL(VapError):
    """No OpenGL back end can render without a display."""


class MissingWeights(VapError):
    """Weights that are not on this machine, or whose checksum differs from the manifest."""


class MissingPart(VapError):
    """An optional part of the package that is not installed (base.extras)."""


class MissingMeshes(VapError):
    """MuJoCo Menagerie's meshes of a robot, neither on this machine nor to be downloaded."""


class BadAction(VapError):
    """An action of the wrong length, or with numbers that are not finite."""


class BadSuite(VapError):
    """An episode list with a malformed row, or one that changed since it was hashed."""


class BadRobot(VapError):
    """A robot whose MJCF file is absent or lacks a part, or with a camera that cannot look so."""


class BadViews(VapError):
    """Views that cannot be used: too many, without calibration, or not those of the start."""


class BadEncoder(VapError):
    """An encoder whose rows have another form than asked for, are not finite or not of length 1."""


class BadPart(VapError):
    """What a detector, segmenter or tracker gave for some pictures is not its protocol's."""


class BadCrop(BadEncoder):
    """A crop that an encoder cannot embed, although it can embed the references."""


class BadStudy(VapError):
    """Tasks, methods and a policy that do not fit together."""


class BadPolicy(VapError):
    """A policy that does not follow its protocol, or a checkpoint that is absent or damaged, would
    execute code, or does not fit the suite."""


class BadPlan(BadPolicy):
    """What a policy returned for some episodes is not a chunk of actions for each."""


class BadEndpoint(VapError):
    """A chat endpoint or policy server that cannot be reached, refuses, or breaks the protocol."""


class BadMessage(VapError):
    """A message of a policy server, or of its client, that is damaged or lacks what it needs."""


class BadCluster(VapError):
    """No Ray cluster where one was expected, or no Ray."""


class OutOfReach(VapError):
    """A pose that inverse kinematics cannot reach."""


class WorkerDied(VapError):
    """A worker process that was killed; what it had not finished runs again."""


def one_of(what: str, name: str, known: Iterable[object]) -> UnknownName:
    """The error for a name that a registry lacks, with the names that it holds, the nearest first.

    `one_of("make_env: task", "x", TASKS)` reads "make_env: task 'x' is unknown; known: ...".
    """
    names = sorted(set(map(str, known)))
    by_letters = {each.lower(): each for each in names}
    asked = name.lower()
    near = [by_letters[each] for each in get_close_matches(asked, by_letters, n=3, cutoff=0.5)]
    near += [each for each in names if asked and asked in each.lower() and each not in near][:3]
    ordered = ", ".join([*near, *(each for each in names if each not in near)])
    return UnknownName(f"{what} {name!r} is unknown; known: {ordered}.")


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


VARIABLE = "VAP_DEVICE"
"""Environment variable that names the device of foundation models and policies: cpu, cuda:1, ..."""


def device_name(device: str | None = None) -> str:
    """The argument, else `VAP_DEVICE`, else a GPU where there is one.

    Raises: UnknownName: no such device on this machine.
    """
    require("policy", "a choice of device")
    import torch

    name = device or os.environ.get(VARIABLE)
    if not name:
        return "cuda" if torch.cuda.is_available() else "cpu"
    try:
        torch.empty(0, device=torch.device(name))
    except (RuntimeError, AssertionError) as error:
        raise UnknownName(
            f"device {name!r} is not on this machine ({str(error).splitlines()[0]}); "
            f"unset {VARIABLE}, or use cpu."
        ) from error
    return name


def check_device() -> None:
    """What `VAP_DEVICE` names is on this machine, whether or not the models at hand use it.

    Raises: UnknownName.
    """
    if os.environ.get(VARIABLE, "cpu") not in ("", "cpu"):
        device_name()


LARGEST_SEED = 2**32
"""Seeds are smaller: a date is one."""
PAGES = Path("/proc/self/statm")
"""Linux counts this process's pages here, the address space first."""
AGAIN_S = 1.0
"""Libraries that catch every exception are interrupted again after so much CPU time."""


class TimeIsUp(BaseException):
    """Raised inside the work. No `except Exception` of a library's catches it."""


@contextmanager
def bounded(memory_bytes: int, cpu_s: float) -> Iterator[None]:
    """The block may take so much more memory, and so much CPU time.

    Memory is limited on Linux. Time is limited in the main thread, where signal handlers run; a
    call into C that does not return is not interrupted.

    Raises: MemoryError; TimeoutError.
    """
    try:
        with _memory_limit(memory_bytes), _timer(cpu_s):
            yield
    except TimeIsUp:
        raise TimeoutError(f"over {cpu_s:g} s of CPU time") from None


@contextmanager
def _memory_limit(more_bytes: int) -> Iterator[None]:
    if not PAGES.exists():
        yield
        return
    taken = int(PAGES.read_text().split()[0]) * resource.getpagesize()
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    limit = taken + more_bytes
    if soft != resource.RLIM_INFINITY:
        limit = min(limit, soft)
    resource.setrlimit(resource.RLIMIT_AS, (limit, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))


@contextmanager
def _timer(cpu_s: float) -> Iterator[None]:
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    with interrupting(cpu_s, signal.SIGPROF, signal.ITIMER_PROF, AGAIN_S):
        yield


@contextmanager
def interrupting(
    seconds: float, number: signal.Signals, timer: int, again_s: float = 0.0
) -> Iterator[None]:
    """Raises TimeIsUp in the block after that time; only in the main thread."""

    def interrupt(*_: object) -> None:
        raise TimeIsUp

    handler = signal.signal(number, interrupt)
    delay_s, _ = signal.setitimer(timer, seconds, again_s)
    try:
        yield
    finally:
        try:
            signal.setitimer(timer, delay_s)
        finally:
            signal.signal(number, handler)


def command(*words: str | Path, environment: Mapping[str, str] | None = None) -> str:
    """A command of the package as a line for the shell: every word and variable is quoted."""
    parts = [f"{name}={shlex.quote(setting)}" for name, setting in (environment or {}).items()]
    parts.append(shlex.join(["./vap", *map(str, words)]))
    return " ".join(parts)
