"""The main job from end to end: killed, resumed, and read back; the closed loop's determinism."""

import json
import os
import random
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.command import vap
from vap_core.attend import Attender
from vap_core.base.errors import BadOutput, UnknownName
from vap_core.policies.protocol import PolicyInput
from vap_core.prompt import PALETTE
from vap_core.recording import Recorder, read_summary, recording_name
from vap_core.rollout.loop import rollout
from vap_core.rollout.prompters import TintPrompter
from vap_core.rollout.types import Episode
from vap_core.study.store import locked, open_run, read
from vap_core.study.trials import DEMO, Study, make_trial, register_personal

ENV = {**os.environ, "OMP_NUM_THREADS": "1"}


def command(out: Path, episodes: int) -> list[str]:
    return ["demo", "--out", str(out), "--episodes", str(episodes), "--workers", "2"]


@pytest.mark.slow
def test_it_ends_with_the_whole_table_and_goes_on_from_it(tmp_path: Path) -> None:
    """That a killed run goes on is proven in test_engine."""
    out = tmp_path / "demo"
    done = vap(*command(out, 1))
    assert done.returncode == 0, done.stderr
    _complete(out, done.stdout)
    again = vap(*command(out, 1))
    assert again.stdout == done.stdout
    other = vap(*command(out, 2))
    assert other.returncode == 2
    assert "holds another run" in other.stderr


def _complete(out: Path, printed: str) -> None:
    lines = json.loads((out / "summary.json").read_text())
    assert [(s["suite"], s["method"], s["n"]) for s in lines] == [
        (suite, m, 1) for suite, _ in DEMO.tasks for m in ("generic", "vap")
    ]
    assert all(
        {"task", "sr", "cmr", "wrong_object", "intervals", "errors"} <= s.keys() for s in lines
    )
    assert all(s["errors"] == 0 for s in lines)
    assert "CMR % [95 %]" in printed
    assert "scripted" in printed
    assert (out / "figure.png").stat().st_size > 10_000
    recordings = sorted((out / "recordings").glob("*.rrd"))
    assert len(recordings) == 4
    for recording in recordings[:1]:
        done = subprocess.run(
            [sys.executable, "-m", "rerun", "rrd", "verify", str(recording)],
            capture_output=True,
            text=True,
        )
        assert done.returncode == 0, done.stdout + done.stderr
    told = {
        (r["suite"], r["episode"], r["method"]): r["success"] for r in read(out).to_dict("records")
    }
    for recording in recordings:
        said = read_summary(recording)
        assert said["success"] == told[said["suite"], said["episode"], said["method"]]


