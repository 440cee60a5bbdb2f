"""Nothing that is started sends anything out: our commands, lerobot's, Rerun, Ray, JupyterLab."""

import json
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.drawn import SUCCESS, frame, opening
from vap_core import get_object, reference_views
from vap_core.base.errors import MissingGL
from vap_core.recording import Recorder, show, stream
from vap_core.recording.stream import rerun_command, rerun_environment
from vap_core.study.trials import shipped
from vap_core.study.workers import ray_executor

ROOT = Path(__file__).resolve().parents[1]


NETWORK = ("-e", "trace=connect,sendto,sendmsg,sendmmsg")
SOCKET = re.compile(r"sa_family=AF_INET6?, .*?(?:inet_addr\(|inet_pton\(AF_INET6, )\"([^\"]*)\"")


IN_TURN = """
import json, sys
from dataclasses import replace
from vap_core.cli import main
from vap_core.simulation import suites

if __name__ == "__main__":
    listed = suites.rows
    suites.rows = lambda *asked, **more: tuple(
        replace(row, max_steps=3) for row in listed(*asked, **more)
    )
    for words in json.loads(sys.argv[1]):
        sys.argv[1:] = words
        try:
            main()
        except SystemExit as stop:
            assert not stop.code, (words, stop.code)
"""
"""Commands one after the other in one process, which imports what they need once; short episodes."""


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("strace") is None, reason="needs strace")
def test_our_commands_and_lerobots_look_nothing_up_and_write_nothing_elsewhere(
    tmp_path: Path,
) -> None:
    """With an empty home, and no variable of ours or of a CI in the environment.

    Of the tour Jupyter's kernel is reached on 127.0.0.1, and IPython makes its profile in the home,
    as it does for every notebook.
    """
    from PIL import Image

    home, bank = tmp_path / "home", tmp_path / "memory"
    home.mkdir()
    photo = tmp_path / "camera.png"
    Image.fromarray(reference_views(get_object("camera-personal"), 1)[0]).save(photo)
    row = ("--suite", "simpler-bridge", "--task", "put-camera")
    bridge = shipped("simpler-bridge")
    lerobot = Path(sys.executable).with_name("lerobot-eval")
    ours = (
        ("register", "camera-personal", "--category", "camera", photo, "--whole", "--memory", bank),
        ("ground", photo, "bring my camera", "--memory", bank, "--out", tmp_path / "ground"),
        ("rollout", *row, "--policy", "mini-pi0", "--episodes", "1", "--out", tmp_path / "rollout"),
        ("eval", *row, "--episodes", "1", "--methods", "vap", "--out", tmp_path / "eval"),
        ("attach", bridge, tmp_path / "with-vap", "--memory", bank),
    )
    commands = (
        (sys.executable, "-c", IN_TURN, json.dumps(ours, default=str)),
        (sys.executable, lerobot, f"--policy.path={tmp_path / 'with-vap'}", "--env.type=vap",
         "--env.task=simpler-bridge/put-camera", "--env.max_steps=3", "--eval.n_episodes=1",
         "--eval.batch_size=1", f"--output_dir={tmp_path / 'lerobot'}"),
        (sys.executable, "-m", "jupyter", "nbconvert", "--to", "notebook", "--execute",
         tmp_path / "tour.ipynb", "--output", "out"),
    )  # fmt: skip
    tour = json.loads((ROOT / "notebooks" / "00_tour.ipynb").read_text())
    numbers = [i for i, cell in enumerate(tour["cells"]) if cell["cell_type"] == "code"]
    tour["cells"] = tour["cells"][: numbers[8]]  # up to the vote, without the episodes
    (tmp_path / "tour.ipynb").write_text(json.dumps(tour))
    kept = {k: v for k, v in os.environ.items() if k in ("PATH", "LD_LIBRARY_PATH", "TMPDIR")}
    environment = {**kept, "HOME": str(home), "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    for number, command in enumerate(commands):
        log = tmp_path / f"calls-{number}"
        done = subprocess.run(
            ["strace", "-f", "--seccomp-bpf", *NETWORK, "-o", log, *map(str, command)],
            env=environment,
            cwd=tmp_path,
            capture_output=True,
            text=True,
            check=False,
        )
        if not log.exists() or "exited with" not in log.read_text():
            pytest.skip("strace may not trace here")
        assert done.returncode == 0, (command, done.stderr[-2000:])
        reached = set(SOCKET.findall(log.read_text())) - {"127.0.0.1", "::1"}
        assert not reached, (command, reached)
    # Matplotlib keeps its list of this machine's fonts there, IPython an empty profile.
    written = {path.relative_to(home).parts[:2] for path in home.rglob("*") if path.is_file()}
    assert written <= {(".cache", "matplotlib"), (".ipython", "profile_default")}


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    path = tmp_path / "one.rrd"
    with Recorder(path, opening(1)) as recorder:
        recorder.frame(frame(0, opening(1)))
        recorder.close(SUCCESS)
    return path


def test_rerun_leaves_no_configuration_in_the_home(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    home = tmp_path / "home"
    home.mkdir()
    monkeypatch.setenv("HOME", str(home))
    monkeypatch.setenv("FORCE_RERUN_ANALYTICS", "1")
    subprocess.run(
        rerun_command("rrd", "optimize", tmp_path / "none.rrd", "-o", tmp_path / "out.rrd"),
        env=rerun_environment(),
        capture_output=True,
        check=False,
    )
    assert not list(home.iterdir())


@pytest.mark.parametrize("start", ["screenshot", "open_viewer", "recover"])
def test_every_process_of_rerun_gets_that_environment(
    recording: Path, monkeypatch: pytest.MonkeyPatch, start: str
) -> None:
    given = []

    def begin(command: list[str], **options: object) -> None:
        given.append(options.get("env") or {})
        raise MissingGL("not started")

    monkeypatch.setattr(show.subprocess, "Popen", begin)
    monkeypatch.setattr(stream.subprocess, "run", begin)
    monkeypatch.setenv("DISPLAY", ":0")
    leftover = recording.with_name(".two.rrd.tmp")
    leftover.write_bytes(b"")
    calls = {
        "screenshot": lambda: show.screenshot(recording, recording.with_suffix(".png")),
        "open_viewer": lambda: show.open_viewer(recording),
        "recover": lambda: stream.recover(leftover),
    }
    with pytest.raises(MissingGL):
        calls[start]()
    (environment,) = given
    assert environment["CI"] == "1"
    assert environment["https_proxy"] == environment["ALL_PROXY"] == "http://127.0.0.1:9"


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("strace") is None, reason="needs strace")
def test_the_viewer_connects_to_nothing_outside(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It looks for a newer version whether it can draw or not; that must end at the proxy."""
    monkeypatch.setenv("HOME", str(tmp_path))
    log = tmp_path / "calls"
    options = ("--headless", "--window-size", "320x200")
    process = subprocess.Popen(
        [
            *("strace", "-f", "-e", "trace=connect,sendto,sendmmsg", "-o", log),
            *show._viewer_command(show.free_port(), *options),
        ],
        env=rerun_environment(),
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )
    deadline = time.monotonic() + 20
    calls = ""
    while "htons(9)" not in calls and time.monotonic() < deadline and process.poll() is None:
        time.sleep(0.2)
        calls = log.read_text() if log.exists() else ""
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    if not calls:
        pytest.skip("strace may not trace here")
    assert "htons(9)" in calls, "it no longer looks for a newer version, or ignores the proxy"
    assert set(re.findall(r'inet_addr\("([^"]*)"', calls)) == {"127.0.0.1"}
    assert not {path.name for path in tmp_path.iterdir()} & {".config", ".local"}


@pytest.mark.slow
def test_the_notebook_widget_is_served_from_this_machine(recording: Path) -> None:
    program = (
        "import sys, pathlib; from vap_core.recording import view\n"
        "view(pathlib.Path(sys.argv[1])); import rerun_notebook; print(rerun_notebook.ESM_MOD)"
    )
    environment = {k: v for k, v in os.environ.items() if k != "RERUN_NOTEBOOK_ASSET"}
    done = subprocess.run(
        [sys.executable, "-c", program, recording],
        env=environment,
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.startswith("http://localhost:")


def test_ray_reports_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("RAY_USAGE_STATS_ENABLED", raising=False)
    ray_executor("10.0.0.5:6379")
    assert os.environ["RAY_USAGE_STATS_ENABLED"] == "0"


def test_jupyterlab_fetches_neither_news_nor_versions() -> None:
    from jupyterlab.handlers.announcements import NeverCheckForUpdate
    from jupyterlab.labapp import LabApp

    options = re.search(r"^QUIET_LAB := (.*)$", (ROOT / "Makefile").read_text(), re.MULTILINE)
    assert options is not None
    lab = LabApp()
    lab.parse_command_line(shlex.split(options[1]))
    assert lab.news_url is None
    assert lab.check_for_updates_class is NeverCheckForUpdate
    assert lab.extension_manager == "readonly"
    assert "jupyter lab --ip 127.0.0.1 $(QUIET_LAB) " in (ROOT / "Makefile").read_text()
