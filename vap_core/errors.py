"""What can go wrong, and how to mend it: every error is one line that says where, what was possible and what to do next."""


class VapError(Exception):
    """Base of every error the user can mend; the command line prints it as one line and exits with status 2."""


class BadPhoto(VapError):
    """A reference photo that cannot be read, is empty, is not an image, or is too large to decode safely."""


class BadInstruction(VapError):
    """An instruction that names no personal object, or more than the prompt palette has colours."""


class UnknownName(VapError):
    """A suite, task, object, category, robot, method, policy or stack that no registry holds."""


class BadMemory(VapError):
    """A memory file that is damaged, of another version, or made with another encoder."""


class BadObject(VapError):
    """A 3-D file that cannot become an object, or the damaged folder of one."""


class BadOutput(VapError):
    """An output folder that cannot be written, or already holds a different run."""


class BadRecording(VapError):
    """A recording that cannot be parsed."""


class MissingGL(VapError):
    """No OpenGL back end can render without a display."""


class MissingWeights(VapError):
    """Weights that are not on this machine, or whose checksum differs from the manifest."""


class MissingMeshes(VapError):
    """MuJoCo Menagerie's meshes of a robot, neither on this machine nor to be downloaded."""


class BadAction(VapError):
    """An action of the wrong length."""


class BadSuite(VapError):
    """An episode list with a malformed row, or one that changed since it was hashed."""


class BadViews(VapError):
    """Views that cannot be associated: too many of them, or cameras without calibration."""


class BadStudy(VapError):
    """A combination of tasks, methods and policy that makes no sense."""


class BadPolicy(VapError):
    """A checkpoint that is not there, would execute code, is not what its files say, or does not fit the suite."""


class BadEndpoint(VapError):
    """A chat endpoint that cannot be reached, refuses, or does not speak the protocol."""


class BadCluster(VapError):
    """No Ray cluster where one was expected, or no Ray."""


class OutOfReach(VapError):
    """A pose that inverse kinematics cannot reach."""


class WorkerDied(VapError):
    """A worker process that was killed; what it had not finished runs again."""


def one_of(what: str, name: str, known: object) -> UnknownName:
    """The error for a name that a registry lacks: `one_of("make_env: task", "x", TASKS)` lists what it holds."""
    names = ", ".join(sorted(str(key) for key in known))  # type: ignore[attr-defined]
    return UnknownName(f"{what} {name!r} is unknown; known: {names}.")
