"""Benches: what they count is exact on known work, and each runs."""

import ast
import json
import re
from dataclasses import replace
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.command import refused, vap
from vap_core.base.errors import BadStudy, UnknownName
from vap_core.cli import bench, timing
from vap_core.cli.bench import PARTS, ROLLOUT_PARTS, Arm, LoopProcess
from vap_core.cli.timing import Parts


def read(path: Path) -> tuple[dict[str, Any], list[Arm]]:
    """The provenance and the arms of a measurement."""
    found = json.loads(path.read_text())
    return found["provenance"], [Arm(work=lambda: None, **arm) for arm in found["arms"]]


class Clock:
    """Seconds that pass only when work says so."""

    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        return self.now


class Work:
    """Nested work of known length."""

    def __init__(self, clock: Clock) -> None:
        self.clock = clock

    def inner(self) -> str:
        self.clock.now += 1.0
        return "done"

    def outer(self) -> str:
        self.clock.now += 2.0
        self.inner()
        return self.inner()


def test_a_part_is_without_the_parts_it_calls() -> None:
    clock = Clock()
    parts = Parts(clock)
    with parts.hooked(Work, "inner", "inner"), parts.hooked(Work, "outer", "outer"):
        assert Work(clock).outer() == "done"
        Work(clock).inner()
    assert parts.seconds == {"inner": 3.0, "outer": 2.0}
    assert parts.with_rest(7.5) == {"inner": 3.0, "outer": 2.0, "rest": 2.5}


def test_a_whole_part_keeps_the_parts_it_calls() -> None:
    clock = Clock()
    parts = Parts(clock)
    with parts.hooked(Work, "inner", "inner"), parts.hooked(Work, "outer", "outer", whole=True):
        Work(clock).outer()
        Work(clock).inner()
    assert parts.seconds == {"inner": 1.0, "outer": 4.0}


def test_hooks_are_removed_and_the_count_is_right_after_an_error() -> None:
    clock = Clock()
    parts = Parts(clock)
    work, inner = Work(clock), Work.inner

    def fail_while_hooked() -> None:
        with parts.hooked(Work, "inner", "class"), parts.hooked(work, "outer", "object"):
            assert Work.inner is not inner
            work.outer()
            raise ValueError("stop")

    with pytest.raises(ValueError, match="stop"):
        fail_while_hooked()
    assert Work.inner is inner
    assert vars(work) == {"clock": clock}
    assert parts.seconds == {"class": 2.0, "object": 2.0}

    def fail() -> None:
        clock.now += 1.0
        raise ValueError("within")

    with pytest.raises(ValueError, match="within"):
        parts.timed(fail, "whole", whole=True)()
    parts.timed(Work(clock).inner, "after")()
    assert (parts.seconds["whole"], parts.seconds["after"]) == (1.0, 1.0)


@pytest.mark.parametrize("functions", [*PARTS.values(), *ROLLOUT_PARTS.values()], ids="+".join)
def test_every_function_of_the_profile_exists(functions: tuple[str, ...]) -> None:
    for function in functions:
        owner, name = bench.resolve(function)
        assert callable(getattr(owner, name))


def arm(name: str, seconds: list[float], axis: str = "a", **facts: str) -> Arm:
    """An arm whose CPU time is half its wall time, two fifths of it in one part."""
    costs = [{"wall": s, "cpu": s / 2, "parts": {"one": 0.2 * s, "rest": 0.3 * s}} for s in seconds]
    return Arm(axis, name, lambda: None, 2, dict(facts), costs)


def test_a_table_compares_with_the_first_of_an_axis() -> None:
    text = bench.table([arm("x", [2.0, 4.0]), arm("y", [4.0, 8.0]), arm("z", [1.0, 1.0], "b")])
    lines = [re.split(r"\s{2,}", line.strip()) for line in text.splitlines()[2:]]
    assert lines[0] == ["a", "x", "750", "500 .. 1000", "300.0", "450.0"]
    assert lines[1][:5] == ["a", "y", "1500", "1000 .. 2000", "2.00 [2.00, 2.00]"]
    assert lines[2][:4] == ["b", "z", "250", "250 .. 250"]


def test_arms_follow_each_other_in_turn_and_warm_ones_do_not_count() -> None:
    told: list[str] = []
    arms = [Arm("a", name, lambda name=name: told.append(name)) for name in "xy"]  # type: ignore[misc]
    bench.measure(arms, 2)
    assert "".join(told) == "yxxyyx"
    assert [len(each.costs) for each in arms] == [2, 2]


