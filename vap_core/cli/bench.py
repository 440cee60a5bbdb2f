"""The command bench: what a step, an episode, a model or a run costs, as ratios within one run.

A bench is a list of arms. They follow each other in turn, so that a slow moment of the machine
falls on all of them; `table` compares each with the first of its axis.
"""

import json
import os
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Annotated, Any

import typer

from vap_core.base.errors import command
from vap_core.cli.command import StackName
from vap_core.cli.timing import Parts

if TYPE_CHECKING:
    from vap_core.rollout.loop import Trial
    from vap_core.simulation.types import EpisodeRow
    from vap_core.study.engine import Job

app = typer.Typer()
Cost = dict[str, Any]
"""`wall` and `cpu` seconds, and CPU seconds by `parts`."""
BATCH = 5


@dataclass
class Arm:
    """One way to do something, and what it cost in every repeat; `n` is how often one does it."""

    axis: str
    name: str
    work: Callable[[], object]
    n: int = 1
    facts: dict[str, Any] = field(default_factory=dict)
    costs: list[Cost] = field(default_factory=list)

    def repeat(self) -> None:
        """Do it once more; what it returns is its cost, if it is one."""
        wall, cpu = time.perf_counter(), time.process_time()
        cost = self.work()
        taken = {"wall": time.perf_counter() - wall, "cpu": time.process_time() - cpu, "parts": {}}
        self.costs.append(cost if isinstance(cost, dict) and "cpu" in cost else taken)

    def seconds(self, clock: str) -> list[float]:
        """What one of its `n` took in every repeat."""
        return [cost[clock] / self.n for cost in self.costs]


def measure(arms: Sequence[Arm], repeats: int, warm: int = 1) -> None:
    """Run all arms in turn, each time beginning with another one; warm repeats do not count."""
    from tqdm import tqdm

    for repeat in tqdm(range(-warm, repeats), "bench", unit="repeat", disable=None):
        for i in range(len(arms)):
            arms[(i + repeat) % len(arms)].repeat()
        if repeat < 0:
            for arm in arms:
                arm.costs.clear()


def table(arms: Sequence[Arm], clock: str = "cpu") -> str:
    """Every arm: milliseconds, times the first of its axis with a 95 % interval, its parts."""
    import numpy as np

    from vap_core.study.stats import ratio
    from vap_core.study.table import printed

    parts = list(dict.fromkeys(part for arm in arms for part in arm.costs[0].get("parts", ())))
    rows = [["", "", f"{clock} ms", "lowest .. highest", "times the first [95 %]", *parts]]
    firsts: dict[str, Arm] = {}
    for arm in arms:
        ms = [1e3 * s for s in arm.seconds(clock)]
        first = firsts.setdefault(arm.axis, arm)
        times = ""
        if first is not arm and len(ms) > 1:
            times = in_brackets(ratio(arm.seconds(clock), first.seconds(clock)))
        row = [arm.axis, arm.name, f"{np.median(ms):.4g}", f"{min(ms):.4g} .. {max(ms):.4g}", times]
        for part in parts:
            of_part = [1e3 * cost["parts"].get(part, 0.0) / arm.n for cost in arm.costs]
            row.append(f"{np.median(of_part):.1f}" if any(of_part) else "-")
        rows.append(row)
    return printed(rows)


def in_brackets(found: tuple[float, float, float]) -> str:
    """A ratio and its interval."""
    return "{:.2f} [{:.2f}, {:.2f}]".format(*found)


# Parts of the running code. Where a function moves, mend these tables; a test resolves every name.

