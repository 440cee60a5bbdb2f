"""Where the time goes, measured in one run: shares of a control step, and each cost in units of one backbone pass."""

import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from vap_core.base.tables import align
from vap_core.evaluation.study import DEMO, make_trial, register_personal
from vap_core.perception.embedded.backbone import features
from vap_core.recording import DeferredRecorder
from vap_core.rollout.loop import Trial, rollout
from vap_core.rollout.prompters.tint import TintPrompter
from vap_core.rollout.types import Episode
from vap_core.simulation.env import Env
from vap_core.simulation.types import EpisodeRow

REPEAT, PLAYS = 15, 5


@dataclass(frozen=True)
class Limit:
    """One measured figure beside its budget."""

    what: str
    measured: float
    budget: float
    unit: str
    ratio: str

    def row(self) -> list[str]:
        verdict = "ok" if self.measured <= self.budget else "OVER"
        return [
            self.what,
            f"{self.measured:.3g} {self.unit}",
            f"<= {self.budget:g} {self.unit}",
            verdict,
            self.ratio,
        ]


def run(steps: int = 60) -> str:
    """Measure everything and say it; takes about a minute."""
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        trial, row = demo_trial(folder, steps)
        unit = _pass_ms(trial)
        recorded = _record(trial, row, folder)
        limits = [*_attend_limits(trial, row, unit), *_record_limits(recorded), _import_limit(unit)]
    steps_run, views = recorded.episode.outcome.steps, len(trial.scene.cameras)
    return "\n".join(
        [
            f"{row.suite}/{row.task}, {views} cameras, {steps_run} steps, one thread; one backbone pass takes {unit:.1f} ms",
            "",
            align([["part of a control step", "ms", "share"], *_shares(recorded.episode)]),
            "",
            beside_budgets(limits),
        ]
    )


def demo_trial(folder: Path, steps: int) -> tuple[Trial, EpisodeRow]:
    """The demo's last task under VAP, its object remembered in `folder`, and an episode of so many steps at most."""
    register_personal(DEMO, folder / "memory")
    rows = DEMO.rows(*DEMO.tasks[-1])
    return make_trial(DEMO, rows, "vap", folder / "memory"), replace(rows[0], max_steps=steps)


def beside_budgets(limits: Sequence[Limit]) -> str:
    """A line per figure."""
    return align([["what", "measured", "budget", "", "ratio"], *(limit.row() for limit in limits)])


def _pass_ms(trial: Trial) -> float:
    env = Env(trial.scene)
    rgb = next(iter(env.observe().images.values()))
    return median_ms(lambda: features([rgb], ["head"]))


def _attend_limits(trial: Trial, row: EpisodeRow, unit: float) -> list[Limit]:
    assert isinstance(trial.prompter, TintPrompter)
    attender, camera = (
        trial.prompter.attender,
        trial.scene.cameras[-1],
    )  # on the wrist: it moves, and what stays as it was costs nothing
    frames = next(rollout(trial, [replace(row, max_steps=REPEAT + 1)], keep_images=True)).frames
    films = iter([{camera: frame.images[camera]} for frame in frames])
    views = next(films)
    start = median_ms(lambda: attender.start(views, row.instruction))
    state, _ = attender.start(views, row.instruction)

    def step() -> None:
        nonlocal state
        state, _ = attender.step(state, next(films))

    track = median_ms(step)
    return [
        Limit(
            "attend step (track + prompt), the wrist's view",
            track,
            60,
            "ms",
            f"{track / unit:.2f} backbone passes",
        ),
        Limit(
            "start-up grounding, one view", start, 350, "ms", f"{start / unit:.2f} backbone passes"
        ),
    ]


@dataclass(frozen=True)
class Recorded:
    """What it takes to keep the steps of a rollout as is done by default where the episode fails: CPU of the whole process, rerun's threads too, in
    percent of the rollout's, once per repeat; and the file's megabytes as JPEGs and as AV1."""

    episode: Episode
    over: tuple[float, ...]
    jpeg_mb: float
    video_mb: float


def _record(trial: Trial, row: EpisodeRow, folder: Path) -> Recorded:
    def keep(episode: Episode, name: str, video: bool = False) -> float:
        start = time.process_time()
        sink = DeferredRecorder(
            folder / f"{name}.rrd", episode.header, lambda outcome: True, video=video
        )
        for frame in episode.frames:
            sink.frame(frame)
        sink.close(episode.outcome)
        return time.process_time() - start

    def played() -> tuple[float, Episode]:
        start = time.process_time()
        episode = next(rollout(trial, [row], keep_images=True))
        return time.process_time() - start, episode

    first = played()[1]
    keep(first, "warm")  # rerun's first call imports pandas
    over = []
    for i in range(PLAYS):
        cpu_s, episode = played()
        over.append(100 * keep(episode, str(i)) / cpu_s)
    keep(first, "video", video=True)
    jpeg_mb, video_mb = ((folder / f"{name}.rrd").stat().st_size / 1e6 for name in ("0", "video"))
    return Recorded(first, tuple(over), jpeg_mb, video_mb)


def _record_limits(recorded: Recorded) -> list[Limit]:
    steps, over = max(recorded.episode.outcome.steps, 1), sorted(recorded.over)
    told = f"{over[0]:.1f} to {over[-1]:.1f} % in {len(over)} repeats"
    return [
        Limit("recording, over the CPU of the rollout", float(np.median(over)), 8, "%", told),
        Limit(
            "60 steps of 3 cameras, as JPEGs",
            recorded.jpeg_mb * 60 / steps,
            4,
            "MB",
            f"{recorded.jpeg_mb:.2f} MB for {steps} steps",
        ),
        Limit(
            "60 steps of 3 cameras, as AV1",
            recorded.video_mb * 60 / steps,
            2,
            "MB",
            f"{recorded.video_mb:.2f} MB for {steps} steps",
        ),
    ]


def _import_limit(unit: float) -> Limit:
    code = "import time; t = time.perf_counter(); import vap_core; print(time.perf_counter() - t)"
    took = [
        float(
            subprocess.run(
                [sys.executable, "-c", code], capture_output=True, text=True, check=True
            ).stdout
        )
        for _ in range(3)
    ]
    return Limit(
        "import vap_core",
        1e3 * min(took),
        300,
        "ms",
        f"{1e3 * min(took) / unit:.2f} backbone passes",
    )


def _shares(episode: Episode) -> list[list[str]]:
    total, steps = sum(episode.seconds.values()), max(episode.outcome.steps, 1)
    ranked = sorted(episode.seconds.items(), key=lambda item: -item[1])
    return [
        [part, f"{1e3 * seconds / steps:.1f}", f"{100 * seconds / total:.0f} %"]
        for part, seconds in ranked
        if 1e3 * seconds >= 0.05 * steps
    ]


def median_ms(work: Callable[[], object]) -> float:
    """Of REPEAT times, after a first one that does not count."""
    work()
    took = []
    for _ in range(REPEAT):
        start = time.perf_counter()
        work()
        took.append(time.perf_counter() - start)
    return 1e3 * float(np.median(took))
