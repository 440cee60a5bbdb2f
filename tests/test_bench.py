"""The benchmarks: what they count is exact on known work, their tables divide as they say."""

import ast
from dataclasses import asdict, replace
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest

from tests.command import refused
from vap_core.base.errors import BadOutput, BadStudy, UnknownName
from vap_core.cli import benches
from vap_core.cli.bench import (
    embeddings,
    engine,
    eval_report,
    lerobot_process,
    measurement,
    memory,
    profile,
    profile_parts,
    scale,
    scale_report,
)
from vap_core.cli.bench import eval as bench_eval
from vap_core.cli.bench.eval_lerobot import LoopProcess
from vap_core.cli.bench.eval_plan import QUICK, Arm, Cost
from vap_core.cli.bench.measurement import Measurement, Table
from vap_core.cli.bench.profile_parts import PARTS, ROLLOUT_PARTS, Part
from vap_core.cli.bench.timing import Parts, median_seconds


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
    assert parts.calls == {"inner": 3, "outer": 1}
    assert parts.with_rest(7.5) == {"inner": 3.0, "outer": 2.0, "rest": 2.5}


def test_a_whole_part_keeps_the_parts_it_calls() -> None:
    clock = Clock()
    parts = Parts(clock)
    with parts.hooked(Work, "inner", "inner"), parts.hooked(Work, "outer", "outer", whole=True):
        Work(clock).outer()
        Work(clock).inner()
    assert parts.seconds == {"inner": 1.0, "outer": 4.0}


def test_hooks_are_removed_after_an_error() -> None:
    clock = Clock()
    parts = Parts(clock)
    work = Work(clock)
    inner = Work.inner

    def fail_while_hooked() -> None:
        with (
            parts.hooked(Work, "inner", "of the class"),
            parts.hooked(work, "outer", "of the object"),
        ):
            assert Work.inner is not inner
            work.outer()
            raise ValueError("stop")

    with pytest.raises(ValueError, match="stop"):
        fail_while_hooked()
    assert Work.inner is inner
    assert vars(work) == {"clock": clock}
    assert parts.seconds == {"of the class": 2.0, "of the object": 2.0}


def test_an_error_inside_a_part_leaves_the_count_right() -> None:
    clock = Clock()
    parts = Parts(clock)

    def fail() -> None:
        clock.now += 1.0
        raise ValueError

    whole = parts.timed(fail, "whole", whole=True)
    with pytest.raises(ValueError):  # noqa: PT011
        whole()
    parts.timed(Work(clock).inner, "after")()
    assert parts.seconds == {"whole": 1.0, "after": 1.0}


def test_the_median_leaves_the_warm_up_out() -> None:
    clock = Clock()
    lengths = iter([100.0, 1.0, 5.0, 2.0])

    def work() -> None:
        clock.now += next(lengths)

    assert median_seconds(work, 3, clock=clock) == 2.0


@pytest.mark.parametrize("part", [*PARTS, *ROLLOUT_PARTS], ids=lambda part: part.name)
def test_every_function_of_the_profile_exists(part: Part) -> None:
    for function in part.functions:
        owner, name = profile_parts.resolve(function)
        assert callable(getattr(owner, name))


def test_a_function_that_moved_is_named() -> None:
    gone = Part("gone", ("vap_core.attend:Attender.no_such",))
    with (
        pytest.raises(UnknownName, match=r"there is no vap_core.attend:Attender.no_such .*mend"),
        profile_parts.profiled([gone]),
    ):
        pass


def test_profiles_parts_sum_to_the_total() -> None:
    column = {
        "name": "toys",
        "method": "vap",
        "steps": 100,
        "seconds": {"mj_step": 0.3, "tint": 0.0, "rest": 0.1},
        "calls": {"mj_step": 1000, "tint": 0},
    }
    about = measurement.provenance("a command")
    table = profile.tables(Measurement("profile", about, {"columns": [column], "count_us": 2.0}))[0]
    assert table.rows == [
        ["part", "toys, vap"],
        ["steps", "100"],
        ["total", "4.0"],
        ["mj_step", "3.0 (75)"],
        ["tint", "-"],
        ["rest", "1.0 (25)"],
    ]
    assert "To count calls takes 0.0 ms a step" in table.note


def arm(loop: str, code: str, equal_cpu: str, wall: str, seconds: list[float]) -> dict:
    """An arm whose CPU time is half its wall time."""
    costs = []
    for s in seconds:
        parts = {"environment": 0.2 * s, "attend": 0.1 * s, "policy": 0.1 * s, "rest": 0.1 * s}
        costs.append(Cost(s, 0.5 * s, parts))
    name = f"{equal_cpu} {wall}"
    found = Arm(name, loop, code, lambda: costs[0], equal_cpu=equal_cpu, wall=wall, costs=costs)
    return found.values()