def test_the_earlier_checkout_is_the_denominator(tmp_path: Path) -> None:
    old = {"loop": "lerobot", "code": "old", "cpu": "best"}
    arms = [
        arm("1", [8.0, 8.0], **{**old, "cpu": "as it comes"}, wall="as it comes"),
        arm("4", [6.0, 6.0], **old, wall="best"),
        arm("4, each a process", [4.0, 4.0], **{**old, "cpu": ""}, wall="best"),
        arm("4", [3.0, 3.0], **{**old, "code": "new"}, wall="best"),
        arm("ours", [2.0, 3.0], loop="ours", code="new", cpu="at calls", wall="at calls"),
    ]
    assert bench.speed_up(arms, "cpu", "at calls", "as it comes")[0] == pytest.approx(
        (4.0 * 8 / 3) ** 0.5
    )
    middle, low, high = bench.speed_up(arms, "cpu", "at calls", "best")
    assert middle == pytest.approx((3.0 * 2.0) ** 0.5)
    assert low < 2.0 < 3.0 < high
    assert bench.speed_up(arms, "wall", "at calls", "best")[0] == pytest.approx(
        (2.0 * 4 / 3) ** 0.5
    )
    about = bench.provenance(command="a command")
    bench.write(tmp_path / "new" / "eval.json", "eval", about, arms)
    again, kept = read(tmp_path / "new" / "eval.json")
    assert again == about
    assert [replace(each, work=arms[0].work) for each in kept] == [
        replace(each, work=arms[0].work) for each in arms
    ]


def test_what_is_wrong_is_refused(tmp_path: Path) -> None:
    (tmp_path / "old" / "vap_core").mkdir(parents=True)
    (tmp_path / "old" / "vap_core" / "__init__.py").write_text("raise RuntimeError('a fault')\n")

    def ends() -> None:
        with LoopProcess(tmp_path / "old", bench.QUICK, tmp_path / "scratch"):
            pass

    calls = (
        (lambda: bench.resolve("vap_core.attend:Attender.no"), UnknownName, "there is no .*mend"),
        (
            lambda: LoopProcess(tmp_path, bench.QUICK, tmp_path),
            BadStudy,
            "is no checkout of this package; make one: git worktree",
        ),
        (ends, BadStudy, "lerobot's loop of .* ended: RuntimeError: a fault"),
    )
    for call, error, said in calls:
        with pytest.raises(error, match=said):
            call()
    assert "bench: 'nothing' is unknown; known: eval" in refused("bench", "nothing")


def test_lerobots_loop_needs_only_what_an_earlier_checkout_has() -> None:
    """Names that timing.py imports of the package: all are in 1cce9d7."""
    names = set()
    for node in ast.walk(ast.parse(Path(timing.__file__).read_text())):
        if isinstance(node, ast.ImportFrom) and str(node.module).startswith("vap_core"):
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
    assert {name.removeprefix("vap_core.") for name in names} == {
        "memory.register", "memory.save", "perception.stacks.load_stack",
        "policies.lerobot.adapter.load_policy", "policies.lerobot.step.VapEnvConfig",
        "policies.lerobot.step.attach", "policies.lerobot.toy_pi0.Toy",
        "policies.lerobot.toy_pi0.save_toy", "policies.lerobot.toy_pi0.toy_sizes",
        "simulation.suites", "simulation.assets.objects.get_object",
        "simulation.studio.reference_views",
    }  # fmt: skip


@pytest.mark.parametrize("candidates", [1, 2, 3, 5])
def test_scale_places_so_many_objects_apart(candidates: int) -> None:
    rows = bench.rows_with(7, candidates, cameras=2, episodes=4)
    assert len(rows) == 4
    for row in rows:
        names = [place.model for place in row.placements]
        assert len(set(names)) == candidates
        assert names[0] == row.target
        assert (row.max_steps, row.cameras) == (7, ("front", "side"))
        for one, other in combinations(row.placements, 2):
            assert np.hypot(one.x - other.x, one.y - other.y) > 0.089


@pytest.mark.sweep
@pytest.mark.parametrize("what", ["step", "profile", "scale", "eval", "policy"])
def test_a_bench_runs(what: str, tmp_path: Path) -> None:
    done = vap("bench", what, "--quick", "--json", tmp_path / "found.json")
    assert done.returncode == 0, done.stderr
    _, arms = read(tmp_path / "found.json")
    assert all(len(each.costs) == 2 for each in arms)


def test_a_stack_is_timed() -> None:
    done = vap("bench", "stack", "--stack", "embedded", "--quick")
    assert done.returncode == 0, done.stderr
    assert "track step, 5 x 3" in done.stdout
