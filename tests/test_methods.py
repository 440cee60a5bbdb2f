"""Every method over one frozen policy: what it changes and what it may read; and nothing that it does changes the policy."""

import inspect
import sys
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch

from tests import tiny_lerobot as tiny
from tests.toys import TOYS, Kept, observation, personal, scene
from vap_core.attend import Attender
from vap_core.base.errors import BadInstruction, BadMemory, BadPolicy, BadStudy
from vap_core.base.types import Description, Views
from vap_core.memory import load_bank
from vap_core.policies.lerobot.toy_pi0 import toy_sizes
from vap_core.policies.protocol import PolicyInput, checksum, unchanged_weights
from vap_core.prompt import PALETTE, tint
from vap_core.rollout.loop import rollout
from vap_core.rollout.prompters import (
    HardPrompt,
    Oracle,
    OraclePrompter,
    PromptContext,
    SceneTruth,
    SoftPrompt,
    TextPrompter,
    TintPrompter,
    hard_prompt,
)
from vap_core.rollout.types import Episode, EpisodeHeader
from vap_core.simulation.types import EpisodeRow, Observation, Placement
from vap_core.study import engine, trials
from vap_core.study.engine import run_job
from vap_core.study.methods import METHODS
from vap_core.study.store import open_run
from vap_core.study.trials import Study, make_trial, register_personal

GREY, TEAL, SAND = (90, 90, 90), (40, 120, 110), (150, 140, 130)
RED = PALETTE[0]
MUG = personal("mug", "cup", TEAL, TEAL)
LINE = scene([(4, 20, GREY), (24, 20, TEAL), (44, 20, SAND)])
ROW = EpisodeRow(
    "toys",
    "bring",
    0,
    0,
    "bring my cup",
    "cup",
    tuple(Placement(name, 0.0, 0.0, 0.0) for name in ("mug", "tray", "twin", "other")),
    5,
)
ALIKE = frozenset({"mug", "twin", "other"})


def where(rgb: np.ndarray, colour: tuple[int, int, int]) -> np.ndarray:
    return (rgb == colour).all(axis=2)


def masks_of(rgb: np.ndarray) -> dict[str, np.ndarray]:
    """The toy world's truth: the mug is teal, its twin grey, the other sand; the tray, of another category, is everything."""
    return {
        "mug": where(rgb, TEAL),
        "twin": where(rgb, GREY),
        "other": where(rgb, SAND),
        "tray": np.ones(rgb.shape[:2], bool),
    }


def revealed(how: Oracle) -> OraclePrompter:
    return OraclePrompter(Attender(TOYS, {"mug": MUG}), how, ALIKE)


def looking(views: Views, row: EpisodeRow = ROW) -> tuple[Observation, PromptContext]:
    """What a prompter gets at a step of the row, with the truth of these views."""
    masks = {camera: masks_of(rgb) for camera, rgb in views.items()}
    return observation(views), PromptContext(row.instruction, truth=SceneTruth(row, masks))


def begin(how: Oracle, rgb: np.ndarray, row: EpisodeRow = ROW):  # type: ignore[no-untyped-def]
    return revealed(how).start(*looking({"front": rgb}, row))


@pytest.mark.parametrize("reveal", ["box", "mask", "track"])
def test_an_oracle_prompts_the_target_and_says_that_it_is_one(reveal: str) -> None:
    _, attended = begin(Oracle(reveal), LINE)  # type: ignore[arg-type]
    (grounding,) = attended.groundings["front"]
    assert (attended.images["front"] == tint(LINE, where(LINE, TEAL), RED)).all()
    assert attended.text == "bring the red cup"
    assert grounding.candidates.xyxy.tolist() == [
        [24, 20, 36, 32],
        [4, 20, 16, 32],
        [44, 20, 56, 32],
    ]
    assert (grounding.winner, grounding.overruled) == (0, False)
    assert grounding.ballot.votes.tolist() == [2, 0, 0]
    assert (
        attended.events[0].text == f"the simulator's {reveal} of mug is read: a bound, not a result"
    )