VALUES = {
    "episodes": 2,
    "steps": 10,
    "workers": 2,
    "arms": [
        arm("lerobot", "old", "as it comes", "", [8.0, 8.0]),
        arm("lerobot", "old", "best", "best", [6.0, 6.0]),
        arm("lerobot", "old", "", "as it comes", [9.0, 9.0]),
        arm("lerobot", "old", "", "best", [4.0, 4.0]),
        arm("lerobot", "new", "best", "best", [3.0, 3.0]),
        arm("lerobot", "new", "as it comes", "as it comes", [4.0, 4.0]),
        arm("ours", "new", "every step", "", [5.0, 5.0]),
        arm("ours", "new", "at calls", "", [2.0, 3.0]),
        arm("ours", "new", "", "every step", [2.5, 2.5]),
        arm("ours", "new", "", "at calls", [2.0, 2.0]),
    ],
}


def test_the_earlier_checkout_is_the_denominator() -> None:
    assert eval_report.lerobot_codes(VALUES) == ["old", "new"]
    found = eval_report.speed_up(VALUES, "cpu", "every step", "best")
    assert found == pytest.approx((6 / 5,) * 3)
    found = eval_report.speed_up(VALUES, "cpu", "every step", "best", "new")
    assert found == pytest.approx((3 / 5,) * 3)
    assert eval_report.speed_up(VALUES, "cpu", "every step", "as it comes")[0] == 8 / 5


def test_wall_time_takes_lerobots_fastest_and_our_workers() -> None:
    assert eval_report.speed_up(VALUES, "wall", "every step", "best")[0] == pytest.approx(4 / 2.5)
    assert eval_report.scaling(VALUES, "every step")[0] == pytest.approx(2.0)


def test_ratios_are_paired_within_repeats() -> None:
    middle, low, high = eval_report.speed_up(VALUES, "cpu", "at calls", "best")
    assert middle == pytest.approx((3.0 * 2.0) ** 0.5)
    assert low < 2.0 < 3.0 < high


def test_parts_of_a_step_sum_to_it() -> None:
    about = measurement.provenance("a command")
    equal, ratios, _, _ = eval_report.tables(Measurement("eval", about, VALUES))
    header, first, *_ = equal.rows
    assert header[2:] == ["ms a step", "environment", "attend", "policy", "rest"]
    step, *parts = map(float, first[2:])
    assert step == pytest.approx(1e3 * 0.5 * 8.0 / 20)
    assert sum(parts) == pytest.approx(step)
    assert ratios.rows[0] == [
        "ours",
        "as it comes, old",
        "best, old",
        "as it comes, new",
        "best, new",
    ]


def test_an_interrupted_measurement_goes_on_after_its_last_whole_repeat(tmp_path: Path) -> None:
    arms = []
    for each in VALUES["arms"]:
        costs = [Cost(**cost) for cost in each["costs"]]
        arms.append(Arm(each["name"], "ours", "new", lambda: Cost(1, 1, {}), costs=costs))
    about = measurement.provenance("a command", n="8 episodes", task="a task")
    values = {"arms": [arm.values() for arm in arms]}
    part = tmp_path / "eval.part.json"
    fresh = [replace(arm, costs=[]) for arm in arms]
    assert bench_eval.resume(fresh, part, Measurement("eval", about, {})) == 0
    measurement.write(Measurement("eval", about, values), part)
    other = Measurement("eval", {**about, "n": "9 episodes"}, {})
    assert bench_eval.resume(fresh, part, other) == 0
    assert bench_eval.resume(fresh, part, Measurement("eval", about, {})) == 2
    assert fresh == arms
    assert bench_eval.resume(fresh[1:], part, Measurement("eval", about, {})) == 0


def test_a_folder_that_is_no_checkout_is_refused(tmp_path: Path) -> None:
    with pytest.raises(BadStudy, match="is no checkout of this package; make one: git worktree"):
        LoopProcess(tmp_path, QUICK, tmp_path / "scratch")


def test_a_loop_that_ends_early_says_why(tmp_path: Path) -> None:
    (tmp_path / "vap_core").mkdir()
    (tmp_path / "vap_core" / "__init__.py").write_text("raise RuntimeError('an old fault')\n")
    with (
        pytest.raises(BadStudy, match="lerobot's loop of .* ended: RuntimeError: an old fault"),
        LoopProcess(tmp_path, QUICK, tmp_path / "scratch"),
    ):
        pass