TRACKER = "vap_core.perception.embedded.tracker:"
PI0 = "lerobot.policies.pi0.modeling_pi0:"
ENV = "vap_core.simulation.env:Env."
RENDERER = "vap_core.simulation.cameras:Renderer."
LEROBOT = "vap_core.policies.lerobot.adapter:LeRobot."
JUDGE = "vap_core.simulation.suites.rules:Judge.step"
WHOLE = {"scene", "tracker: re-detection", "grounding", "environment", "attend", "policy"}
"""Parts that keep the time of the parts that they call."""
PARTS = {
    "scene": ("vap_core.study.engine:make_trial",),
    "mj_step": ("mujoco:mj_step",),
    "contacts": (f"{ENV}_advance",),
    "IK": (f"{ENV}commanded",),
    "RGB": (f"{RENDERER}rgb",),
    "sensor noise": ("vap_core.simulation.env:apply_sensor",),
    "truth masks": (f"{RENDERER}masks_and_hand",),
    "tracker: backbone": (f"{TRACKER}embed_cells",),
    "tracker: segmenter": (
        "vap_core.perception.embedded.segmenter:LiteSegmenter.mask_probability",
    ),
    "tracker: re-detection": (f"{TRACKER}search",),
    "tracker: rest": (f"{TRACKER}LiteTracker.step",),
    "grounding": ("vap_core.attend:Attender.start",),
    "tint": ("vap_core.attend:Attender.steps",),
    "policy: image tower": (f"{PI0}PaliGemmaWithExpertModel.embed_image",),
    "policy: denoising": (f"{PI0}PI0Pytorch.denoise_step",),
    "policy: prefix": (f"{PI0}PI0Policy.predict_action_chunk",),
    "policy: traced graph": ("vap_core.policies.lerobot.traced:ChunkPredictor.__call__",),
    "policy: rest": (f"{LEROBOT}plan",),
    "poses, judge": (f"{ENV}truth", JUDGE),
    "recording": (
        "vap_core.recording:DeferredRecorder.frame",
        "vap_core.recording:DeferredRecorder.close",
    ),
    "checksum": (f"{LEROBOT}sha256",),
}
PROMPTER = "vap_core.rollout.prompters:TintPrompter."
ROLLOUT_PARTS = {
    "environment": (
        *(f"{ENV}{name}" for name in ("__init__", "reset", "observe", "state", "step", "truth")),
        JUDGE,
    ),
    "attend": (f"{PROMPTER}start", f"{PROMPTER}steps"),
    "policy": (f"{LEROBOT}plan",),
}
"""What lerobot's loop can be divided into, too. The environment has the judge in it, as there."""


def resolve(function: str) -> tuple[Any, str]:
    """The module or class that holds a function, and the function's name. Raises: UnknownName."""
    from vap_core.base.errors import UnknownName

    owner, _, name = re.split(r"([.:])(?=\w+$)", function)
    try:
        resolve_name(function)
        return resolve_name(owner), name
    except (ImportError, AttributeError) as error:
        raise UnknownName(
            f"bench: there is no {function} ({error}); mend the parts in vap_core/cli/bench.py."
        ) from error


@contextmanager
def profiled(parts: dict[str, tuple[str, ...]]) -> Iterator[Cost]:
    """Inside, every function of the table counts its CPU time; then the cost is filled in."""
    counted, cost = Parts(), Cost()
    with ExitStack() as hooks:
        for part, functions in parts.items():
            for function in functions:
                owner, name = resolve(function)
                hooks.enter_context(counted.hooked(owner, name, part, whole=part in WHOLE))
        wall, cpu = time.perf_counter(), time.process_time()
        yield cost
        wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
        cost |= {"wall": wall, "cpu": cpu, "parts": counted.with_rest(cpu)}