def test_the_vote_is_kept_beside_the_truth_that_overrules_it() -> None:
    fooled = OraclePrompter(
        Attender(TOYS, {"mug": personal("mug", "cup", GREY)}), Oracle("mask"), ALIKE
    )
    _, attended = fooled.start(*looking({"front": LINE}))
    (grounding,) = attended.groundings["front"]
    ballot = grounding.ballot
    assert (grounding.winner, grounding.overruled, ballot.winner) == (0, True, 1)
    assert ballot.votes.tolist() == [0, 1, 0]
    assert (attended.images["front"] == tint(LINE, where(LINE, TEAL), RED)).all()
    assert (
        attended.events[1].text
        == "front: takes candidate 0 for mug with 0/1 votes by the simulator, over candidate 1 with 1"
    )


def test_only_the_stage_that_is_told_is_replaced() -> None:
    """A segmenter and a tracker that find half of everything: the true box still suffers from both, the true mask from the tracker."""

    def half(image: np.ndarray, boxes: object) -> np.ndarray:
        return TOYS.segmenter(image, boxes) & (np.arange(64) % 2 == 0)  # type: ignore[arg-type]

    stack = replace(TOYS, segmenter=half)
    shares = {}
    for reveal in ("box", "mask"):
        arm = OraclePrompter(Attender(stack, {"mug": MUG}), Oracle(reveal), ALIKE)
        _, attended = arm.start(*looking({"front": LINE}))
        mask = attended.tracks["front"][0].mask
        assert mask is not None
        shares[reveal] = int(mask.sum())
    assert shares == {"box": 6 * 12, "mask": 12 * 12}
    moved = scene(
        [(4, 20, GREY), (24, 40, (41, 120, 110)), (44, 20, SAND)]
    )  # the tracker of exact colours is lost
    told = SceneTruth(ROW, {"front": {"mug": where(moved, (41, 120, 110))}})
    context = PromptContext(ROW.instruction, truth=told)
    for reveal, seen in (("mask", False), ("track", True)):
        arm = revealed(Oracle(reveal))  # type: ignore[arg-type]
        state, _ = arm.start(*looking({"front": LINE}))
        ((_, after),) = arm.steps([state], [observation({"front": moved})], [context])
        assert (
            after.tracks["front"][0].mask is not None,
            (after.images["front"] != moved).any(),
        ) == (seen, seen)


def test_wrong_mask_is_the_first_look_alike_and_reads_right() -> None:
    _, attended = begin(Oracle("track", of="look-alike"), LINE)
    assert (attended.images["front"] == tint(LINE, where(LINE, GREY), RED)).all()
    assert attended.text == "bring the red cup"
    assert attended.groundings["front"][0].overruled
    assert attended.groundings["front"][0].ballot.winner == 0
    beside = replace(ROW, goal="twin")
    _, attended = begin(Oracle("track", of="look-alike"), LINE, beside)
    assert (attended.images["front"] == tint(LINE, where(LINE, SAND), RED)).all()
    with pytest.raises(
        BadStudy, match="toys.bring.000 places no look-alike of 'mug'; leave wrong-mask out"
    ):
        begin(Oracle("track", of="look-alike"), LINE, replace(ROW, placements=ROW.placements[:2]))


def test_what_is_invisible_passes_unmodified_and_a_true_track_comes_back() -> None:
    hidden = scene([(4, 20, GREY), (44, 20, SAND)])
    arm = revealed(Oracle("track"))
    state, attended = arm.start(*looking({"front": LINE, "side": hidden}))
    assert attended.images["side"] is hidden
    assert (
        attended.groundings["side"][0].winner,
        len(attended.groundings["side"][0].candidates),
    ) == (None, 2)
    seen, context = looking({"front": hidden, "side": LINE})
    ((_, after),) = arm.steps([state], [seen], [context])
    assert after.images["front"] is hidden
    assert (after.images["side"] == tint(LINE, where(LINE, TEAL), RED)).all()
    assert [e.text for e in after.events] == [
        "front: target 0 not visible, the view passes unmodified",
        "side: target 0 re-acquired",
    ]
    _, nothing = begin(Oracle("mask"), scene([]))
    assert nothing.text == "bring my cup"