def test_lerobots_loop_needs_only_what_an_earlier_checkout_has() -> None:
    """Names that lerobot_process.py imports of the package: all are in 1cce9d7."""
    names = set()
    for node in ast.walk(ast.parse(Path(lerobot_process.__file__).read_text())):
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
    condition = replace(scale.CONDITIONS[0], candidates=candidates, cameras=2, episodes=4)
    rows = scale.rows_with(condition, 7)
    assert len(rows) == 4
    for row in rows:
        names = [place.model for place in row.placements]
        assert len(set(names)) == candidates
        assert names[0] == row.target
        assert (row.max_steps, row.cameras) == (7, ("front", "side"))
        for one, other in combinations(row.placements, 2):
            assert np.hypot(one.x - other.x, one.y - other.y) > 0.089


def test_a_run_is_timed_beyond_start_up() -> None:
    """Of two workers' jobs the first two are start-up, the other two, of 5 and 1 episodes, not."""
    arrivals = [(10.0, 5), (12.0, 5), (14.0, 5), (18.0, 1)]
    assert engine.seconds_beyond_start_up(arrivals, 2) == pytest.approx((18.0 - 12.0) / 6)
    with pytest.raises(BadStudy, match="4 jobs for 4 workers leave nothing beyond start-up"):
        engine.seconds_beyond_start_up(arrivals, 4)


def test_rays_overhead_is_beyond_start_up() -> None:
    workers = [
        {"label": "1", "seconds": 30.0, "episode_s": 1.0},
        {"label": "2", "seconds": 20.0, "episode_s": 0.5},
    ]
    assert scale_report.ray_overhead_pct(workers) is None
    workers.append({"label": "2, Ray", "seconds": 40.0, "episode_s": 0.52})
    assert scale_report.ray_overhead_pct(workers) == pytest.approx(4.0)


def test_memory_is_what_the_process_holds() -> None:
    before = memory.resident_mb()
    block = np.ones(25_000_000)
    assert memory.resident_mb() - before == pytest.approx(block.nbytes / 1e6, rel=0.2)


def test_a_measurement_comes_back_from_its_file(tmp_path: Path) -> None:
    about = measurement.provenance("python -m vap_core bench eval", n=2)
    one = Measurement("eval", about, {"arms": [1.5]})
    measurement.write(one, tmp_path / "new" / "eval.json")
    assert measurement.read(tmp_path / "new" / "eval.json") == one
    assert {"commit", "machine", "day", "libraries", "n"} <= set(about)
    (tmp_path / "bad.json").write_text("{}")
    with pytest.raises(BadOutput, match="holds no measurement"):
        measurement.read(tmp_path / "bad.json")


def test_the_same_tables_are_printed_and_written() -> None:
    one = Measurement("toy", measurement.provenance("a command"), {})
    tables = [Table("A title", [["what", "ms"], ["a step", "1.5"]], "A note.")]
    for text in (measurement.as_text(one, tables), measurement.as_markdown(one, tables)):
        for part in ("A title", "a step", "1.5", "A note.", "commit "):
            assert part in text


def test_compared_tables_are_measured_as_the_noise_says() -> None:
    """The cosine of a row to itself with noise of relative size s is 1 / sqrt(1 + s^2)."""
    found = []
    for label, noise in embeddings.NOISE.items():
        values = embeddings._compare(((700, 64), noise))
        assert values["cosine_mean"] == pytest.approx((1 + noise**2) ** -0.5, abs=2e-3)
        assert values["tokens"] == 700
        assert values["nearest"] > 0.9
        assert 0 < values["peak_gb"] < 50
        found.append({"label": label, "noise": noise, **values})
    about = measurement.provenance("a command")
    (table,) = embeddings.tables(Measurement("embeddings", about, {"size": [700, 64], "tables": found}))  # fmt: skip
    assert [row[0] for row in table.rows[1:]] == list(embeddings.NOISE)
    assert {row[1] for row in table.rows[1:]} == {"700 x 64"}
    assert len({len(row) for row in table.rows}) == 1