def step(folder: Path, quick: bool) -> list[Arm]:
    """Parts of the prompted control loop, its recording and a query, beside a backbone pass."""
    import numpy as np

    from vap_core.recording import DeferredRecorder
    from vap_core.rollout.loop import rollout
    from vap_core.rollout.prompters import TintPrompter
    from vap_core.study import diagnosis, steps, store
    from vap_core.study.perception import opening_views
    from vap_core.study.trials import DEMO, make_trial, register_personal
    from vap_make.perception.backbone import features

    register_personal(DEMO, folder / "memory")
    suite, task = DEMO.tasks[-1]
    (listed, *_) = rows = DEMO.rows(suite, task)
    trial = make_trial(DEMO, rows, "vap", folder / "memory")
    row = replace(listed, max_steps=4 if quick else 60)
    episode = next(rollout(trial, [row], keep_images=True))
    assert isinstance(trial.prompter, TintPrompter)
    attender = trial.prompter.attender
    camera = trial.scene.cameras[-1]  # on the wrist; what stays as it was costs nothing
    views = [{camera: frame.images[camera]} for frame in episode.frames]
    (opening,) = opening_views([row])
    larger = {view.camera: view.rgb for view in opening if view.camera == camera}
    (state, _), turn = attender.start(views[0], row.instruction), iter(range(10**6))
    noise = np.random.default_rng(0).integers(0, 255, (224, 224, 3), dtype=np.uint8)
    run = folder / "run"
    run.mkdir()
    for number in range(20):
        header = replace(episode.header, row=replace(row, episode=number))
        copy = replace(episode, header=header)
        steps.write(run, [copy])
        store.append(run, [{**copy.summary(), **diagnosis.columns(copy), "attempt": 1}])

    def follow() -> None:
        nonlocal state
        state, _ = attender.step(state, views[next(turn) % len(views)])

    def ground() -> None:
        attender.start(views[0], row.instruction, larger=larger)

    def record(video: bool) -> None:
        sink = DeferredRecorder(
            folder / f"{next(turn)}.rrd", episode.header, lambda _: True, video=video
        )
        for frame in episode.frames:
            sink.frame(frame)
        sink.close(episode.outcome)

    code = "import vap_core"
    n = max(episode.outcome.steps, 1)
    return [
        Arm("a view", "backbone pass", lambda: features([noise + next(turn)], ["head"]), 1),
        Arm("a view", "attend step", follow, 1),
        Arm("a view", "grounding", ground, 1),
        Arm("a control step", "rollout", lambda: rolled(trial, [row]), n),
        Arm("a control step", "recording, JPEG", lambda: record(False), n),
        Arm("a control step", "recording, AV1", lambda: record(True), n),
        Arm("a command", "query, 20 episodes", lambda: steps.query(run, "margin < 1"), 1),
        Arm("a command", code, lambda: subprocess.run([sys.executable, "-c", code], check=True), 1),
    ]


def rolled(trial: "Trial", rows: Sequence["EpisodeRow"], batch: int = 1) -> Cost:
    """What episodes cost by part."""
    from vap_core.rollout.loop import rollout

    with profiled(ROLLOUT_PARTS) as cost:
        for episode in rollout(trial, rows, batch=batch):
            assert episode.outcome.status != "error", episode.outcome.detail
    return cost


TASKS = {
    "simpler-bridge": ("put-camera", "pick-shaver"),
    "simpler-fractal": ("pick-pen-holder", "move-bottle-near-coke-can"),
    "vlabench": ("select-cup", "select-leather-bag"),
    "tabletop": ("select-cup", "put-plant"),
}


def profile(folder: Path, quick: bool) -> list[Arm]:
    """A control step of eval by part: every suite and two methods with the shipped policies."""
    from vap_core.policies.names import MINI
    from vap_core.study.engine import Job, run_job, spread_evenly
    from vap_core.study.trials import Study, register_personal

    arms = []
    for suite, tasks in list(TASKS.items())[: 1 if quick else None]:
        for method in ("generic", "vap"):
            study = Study(tuple((suite, t) for t in tasks), (method,), policy=MINI, follow="call")
            register_personal(study, folder / "memory")
            jobs = []
            for task in study.tasks:
                rows = spread_evenly(list(study.rows(*task)), 1 if quick else BATCH)
                batch = tuple(replace(row, max_steps=3 if quick else 40) for row in rows)
                keys = tuple(f"{row.task}-{row.episode}" for row in batch)
                jobs.append(Job(study, method, batch, keys, 1, folder, "failures"))
            arm = Arm(suite, method, lambda: None)

            def work(jobs: "list[Job]" = jobs, arm: Arm = arm) -> Cost:
                with profiled(PARTS) as cost:
                    arm.n = sum(int(row["steps"]) for job in jobs for row in run_job(job))
                return cost

            arm.work = work
            arms.append(arm)
    return arms


