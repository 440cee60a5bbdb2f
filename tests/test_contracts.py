"""The parts that ship keep the contracts, and the contracts find what an implementation does wrong."""

import os
import re
import shlex
import subprocess
import sys
from collections.abc import Callable, Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.contract import kept
from vap_core.attend import Attender
from vap_core.base.errors import UnknownName
from vap_core.base.types import Boxes, Track
from vap_core.contracts import (  # fmt: skip
    given,
    test_detector,
    test_encoder,
    test_policy,
    test_prompter,
    test_segmenter,
    test_suite,
    test_tracker,
)
from vap_core.contracts.given import RenderedScene
from vap_core.contracts.plugin import PROTOCOLS
from vap_core.memory import register
from vap_core.perception.stacks import load_stack
from vap_core.policies.scripted.scripted import Random
from vap_core.rollout import prompters
from vap_core.rollout.prompters import PromptContext, Prompter, TintPrompter, unchanged
from vap_core.simulation.assets.objects import get_object
from vap_core.simulation.studio import reference_views
from vap_core.simulation.suites import SUITES, Suite
from vap_core.vote import similarity

ROOT = Path(__file__).resolve().parents[1]
WHERE = "widowx-pick/pick-straw-cup"


@pytest.fixture(scope="module")
def scene() -> RenderedScene:
    return given.rendered_scene()


def test_the_embedded_stack_keeps_its_contracts(scene: RenderedScene) -> None:
    stack = load_stack("embedded")
    kept(test_encoder, encoder=stack.encoder, scene=scene)
    kept(test_encoder, encoder=stack.unfamiliar_encoder, scene=scene)
    kept(test_detector, detector=stack.detector, scene=scene)
    kept(test_detector, sanity=False, detector=stack.by_category, scene=scene)
    kept(test_segmenter, segmenter=stack.segmenter, scene=scene)
    kept(test_tracker, tracker=stack.tracker, scene=scene)


@pytest.mark.parametrize("make", [Random])
def test_shipped_policies_keep_theirs(make: Callable[[], Any]) -> None:
    kept(test_policy, policy=make(), where=WHERE)


def tinting() -> TintPrompter:
    """The method, with one object in memory."""
    stack = load_stack("embedded")
    views = reference_views(get_object("straw-cup-personal"), 3)
    obj, _ = register("straw-cup-personal", "straw cup", views, stack.detector, stack.encoder)
    return TintPrompter(Attender(stack, {obj.name: obj}))


@pytest.mark.parametrize("make", [prompters.generic, tinting])
def test_prompters_keep_theirs(make: Callable[[], Prompter[Any]]) -> None:
    kept(test_prompter, prompter=make(), where=WHERE)


@pytest.mark.parametrize("suite", SUITES.values(), ids=SUITES)
def test_suites_keep_theirs(suite: Suite) -> None:
    kept(test_suite, suite=suite)


# --- What they find ------------------------------------------------------------------------------


class Outside:
    """Boxes beyond the image, worst first, and another number with every call."""

    def __call__(self, images: list, phrase: str, threshold: float | None = None) -> list[Boxes]:
        wide = [[0, 0, image.shape[1] + 5, 10] for image in images]
        return [Boxes(np.array([box], np.float32), np.ones(1, np.float32), phrase) for box in wide]


class Paints:
    """Darkens what it is given in place."""

    needs_truth = "never"
    highlights = True
    references: dict = {}  # noqa: RUF012

    def start(self, observation: Any, context: PromptContext) -> Any:
        for image in observation.images.values():
            image[:] //= 2
        return None, unchanged(observation.images, context.instruction)

    def steps(self, *_: Any) -> Any: ...


class PaintsLater:
    """Writes into what it is given from the second step on."""

    needs_truth = "never"
    highlights = False
    references: dict = {}  # noqa: RUF012

    def start(self, observation: Any, context: PromptContext) -> Any:
        return None, unchanged(observation.images, context.instruction)

    def steps(self, states: Any, observations: Any, contexts: Any) -> Any:
        for observation in observations:
            for image in observation.images.values():
                image[:20, :20] = 255, 0, 0
        return [self.start(*seen) for seen in zip(observations, contexts, strict=True)]


