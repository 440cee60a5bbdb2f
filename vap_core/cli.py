"""The commands. Each parses, calls one function of the house, and prints; errors the user can mend are one line, status 2."""

import json
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from vap_core.errors import VapError

if TYPE_CHECKING:
    from vap_core.engine import Record
    from vap_core.experiments import Study

HELP = """Visual Attentive Prompting: steer a frozen policy to your own object, and see why it worked or failed.

Start with: python -m vap_core doctor, then python -m vap_core demo."""

app = typer.Typer(no_args_is_help=True, pretty_exceptions_enable=False, add_completion=False, rich_markup_mode=None, help=HELP)
train_app = typer.Typer(no_args_is_help=True, help="Train shipped parts again; every training resumes after an interruption.")
app.add_typer(train_app, name="train")
objects_app = typer.Typer(no_args_is_help=True, help="The objects of the scenes: what there is, and your own 3-D scans.")
app.add_typer(objects_app, name="objects")
weights_app = typer.Typer(no_args_is_help=True, help="The foundation stack's weights: what is there, and how to get the rest.")
app.add_typer(weights_app, name="weights")

Memory = Annotated[Path, typer.Option(help="Folder of remembered objects.")]
StackName = Annotated[str, typer.Option("--stack", help="Perception stack: embedded (offline, CPU), foundation or foundation-small (see weights).")]
Methods = Annotated[
    list[str] | None,
    typer.Option(
        "--methods", "--method", help="generic, vap, vap-associated, mask-only, rewrite-only; with commas, or repeated. Default: generic,vap."
    ),
]
PolicyName = Annotated[str, typer.Option("--policy", help="scripted, or the bounds: expert (reads the simulator), random.")]
Seed = Annotated[int, typer.Option(min=0, help="Seed of the policy and the sensors; of a warm-up suite's episode list, too.")]
Workers = Annotated[int, typer.Option(min=1, help="Processes.")]
Recorded = Annotated[Literal["all", "failures", "none"], typer.Option("--record", help="Which episodes become a .rrd file; errors always do.")]
Retries = Annotated[int, typer.Option(min=0, help="How often an episode that ended in an error is tried again.")]
Meshes = Annotated[str, typer.Option("--robots", help="plain, or menagerie: MuJoCo Menagerie's meshes, downloaded or found in MENAGERIE_ROOT.")]
BANK = Path("data/memory")
INTERRUPTED = 130
NOTE = "note: the embedded detector knows {domain} only, not real photos; {mend}."


def main() -> None:
    """Run the command line; what the user can mend is printed as one line."""
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    try:
        app()
    except VapError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)
    except SystemExit as stop:
        if stop.code == INTERRUPTED:
            print("interrupted; run the same command again, it goes on where it stopped.", file=sys.stderr)
        raise


@app.command()
def register(
    name: Annotated[str, typer.Argument(help="What to call the object, for example mug.")],
    photos: Annotated[list[Path], typer.Argument(help="One to about ten photos of this very object, five are best.")],
    category: Annotated[str, typer.Option(help="What kind of thing it is: the word you will use after 'my'.")],
    memory: Memory = BANK,
    stack: StackName = "embedded",
    whole: Annotated[bool, typer.Option("--whole", help="The photos are cut out already: use them whole, without the detector.")] = False,
    replace: Annotated[bool, typer.Option("--replace", help="Overwrite an object of this name.")] = False,
) -> None:
    """Remember a personal object from photos.

    Example: python -m vap_core register mug --category cup photos/mug-*.jpg
    """
    from vap_core.attend import load_stack
    from vap_core.memory import load_photo, remember, save
    from vap_core.memory import register as learn

    pictures = [load_photo(photo) for photo in photos]
    models = load_stack(stack)
    _note(models.domain, whole, "look at what it cropped, or cut the photos out yourself and pass --whole")
    if whole:
        obj = remember(name, category, pictures, models.encoder)
    else:
        obj, uncropped = learn(name, category, pictures, models.detector, models.encoder)
        for index in uncropped:
            print(f"note: no sure {obj.category} found in {photos[index]}; the whole photo is used.", file=sys.stderr)
    path = save(memory, obj, replace=replace)
    print(f"{obj.name}: a {obj.category} with {len(obj.crops)} references, saved to {path}")
    print(f'next: python -m vap_core ground IMAGE "bring my {obj.category}" --memory {memory}')