CONDITIONS: dict[str, list[dict[str, Any]]] = {
    "cameras": [{"cameras": n} for n in (1, 2, 3)],
    "image size": [{"image_size": size} for size in (224, 448, (480, 640))],
    "objects of the category": [{"candidates": n} for n in (1, 2, 3, 5)],
    "batch": [{"batch": n, "episodes": 10} for n in (1, 5, 10)],
}
"""Axes of `bench scale`; what is not said is one camera of 224 px, three objects, batches of 5."""
SCALE = ("vlabench", "select-cup")
LOOKALIKES = tuple(f"paper-cup-lookalike-{i}" for i in range(1, 7))
TOY: dict[str, int] = {
    "image": 128, "patch": 16, "width": 128, "layers": 4, "expert": 96, "chunk": 4, "denoise": 10,
}  # fmt: skip


def rows_with(
    steps: int, candidates: int = 3, cameras: int = 1, episodes: int = 2
) -> list["EpisodeRow"]:
    """Episodes with so many objects of the category in view, apart, the target among them."""
    from vap_core.simulation import suites

    listed = suites.rows(*SCALE)
    views = suites.suite(SCALE[0]).cameras[:cameras]
    places = [place for row in listed for place in row.placements]
    found = []
    for row in listed[:episodes]:
        placed = list(row.placements[:candidates])
        unused = [name for name in LOOKALIKES if name not in {each.model for each in placed}]
        for place in places:
            if len(placed) == candidates:
                break
            if min((place.x - p.x) ** 2 + (place.y - p.y) ** 2 for p in placed) >= 0.09**2:
                placed.append(replace(place, model=unused.pop()))
        found.append(replace(row, placements=tuple(placed), cameras=views, max_steps=steps))
    return found


def scale(folder: Path, quick: bool) -> list[Arm]:
    """How the cost of an episode grows with cameras, image size, candidates, batch and workers."""
    from importlib.util import find_spec

    from vap_core.attend import Attender
    from vap_core.memory import load_bank
    from vap_core.perception.stacks import load_stack
    from vap_core.policies.lerobot.adapter import load_policy
    from vap_core.policies.lerobot.toy_pi0 import Toy, save_toy, toy_sizes
    from vap_core.policies.names import MINI
    from vap_core.rollout.loop import Trial
    from vap_core.rollout.prompters import TintPrompter
    from vap_core.simulation import suites
    from vap_core.simulation.env import Env
    from vap_core.simulation.suites.open_row import build_scene
    from vap_core.study import engine, workers
    from vap_core.study.trials import Study, register_personal

    steps = 2 if quick else 20
    suite = suites.suite(SCALE[0])
    register_personal(Study((SCALE,), ("vap",)), folder / "memory")
    prompter = TintPrompter(Attender(load_stack("embedded"), load_bank(folder / "memory")))
    scene = build_scene(SCALE[0], ("paper-cup-personal", *LOOKALIKES))
    env, toy = Env(scene, control=suite.control), Toy(**TOY)
    policies = {}
    with toy_sizes(toy):
        for n in range(1, 1 + len(suite.cameras)):
            sizes = (len(env.state()), env.action_size)
            save_toy(folder / f"pi0-{n}", suite.cameras[:n], *sizes, toy)
            policies[n] = load_policy(folder / f"pi0-{n}", "cpu")
    arms = []
    for axis, conditions in CONDITIONS.items():
        for given in conditions:
            more = dict(given)
            size, batch = more.pop("image_size", 224), more.pop("batch", BATCH)
            rows = rows_with(steps, **more)
            trial = Trial(
                method="vap",
                scene=scene,
                policy=policies[more.get("cameras", 1)],
                prompter=prompter,
                control=suite.control,
                sensor=suite.sensor,
                follow="call",
                image_size=size,
            )
            name = str(next(iter(given.values())))
            arms.append(Arm(axis, name, partial(rolled, trial, rows, batch), len(rows)))
    tasks = tuple(("simpler-bridge", task) for task in TASKS["simpler-bridge"])
    study = Study(tasks, ("vap",), episodes=1 if quick else 10, policy=MINI, follow="call")

    def spread(name: str, executor: Any) -> None:
        out, n = Path(tempfile.mkdtemp(dir=folder)), int(name[0])
        engine.run(study, out, workers=n, record="none", progress=False, executor=executor)

    ways = {"1": workers.results, "2": workers.results}
    if find_spec("ray") is not None and not quick:
        ways["2, Ray"] = workers.ray_executor(local_cluster(2))
    for name, executor in ways.items():
        arms.append(
            Arm("workers (wall)", name, partial(spread, name, executor), study.episodes or 1)
        )
    return arms