class ReadsLater:
    """Says that it reads the simulator at the start, and reads it at every step."""

    needs_truth = "start"
    highlights = False
    references: dict = {}  # noqa: RUF012

    def start(self, observation: Any, context: PromptContext) -> Any:
        assert context.truth is not None
        return None, unchanged(observation.images, context.truth.row.instruction)

    def steps(self, states: Any, observations: Any, contexts: Any) -> Any:
        return [self.start(*seen) for seen in zip(observations, contexts, strict=True)]


class ReadsAlways(ReadsLater):
    needs_truth = "always"


class Wild(Random):
    """Other actions in every episode that it ever runs."""

    count = 0

    def start(self, rng: np.random.Generator) -> Any:
        Wild.count += 1
        return super().start(np.random.default_rng(Wild.count))


def test_boxes_outside_the_image_are_found(scene: RenderedScene) -> None:
    with pytest.raises(AssertionError):
        test_detector.test_every_image_has_its_boxes_inside_it_best_first(Outside(), scene)


class RandomScores:
    """Another score with every call."""

    def __call__(self, images: list, phrase: str, threshold: float | None = None) -> list[Boxes]:
        found = []
        for _ in images:
            score = np.random.rand(1).astype(np.float32)  # noqa: NPY002
            found.append(Boxes(np.array([[9, 9, 30, 30]], np.float32), score, phrase))
        return found


class NothingAlone:
    """Finds a box in a batch, none in a single picture."""

    def __call__(self, images: list, phrase: str, threshold: float | None = None) -> list[Boxes]:
        if len(images) == 1:
            return [Boxes.empty(phrase)]
        one = Boxes(np.array([[9, 9, 30, 30]], np.float32), np.ones(1, np.float32), phrase)
        return [one for _ in images]


@pytest.mark.parametrize("make", [RandomScores, NothingAlone])
def test_boxes_that_depend_on_the_call_are_found(
    make: Callable[[], Any], scene: RenderedScene
) -> None:
    with pytest.raises(AssertionError):
        test_detector.test_a_batch_equals_one_by_one_and_repeats_its_bits(make(), scene)


@pytest.mark.parametrize("make", [Paints, PaintsLater])
def test_a_prompter_that_paints_in_place_is_found(make: Callable[[], Prompter[Any]]) -> None:
    with pytest.raises(AssertionError):
        test_prompter.test_what_it_is_given_stays_as_it_was(make(), WHERE)


def test_a_prompter_that_reads_more_than_it_says_is_found() -> None:
    with pytest.raises(AssertionError):
        test_prompter.test_every_step_has_a_text_and_images_that_fit(ReadsLater(), WHERE)
    kept(test_prompter, prompter=ReadsAlways(), where=WHERE)


def test_the_truth_of_a_step_has_its_number() -> None:
    for first, second in test_prompter.two_steps(ReadsAlways(), WHERE):
        truths = [context.truth for _, context in (first, second)]
        assert [truth and truth.step for truth in truths] == [0, 1]


class Stacks:
    """Takes all views as one array."""

    def start(self, images: list, masks: list) -> list:
        np.stack(images)
        return [tuple(Track(mask, 1.0) for mask in of_view) for of_view in masks]

    def step(self, states: list, images: list) -> tuple[list, list]:
        np.stack(images)
        return list(states), list(states)


class Drops:
    """Leaves out the identities that it is not asked for."""

    def start(self, images: list, masks: list) -> list:
        return [tuple(Track(mask, 1.0) for mask in of_view) for of_view in masks]

    def start_targets(self, images: list, masks: list, targets: list) -> list:
        asked = [of_view[list(wanted)] for of_view, wanted in zip(masks, targets, strict=True)]
        return self.start(images, asked)

    def step(self, states: list, images: list) -> tuple[list, list]:
        return list(states), list(states)


def test_a_tracker_that_wants_views_of_one_size_is_found(scene: RenderedScene) -> None:
    with pytest.raises(ValueError, match="need at least one array"):
        test_tracker.test_no_view_has_no_tracks(Stacks())
    with pytest.raises(ValueError, match="must have the same shape"):
        test_tracker.test_views_may_differ_in_size(Stacks(), scene)