@app.command()
def ground(
    image: Annotated[Path, typer.Argument(help="Picture of the scene.")],
    instruction: Annotated[str, typer.Argument(help='What you would tell the robot, for example "bring my cup".')],
    object: Annotated[
        list[str] | None, typer.Option("--object", help="Remembered object of each 'my ...', where the category alone does not decide.")
    ] = None,
    memory: Memory = BANK,
    stack: StackName = "embedded",
    box: Annotated[list[str] | None, typer.Option(help="A candidate x0,y0,x1,y1 in pixels, instead of the detector; repeatable.")] = None,
    out: Annotated[Path, typer.Option(help="Folder for the overlay PNG and the recording.")] = Path("data/runs/ground"),
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object and nothing else.")] = False,
) -> None:
    """Find a remembered object in a picture, and show why that box won.

    Example: python -m vap_core ground desk.jpg "bring my cup" --box 40,60,180,220 --box 300,80,420,230
    """
    from vap_core.ground import ground_image, parse_boxes, to_json, write_evidence
    from vap_core.memory import load_photo

    rgb = load_photo(image, long_side=None)
    boxes = parse_boxes(box, rgb) if box else None
    found = ground_image(rgb, instruction, memory, stack, objects=object, boxes=boxes)
    _note(found.domain, boxes is not None, "on a real photo give the candidates with --box")
    written = write_evidence(out, image.stem, found)
    if as_json:
        print(json.dumps(to_json(found)))
        return
    print(found)
    print("wrote " + " and ".join(str(path) for path in written) + f"; look: .venv/bin/rerun --bind 127.0.0.1 {written[1]}")


@app.command()
def demo(
    out: Annotated[Path, typer.Option(help="Run folder; a run found there is resumed.")] = Path("data/runs/demo"),
    workers: Annotated[int, typer.Option(min=1, help="Processes.")] = 2,
    episodes: Annotated[int, typer.Option(min=1, help="Episodes per task and method.")] = 20,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the episode list.")] = 0,
) -> None:
    """The main job: personalise a scripted policy on two robots, generic against VAP, with recordings of every episode.

    Example: python -m vap_core demo --episodes 20
    """
    from dataclasses import replace

    from vap_core.experiments import DEMO

    _run(replace(DEMO, episodes=episodes, seed=seed), out, workers, "all", retries=1)


@app.command()
def suites() -> None:
    """List the benchmarks: robots, cameras, tasks, episodes, and the hashes of their episode lists.

    Example: python -m vap_core suites
    """
    from vap_core.report import suites_table

    print(suites_table())


@app.command()
def rollout(
    suite: Annotated[str, typer.Option(help="A suite: see python -m vap_core suites.")],
    task: Annotated[list[str], typer.Option(help="Task of the suite, for example pick-cup; repeatable.")],
    out: Annotated[Path, typer.Option(help="Run folder; a run found there is resumed.")],
    method: Methods = None,
    policy: PolicyName = "scripted",
    episodes: Annotated[int, typer.Option(min=1, help="Episodes per task and method.")] = 20,
    seed: Seed = 0,
    workers: Workers = 2,
    record: Recorded = "all",
    retries: Retries = 1,
    robots: Meshes = "plain",
    stack: StackName = "embedded",
) -> None:
    """Run tasks of a suite in closed loop, record every episode, and print the table.

    Example: python -m vap_core rollout --suite widowx-pick --task pick-bottle --episodes 4 --out data/runs/bottle
    """
    tasks = tuple((suite, name) for name in dict.fromkeys(task))
    _run(_study(tasks, method, policy=policy, episodes=episodes, seed=seed, robots=robots, stack=stack), out, workers, record, retries)