def local_cluster(cpus: int) -> str:
    """The address of a Ray cluster of one node on this machine, on loopback, until this ends."""
    import atexit

    os.environ.setdefault("RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER", "0")
    from ray.cluster_utils import Cluster

    head = {"num_cpus": cpus, "node_ip_address": "127.0.0.1", "object_store_memory": 2**28}
    nodes = Cluster(initialize_head=True, head_node_args={**head, "include_dashboard": False})
    atexit.register(nodes.shutdown)
    return str(nodes.address)


def stack(folder: Path, quick: bool, kind: str, device: str | None = None) -> list[Arm]:
    """The models of one perception stack; with random weights where none are here. Speed does not
    depend on weights."""
    import numpy as np

    from vap_core.base.errors import MissingWeights
    from vap_core.base.types import Boxes
    from vap_core.perception.stacks import load_embedded, load_random, load_stack

    try:
        parts = load_embedded() if kind == "embedded" else load_stack(kind)
    except MissingWeights as error:
        print(f"note: with random weights ({error})", file=sys.stderr)
        parts = load_random(kind, device)
    rng = np.random.default_rng(0)
    corners = np.array([(10, 10), (80, 10), (150, 10), (10, 100), (80, 100)], np.float32)
    boxes = Boxes(np.concatenate([corners, corners + np.array([50, 60])], 1).astype(np.float32),
                  np.ones(5, np.float32), "cup")  # fmt: skip
    masks = np.zeros((5, 224, 224), bool)
    for mask, (x, y) in zip(masks, corners.astype(int), strict=True):
        mask[y : y + 60, x : x + 50] = True

    def views(n: int) -> list[Any]:
        return list(rng.integers(0, 256, (n, 224, 224, 3), dtype=np.uint8))

    crops = [view[:60, :50].copy() for view in views(5)]
    tracked = views(3)
    states = parts.tracker.start(tracked, [masks] * 3)
    return [
        Arm(kind, "detection", lambda: parts.detector(views(1), "cup"), 1),
        Arm(kind, "detection, 3 views", lambda: parts.detector(views(3), "cup"), 3),
        Arm(kind, "embedding, 5 crops", lambda: parts.encoder(crops), 5),
        Arm(kind, "segmentation, 5 boxes", lambda: parts.segmenter(views(1)[0], boxes), 1),
        Arm(kind, "track step, 5 x 3", lambda: parts.tracker.step(states, tracked), 3),
    ]