def test_a_tracker_that_moves_the_identities_is_found(scene: RenderedScene) -> None:
    with pytest.raises(AssertionError):
        test_tracker.test_the_targets_of_a_view_keep_their_places(Drops(), scene)
    test_tracker.test_the_targets_of_a_view_keep_their_places(Stacks(), scene)


def test_randomness_of_its_own_is_found() -> None:
    test_policy.test_its_actions_fit_the_robot(Wild(), WHERE)
    with pytest.raises(AssertionError):
        test_policy.test_an_episode_repeats_its_actions(Wild(), WHERE)


class Counts(Random):
    """Remembers its calls in the state that it is given."""

    def start(self, rng: np.random.Generator) -> Any:
        return [0, super().start(rng)]

    def plan_from_simulation(self, states: Any, envs: Any) -> Any:
        chunks = []
        for state, env in zip(states, envs, strict=True):
            chunks.append(np.full((1, env.action_size), 1e-3 * state[0], np.float32))
            state[0] += 1
        return states, chunks


def test_states_that_are_changed_in_place_are_found() -> None:
    test_policy.test_a_batch_equals_one_by_one(Counts(), WHERE)
    with pytest.raises(AssertionError):
        test_policy.test_the_states_it_is_given_stay_as_they_were(Counts(), WHERE)


class Pushes(Random):
    """Moves the simulated robot itself where it plans for one episode alone."""

    def plan_from_simulation(self, states: Any, envs: Any) -> Any:
        if len(envs) == 1:
            envs[0].step(np.full(envs[0].action_size, 0.02, np.float32))
        return super().plan_from_simulation(states, envs)


class Reuses(Random):
    """Writes every chunk into one array."""

    def __init__(self) -> None:
        self.out = np.zeros((2, 1, 7), np.float32)

    def plan_from_simulation(self, states: Any, envs: Any) -> Any:
        states, chunks = super().plan_from_simulation(states, envs)
        self.out[: len(chunks)] = chunks
        return states, list(self.out[: len(chunks)])


def test_states_that_differ_under_the_same_actions_are_found() -> None:
    runs = [test_policy.episodes(Pushes(), WHERE, batch) for batch in (1, 2)]
    assert np.array_equal(*[test_policy.actions(run) for run in runs])
    with pytest.raises(AssertionError):
        test_policy.test_a_batch_equals_one_by_one(Pushes(), WHERE)


def test_a_policy_that_reuses_its_array_keeps_the_contract() -> None:
    kept(test_policy, policy=Reuses(), where=WHERE)
    ours = test_policy.actions(test_policy.episodes(Random(), WHERE, batch=2))
    assert np.array_equal(ours, test_policy.actions(test_policy.episodes(Reuses(), WHERE, 2)))


# --- The page ------------------------------------------------------------------------------------

BEFORE, PAGE = (ROOT / "docs" / "extend.md").read_text().split("\n## Contracts\n")
PYTHON = re.compile(r"```python\n(.*?)```", re.DOTALL)
(POLICY,) = (block for block in PYTHON.findall(BEFORE) if "class Still" in block)
(DESK,) = (block for block in PYTHON.findall(BEFORE) if "SUITE = Suite(" in block)
EXAMPLES = "\n\n".join([*PYTHON.findall(PAGE), POLICY.partition("\nstudy =")[0]])
COMMANDS = [shlex.split(line) for line in re.findall(r"^pytest .*$", PAGE, re.M)]


def test_every_protocol_has_a_section_with_its_command() -> None:
    sections = {section.split()[0].lower() for section in PAGE.split("\n### ")[1:]}
    assert sections == set(PROTOCOLS)
    assert sorted(command[3] for command in COMMANDS) == sorted(f"--{name}" for name in PROTOCOLS)


@pytest.fixture
def mine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The page's examples, saved as it says."""
    (tmp_path / "mine.py").write_text(EXAMPLES)
    (tmp_path / "desk.py").write_text(DESK)
    monkeypatch.chdir(tmp_path)
    yield tmp_path
    for module in ("mine", "desk"):
        sys.modules.pop(module, None)