@app.command("eval")
def evaluate(
    suite: Annotated[list[str], typer.Option(help="A suite, or all four benchmarks: all; repeatable.")],
    out: Annotated[Path | None, typer.Option(help="Run folder; a run found there is resumed. Default data/runs/POLICY-SUITE.")] = None,
    method: Methods = None,
    policy: PolicyName = "scripted",
    episodes: Annotated[int | None, typer.Option(min=1, help="Episodes per task, spread evenly over its list. Default the whole list.")] = None,
    seed: Seed = 0,
    seeds: Annotated[int, typer.Option(min=1, help="Run every episode with so many seeds, from --seed on.")] = 1,
    workers: Workers = 2,
    engine: Annotated[Literal["local", "ray"], typer.Option(help="local: processes of this machine; ray: a Ray cluster.")] = "local",
    address: Annotated[str, typer.Option(help="ray: host:port of the cluster, or auto for the one on this machine.")] = "auto",
    record: Recorded = "none",
    retries: Retries = 1,
    follow: Annotated[
        Literal["call", "step"], typer.Option(help="Take images and track when the policy is asked, or at every control step (smoother recordings).")
    ] = "call",
    audit: Annotated[
        bool, typer.Option("--audit", help="Prove that tint and text reach the policy: every call is made with the raw input, too.")
    ] = False,
    images_every: Annotated[int, typer.Option(min=0, help="Expert and random: render all cameras every so many steps; 0 never.")] = 0,
    robots: Meshes = "plain",
    stack: StackName = "embedded",
) -> None:
    """Run whole suites, and print the table with 95 % intervals. Interrupted, the same command goes on.

    Example: python -m vap_core eval --suite simpler-bridge --policy expert
    Example: python -m vap_core eval --suite all --methods generic,vap --episodes 4 --out data/runs/all
    Example: python -m vap_core eval --suite all --engine ray --address 10.0.0.5:6379
    """
    from vap_core import suites as known

    names = [name for each in suite for name in (known.BENCHMARKS if each == "all" else [each])]
    tasks = tuple((name, task.name) for name in dict.fromkeys(names) for task in known.suite(name).tasks)
    options = {"seeds": seeds, "images_every": images_every, "follow": follow, "audit": audit}
    study = _study(tasks, method, policy=policy, episodes=episodes, seed=seed, robots=robots, stack=stack, **options)
    folder = out or Path(f"data/runs/{Path(policy).name}-{'-'.join(dict.fromkeys(suite))}")
    _run(study, folder, workers, record, retries, address if engine == "ray" else None)


@app.command("eval-perception")
def eval_perception(
    stack: StackName = "embedded",
    suite: Annotated[list[str] | None, typer.Option(help="A benchmark; repeatable. Default all four.")] = None,
    episodes: Annotated[int | None, typer.Option(min=1, help="Opening frames per task, as episodes spread evenly over its list.")] = None,
    jobs: Annotated[int, typer.Option(min=1, help="Processes.")] = 2,
    out: Annotated[Path, typer.Option(help="Run folder; a run found there is resumed.")] = Path("data/runs/perception"),
    quick: Annotated[bool, typer.Option("--quick", help="Two opening frames per task and one tracked episode per suite.")] = False,
    publish: Annotated[Path | None, typer.Option(help="Keep the tables in this folder too, as perception_NAME.parquet.")] = None,
) -> None:
    """Measure perception against the simulator: opening frames, tracks through whole expert episodes, and time. Interrupted, it goes on.

    Example: python -m vap_core eval-perception --suite simpler-bridge --quick
    """
    from vap_core import suites as known
    from vap_core.survey.report import conclude
    from vap_core.survey.run import Survey, run
    from vap_core.survey.run import publish as keep

    asked = Survey(stack, tuple(dict.fromkeys(suite or known.BENCHMARKS)), episodes, quick)
    print(conclude(run(asked, out, jobs=jobs), asked.stack, out))
    if publish is not None:
        print("wrote " + ", ".join(map(str, keep(out, publish))))


@app.command()
def rescore(run: Annotated[Path, typer.Argument(help="Run folder of eval, rollout or demo.")]) -> None:
    """Judge a finished run again from its saved states, without a simulator, and say what changed.

    Example: python -m vap_core rescore data/runs/expert-simpler-bridge
    """
    from vap_core.rescore import rescore as judge_again

    print(judge_again(run))


@app.command()
def report(
    runs: Annotated[list[Path], typer.Argument(help="Run folders of eval, rollout or demo; several seeds of a suite make one report.")],
    out: Annotated[Path | None, typer.Option(help="Folder for report.md, CSV and LaTeX tables and pictures. Default RUN/report.")] = None,
) -> None:
    """Print and write what runs found: tables with intervals beside the paper's, paired comparisons, errors, provenance, pictures.

    Example: python -m vap_core report data/runs/demo
    """
    from vap_core.report import report as conclude

    place = out or runs[0] / "report"
    print(conclude(runs, place))
    print(f"\nwrote {place}: report.md, tables as CSV and LaTeX, pictures")


@app.command()
def publish(
    runs: Annotated[list[Path], typer.Argument(help="Run folders of eval, rollout or demo.")],
    to: Annotated[Path, typer.Option(help="The table to write, for example data/results/mine.parquet.")],
    replace: Annotated[bool, typer.Option("--replace", help="Overwrite that table.")] = False,
) -> None:
    """Keep the results of finished runs as one small table, with their configurations.

    Example: python -m vap_core publish data/runs/expert-all data/runs/random-all --to data/results/bounds.parquet --replace
    """
    from vap_core.publish import publish as keep

    print(f"wrote {to}: {keep(runs, to, replace=replace)} episodes")