def policy(folder: Path, quick: bool) -> list[Arm]:
    """A call of every shipped policy, for one episode and for many at once."""
    import numpy as np

    from vap_core.policies.lerobot.adapter import load_policy
    from vap_core.policies.lerobot.attribution import noise_input
    from vap_core.simulation.suites import BENCHMARKS
    from vap_core.study.trials import shipped

    arms = []
    for name in list(BENCHMARKS)[: 1 if quick else None]:
        loaded = load_policy(shipped(name))
        rng = np.random.default_rng(0)
        inputs = [noise_input(loaded, rng, 224) for _ in range(16)]
        states = [loaded.start(np.random.default_rng(i)) for i in range(16)]
        for n in (1, 4, 16):
            plan = partial(loaded.plan, states[:n], inputs[:n])
            arms.append(Arm(name, f"batch {n}, an episode", plan, n))
    return arms


@dataclass(frozen=True)
class Plan:
    """What `bench eval` runs: so many episodes of so many steps; `loops` are lerobot's numbers of
    environments, and whether each is a process."""

    episodes: int = 8
    steps: int = 40
    toy: dict[str, int] = field(default_factory=lambda: TOY)
    loops: tuple[tuple[int, bool], ...] = ((1, False), (4, False), (4, True))
    suite: str = "simpler-bridge"
    task: str = "put-camera"


QUICK = Plan(
    2, 2, {**TOY, "image": 64, "width": 32, "layers": 1, "denoise": 2}, ((1, False), (2, False))
)


class LoopProcess:
    """timing.py as a script with the package of one checkout, warm; it ends with the block.

    Raises: BadStudy when the folder is no checkout, or when the process ends early.
    """

    def __init__(self, checkout: Path, plan: Plan, folder: Path) -> None:
        from vap_core.base.errors import BadStudy
        from vap_core.base.files import code_version

        package = checkout.resolve() / "vap_core" / "__init__.py"
        if not package.is_file():
            raise BadStudy(
                f"bench eval: {checkout} is no checkout of this package; "
                "make one: git worktree add DIR 1cce9d7"
            )
        folder.mkdir(parents=True)
        self.code = code_version(package.parent)
        self._errors = folder / "stderr.txt"
        (folder / "plan.json").write_text(json.dumps(asdict(plan)))
        script = Path(__file__).with_name("timing.py")
        with self._errors.open("w") as errors:
            self._process = subprocess.Popen(
                [sys.executable, "-P", str(script), str(folder), str(folder / "plan.json")],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=errors,
                text=True,
                cwd=folder,
                env={**os.environ, "PYTHONPATH": str(checkout.resolve())},
            )

    def __enter__(self) -> "LoopProcess":
        self._answer()
        return self

    def __exit__(self, *error: object) -> None:
        try:  # it closes its environments, which may be processes, first
            self._process.communicate(timeout=30)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.communicate()

    def run(self, **arm: Any) -> Cost:
        """One evaluation of all episodes: n_envs, in_processes, threads, videos."""
        assert self._process.stdin is not None
        with suppress(BrokenPipeError):  # where the process has died, the answer says why
            self._process.stdin.write(json.dumps(arm) + "\n")
            self._process.stdin.flush()
        return self._answer()

    def _answer(self) -> Cost:
        from vap_core.base.errors import BadStudy

        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            self._process.communicate()
            said = self._errors.read_text().strip().splitlines() or ["it said nothing"]
            raise BadStudy(f"bench eval: lerobot's loop of {self.code} ended: {said[-1][:160]}")
        answer = json.loads(line)
        return answer


