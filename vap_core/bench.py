"""Where the time goes, measured in one run: shares of a control step, and each cost in units of one backbone pass."""

import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from vap_core.attend import Attender
from vap_core.experiments import DEMO, make_trial, register_personal
from vap_core.features import features
from vap_core.record import Recorder
from vap_core.report import align
from vap_core.rollout import Trial, rollout
from vap_core.sim.env import Env
from vap_core.values import Episode, EpisodeRow, Opening

REPEAT = 15


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
        return [self.what, f"{self.measured:.3g} {self.unit}", f"<= {self.budget:g} {self.unit}", verdict, self.ratio]


def run(steps: int = 60) -> str:
    """Measure everything and say it; takes about a minute."""
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        bank = folder / "memory"
        register_personal(DEMO, bank)
        suite, task = DEMO.tasks[-1]
        rows = DEMO.rows(suite, task)
        trial, row = make_trial(DEMO, rows, "vap", bank), replace(rows[0], max_steps=steps)
        unit = _pass_ms(trial)
        recorded = _record(trial, row, folder / "bench.rrd")
        limits = [*_attend_limits(trial, row, unit), *_record_limits(recorded), _import_limit(unit)]
    head = ["what", "measured", "budget", "", "ratio"]
    steps_run, views = recorded.episode.outcome.steps, len(trial.scene.cameras)
    return "\n".join(
        [
            f"{suite}/{task}, {views} cameras, {steps_run} steps, one thread; one backbone pass takes {unit:.1f} ms",
            "",
            align([["part of a control step", "ms", "share"], *_shares(recorded.episode)]),
            "",
            align([head, *(limit.row() for limit in limits)]),
        ]
    )


def _pass_ms(trial: Trial) -> float:
    env = Env(trial.scene)
    rgb = next(iter(env.observe().images.values()))
    return _median_ms(lambda: features([rgb], ["head"]))


def _attend_limits(trial: Trial, row: EpisodeRow, unit: float) -> list[Limit]:
    assert isinstance(trial.attender, Attender)
    attender, env = trial.attender, Env(trial.scene)
    env.reset(row)
    views = {trial.scene.cameras[0]: env.observe().images[trial.scene.cameras[0]]}
    start = _median_ms(lambda: attender.start(views, row.instruction))
    state, _ = attender.start(views, row.instruction)

    def step() -> None:
        nonlocal state
        state, _ = attender.step(state, views)

    track = _median_ms(step)
    return [
        Limit("attend step (track + prompt), one view", track, 60, "ms", f"{track / unit:.2f} backbone passes"),
        Limit("start-up grounding, one view", start, 350, "ms", f"{start / unit:.2f} backbone passes"),
    ]


@dataclass(frozen=True)
class Recorded:
    """The same steps without and with a recording: CPU seconds of the whole process, and the file's size."""

    episode: Episode
    cpu_s: float
    plain_cpu_s: float
    megabytes: float


def _record(trial: Trial, row: EpisodeRow, path: Path) -> Recorded:
    def recorder(opening: Opening) -> Recorder:
        return Recorder(path, opening)

    next(
        rollout(trial, [replace(row, max_steps=1)], lambda opening: Recorder(path.with_name("warm.rrd"), opening))
    )  # rerun's first call imports pandas
    start = time.process_time()
    next(rollout(trial, [row]))
    middle = time.process_time()
    episode = next(rollout(trial, [row], recorder))
    return Recorded(episode, time.process_time() - middle, middle - start, path.stat().st_size / 1e6)


def _record_limits(recorded: Recorded) -> list[Limit]:
    episode, steps = recorded.episode, max(recorded.episode.outcome.steps, 1)
    share = 100 * episode.seconds["record"] / sum(episode.seconds.values())
    return [
        Limit("recording, share of the rollout", share, 10, "%", f"whole process {recorded.cpu_s / recorded.plain_cpu_s:.2f} x the CPU time without"),
        Limit("60 steps, 3 cameras, as .rrd", recorded.megabytes * 60 / steps, 6, "MB", f"{recorded.megabytes:.2f} MB for {steps} steps"),
    ]


def _import_limit(unit: float) -> Limit:
    code = "import time; t = time.perf_counter(); import vap_core; print(time.perf_counter() - t)"
    took = [float(subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout) for _ in range(3)]
    return Limit("import vap_core", 1e3 * min(took), 300, "ms", f"{1e3 * min(took) / unit:.2f} backbone passes")


def _shares(episode: Episode) -> list[list[str]]:
    total, steps = sum(episode.seconds.values()), max(episode.outcome.steps, 1)
    ranked = sorted(episode.seconds.items(), key=lambda item: -item[1])
    return [[part, f"{1e3 * seconds / steps:.1f}", f"{100 * seconds / total:.0f} %"] for part, seconds in ranked]


def _median_ms(work: Callable[[], object]) -> float:
    work()
    took = []
    for _ in range(REPEAT):
        start = time.perf_counter()
        work()
        took.append(time.perf_counter() - start)
    return 1e3 * float(np.median(took))