@app.command()
def show(
    recording: Annotated[Path, typer.Argument(help="A .rrd file.")],
    png: Annotated[Path, typer.Argument(help="Picture to write.")],
    frame: Annotated[int | None, typer.Option(help="Control step to show; default the middle one.")] = None,
) -> None:
    """Take a picture of a recording as the viewer shows it, without a display.

    Example: python -m vap_core show data/runs/demo/recordings/NAME.rrd shot.png --frame 20
    """
    from vap_core.record import screenshot

    screenshot(recording, png, frame_index=frame)
    print(f"wrote {png}")


@app.command()
def doctor() -> None:
    """Say what works on this machine, and how to mend what does not; status 1 when the main job cannot run.

    Example: python -m vap_core doctor
    """
    from vap_core.doctor import examine

    findings = examine()
    for finding in findings:
        print(finding)
    if any(finding.needed and not finding.works for finding in findings):
        raise typer.Exit(1)


@app.command()
def bench(
    what: Annotated[
        str,
        typer.Argument(
            help="loop: the prompted control loop; suites: every benchmark's simulator; stack: a stack's models; eval: episodes per hour against "
            "lerobot's own loop."
        ),
    ] = "loop",
    steps: Annotated[int, typer.Option(min=5, help="loop: control steps to time.")] = 60,
    workers: Workers = 2,
    stack: StackName = "foundation",
    random_weights: Annotated[bool, typer.Option("--random-weights", help="stack: without weights; they change nothing about speed.")] = False,
    device: Annotated[str | None, typer.Option(help="stack: cpu or cuda; default VAP_DEVICE, or a GPU where there is one.")] = None,
    quick: Annotated[bool, typer.Option("--quick", help="eval: a few steps, to see that it runs; its numbers mean nothing.")] = False,
) -> None:
    """Time a control step by part, as shares and ratios within one run: of the prompted loop, every benchmark's simulator, or a stack's models.

    Example: python -m vap_core bench suites
    """
    from vap_core import bench as loop
    from vap_core import bench_eval, bench_stack, bench_suites
    from vap_core.errors import one_of

    runs = {
        "loop": lambda: loop.run(steps),
        "suites": lambda: bench_suites.run(workers),
        "stack": lambda: bench_stack.run(stack, random=random_weights, device=device),
        "eval": lambda: bench_eval.run(workers, quick),
    }
    if what not in runs:
        raise one_of("bench:", what, runs)
    print(runs[what]())


@weights_app.command("list")
def list_weights() -> None:
    """What is on this machine, what is missing, and how to get it.

    Example: python -m vap_core weights list
    """
    from vap_core.hub import table

    print(table())


@weights_app.command("pull")
def pull_weights(
    stack: Annotated[str, typer.Option("--stack", help="foundation, or foundation-small.")] = "foundation",
    origin: Annotated[Path | None, typer.Option("--from", help="Without internet: a folder with a copy of another machine's.")] = None,
    unpinned: Annotated[bool, typer.Option("--unpinned", help="Take other weights of the same architecture, for example your own.")] = False,
) -> None:
    """Get a stack's weights at their pinned revisions and check them. Interrupted, the same command goes on.

    Example: python -m vap_core weights pull --stack foundation-small
    """
    from vap_core import hub

    hub.pull(hub.names(stack), hub.home(), origin=origin, unpinned=unpinned)


@train_app.command()
def perception(
    out: Annotated[Path, typer.Option(help="Folder of the weights and their manifest.")] = Path("data/weights"),
    scenes: Annotated[int, typer.Option(min=1, help="Rendered training views.")] = 6480,
    seed: Annotated[int, typer.Option(min=0)] = 0,
    minutes: Annotated[float | None, typer.Option(help="Stop training after this long.")] = None,
) -> None:
    """Train the heads of detector, segmenter and encoder on rendered generic objects, and evaluate them on unseen ones.

    Example: python -m vap_core train perception --out data/runs/weights --scenes 400
    """
    from vap_core.training.perception import train

    print(json.dumps(train(out, scenes=scenes, seed=seed, minutes=minutes), indent=1))