def evaluate(folder: Path, quick: bool, earlier: Path | None, ended: ExitStack) -> list[Arm]:
    """Our rollouts against lerobot's own evaluation loop: the same toy PI0, episodes and VAP.

    lerobot's loop shares `attend` with ours and so gets faster when ours does: `earlier` names a
    checkout whose loop is the fixed denominator.
    """
    import vap_core
    from vap_core.attend import Attender
    from vap_core.base.files import code_version
    from vap_core.memory import load_bank
    from vap_core.perception.stacks import load_stack
    from vap_core.policies.lerobot.adapter import load_policy
    from vap_core.policies.lerobot.toy_pi0 import Toy, toy_sizes
    from vap_core.rollout.loop import Trial
    from vap_core.rollout.prompters import TintPrompter
    from vap_core.simulation import suites
    from vap_core.simulation.suites.open_row import build_scene, models_of

    plan = QUICK if quick else Plan()
    here = Path(vap_core.__file__).resolve().parents[1]
    arms = []
    for i, checkout in enumerate(filter(None, (earlier, here))):
        process = ended.enter_context(LoopProcess(checkout, plan, folder / f"lerobot-{i}"))
        for n, in_processes in plan.loops:
            for threads in sorted({1, os.cpu_count() or 1}):
                given = {"n_envs": n, "in_processes": in_processes, "threads": threads}

                loop = partial(process.run, **given, videos=n == 1)
                name = f"lerobot {process.code}: {n} envs, {threads} threads"
                kind = "as it comes" if n == 1 else "best"
                cpu = kind * (threads == 1 > in_processes)
                facts = {"loop": "lerobot", "code": process.code, "cpu": cpu, "wall": kind}
                name += ", each a process" * in_processes
                arms.append(Arm("an episode", name, loop, plan.episodes, facts))
    rows = [replace(r, max_steps=plan.steps) for r in suites.rows(plan.suite, plan.task)]
    rows = rows[: plan.episodes]
    suite = suites.suite(plan.suite)
    with toy_sizes(Toy(**plan.toy)):
        loaded = load_policy(folder / "lerobot-0" / "pi0", "cpu")
    bank = load_bank(folder / "lerobot-0" / "memory")
    trial = Trial(
        method="vap",
        scene=build_scene(plan.suite, models_of(rows)),
        policy=loaded,
        prompter=TintPrompter(Attender(load_stack("embedded"), bank)),
        control=suite.control,
        sensor=suite.sensor,
    )
    for name, ours in (("every step", trial), ("at calls", replace(trial, follow="call"))):
        facts = {"loop": "ours", "code": code_version(), "cpu": name, "wall": name}
        work = partial(rolled, ours, rows, 4)
        arms.append(Arm("an episode", f"ours, {name}", work, plan.episodes, facts))
    return arms


def speed_up(arms: Sequence[Arm], clock: str, ours: str, theirs: str) -> tuple[float, float, float]:
    """How many times as fast our loop is as lerobot's: mean within repeats, 95 % interval.

    `ours` is "every step" or "at calls"; `theirs` "as it comes" or "best", the fastest of the first
    checkout that was measured, the fixed denominator.
    """
    import numpy as np

    from vap_core.study.stats import ratio

    code = next(arm.facts["code"] for arm in arms if arm.facts["loop"] == "lerobot")

    def taken(**wanted: str) -> list[list[float]]:
        return [arm.seconds(clock) for arm in arms if wanted.items() <= arm.facts.items()]

    slow = taken(loop="lerobot", code=code, **{clock: theirs})
    (fast,) = taken(loop="ours", **{clock: ours})
    return ratio(min(slow, key=lambda seconds: float(np.median(seconds))), fast)


def provenance(**about: Any) -> dict[str, Any]:
    """Code version, machine, versions of libraries and day."""
    import platform
    from datetime import UTC, datetime
    from importlib.metadata import PackageNotFoundError, version

    from vap_core.base.files import code_version

    libraries = {"python": platform.python_version()}
    for name in ("torch", "mujoco", "lerobot", "onnxruntime", "ray"):
        with suppress(PackageNotFoundError):
            libraries[name] = version(name)
    processor = platform.machine()
    with suppress(OSError):
        named = re.search(r"model name\s*: (.*)", Path("/proc/cpuinfo").read_text())
        processor = named[1] if named else processor
    machine = f"{processor}, {len(os.sched_getaffinity(0))} cores"
    day = datetime.now(UTC).date().isoformat()
    found = dict(commit=code_version(), machine=machine, day=day, libraries=libraries)
    return found | about