@pytest.fixture(scope="module")
def bank(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("memory")
    register_personal(DEMO, folder)
    return folder


STUDY = replace(DEMO, episodes=3)
SUITE, TASK = DEMO.tasks[0]


def same(one: Episode, other: Episode) -> None:
    assert one.outcome.steps == other.outcome.steps
    assert (
        one.summary().items()
        >= {k: v for k, v in other.summary().items() if not k.startswith("seconds")}.items()
    )
    for a, b in zip(one.frames, other.frames, strict=True):
        assert np.array_equal(a.action, b.action)
        assert (a.state == b.state).all()


def test_neither_batch_nor_order_nor_global_seeds_change_an_episode(bank: Path) -> None:
    trial = make_trial(STUDY, STUDY.rows(SUITE, TASK), "vap", bank)
    rows = [replace(row, max_steps=5) for row in STUDY.rows(SUITE, TASK)]
    together = list(rollout(trial, rows, batch=3))
    np.random.seed(123)  # noqa: NPY002
    torch.manual_seed(123)
    random.seed(123)
    alone = list(rollout(trial, rows, batch=1))
    backwards = list(rollout(trial, rows[::-1], batch=2))[::-1]
    for one, other, third in zip(together, alone, backwards, strict=True):
        same(one, other)
        same(one, third)


def test_the_rows_of_its_job_do_not_change_an_episode(tmp_path: Path) -> None:
    study = Study((("simpler-bridge", "put-straw-cup"),), ("generic",), policy="random")
    rows = study.rows(*study.tasks[0])
    row = replace(rows[14], max_steps=3)
    trials = [make_trial(study, [row, *beside], "generic", tmp_path) for beside in ([], [rows[2]])]
    alone, together = (next(iter(rollout(trial, [row]))) for trial in trials)
    same(alone, together)
    for one, other in zip(alone.frames, together.frames, strict=True):
        assert one.truth.objects_world.keys() == {place.model for place in row.placements}
        for name, pose in one.truth.objects_world.items():
            assert np.array_equal(pose, other.truth.objects_world[name])


def test_the_prompt_reaches_the_policy_and_only_the_prompt(bank: Path) -> None:
    seen: list[PolicyInput] = []
    trial = make_trial(STUDY, STUDY.rows(SUITE, TASK), "vap", bank)

    class Witness:
        label, execute = trial.policy.label, trial.policy.execute
        start = trial.policy.start

        def plan(self, states, inputs):  # type: ignore[no-untyped-def]
            seen.extend(inputs)
            return trial.policy.plan(states, inputs)

    row = replace(STUDY.rows(SUITE, TASK)[0], max_steps=2)
    (episode,) = rollout(replace(trial, policy=Witness()), [row], keep_images=True)
    frame = episode.frames[0]
    (word,) = {c.name for c in PALETTE} & set(seen[0].text.split())
    assert seen[0].text == episode.header.rewritten == f"pick up the {word} {row.category}"
    assert np.array_equal(seen[0].images["front"], frame.prompted["front"])
    assert np.shares_memory(seen[0].images["front"], frame.prompted["front"])
    changed = (frame.images["front"] != frame.prompted["front"]).any(axis=2)
    assert changed.any()
    assert (changed <= frame.tracks["front"][0].mask).all()


def test_generic_sees_raw_images_and_raw_words(bank: Path) -> None:
    trial = make_trial(STUDY, STUDY.rows(SUITE, TASK), "generic", bank)
    (episode,) = rollout(
        trial, [replace(STUDY.rows(SUITE, TASK)[0], max_steps=2)], keep_images=True
    )
    assert episode.header.rewritten == episode.header.instruction
    assert all((f.images["front"] == f.prompted["front"]).all() for f in episode.frames)
    assert [frame.action is None for frame in episode.frames] == [False, False, True], (
        "nothing is executed at the terminal frame"
    )


def test_an_episode_that_breaks_is_an_error_with_its_traceback_and_its_recording(
    bank: Path, tmp_path: Path
) -> None:
    trial = make_trial(STUDY, STUDY.rows(SUITE, TASK), "generic", bank)

    class Breaks:
        label, execute = "scripted", trial.policy.execute
        start = trial.policy.start
        asked = 0

        def plan(self, states, inputs):  # type: ignore[no-untyped-def]
            self.asked += 1
            if self.asked == 3:
                raise RuntimeError("the policy fell over")
            return trial.policy.plan(states, inputs)

    rows = STUDY.rows(SUITE, TASK)[:1]
    path = tmp_path / recording_name(rows[0], "generic")
    (episode,) = rollout(
        replace(trial, policy=Breaks()), rows, lambda opening: Recorder(path, opening)
    )
    assert (episode.outcome.status, episode.outcome.success) == ("error", False)
    assert "the policy fell over" in episode.outcome.detail
    assert len(episode.frames) == 4
    assert read_summary(path)["frames"] == 4


def test_a_policy_that_chokes_on_one_episode_spares_the_others(bank: Path) -> None:
    trial = make_trial(STUDY, STUDY.rows(SUITE, TASK), "generic", bank)
    rows = [replace(row, max_steps=4) for row in STUDY.rows(SUITE, TASK)]
    bad = replace(rows[1], instruction="poison")

    class Chokes:
        label, execute = "scripted", trial.policy.execute
        start = trial.policy.start

        def plan(self, states, inputs):  # type: ignore[no-untyped-def]
            if any(seen.text == "poison" for seen in inputs):
                raise RuntimeError("cannot read this")
            return trial.policy.plan(states, inputs)

    episodes = list(rollout(replace(trial, policy=Chokes()), [rows[0], bad, rows[2]], batch=3))
    assert [e.outcome.status for e in episodes] == ["failure", "error", "failure"]
    assert [e.outcome.steps for e in episodes] == [4, 0, 4]


def test_an_error_before_the_first_step_keeps_its_method_and_its_place(bank: Path) -> None:
    trial = make_trial(STUDY, STUDY.rows(SUITE, TASK), "vap", bank)

    assert isinstance(trial.prompter, TintPrompter)
    attender = trial.prompter.attender

    class Blind(Attender):
        def start(self, views, instruction, **options):  # type: ignore[no-untyped-def]
            raise RuntimeError("the detector fell over")

    blind = TintPrompter(Blind(attender.stack, attender.memory))

    rows = STUDY.rows(SUITE, TASK)[:2]
    episodes = list(rollout(replace(trial, prompter=blind), rows))
    assert [(e.outcome.status, e.summary()["method"], e.summary()["policy"]) for e in episodes] == [
        ("error", "vap", "scripted")
    ] * 2
    assert "the detector fell over" in episodes[0].outcome.detail


def test_a_run_in_use_is_left_alone(tmp_path: Path) -> None:
    run = open_run(tmp_path / "run", {})
    with locked(run), pytest.raises(BadOutput, match="another process is working"), locked(run):
        pass


@pytest.mark.sweep
def test_a_dead_worker_is_said_and_what_was_done_stays(tmp_path: Path) -> None:
    out = tmp_path / "demo"
    code = (
        "import os, vap_core.study.engine as e, vap_core.study.trials as x\n"
        "from dataclasses import replace; from pathlib import Path\n"
        "def work(job): os.kill(os.getpid(), 9)\n"
        "e.run_job = work\n"
        f"\nif __name__ == '__main__': e.run(replace(x.DEMO, episodes=1), Path({str(out)!r}), progress=False)\n"
    )
    (tmp_path / "die.py").write_text(code)
    done = subprocess.run(
        [sys.executable, str(tmp_path / "die.py")],
        env=ENV,
        capture_output=True,
        text=True,
        timeout=200,
    )
    assert "WorkerDied: a worker process died" in done.stderr.strip().splitlines()[-1]
    assert (out / "run.json").exists()


def test_study_refuses_unknown_names() -> None:
    with pytest.raises(
        UnknownName,
        match="known: franka-pick, libero-personal, libero-personal-dev, shared-pair, shared-sequence, shared-sequence-bridge, simpler-bridge, simpler-fractal, tabletop, vlabench, widowx-pick",
    ):
        Study((("nowhere", "pick-cup"),), ("vap",))