@objects_app.command("import")
def import_object(
    file: Annotated[Path, typer.Argument(help="A closed, coloured GLB, OBJ, PLY or STL file.")],
    category: Annotated[str, typer.Option(help="What kind of thing it is: the word you will use after 'my'.")],
    name: Annotated[str | None, typer.Option(help="What to call it; default the file's name.")] = None,
    height_cm: Annotated[float | None, typer.Option(min=0.1, help="Its real height, where the file's units are not metres.")] = None,
    up: Annotated[Literal["y", "z"] | None, typer.Option(help="Axis that points up in the file; default y for GLB and OBJ, z for PLY, STL.")] = None,
    mass_kg: Annotated[float | None, typer.Option(help="Its mass; default from its volume.")] = None,
    colour: Annotated[str | None, typer.Option(help="Paint it all over, for example '#aa3322'.")] = None,
    licence: Annotated[str, typer.Option(help="Kept with the object, for example 'CC-BY 4.0, Jane Doe'.")] = "",
    repair: Annotated[bool, typer.Option("--repair", help="Close holes and turn triangles alike where that is possible.")] = False,
    replace: Annotated[bool, typer.Option("--replace", help="Overwrite an object of this name.")] = False,
    out: Annotated[Path | None, typer.Option(help="Folder of your objects; default VAP_OBJECTS or data/objects.")] = None,
) -> None:
    """Make an object of your own 3-D scan; it takes about half a minute.

    Example: python -m vap_core objects import mug.glb --category cup --height-cm 9
    """
    from vap_core.sim import objects
    from vap_core.sim.scans import bring, stored

    folder, name = out or stored.home(), name or bring.slug(file)
    stored.free(folder, name, replace)
    card, body = bring.bring(
        file, name, category, height_cm=height_cm, up=up, mass_kg=mass_kg, colour=colour, repair=repair, licence=licence,
        say=lambda line: print(line, file=sys.stderr),
    )  # fmt: skip
    place = stored.save(folder, card, body, replace=replace)
    size = " x ".join(f"{100 * side:.1f}" for side in objects.extent_m(objects.own(place)))
    print(f"{card.name}: a {card.category}, {size} cm, {card.mass_kg:g} kg, {len(body.hulls)} convex parts, saved to {place}")
    setting = "" if folder == stored.home() else f"VAP_OBJECTS={folder} "
    print(f"next: {setting}python -m vap_core objects photograph '{card.name}', or in Python scenes.build('wx250s', ['{card.name}'])")


@objects_app.command("list")
def list_objects() -> None:
    """Every object there is, your own last.

    Example: python -m vap_core objects list
    """
    from vap_core.sim.scans.bring import table

    print(table())


@objects_app.command()
def photograph(
    name: Annotated[str, typer.Argument(help="An object; see python -m vap_core objects list.")],
    out: Annotated[Path, typer.Option(help="Folder for the pictures.")] = Path("data/photos"),
    views: Annotated[int, typer.Option(min=1, max=20, help="Pictures, taken all around it.")] = 5,
) -> None:
    """Take reference photos of an object, as one walks around it.

    Example: python -m vap_core objects photograph cup-personal
    """
    from vap_core.sim.objects import get
    from vap_core.sim.studio import write_views

    model = get(name)
    paths = write_views(model, out, views)
    print(f"wrote {views} pictures to {out}")
    print(f"next: python -m vap_core register '{name}' --category '{model.category}' {' '.join(f"'{path}'" for path in paths)}")


def _study(tasks: tuple[tuple[str, str], ...], methods: list[str] | None, *, policy: str, **options: Any) -> "Study":
    from vap_core.experiments import INSIDERS, Study

    asked = [name for each in methods or () for name in each.split(",") if name]
    usual = ("generic",) if policy in INSIDERS else ("generic", "vap")
    return Study(tasks, tuple(dict.fromkeys(asked)) or usual, policy=policy, **options)


def _run(study: "Study", out: Path, workers: int, record: "Record", retries: int, address: str | None = None) -> None:
    from vap_core.cluster import spread
    from vap_core.engine import run
    from vap_core.processes import results
    from vap_core.report import conclude
    from vap_core.statistics import foresight

    if len(study.methods) > 1:
        print(foresight([row for suite, task in study.tasks for row in study.rows(suite, task)]), file=sys.stderr)
    table = run(study, out, workers=workers, record=record, retries=retries, spread=spread(address) if address else results)
    print(conclude(study, table, out))
    if study.audit:
        from vap_core.audit import verdict

        print("\n" + verdict(out))


def _note(domain: str, by_hand: bool, mend: str) -> None:
    if domain and not by_hand:
        print(NOTE.format(domain=domain, mend=mend), file=sys.stderr)
