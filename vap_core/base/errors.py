"""Errors with their remedy: one line that says where, what was possible and what to do next."""

from collections.abc import Iterable


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


class BadCrop(BadEncoder):
    """A crop that an encoder cannot embed, although it can embed the references."""


class BadStudy(VapError):
    """Tasks, methods and a policy that do not fit together."""


class BadPolicy(VapError):
    """A policy that does not follow its protocol, or a checkpoint that is absent or damaged, would
    execute code, or does not fit the suite."""


class BadEndpoint(VapError):
    """A chat endpoint that cannot be reached, refuses, or does not follow the protocol."""


class BadCluster(VapError):
    """No Ray cluster where one was expected, or no Ray."""


class OutOfReach(VapError):
    """A pose that inverse kinematics cannot reach."""


class WorkerDied(VapError):
    """A worker process that was killed; what it had not finished runs again."""


def one_of(what: str, name: str, known: Iterable[object]) -> UnknownName:
    """The error for a name that a registry lacks, with the names that it holds.

    `one_of("make_env: task", "x", TASKS)` reads "make_env: task 'x' is unknown; known: ...".
    """
    names = ", ".join(sorted(map(str, known)))
    return UnknownName(f"{what} {name!r} is unknown; known: {names}.")
