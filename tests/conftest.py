"""Every test runs with the shapes in the signatures of vap_core and vap_make checked."""

import gc
import os
import tarfile
from collections.abc import Generator
from dataclasses import replace
from multiprocessing import forkserver
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

import pytest
from hypothesis import settings

from tests.checked import check_signatures

if TYPE_CHECKING:
    from vap_core.rollout.types import EpisodeHeader, Frame
    from vap_make.films.demonstrations import Film

check_signatures("vap_core", "vap_make")
os.environ["RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER"] = (
    "0"  # read when ray is first imported: the tests' cluster stays on loopback
)

forkserver.set_forkserver_preload(
    ["vap_core.study.server", "vap_core.study.engine", "vap_core.recording.recorder",
     "vap_core.policies.lerobot.adapter", "lerobot.policies",
     "vap_core.policies.mini_pi0.processor_mini_pi0", "vap_core.study.server_ready"]
)  # fmt: skip
forkserver.set_forkserver_preload = lambda modules: None
"""One server serves a whole session of tests: what any command's workers import, it imports once."""

END_TO_END = {
    "test_attention", "test_benchmarks", "test_cli", "test_cluster", "test_dataset",
    "test_demo", "test_demonstrations", "test_diagnosis", "test_engine", "test_eval_cli",
    "test_foundation", "test_gallery", "test_imported", "test_lerobot", "test_lerobot_loop",
    "test_methods", "test_mini_pi0", "test_perception_training", "test_planted",
    "test_policy_batches", "test_policy_training", "test_probe", "test_record", "test_record_files", "test_shipped_policies",
    "test_sim", "test_soft_prompt", "test_survey_tables", "test_tokens",
}  # fmt: skip
"""Modules that run whole episodes, trainings or commands: slow, so `make check` leaves them out."""
LONG = {
    "test_attention_recording", "test_contracts", "test_kills", "test_menagerie", "test_objects", "test_obedience",
    "test_outgoing", "test_own_object", "test_own_policy", "test_own_suite", "test_pair_training", "test_policy_ahead",
    "test_real_clients", "test_runtime", "test_same_inputs", "test_served", "test_shared", "test_split",
    "test_training_folder", "test_training_language", "test_wheel", "test_wires",
}  # fmt: skip
"""Others that take long."""


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """What is there after the collection is no garbage: to search it took a tenth of the time."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.enable()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark the slow tests; notebooks and long modules run first, so that workers end together."""
    for item in items:
        if item.path.stem in END_TO_END:
            item.add_marker(pytest.mark.slow)
    first = END_TO_END | LONG
    items.sort(key=lambda item: item.path.suffix == ".py" and item.path.stem not in first)


settings.register_profile("vap", deadline=None, derandomize=True)
settings.load_profile("vap")

ROOT = Path(__file__).parent.parent
ARCHIVES = sorted((ROOT.parent / "shared" / "menagerie").glob("*.tar.xz"))
if (
    ARCHIVES and "MENAGERIE_ROOT" not in os.environ
):  # beside a checkout that has them, the robots are compared with Menagerie's
    UNPACKED = TemporaryDirectory(prefix="menagerie-")
    for archive in ARCHIVES:
        with tarfile.open(archive) as tar:
            tar.extractall(UNPACKED.name, filter="data")
    os.environ["MENAGERIE_ROOT"] = UNPACKED.name


@pytest.fixture(autouse=True)
def _one_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "1")


@pytest.fixture(scope="session")
def stage(tmp_path_factory: pytest.TempPathFactory) -> "tuple[Path, list[Film]]":
    """A folder that keeps a stage of two episodes of simpler-bridge, and its films."""
    from vap_make.films import demonstrations
    from vap_make.policy.train import FILMS

    folder = tmp_path_factory.mktemp("cache") / FILMS
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(demonstrations, "EPISODES", 2)
        return folder, demonstrations.cached(folder, "simpler-bridge", 0, 1)


@pytest.fixture(scope="module")
def short_episodes() -> Generator[None]:
    """Those of widowx-pick have twelve steps, for what many are run for."""
    from vap_core.simulation import suites

    suite = suites.SUITES["widowx-pick"]
    short = tuple(replace(task, max_steps=12) for task in suite.tasks)
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(suites.SUITES, suite.name, replace(suite, tasks=short))
        yield


@pytest.fixture(scope="module")
def three(tmp_path_factory: pytest.TempPathFactory) -> "tuple[Path, EpisodeHeader, list[Frame]]":
    """A recording of three cameras, how it opened, and its frames."""
    from tests.drawn import opening, record

    path, start = tmp_path_factory.mktemp("three") / "three.rrd", opening(3)
    return path, start, record(path, start)
