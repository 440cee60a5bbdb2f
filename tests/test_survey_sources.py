"""What the survey measures is never trained on, and nothing reads weights by executing them."""

import ast
import json
import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

import vap_core
from vap_core.simulation.assets import objects
from vap_core.simulation.suites import BENCHMARKS, benchmark
from vap_make.films import scenes
from vap_make.lists import benchmarks
from vap_make.objects import generic_instance

PLACED = sorted(
    {place.model for name in BENCHMARKS for row in benchmark(name) for place in row.placements}
)
NUMBER = re.compile(r"-generic-(\d+)")
SOURCES = sorted(Path(vap_core.__file__).parent.rglob("*.py"))
EXECUTES = {"pickle", "cPickle", "dill", "cloudpickle", "joblib", "shelve", "marshal"}
TEXT_ONLY = re.compile("Tokenizer|Processor|Config|policy_class")
"""What reads no weights, and lerobot's policies, which read model.safetensors and no other file."""


def test_training_draws_no_object_that_a_benchmark_places() -> None:
    drawn = {
        model.name
        for i in range(40)
        for held_out in (False, True)
        for model in scenes.draw_objects(np.random.default_rng(i), held_out)[0]
    }
    assert len(drawn) > 200
    assert not drawn & set(PLACED)


def test_whatever_a_benchmark_places_lies_outside_the_numbers_that_training_draws_from() -> None:
    """Not for a sample only: training draws 0.. and HELD_OUT.., the lists hold evaluation instances, props, and generic bystanders between."""
    found = [NUMBER.search(name) for name in PLACED]
    generic = [int(match[1]) for match in found if match]
    assert generic
    assert all(
        scenes.TRAIN_INSTANCES <= benchmarks.NOVEL <= number < scenes.HELD_OUT for number in generic
    )
    assert {
        objects.get_object(name).split
        for name, match in zip(PLACED, found, strict=True)
        if not match
    } == {"personal", "lookalike", "prop"}


def test_no_training_instance_looks_like_one_that_a_benchmark_places() -> None:
    def look(model: objects.ObjectModel) -> str:
        return json.dumps(model.shape) + repr(model.texture)

    placed = {look(objects.get_object(name)) for name in PLACED}
    kinds = {objects.get_object(name).category for name in PLACED}
    trained = {
        look(model)
        for kind in sorted(kinds)
        for model in (generic_instance(kind, i) for i in range(20))
    }
    assert len(trained) == 20 * len(kinds)
    assert not placed & trained


def calls(tree: ast.AST) -> Iterator[tuple[str, dict[str, object]]]:
    """Every call by what it names, such as "torch.load", with its literal keywords."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Call):
            keywords = {
                word.arg: word.value.value
                for word in node.keywords
                if word.arg and isinstance(word.value, ast.Constant)
            }
            yield ast.unparse(node.func), keywords


def offences(tree: ast.AST) -> list[str]:
    """Where a source could execute a file that it reads."""
    found = []
    for node in ast.walk(tree):
        names = (
            [alias.name for alias in node.names]
            if isinstance(node, ast.Import)
            else [node.module or ""]
            if isinstance(node, ast.ImportFrom)
            else []
        )
        found += [f"import {name}" for name in names if name.split(".")[0] in EXECUTES]
    for name, keywords in calls(tree):
        if name == "torch.load" and keywords.get("weights_only") is not True:
            found.append("torch.load without weights_only=True")
        if (
            name.endswith(".from_pretrained")
            and not TEXT_ONLY.search(name)
            and keywords.get("use_safetensors") is not True
        ):
            found.append(f"{name} without use_safetensors=True")
        if name in ("np.load", "numpy.load") and keywords.get("allow_pickle"):
            found.append("np.load with allow_pickle")
        if name.endswith("read_pickle") or name in (
            "torch.jit.load",
            "torch.package.PackageImporter",
        ):
            found.append(name)
    return found


@pytest.mark.parametrize(
    "source",
    ["import pickle", "from pickle import load", "torch.load(path)", "torch.load(path, weights_only=False)", "np.load(path, allow_pickle=True)",
     "pd.read_pickle(path)", "Model.from_pretrained(folder)", "import torch\ntorch.load(path, weights_only=flag)"],
)  # fmt: skip
def test_offences_are_seen(source: str) -> None:
    assert len(offences(ast.parse(source))) == 1


@pytest.mark.parametrize(
    "source",
    [
        "import json",
        "torch.load(path, weights_only=True)",
        "np.load(path)",
        "AutoTokenizer.from_pretrained(x)",
        "M.from_pretrained(x, use_safetensors=True)",
    ],
)
def test_what_only_reads_is_no_offence(source: str) -> None:
    assert offences(ast.parse(source)) == []


def test_no_weights_are_loaded_by_pickle() -> None:
    trees = {str(path): ast.parse(path.read_text()) for path in SOURCES}
    assert len(trees) > 100
    wrong = {Path(name).name: found for name, tree in trees.items() if (found := offences(tree))}
    assert wrong == {"networks.py": ["import pickle"]}, "it refuses all names but a tensor's"