@pytest.mark.parametrize("command", COMMANDS, ids=[command[3] for command in COMMANDS])
def test_the_documented_examples_keep_their_contracts(
    command: list[str], mine: Path, scene: RenderedScene
) -> None:
    """What each printed command tests, in this process."""
    assert command[:3] == ["pytest", "--pyargs", "vap_core.contracts"]
    name = command[3].removeprefix("--")
    found = {name: given.made(command[4]), "scene": scene, "where": WHERE}
    kept(import_module(f"vap_core.contracts.test_{name}"), sanity="not sanity" not in command, **found)  # fmt: skip


@pytest.mark.sweep
@pytest.mark.parametrize("command", COMMANDS, ids=[command[3] for command in COMMANDS])
def test_the_printed_commands_run(command: list[str], mine: Path) -> None:
    program = str(Path(sys.executable).with_name("pytest"))
    done = subprocess.run([program, *command[1:]], cwd=mine, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    assert re.search(r"[3-9] passed", done.stdout), done.stdout


# --- The command ---------------------------------------------------------------------------------

MINE = """
import numpy as np
from vap_core.base.types import Boxes

class Detector:
    def __call__(self, images, phrase, threshold=None):
        return [Boxes.empty(phrase) for _ in images]

class Encoder:
    name = "mean"

    def __call__(self, crops):
        return np.array([crop.reshape(-1, 3).mean(axis=0) for crop in crops])
"""


def contracts(folder: Path, *options: str) -> subprocess.CompletedProcess[str]:
    """The command as a user runs it, from the folder of `mine.py`."""
    (folder / "mine.py").write_text(MINE)
    plugin = ("-p", "vap_core.contracts.plugin", "-p", "no:cacheprovider")
    command = [sys.executable, "-m", "pytest", "-q", "--pyargs", "vap_core.contracts", *plugin]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    return subprocess.run(
        [*command, *options], cwd=folder, env=environment, capture_output=True, text=True
    )


@pytest.mark.slow
def test_the_command_tests_what_it_is_given(tmp_path: Path) -> None:
    done = contracts(tmp_path, "--detector", "mine:Detector", "--encoder", "mine:Encoder")
    assert done.returncode == 1, done.stdout + done.stderr
    failed = {
        line.split(" - ")[0].rpartition("::")[2]
        for line in done.stdout.splitlines()
        if line.startswith("FAILED")
    }
    assert failed == {
        "test_sanity_most_objects_of_a_rendered_table_have_a_box",
        "test_rows_are_float32_of_length_1",
        "test_no_crop_gives_no_row",
        "test_sanity_an_object_is_most_like_itself",
    }
    assert "test_tracker" not in done.stdout


@pytest.mark.slow
def test_the_command_without_a_part_says_how(tmp_path: Path) -> None:
    done = contracts(tmp_path)
    assert done.returncode == 4
    assert "give what is to be tested, as MODULE:NAME: --detector, --encoder" in done.stderr


@pytest.mark.parametrize(
    "name", ["nowhere:Detector", "vap_core.memory:Nothing", "vap_core.memory", ""]
)
def test_what_names_nothing_is_one_line(name: str) -> None:
    with pytest.raises(UnknownName, match="names nothing .* write MODULE:NAME"):
        given.made(name)


def test_objects_classes_and_functions_can_be_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "path", list(sys.path))
    monkeypatch.chdir(tmp_path)
    Path("lazy_load.py").write_text("def load():\n    import beside\n    return beside.PART\n")
    Path("beside.py").write_text("PART = 7\n")
    assert given.made("lazy_load:load") == 7, "what is imported late is found, too"
    assert isinstance(given.made("vap_core.policies.scripted.scripted:Random"), Random)
    assert given.made("vap_core.simulation.suites.layout:WIDOWX") is SUITES["widowx-pick"]
    assert given.made("vap_core.perception.embedded.encoder:load").name.startswith("lite0")
    assert given.made("vap_core.vote:similarity") is similarity