def test_a_batch_of_oracles_is_each_by_itself() -> None:
    arm = revealed(Oracle("track", of="look-alike"))
    other = replace(ROW, placements=(ROW.placements[0], ROW.placements[3], ROW.placements[2]))
    seen = [looking({"front": LINE}, row) for row in (ROW, other)]
    states = [arm.start(*of_row)[0] for of_row in seen]
    both = arm.steps(states, *zip(*seen, strict=True))
    assert [
        (a.images["front"] == tint(LINE, where(LINE, colour), RED)).all()
        for (_, a), colour in zip(both, (GREY, SAND), strict=True)
    ] == [True] * 2


def test_the_truth_is_about_one_target() -> None:
    two = replace(ROW, instruction="put my cup near my bowl")
    memory = {"mug": MUG, "dish": personal("dish", "bowl", GREY, GREY)}
    arm = OraclePrompter(Attender(TOYS, memory), Oracle("box"), ALIKE)
    with pytest.raises(
        BadInstruction, match="2 targets in 'put my cup near my bowl', but the truth is about one"
    ):
        arm.start(*looking({"front": LINE}, two))


def test_an_object_named_twice_is_one_target_of_the_truth() -> None:
    twice = replace(ROW, instruction="bring my cup, my cup")
    (_, attended), (_, once) = begin(Oracle("box"), LINE, twice), begin(Oracle("box"), LINE)
    assert attended.text == "bring the red cup, the red cup"
    assert (attended.images["front"] == once.images["front"]).all()


@pytest.mark.parametrize(
    ("length", "text"),
    [
        ("short", "bring my cup. My cup is teal."),
        ("long", "bring my cup. My cup is a teal cup, plain."),
    ],
)
def test_a_hard_prompt_appends_words_and_leaves_pictures(length: str, text: str) -> None:
    told = hard_prompt(
        replace(MUG, description=Description("teal", "a teal cup, plain")),
        HardPrompt(length),  # type: ignore[arg-type]
    )
    views = {"front": LINE}
    context = PromptContext("bring my cup")
    state, attended = told.start(observation(views), context)
    assert attended.text == text
    assert attended.images is views
    assert (attended.groundings, attended.tracks, attended.colours) == ({}, {}, ())
    moved = {"front": scene([(8, 8, TEAL)])}
    both = told.steps([state] * 2, [observation(views), observation(moved)], [context] * 2)
    assert [(a.text, a.images) for _, a in both] == [(text, views), (text, moved)]
    with pytest.raises(
        BadMemory, match="'mug' has no description; register it again with --replace"
    ):
        hard_prompt(MUG, HardPrompt("short"))


SUITE, TASK = "simpler-bridge", "put-camera"
PLAIN = tuple(name for name, how in METHODS.items() if not isinstance(how, SoftPrompt))
"""All but the soft prompt, which takes a policy of its own words; its own tests hold it to the same."""
STUDY = Study(((SUITE, TASK),), PLAIN, episodes=2)
ROWS = tuple(replace(row, max_steps=2) for row in STUDY.rows(SUITE, TASK))


