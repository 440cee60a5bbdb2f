"""Does a policy obey a tint: the sequential test, its error rates, and the real command."""

import itertools
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from tests.command import vap
from vap_core.study import obedience
from vap_core.study.obedience import ARMS, LOOKS, WAVE, Obedience, verdict
from vap_core.study.stats import mcnemar


def test_the_verdicts_of_a_look() -> None:
    assert mcnemar(0, 8) <= obedience.ALPHA < mcnemar(0, 7)
    assert verdict(0, 8, 30) == "obeys"
    assert verdict(8, 0, 30) == "does not obey"
    assert verdict(0, 7, 30) == "open"
    assert verdict(0, 0, 30) == "open"
    assert verdict(0, 0, 60) == "does not obey"


judged = cache(verdict)


def study(rng: np.random.Generator, plain: float, tinted: float) -> str:
    lost = won = 0
    for k in range(1, LOOKS + 1):
        generic, oracle = rng.random(WAVE) < plain, rng.random(WAVE) < tinted
        lost += int((generic & ~oracle).sum())
        won += int((~generic & oracle).sum())
        found = judged(lost, won, k * WAVE)
        if found != "open":
            return found
    return "open"


@pytest.mark.parametrize(
    ("plain", "tinted", "said", "least", "most"),
    [
        (0.3, 0.3, "obeys", 0.0, 0.05),
        (0.1, 0.1, "obeys", 0.0, 0.05),
        (0.3, 0.6, "obeys", 0.97, 1.0),
        (0.0, 0.1, "does not obey", 0.0, 0.05),
        (0.3, 0.4, "does not obey", 0.0, 0.05),
    ],
)
def test_error_rates_of_whole_studies(
    plain: float, tinted: float, said: str, least: float, most: float
) -> None:
    rng = np.random.default_rng(3)
    share = np.mean([study(rng, plain, tinted) == said for _ in range(600)])
    assert least <= share <= most


def test_waves_are_disjoint_and_every_arm_has_the_same_episodes() -> None:
    asked = Obedience("simpler-bridge", "scripted", waves=3)
    jobs = asked.jobs()
    assert len({job.name for job in jobs}) == len(jobs)
    by_arm = {
        method: [row.key for job in jobs if job.method == method for row in job.rows]
        for method in ARMS
    }
    (keys,) = {tuple(keys) for keys in by_arm.values()}
    assert len(set(keys)) == len(keys) == 3 * WAVE
    first = Obedience("simpler-bridge", "scripted", waves=1)
    assert list(itertools.takewhile(lambda job: job.wave == 0, jobs)) == list(first.jobs())
    assert first.settings() == asked.settings()


@pytest.mark.slow
@pytest.mark.timeout(300)
@pytest.mark.usefixtures("short_episodes")
def test_the_command_answers_in_a_sentence_with_a_page_and_two_recordings(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(obedience, "WAVE", 1)
    monkeypatch.setattr(obedience, "LOOKS", 1)
    words = ("measure", "obedience", "--policy", "scripted", "--suite", "widowx-pick")
    done = vap(*words, "--workers", "1", "--out", tmp_path / "run")
    assert done.returncode == 0, done.stderr
    first = done.stdout.splitlines()[0]
    assert first.startswith("scripted ")
    assert "on widowx-pick: success" in first
    page = (tmp_path / "run" / "obedience.html").read_text()
    assert page.count(".rrd") == 2
    assert len(list((tmp_path / "run" / "recordings").glob("*.rrd"))) == 2
    again = vap(*words, "--workers", "1", "--out", tmp_path / "run")
    assert again.stdout == done.stdout


def test_what_is_refused() -> None:
    for words, said in [
        (("--policy", "expert", "--suite", "simpler-bridge"), "sees no pictures"),
        (("--policy", "scripted", "--suite", "nowhere"), "nowhere"),
        (("--policy", "ws://", "--suite", "simpler-bridge"), "is no address"),
    ]:
        done = vap("measure", "obedience", *words)
        assert done.returncode == 2
        assert said in done.stderr
