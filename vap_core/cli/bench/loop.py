"""What each part of a control step costs, measured in one run.

Shares of a control step, and each cost in units of one backbone pass.
"""

import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from vap_core.base.tables import align
from vap_core.cli.bench.timing import median_seconds, seconds_of
from vap_core.evaluation.study import DEMO
from vap_core.evaluation.trials import make_trial, register_personal
from vap_core.recording import DeferredRecorder
from vap_core.rollout.loop import Trial, rollout
from vap_core.rollout.prompters.tint import TintPrompter
from vap_core.rollout.types import Episode
from vap_core.simulation.env import Env
from vap_core.simulation.types import EpisodeRow

REPEAT = 15
RECORDINGS = 5
"""Rollouts that are timed and then recorded."""


@dataclass(frozen=True)
class Limit:
    """One measured figure beside its budget."""

    what: str
    measured: float
    budget: float
    unit: str
    ratio: str

    def row(self) -> list[str]:
        """The cells of a table."""
        verdict = "ok" if self.measured <= self.budget else "OVER"
        return [
            self.what,
            f"{self.measured:.3g} {self.unit}",
            f"<= {self.budget:g} {self.unit}",
            verdict,
            self.ratio,
        ]


@dataclass(frozen=True)
class RecordingCost:
    """What it takes to keep the steps of a rollout, as is done by default for failures.

    `over` is CPU of the whole process, rerun's threads too, in percent of the rollout's, once per
    repeat; the file's megabytes are with JPEGs and with AV1.
    """

    episode: Episode
    over: tuple[float, ...]
    jpeg_mb: float
    video_mb: float


def run(steps: int = 60) -> str:
    """Measure everything and report it; takes about a minute."""
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        trial, row = demo_trial(folder, steps)
        unit = _pass_ms(trial)
        cost = _recording_cost(trial, row, folder)
        limits = _attend_limits(trial, row, unit)
        limits += _record_limits(cost)
        limits.append(_import_limit(unit))
    n_steps = cost.episode.outcome.steps
    n_cameras = len(trial.scene.cameras)
    title = (
        f"{row.suite}/{row.task}, {n_cameras} cameras, {n_steps} steps, one thread; "
        f"one backbone pass takes {unit:.1f} ms"
    )
    shares = align([["part of a control step", "ms", "share"], *_shares(cost.episode)])
    return "\n".join([title, "", shares, "", beside_budgets(limits)])


def demo_trial(folder: Path, steps: int) -> tuple[Trial, EpisodeRow]:
    """The demo's last task under VAP, and an episode of so many steps at most.

    Its object is remembered in `folder`.
    """
    register_personal(DEMO, folder / "memory")
    suite, task = DEMO.tasks[-1]
    rows = DEMO.rows(suite, task)
    trial = make_trial(DEMO, rows, "vap", folder / "memory")
    return trial, replace(rows[0], max_steps=steps)


def beside_budgets(limits: Sequence[Limit]) -> str:
    """A line per figure."""
    rows = [["what", "measured", "budget", "", "ratio"]]
    for limit in limits:
        rows.append(limit.row())
    return align(rows)


def median_ms(work: Callable[[], object]) -> float:
    """Of REPEAT times, after a first one that does not count."""
    return 1e3 * median_seconds(work, REPEAT)


def _pass_ms(trial: Trial) -> float:
    """A pass of the backbone."""
    from vap_core.perception.embedded.backbone import features

    env = Env(trial.scene)
    rgb = next(iter(env.observe().images.values()))
    return median_ms(lambda: features([rgb], ["head"]))