@pytest.fixture(scope="module")
def bank(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Registered before descriptions were wanted, and again when they were."""
    folder = tmp_path_factory.mktemp("memory")
    register_personal(replace(STUDY, methods=("vap",)), folder)
    (plain,) = load_bank(folder).values()
    assert plain.description is None
    register_personal(STUDY, folder)
    (obj,) = load_bank(folder).values()
    assert obj.description is not None
    assert (obj.embeddings == plain.embeddings).all()
    return folder


def test_a_methods_photos_do_not_depend_on_what_else_is_run(bank: Path, tmp_path: Path) -> None:
    (five,) = load_bank(bank).values()
    register_personal(replace(STUDY, methods=("vap",)), tmp_path)
    register_personal(replace(STUDY, methods=("vap", "references-7", "hard-short")), tmp_path)
    (seven,) = load_bank(tmp_path).values()
    assert len(seven.crops) == 7
    first = seven.first(5)
    assert all(map(np.array_equal, first.crops, five.crops))
    assert (first.embeddings == five.embeddings).all()
    assert str(seven.description) == str(five.description)


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """pi0's real classes, tiny, with random weights."""
    with toy_sizes(tiny.TOY):
        yield tiny.pi0(tmp_path_factory.mktemp("pi0") / "toy")


@pytest.fixture(scope="module")
def runs(bank: Path, checkpoint: Path) -> tuple[dict[str, list[Episode]], dict[str, str]]:
    """Two episodes of two steps by every method with one tiny random pi0, and its checksum before and after each."""
    study, episodes, sums = replace(STUDY, policy=str(checkpoint)), {}, {}
    for method in PLAIN:
        trial = make_trial(study, ROWS, method, bank)
        sums[f"before {method}"] = checksum(trial.policy)
        episodes[method] = list(rollout(trial, ROWS, batch=2, keep_images=True))
        sums[f"after {method}"] = checksum(trial.policy)
    return episodes, sums


def test_no_parameter_changes_while_any_method_runs(
    runs: tuple[dict[str, list[Episode]], dict[str, str]], checkpoint: Path, bank: Path
) -> None:
    episodes, sums = runs
    assert set(episodes) == set(PLAIN)
    assert {e.outcome.status for of in episodes.values() for e in of} == {"failure"}, [
        e.outcome.detail for of in episodes.values() for e in of
    ]
    assert len(set(sums.values())) == 1
    policy = make_trial(replace(STUDY, policy=str(checkpoint)), ROWS, "generic", bank).policy
    assert sums["before generic"] == policy.sha256()[:16]  # type: ignore[union-attr]


def test_what_each_method_changes(runs: tuple[dict[str, list[Episode]], dict[str, str]]) -> None:
    """Pictures, words, both or nothing; and only the arms that read the simulator say so."""
    episodes, _ = runs
    changed = {}
    for method, (one, _) in episodes.items():
        first = one.frames[0]
        pictures = any((first.prompted[c] != first.images[c]).any() for c in first.images)
        reads = any("a bound, not a result" in event.text for event in first.events)
        changed[method] = (pictures, one.header.rewritten != one.header.instruction, reads)
    both, told = (True, True, False), (True, True, True)
    assert changed == {
        "generic": (False, False, False), "hard-short": (False, True, False), "hard-long": (False, True, False), "vap": both,
        "vap-always-tint": both,
        "mask-only": (True, False, False), "rewrite-only": (False, True, False), "vap-associated": both, "oracle-box": told, "oracle-mask": told,
        "oracle-track": told, "wrong-mask": told,
    }  # fmt: skip
    assert episodes["hard-short"][0].header.rewritten.startswith(
        "put my camera on the plate. My camera is "
    )


def test_oracles_mark_the_true_pixels_and_the_wrong_one_a_look_alike(
    bank: Path, checkpoint: Path
) -> None:
    """Against masks rendered for a recording, at every step, in a batch."""
    for method, place in (("oracle-track", 0), ("wrong-mask", 2)):
        trial = make_trial(replace(STUDY, policy=str(checkpoint)), ROWS, method, bank)
        kept: list[Kept] = []

        def keep(opening: EpisodeHeader, into: list[Kept] = kept) -> Kept:
            into.append(Kept())
            return into[-1]

        list(rollout(trial, ROWS, keep, batch=2))
        assert [len(one.frames) for one in kept] == [3, 3]
        for row, one in zip(ROWS, kept, strict=True):
            assert row.placements[place].model.startswith(
                "camera-personal" if place == 0 else "camera-lookalike"
            )
            for frame in one.frames:
                mask = frame.tracks["front"][0].mask
                assert mask is not None
                assert (mask == frame.truth.masks["front"][row.placements[place].model]).all()


def test_truth_reaches_nobody_but_an_oracle(
    bank: Path, checkpoint: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without a sink, no other method has the true masks rendered before its policy is asked; what highlights is judged by them afterwards."""
    from vap_core.simulation.env import Env

    asked: list[tuple[str, bool]] = []
    truth = Env.truth
    monkeypatch.setattr(
        Env,
        "truth",
        lambda self, masks=False: (
            asked.append((sys._getframe(1).f_code.co_name, masks)) or truth(self, masks)
        ),
    )
    before: dict[str, int] = {}
    after: dict[str, int] = {}
    for method in PLAIN:
        asked.clear()
        list(
            rollout(
                make_trial(replace(STUDY, policy=str(checkpoint)), ROWS[:1], method, bank), ROWS[:1]
            )
        )
        before[method] = sum(masks for caller, masks in asked if caller != "_act")
        after[method] = sum(masks for caller, masks in asked if caller == "_act")
    oracles = {"oracle-box": 1, "oracle-mask": 1, "oracle-track": 3, "wrong-mask": 3}
    assert {m: n for m, n in before.items() if n} == oracles
    assert {m: n for m, n in after.items() if n} == dict.fromkeys(
        (*oracles, "vap", "vap-always-tint", "mask-only", "vap-associated"), 3
    )
    assert not {"truth", "masks", "row"} & set(inspect.signature(Attender.start).parameters)
    assert not {"truth", "masks", "row"} & set(inspect.signature(TextPrompter.start).parameters)
    assert TextPrompter.needs_truth == TintPrompter.needs_truth == "never"


def test_what_is_judged_afterwards_changes_nothing(
    bank: Path, checkpoint: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def actions() -> np.ndarray:
        (episode,) = rollout(
            make_trial(replace(STUDY, policy=str(checkpoint)), ROWS[:1], "vap", bank), ROWS[:1]
        )
        return np.stack([frame.action for frame in episode.frames[:-1]])

    judged = actions()
    monkeypatch.setattr("vap_core.rollout.loop.mask_coverage", lambda *args, **kwargs: ())
    assert (actions() == judged).all()


class Soft:
    """A policy whose parameters are one tensor; it can be told to train on what it sees."""

    label, execute = "soft", 1

    def __init__(self, learns: bool) -> None:
        self.weight, self.learns = torch.zeros(3), learns

    def sha256(self) -> str:
        import hashlib

        return hashlib.sha256(self.weight.numpy().tobytes()).hexdigest()

    def start(self, rng: np.random.Generator) -> None:
        return None

    def plan(
        self, states: Sequence[None], inputs: Sequence[PolicyInput]
    ) -> tuple[list[None], list[np.ndarray]]:
        self.weight += self.learns
        return list(states), [np.zeros((1, 7), np.float32) for _ in inputs]


def test_the_checksum_is_in_every_row_and_a_policy_that_changes_is_refused(
    bank: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    study = replace(STUDY, methods=("generic", "oracle-mask"), episodes=1)
    soft = Soft(learns=False)
    monkeypatch.setattr(trials, "make_policy", lambda name, scene, suite, stack: soft)
    out = open_run(tmp_path / "run", {})
    (tmp_path / "run" / "memory").symlink_to(bank)

    def job(method: str) -> engine.Job:
        return engine.Job(study, method, ROWS[:1], ("key",), 1, out, "none")

    ((plain,), (bound,)) = run_job(job("generic")), run_job(job("oracle-mask"))
    assert plain["policy_sha256"] == bound["policy_sha256"] == soft.sha256()[:16]
    assert (plain["bound"], bound["bound"]) == (False, True)
    soft.learns = True
    with pytest.raises(
        BadPolicy,
        match=r"the parameters of soft changed while episodes ran \(\w{16} before, \w{16} now\); these are no results",
    ):
        run_job(job("generic"))
    soft.learns = False
    with pytest.raises(BadPolicy, match="the parameters of soft changed"):
        run_job(
            job("generic")
        )  # changed between jobs: still not the policy that the first rows were made with
    soft.weight.zero_()
    assert run_job(job("generic"))[0]["policy_sha256"] == plain["policy_sha256"]


def test_what_has_no_parameters_has_no_checksum() -> None:
    with unchanged_weights(object()) as found:
        assert found == ""
    assert checksum(Soft(False)) == Soft(False).sha256()[:16]


def test_rows_from_before_there_were_checksums_stay_readable(tmp_path: Path) -> None:
    from vap_core.study.store import append, read

    run = open_run(tmp_path / "run", {})
    about = {"suite": "s", "task": "t", "method": "m", "seed": 0, "attempt": 1}
    append(run, [{**about, "episode": 0}])
    append(run, [{**about, "episode": 1, "policy_sha256": "ab", "bound": False}])
    assert pd.isna(read(run).policy_sha256).tolist() == [True, False]