def test_the_pictures_bars_are_the_tables() -> None:
    conditions = []
    for i, condition in enumerate(scale.CONDITIONS):
        parts = {"environment": 1.0 + i, "attend": 2.0, "policy": 0.5, "rest": 0.5}
        cost = Cost(9.0, sum(parts.values()), parts)
        conditions.append({**asdict(condition), "costs": [asdict(cost)]})
    workers = [{"label": "1", "seconds": 30.0, "episode_s": 1.0}]
    values = {"conditions": conditions, "workers": workers, "memory": [(0, 600.0), (50, 900.0)]}
    found = Measurement("scale", measurement.provenance("a command"), values)
    figure = scale_report.figure(found)
    titles = [axes.get_title() for axes in figure.axes]
    assert titles == [
        "cameras",
        "image size",
        "objects of the category",
        "batch",
        "workers, beyond start-up",
        "memory of one process",
    ]
    tops = [bar.get_y() + bar.get_height() for bar in figure.axes[0].containers[-1]]
    quoted = [float(row[2]) for row in scale_report.tables(found)[0].rows[1:4]]
    assert tops == quoted == [2.0, 2.5, 3.0]
    dots = figure.axes[0].lines
    assert [list(line.get_ydata()) for line in dots] == [[2.0], [2.5], [3.0]], "one a repeat"
    assert {line.get_color() for line in dots} == {"black"}


@pytest.mark.sweep
def test_the_loops_run_over_the_same_steps() -> None:
    found = bench_eval.measure(quick=True)
    arms = found.values["arms"]
    assert {arm["loop"] for arm in arms} == {"lerobot", "ours"}
    for each in arms:
        assert len(each["costs"]) == QUICK.repeats
        for cost in each["costs"]:
            assert sum(cost["parts"].values()) == pytest.approx(cost["cpu"])
            assert min(cost["parts"].values()) > 0
    assert "Equal CPU" in measurement.as_text(found, eval_report.tables(found))


@pytest.mark.sweep
def test_a_profile_runs() -> None:
    found = profile.measure(quick=True)
    generic, vap = found.values["columns"]
    assert generic["steps"] == vap["steps"] == 2 * profile.QUICK_STEPS
    assert generic["calls"]["grounding at t = 0"] == 0
    assert vap["calls"]["grounding at t = 0"] == 2
    for column in (generic, vap):
        assert column["calls"]["mj_step"] > 0
        assert column["seconds"]["rest"] > 0
    assert len(profile.tables(found)[0].rows) == 3 + len(PARTS) + 1


@pytest.mark.sweep
def test_scale_runs() -> None:
    found = scale.measure(quick=True)
    assert [len(each["costs"]) for each in found.values["conditions"]] == [1] * 13
    assert [each["label"] for each in found.values["workers"]] == ["1", "2", "2, Ray"]
    assert [done for done, _ in found.values["memory"]] == [0, 5, 10]
    assert len(scale_report.tables(found)) == 3
    assert asdict(found)


@pytest.mark.parametrize(
    ("words", "match"),
    [
        ("--json x.json loop --steps 5", "bench: loop reads --steps; leave --json out."),
        ("loop --quick", "leave --quick out"),
        ("policy --device cpu", "leave --device out"),
        ("profile --stack embedded", "profile reads --quick, --json; leave --stack out."),
        ("engine --episodes 200", "leave --episodes out"),  # as the default says, too
        ("nothing --json x", "bench: 'nothing' is unknown; known: embeddings, engine"),
    ],
)
def test_an_option_that_a_bench_does_not_read_is_refused(words: str, match: str) -> None:
    assert match in refused("bench", *words.split())


def test_each_bench_reads_the_options_that_the_table_says() -> None:
    source = ast.parse(Path(benches.__file__).read_text())
    (choice,) = (node for node in ast.walk(source) if isinstance(node, ast.Match))
    derived = {"parts": benches.STACK_PARTS, "part": ("json",)}
    options = {*derived, *(name for read in benches.BENCHES.values() for name in read)}
    reads = {}
    for case in choice.cases:
        assert isinstance(case.pattern, ast.MatchValue)
        names = set()
        for node in ast.walk(ast.Module(case.body, [])):
            if isinstance(node, ast.Name) and node.id in options:
                names |= set(derived.get(node.id, (node.id,)))
        reads[ast.literal_eval(case.pattern.value)] = names
    assert reads == {what: set(read) for what, read in benches.BENCHES.items()}


def test_a_file_that_cannot_be_written_is_refused_before_the_measurement(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def measure(*_: object, **__: object) -> Measurement:
        raise AssertionError("measured")

    monkeypatch.setattr(profile, "measure", measure)
    (tmp_path / "file").write_bytes(b"")
    below = refused("bench", "profile", "--json", tmp_path / "file" / "x.json")
    assert "cannot be written" in below
    assert "give --json another name" in below
    assert "is a folder; give --json another name" in refused(
        "bench", "profile", "--json", tmp_path
    )