def _attend_limits(trial: Trial, row: EpisodeRow, unit: float) -> list[Limit]:
    assert isinstance(trial.prompter, TintPrompter)
    attender = trial.prompter.attender
    # The camera on the wrist moves; what stays as it was costs nothing.
    camera = trial.scene.cameras[-1]
    longer = replace(row, max_steps=REPEAT + 1)
    episode = next(rollout(trial, [longer], keep_images=True))
    views = iter([{camera: frame.images[camera]} for frame in episode.frames])
    first = next(views)
    start_ms = median_ms(lambda: attender.start(first, row.instruction))
    state, _ = attender.start(first, row.instruction)

    def step() -> None:
        nonlocal state
        state, _ = attender.step(state, next(views))

    step_ms = median_ms(step)
    return [
        Limit(
            what="attend step (track + prompt), the wrist's view",
            measured=step_ms,
            budget=60.0,
            unit="ms",
            ratio=f"{step_ms / unit:.2f} backbone passes",
        ),
        Limit(
            what="start-up grounding, one view",
            measured=start_ms,
            budget=350.0,
            unit="ms",
            ratio=f"{start_ms / unit:.2f} backbone passes",
        ),
    ]


def _recording_cost(trial: Trial, row: EpisodeRow, folder: Path) -> RecordingCost:
    _, first = _timed_rollout(trial, row)
    # rerun's first call imports pandas.
    _record_seconds(first, folder / "warm.rrd")
    over = []
    for i in range(RECORDINGS):
        rollout_s, episode = _timed_rollout(trial, row)
        record_s = _record_seconds(episode, folder / f"{i}.rrd")
        over.append(100 * record_s / rollout_s)
    _record_seconds(first, folder / "video.rrd", video=True)
    return RecordingCost(
        episode=first,
        over=tuple(over),
        jpeg_mb=(folder / "0.rrd").stat().st_size / 1e6,
        video_mb=(folder / "video.rrd").stat().st_size / 1e6,
    )


def _timed_rollout(trial: Trial, row: EpisodeRow) -> tuple[float, Episode]:
    """CPU seconds of an episode, and the episode."""
    start = time.process_time()
    episode = next(rollout(trial, [row], keep_images=True))
    return time.process_time() - start, episode


def _record_seconds(episode: Episode, path: Path, video: bool = False) -> float:
    """CPU seconds of recording an episode."""

    def record() -> None:
        sink = DeferredRecorder(path, episode.header, lambda outcome: True, video=video)
        for frame in episode.frames:
            sink.frame(frame)
        sink.close(episode.outcome)

    return seconds_of(record, time.process_time)


def _record_limits(cost: RecordingCost) -> list[Limit]:
    n_steps = max(cost.episode.outcome.steps, 1)
    over = sorted(cost.over)
    return [
        Limit(
            what="recording, over the CPU of the rollout",
            measured=float(np.median(over)),
            budget=8.0,
            unit="%",
            ratio=f"{over[0]:.1f} to {over[-1]:.1f} % in {len(over)} repeats",
        ),
        Limit(
            what="60 steps of 3 cameras, as JPEGs",
            measured=cost.jpeg_mb * 60 / n_steps,
            budget=4.0,
            unit="MB",
            ratio=f"{cost.jpeg_mb:.2f} MB for {n_steps} steps",
        ),
        Limit(
            what="60 steps of 3 cameras, as AV1",
            measured=cost.video_mb * 60 / n_steps,
            budget=2.0,
            unit="MB",
            ratio=f"{cost.video_mb:.2f} MB for {n_steps} steps",
        ),
    ]


def _import_limit(unit: float) -> Limit:
    code = "import time; t = time.perf_counter(); import vap_core; print(time.perf_counter() - t)"
    seconds = []
    for _ in range(3):
        done = subprocess.run(
            [sys.executable, "-c", code], capture_output=True, text=True, check=True
        )
        seconds.append(float(done.stdout))
    fastest_ms = 1e3 * min(seconds)
    return Limit(
        what="import vap_core",
        measured=fastest_ms,
        budget=300.0,
        unit="ms",
        ratio=f"{fastest_ms / unit:.2f} backbone passes",
    )


def _shares(episode: Episode) -> list[list[str]]:
    """Milliseconds and share of every part of a step, the largest first."""
    total = sum(episode.seconds.values())
    n_steps = max(episode.outcome.steps, 1)
    rows = []
    for part, seconds in sorted(episode.seconds.items(), key=lambda item: -item[1]):
        ms = 1e3 * seconds / n_steps
        if 1e3 * seconds >= 0.05 * n_steps:
            rows.append([part, f"{ms:.1f}", f"{100 * seconds / total:.0f} %"])
    return rows
