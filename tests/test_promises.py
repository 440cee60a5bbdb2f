"""Files are parsed and never executed, servers are on loopback, and keys stay where they are."""

import ast
import errno
import os
import re
import socket
import time
from pathlib import Path

import pytest

import vap_core
from vap_core import memory
from vap_core.base import files
from vap_core.base.errors import LONGEST, BadMemory, BadObject, BadOutput, one_of
from vap_core.instruction import context
from vap_core.policies.mini_pi0 import learned_token
from vap_core.recording import show as viewer
from vap_core.study import store

ROOT = Path(vap_core.__file__).resolve().parent
SOURCES = sorted(ROOT.rglob("*.py"))
RUNS_CODE = {
    *("pickle", "cPickle", "_pickle", "dill", "cloudpickle", "joblib", "marshal", "shelve", "yaml"),
}
"""Modules whose readers execute what a file says, or build any object that it names."""


def calls(tree: ast.AST) -> list[tuple[str, ast.Call]]:
    """Every call with the dotted name of what is called."""
    found = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Call):
            found.append((ast.unparse(node.func), node))
    return found


def keyword(call: ast.Call, name: str) -> str:
    return next((ast.unparse(each.value) for each in call.keywords if each.arg == name), "")


RESTRICTED = ("networks.py", "pickle")
"""Reads one file of a known digest, and refuses all names but a tensor's: see test_extras."""


def test_no_module_reads_what_can_execute() -> None:
    wrong = []
    for path in SOURCES:
        tree = ast.parse(path.read_text())
        for node in ast.walk(tree):
            names = []
            if isinstance(node, ast.Import):
                names = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom):
                names = [node.module or ""]
            for name in names:
                if name.split(".")[0] in RUNS_CODE and (path.name, name) != RESTRICTED:
                    wrong.append(f"{path.name}: {name}")
        for name, call in calls(tree):
            if name in ("eval", "exec", "compile", "__import__"):
                wrong.append(f"{path.name}: {name}()")
            if name == "torch.load" and keyword(call, "weights_only") != "True":
                wrong.append(f"{path.name}: torch.load without weights_only")
            if name in ("np.load", "numpy.load") and keyword(call, "allow_pickle") == "True":
                wrong.append(f"{path.name}: np.load with pickle")
            if name.endswith(("read_pickle", "to_pickle")):
                wrong.append(f"{path.name}: {name}")
            if keyword(call, "shell") == "True" or keyword(call, "trust_remote_code") == "True":
                wrong.append(f"{path.name}: {name} with shell or remote code")
    assert not wrong


def test_set_up_installs_nothing_without_its_hash() -> None:
    """Each install of packages asks for hashes, and every pinned package has one."""
    root = Path(__file__).parents[1]
    installs = []
    for line in (root / ".ci" / "setup").read_text().splitlines():
        if re.search(r"pip install|\{PIP\[@\]\}", line) and " -r " in line:
            installs.append(line)
    assert len(installs) == 3
    assert all("--require-hashes" in line for line in installs)
    pinned = re.split(r"\n(?=[a-zA-Z0-9])", (root / "environment.txt").read_text())
    packages = [entry for entry in pinned if "==" in entry]
    assert len(packages) > 200
    assert all("--hash=sha256:" in entry for entry in packages)


def test_a_clock_that_was_set_back_makes_no_scratch_file_old(tmp_path: Path) -> None:
    young = tmp_path / ".a.tmp"
    young.touch()
    ahead = time.time() + 10 * files.ABANDONED_S
    os.utime(young, (ahead, ahead))
    files.remove_scratch(tmp_path)
    assert young.exists()


def damaged(path: Path) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(b"PAR1 and nothing else")
    return path


def test_a_damaged_table_is_one_line_wherever_it_is_read(tmp_path: Path) -> None:
    from vap_core.study import attention, logs, survey

    for name in attention.TABLES:
        damaged(tmp_path / f"{attention.PREFIX}{name}.parquet")
    for name in survey.TABLES:
        damaged(tmp_path / f"perception_{name}.parquet")
    damaged(tmp_path / "traces" / "a.parquet")
    damaged(tmp_path / "audit" / "a.parquet")
    for read in (
        attention.read, survey.published, logs.read_audit, logs.read_states,
    ):  # fmt: skip
        with pytest.raises(BadOutput, match=r"parquet is damaged; ") as told:
            list(read(tmp_path))
        assert "\n" not in str(told.value)


@pytest.mark.parametrize(
    ("error", "reason"),
    [
        (PermissionError(errno.EACCES, "Permission denied"), "Permission denied"),
        (OSError(errno.EMFILE, "Too many open files"), "Too many open files"),
        (UnicodeEncodeError("utf-8", "\udce4", 0, 1, "surrogates"), "a name that is no text"),
    ],
)
def test_a_table_that_cannot_be_opened_is_not_to_be_deleted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: Exception, reason: str
) -> None:
    def refuse(path: Path) -> None:
        raise error

    monkeypatch.setattr("pyarrow.parquet.read_metadata", refuse)
    with pytest.raises(BadOutput, match=reason) as told:
        files.read_parquet(damaged(tmp_path / "a.parquet"), "x", "delete it")
    assert "delete" not in str(told.value)