def write(path: Path, bench: str, about: dict[str, Any], arms: Sequence[Arm]) -> None:
    """Keep a measurement as JSON. Raises: BadOutput."""
    from vap_core.base.files import write_atomic, writing

    kept = [{n: v for n, v in vars(arm).items() if n != "work"} for arm in arms]
    text = json.dumps({"bench": bench, "provenance": about, "arms": kept}, indent=1)
    with writing(path, "bench", "give --json another name"):
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomic(path, f"{text}\n".encode())


BENCHES: dict[str, Callable[..., list[Arm]]] = {
    "step": step,
    "profile": profile,
    "scale": scale,
    "eval": evaluate,
    "stack": stack,
    "policy": policy,
}


@app.command()
def bench(
    what: Annotated[
        str,
        typer.Argument(
            help="step: the prompted control loop, a recording, a query; profile: a control step "
            "of eval by part; scale: cost against cameras, image size, candidates, batch, workers "
            "and Ray; eval: our loop against lerobot's own; stack: a stack's models; policy: the "
            "shipped policies; proxy: what the prompting proxy adds to a call of a policy server."
        ),
    ] = "step",
    stack: StackName = "foundation",
    repeats: Annotated[int, typer.Option(min=2, help="How often every way is measured.")] = 5,
    quick: Annotated[
        bool,
        typer.Option("--quick", help="To see that it runs; its numbers mean nothing."),
    ] = False,
    lerobot_from: Annotated[
        Path | None,
        typer.Option(
            help="eval: a checkout of this repository at an earlier commit (git worktree add DIR "
            "COMMIT), whose lerobot loop is measured, too, as the fixed denominator."
        ),
    ] = None,
    keep: Annotated[
        Path | None, typer.Option("--json", help="Keep the measurement in this file, too.")
    ] = None,
) -> None:
    """Measure what a step, an episode, a model or a run costs, as ratios within one run.

    Example: ./vap bench step
    Example: ./vap bench profile --json profile.json
    Example: ./vap bench stack --stack foundation-small:detector=sam3
    """
    from vap_core.base.errors import one_of

    if what == "proxy":
        import pandas as pd

        from vap_core.serve import latency
        from vap_core.study.table import printed

        machine = provenance()
        print(f"{machine['machine']}, {machine['commit']}")
        with tempfile.TemporaryDirectory() as scratch:
            for measured in (latency.alone, latency.between):
                table_of = pd.DataFrame(measured(Path(scratch), quick)).round(1)
                print("\n" + printed(table_of))
        return
    if what not in BENCHES:
        raise one_of("bench:", what, [*BENCHES, "proxy"])
    more: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as scratch, ExitStack() as ended:
        if what == "stack":
            more = {"kind": stack}
        elif what == "eval":
            more = {"earlier": lerobot_from, "ended": ended}
        arms = BENCHES[what](Path(scratch), quick, **more)
        measure(arms, 2 if quick else repeats)
    about = provenance(command=command("bench", what), repeats=len(arms[0].costs))
    print(f"{about['machine']}, {about['commit']}\n\n{table(arms)}")
    if what in ("step", "scale", "eval"):
        print(f"\n{table(arms, 'wall')}")
    if what == "eval":
        for ours in ("every step", "at calls"):
            found = (speed_up(arms, "cpu", ours, theirs) for theirs in ("as it comes", "best"))
            usual, best = map(in_brackets, found)
            print(f"ours, {ours}: {usual} times as fast as lerobot as it comes, {best} as its best")
    if keep is not None:
        write(keep, what, about, arms)
