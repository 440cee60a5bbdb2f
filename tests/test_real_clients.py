"""The clients that others use, in environments of their own: openpi's, and vla-eval's harness."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from tests.test_served import COMMAND, REWRITTEN, Countdown, line, ours, proxied
from vap_core.policies.wire_map import MAPS
from vap_core.policies.wires import WIRES, decoded, unpack
from vap_core.serve.server import PolicyServer
from vap_core.study.trials import Study, make_trial

ROOT = Path(__file__).resolve().parents[1]
UV = [sys.executable, "-m", "uv"]
pytestmark = pytest.mark.slow


def environment(folder: Path, package: str, *options: str) -> Path:
    """The Python of a new environment with a package; the test is skipped without a registry."""
    subprocess.run([*UV, "venv", "-q", "--python", sys.executable, folder], check=True)
    python = folder / "bin" / "python"
    words = [*UV, "pip", "install", "-q", "--python", python, package, *options]
    try:
        done = subprocess.run(words, capture_output=True, text=True, timeout=300, check=False)
    except subprocess.TimeoutExpired:
        pytest.skip(f"{package} was not installed within five minutes")
    if done.returncode:
        pytest.skip(f"{package} cannot be installed here: {done.stderr.strip()[-200:]}")
    return python


OPENPI = """
import sys, numpy as np
from openpi_client.websocket_client_policy import WebsocketClientPolicy
client = WebsocketClientPolicy("127.0.0.1", int(sys.argv[1]))
for x in (24, 26):
    rgb = np.load(sys.argv[2])
    answer = client.infer({"observation/image": np.roll(rgb, x - 24, axis=1), "prompt": sys.argv[3],
                           "observation/state": np.zeros(8)})
    print(answer["actions"].shape, answer["server_timing"])
try:
    client.infer({"observation/image": rgb / 255.0, "prompt": sys.argv[3]})
except RuntimeError as error:
    print(str(error).splitlines()[-1])
"""


def test_openpis_client_through_the_proxy(tmp_path: Path) -> None:
    import numpy as np

    python = environment(tmp_path / "env", "openpi-client==0.1.2", "typing_extensions")
    np.save(tmp_path / "rgb.npy", line())
    with proxied() as (upstream, client):
        port = client().remote_address[1]
        words = [python, "-c", OPENPI, str(port), tmp_path / "rgb.npy", COMMAND]
        done = subprocess.run(words, capture_output=True, text=True, timeout=60, check=True)
    lines = done.stdout.splitlines()
    assert lines[:2] == ["(2, 7) {'infer_ms': 1.5}"] * 2
    assert "is a picture of float64; send uint8" in lines[2]
    assert [decoded(unpack(frame))["prompt"] for frame in upstream.frames] == [REWRITTEN] * 2


CONNECTION = """
import sys, anyio, numpy as np
from vla_eval.connection import Connection

async def main():
    async with Connection(f"ws://127.0.0.1:{sys.argv[1]}") as link:
        print(link.server_info["model_server"], link.server_info["protocol_version"])
        for _ in range(2):
            await link.start_episode({"task": {"name": "x"}})
            obs = {"images": {"front": np.load(sys.argv[2])}, "state": np.zeros(13, np.float32),
                   "task_description": "pick up a cup"}
            print([float((await link.act(obs))["actions"][0]) for _ in range(3)])
            await link.end_episode({"metrics": {"success": True}})
        try:
            await link.act({"images": {}})
        except RuntimeError as error:
            print(error)

anyio.run(main)
"""


@pytest.fixture(scope="module")
def vla_eval(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """vla-eval 0.8 in an environment of its own, which finds our packages, too."""
    folder = tmp_path_factory.mktemp("vla-eval")
    pins = [*UV, "pip", "freeze", "--exclude-editable", "--python", sys.executable]
    listed = subprocess.run(pins, capture_output=True, text=True, check=True).stdout
    known = [pin for pin in listed.splitlines() if "==" in pin and " " not in pin]
    (folder / "pins.txt").write_text("\n".join(known))
    python = environment(folder / "env", "vla-eval==0.8.0", "-c", str(folder / "pins.txt"))
    (own,) = (folder / "env" / "lib").glob("python*/site-packages")
    here = [ROOT, ROOT / "plugins" / "vla_eval_vap", Path(pytest.__file__).parents[1]]
    (own / "ours.pth").write_text("\n".join(map(str, here)))
    return python


def test_vla_evals_connection_against_our_server(vla_eval: Path, tmp_path: Path) -> None:
    import numpy as np

    np.save(tmp_path / "rgb.npy", line())
    server = PolicyServer(Countdown(), MAPS["ours-vla-eval"], ["front"])
    with ours(server, WIRES["vla-eval"]) as port:
        words = [vla_eval, "-c", CONNECTION, str(port), tmp_path / "rgb.npy"]
        done = subprocess.run(words, capture_output=True, text=True, timeout=60, check=True)
    lines = done.stdout.splitlines()
    assert lines[:3] == ["countdown 1", "[0.0, 1.0, 1.0]", "[0.0, 1.0, 1.0]"]
    assert "has nothing where a picture" in lines[3]


@pytest.mark.timeout(240)
def test_vla_eval_counts_what_our_engine_counts(vla_eval: Path, tmp_path: Path) -> None:
    """Two episodes of simpler-bridge with mini-pi0, of which it fails one, by its runner and by ours."""
    from vap_core.rollout import rollout

    suite, task = "simpler-bridge", "put-owl-figurine"
    study = Study(((suite, task),), ("generic",), policy="mini-pi0")
    rows = study.rows(suite, task)[:2]
    trial = make_trial(study, rows, "generic", tmp_path / "memory")
    wanted = sum(episode.outcome.success for episode in rollout(trial, rows))
    assert wanted == 1
    config = {
        "server": {"url": "ws://127.0.0.1:0"},
        "output_dir": str(tmp_path / "out"),
        "benchmarks": [
            {
                "benchmark": "vla_eval_vap:VapBenchmark",
                "episodes_per_task": 2,
                "params": {"suite": suite, "tasks": [task]},
            }
        ],
    }
    (tmp_path / "config.yaml").write_text(json.dumps(config))
    server = PolicyServer(trial.policy, MAPS["ours-vla-eval"], ["front"])  # type: ignore[arg-type]
    with ours(server, WIRES["vla-eval"]) as port:
        words = [vla_eval, "-m", "vla_eval.cli.main", "run", "--no-docker"]
        words += ["--config", tmp_path / "config.yaml", "--server-url", f"ws://127.0.0.1:{port}"]
        done = subprocess.run(words, capture_output=True, text=True, timeout=200, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    (file,) = (tmp_path / "out").glob("*aggregate.json")
    found = json.loads(file.read_text())
    assert [round(2 * task["mean_success"]) for task in found["tasks"]] == [wanted]