READS_WHOLE_FILES = {
    "memory": (memory.load, "mug.safetensors", BadMemory),
    "token": (lambda path: learned_token.load(path.parent, "mug", "model"), "mug.token.safetensors", BadMemory),
    "history": (lambda path: context.read_uses(path.parent), context.FILE, BadMemory),
    "run": (lambda path: store.read_manifest(path.parent), store.MANIFEST, BadOutput),
}  # fmt: skip


@pytest.mark.parametrize("kind", READS_WHOLE_FILES)
def test_a_file_larger_than_any_memory_is_one_line(tmp_path: Path, kind: str) -> None:
    read, name, error = READS_WHOLE_FILES[kind]
    (tmp_path / name).touch()
    os.truncate(tmp_path / name, 1 << 42)
    with pytest.raises(error) as caught:
        read(tmp_path / name)
    assert len(str(caught.value).splitlines()) == 1


def test_a_file_for_which_the_memory_does_not_suffice_is_an_error_of_reading(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def exhausted(path: Path) -> bytes:
        raise MemoryError

    (tmp_path / "file").touch()
    monkeypatch.setattr(Path, "read_bytes", exhausted)
    with pytest.raises(OSError, match="Cannot allocate memory"):
        files.read_file(tmp_path / "file")


def test_arrays_of_objects_are_refused_wherever_arrays_are_read(tmp_path: Path) -> None:
    """numpy's default, which nothing of ours changes."""
    import numpy as np

    ran = tmp_path / "ran"

    class Runs:
        def __reduce__(self) -> tuple:
            return ran.touch, ()

    array = np.empty(1, object)
    array[0] = Runs()
    np.savez(tmp_path / "a.npz", vertex=array)
    with np.load(tmp_path / "a.npz") as file, pytest.raises(ValueError, match="allow_pickle"):
        file["vertex"]
    assert not ran.exists()


def test_no_address_but_loopback_is_listened_to() -> None:
    wrong = []
    for path in (*SOURCES, ROOT.parent / "Makefile"):
        for number, line in enumerate(path.read_text().splitlines(), 1):
            if re.search(r"0\.0\.0\.0|\[::\]|--ip[= ](?!127)|INADDR_ANY", line):
                wrong.append(f"{path.name}:{number}: {line.strip()}")
    assert not wrong


def listening() -> set[tuple[str, int]]:
    """Addresses and ports that this process listens on, as the kernel says."""
    own = set()
    for descriptor in Path("/proc/self/fd").iterdir():
        try:
            target = str(descriptor.readlink())
        except OSError:
            continue
        if target.startswith("socket:["):
            own.add(target[8:-1])
    found = set()
    for table in ("tcp", "tcp6"):
        for line in Path(f"/proc/net/{table}").read_text().splitlines()[1:]:
            cells = line.split()
            if cells[3] == "0A" and cells[9] in own:
                address, port = cells[1].split(":")
                found.add((address, int(port, 16)))
    return found


LOOPBACK = {"0100007F", "0000000000000000FFFF00000100007F", "00000000000000000000000001000000"}


@pytest.mark.skipif(not Path("/proc/net/tcp").exists(), reason="needs Linux")
def test_sockets_are_seen_and_reruns_server_opens_them_on_loopback_alone(tmp_path: Path) -> None:
    before = listening()
    with socket.create_server(("127.0.0.1", 0)) as server:
        ((address, port),) = listening() - before
        assert (address in LOOPBACK, port) == (True, server.getsockname()[1])
    with socket.create_server(("0.0.0.0", 0)):
        ((address, _),) = listening() - before
        assert address not in LOOPBACK
    import rerun as rr

    with rr.server.Server(host="127.0.0.1"):
        opened = listening() - before
    assert opened
    assert {address for address, _ in opened} <= LOOPBACK


def test_the_viewer_has_a_port_on_loopback() -> None:
    command = list(map(str, viewer._viewer_command(viewer.free_port())))
    assert "0.0.0.0" not in " ".join(command)


def test_keys_are_read_in_one_place_and_shown_in_none() -> None:
    readers = set()
    for path in SOURCES:
        if re.search(r"[\"'][A-Z_]*(API_KEY|TOKEN|SECRET)[\"']", path.read_text()):
            readers.add(path.relative_to(ROOT).as_posix())
    assert readers <= {"perception/chat.py", "policies/wires.py"}
    text = "\n".join((ROOT / reader).read_text() for reader in sorted(readers))
    shown = [line for line in text.splitlines() if re.search(r"\{(\w+\.)*(key|token)\}", line)]
    assert [line.strip() for line in shown] == [
        'headers = {"Authorization": f"Bearer {endpoint.key}"} if endpoint.key else {}',
        'return {"Authorization": f"Api-Key {token}"} if token else {}',
    ]


def test_a_long_error_keeps_its_place_and_its_remedy() -> None:
    short = "objects: mug is damaged; import it again."
    assert str(BadObject(short)) == short
    said = str(BadObject(f"objects: mug is damaged ({'x' * 5000}); import it again."))
    assert len(said) <= LONGEST
    assert said.startswith("objects: mug is damaged (x")
    assert " ... " in said
    assert said.endswith("x); import it again.")
    names = [f"cup-{i}" for i in range(500)]
    assert all(name in str(one_of("objects: object", "mug", names)) for name in names)
