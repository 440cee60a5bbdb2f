"""Commands about this machine and what it measures: doctor, weights, bench, eval-perception, train, show."""

import json
from pathlib import Path
from typing import Annotated

import typer

from vap_core.cli.options import StackName, Workers, names

app = typer.Typer()
train_app = typer.Typer(
    no_args_is_help=True,
    help="Train shipped parts again; every training resumes after an interruption.",
)
app.add_typer(train_app, name="train")
weights_app = typer.Typer(
    no_args_is_help=True,
    help="The foundation stack's weights: what is there, and how to get the rest.",
)
app.add_typer(weights_app, name="weights")


@app.command("eval-perception")
def eval_perception(
    stack: StackName = "embedded",
    suite: Annotated[
        list[str] | None, typer.Option(help="A benchmark; repeatable. Default all four.")
    ] = None,
    episodes: Annotated[
        int | None,
        typer.Option(
            min=1, help="Opening frames per task, as episodes spread evenly over its list."
        ),
    ] = None,
    jobs: Annotated[int, typer.Option(min=1, help="Processes.")] = 2,
    out: Annotated[Path, typer.Option(help="Run folder; a run found there is resumed.")] = Path(
        "data/runs/perception"
    ),
    quick: Annotated[
        bool,
        typer.Option(
            "--quick", help="Two opening frames per task and one tracked episode per suite."
        ),
    ] = False,
    publish: Annotated[
        Path | None,
        typer.Option(help="Keep the tables in this folder too, as perception_NAME.parquet."),
    ] = None,
) -> None:
    """Measure perception against the simulator: opening frames, tracks through whole expert episodes, and time. Interrupted, it goes on.

    Example: python -m vap_core eval-perception --suite simpler-bridge --quick
    """
    from vap_core.evaluation.perception.report import conclude
    from vap_core.evaluation.perception.run import Survey, run
    from vap_core.evaluation.perception.run import publish as keep
    from vap_core.simulation import suites as known

    asked = Survey(stack, tuple(dict.fromkeys(suite or known.BENCHMARKS)), episodes, quick)
    print(conclude(run(asked, out, jobs=jobs), asked.stack, out))
    if publish is not None:
        print("wrote " + ", ".join(map(str, keep(out, publish))))


@app.command("eval-policy")
def eval_policy(
    suite: Annotated[str, typer.Option(help="The benchmark that the policy was trained for.")],
    policy: Annotated[
        str, typer.Option(help="mini-pi0, or a checkpoint's folder or hub id.")
    ] = "mini-pi0",
    scenes: Annotated[
        int,
        typer.Option(min=1, help="Scenes of four episodes each, spread over the suite's tasks."),
    ] = 24,
    ways: Annotated[
        str,
        typer.Option(
            help="How the target is told, with commas: tinted, painted, described, plain."
        ),
    ] = "tinted,painted,described,plain",
    execute: Annotated[
        int | None,
        typer.Option(
            min=1,
            help="Actions of each chunk to carry out before the policy is asked again. Default as the checkpoint says.",
        ),
    ] = None,
    seed: Annotated[int, typer.Option(min=0)] = 0,
    workers: Workers = 2,
    out: Annotated[
        Path | None,
        typer.Option(
            help="A table to add the episodes to, for example data/results/probe.parquet."
        ),
    ] = None,
) -> None:
    """Measure what a policy can do with generic objects that no film has shown, told by a tint, by paint, by words, or not at all.

    Example: python -m vap_core eval-policy --suite simpler-bridge --scenes 4
    Example: python -m vap_core eval-policy --suite tabletop --ways tinted --execute 10
    """
    from vap_core.base.errors import BadStudy
    from vap_core.evaluation.study import Study
    from vap_core.simulation import suites as known
    from vap_core.training.policy.probe import conclude, keep, probe

    study = Study(
        tuple((suite, task.name) for task in known.suite(suite).tasks), ("generic",), policy=policy
    )
    if not study.checkpoint(suite):
        raise BadStudy(
            f"eval-policy: {policy!r} has no weights; take mini-pi0, or a lerobot checkpoint's folder or hub id."
        )
    table = probe(
        study.checkpoint(suite),
        suite,
        scenes=scenes,
        ways=names(ways),
        execute=execute,
        seed=seed,
        workers=workers,
    )
    print(conclude(table))
    if out is not None:
        keep(table, out)
        print(f"wrote {out}")


@app.command()
def show(
    recording: Annotated[Path, typer.Argument(help="A .rrd file.")],
    png: Annotated[Path, typer.Argument(help="Picture to write.")],
    frame: Annotated[
        int | None, typer.Option(help="Control step to show; default the middle one.")
    ] = None,
) -> None:
    """Take a picture of a recording as the viewer shows it, without a display.

    Example: python -m vap_core show data/runs/demo/recordings/NAME.rrd shot.png --frame 20
    """
    from vap_core.recording import screenshot

    screenshot(recording, png, frame_index=frame)
    print(f"wrote {png}")


@app.command()
def doctor() -> None:
    """Say what works on this machine, and how to mend what does not; status 1 when the main job cannot run.

    Example: python -m vap_core doctor
    """
    from vap_core.cli.doctor import examine

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
            help="loop: the prompted control loop; suites: every benchmark's simulator; stack: a stack's models; policy: the shipped policies; "
            "eval: episodes per hour against lerobot's own loop; engine: a Ray cluster on this machine against local processes; "
            "query: a question to a thousand recordings; style: how the source reads."
        ),
    ] = "loop",
    steps: Annotated[int, typer.Option(min=5, help="loop: control steps to time.")] = 60,
    workers: Workers = 2,
    stack: StackName = "foundation",
    random_weights: Annotated[
        bool,
        typer.Option(
            "--random-weights", help="stack: without weights; they change nothing about speed."
        ),
    ] = False,
    device: Annotated[
        str | None,
        typer.Option(help="stack: cpu or cuda; default VAP_DEVICE, or a GPU where there is one."),
    ] = None,
    quick: Annotated[
        bool,
        typer.Option(
            "--quick",
            help="policy, eval, engine, query: a few steps, to see that it runs; its numbers mean nothing.",
        ),
    ] = False,
) -> None:
    """Time a control step by part, as shares and ratios within one run: of the prompted loop, every benchmark's simulator, the models.

    Example: python -m vap_core bench suites
    """
    from vap_core.base.errors import one_of
    from vap_core.cli.bench import engine as bench_engine
    from vap_core.cli.bench import eval as bench_eval
    from vap_core.cli.bench import loop as loop
    from vap_core.cli.bench import policy as bench_policy
    from vap_core.cli.bench import query as bench_query
    from vap_core.cli.bench import stack as bench_stack
    from vap_core.cli.bench import style as bench_style
    from vap_core.cli.bench import suites as bench_suites

    runs = {
        "loop": lambda: loop.run(steps),
        "suites": lambda: bench_suites.run(workers),
        "stack": lambda: bench_stack.run(stack, random=random_weights, device=device),
        "policy": lambda: bench_policy.run(quick),
        "eval": lambda: bench_eval.run(workers, quick),
        "engine": lambda: bench_engine.run(workers, quick),
        "query": lambda: bench_query.run(quick=quick),
        "style": bench_style.run,
    }
    if what not in runs:
        raise one_of("bench:", what, runs)
    print(runs[what]())


@weights_app.command("list")
def list_weights() -> None:
    """What is on this machine, what is missing, and how to get it.

    Example: python -m vap_core weights list
    """
    from vap_core.perception.foundation.store import weights_table

    print(weights_table())


@weights_app.command("pull")
def pull_weights(
    stack: Annotated[
        str, typer.Option("--stack", help="foundation, or foundation-small.")
    ] = "foundation",
    origin: Annotated[
        Path | None,
        typer.Option("--from", help="Without internet: a folder with a copy of another machine's."),
    ] = None,
    unpinned: Annotated[
        bool,
        typer.Option(
            "--unpinned", help="Take other weights of the same architecture, for example your own."
        ),
    ] = False,
) -> None:
    """Get a stack's weights at their pinned revisions and check them. Interrupted, the same command goes on.

    Example: python -m vap_core weights pull --stack foundation-small
    """
    from vap_core.perception.foundation.downloads import pull
    from vap_core.perception.foundation.sources import models_of
    from vap_core.perception.foundation.store import store_folder

    pull(models_of(stack), store_folder(), origin=origin, unpinned=unpinned)


@train_app.command()
def perception(
    out: Annotated[Path, typer.Option(help="Folder of the weights and their manifest.")] = Path(
        "data/weights"
    ),
    scenes: Annotated[int, typer.Option(min=1, help="Rendered training views.")] = 6480,
    seed: Annotated[int, typer.Option(min=0)] = 0,
    minutes: Annotated[float | None, typer.Option(help="Stop training after this long.")] = None,
) -> None:
    """Train the heads of detector, segmenter and encoder on rendered generic objects, and evaluate them on unseen ones.

    Example: python -m vap_core train perception --out data/runs/weights --scenes 400
    """
    from vap_core.training.perception.train import train

    print(json.dumps(train(out, scenes=scenes, seed=seed, minutes=minutes), indent=1))


@train_app.command()
def demonstrations(
    suite: Annotated[
        str, typer.Option(help="The benchmark whose robot, cameras and kinds of task are shown.")
    ],
    stages: Annotated[
        int,
        typer.Option(
            min=1, help="Scenes with generic objects, of about eight demonstrations each."
        ),
    ] = 400,
    out: Annotated[
        Path | None,
        typer.Option(help="Folder of the dataset. Default data/runs/demonstrations-SUITE."),
    ] = None,
    seed: Annotated[int, typer.Option(min=0)] = 0,
    jobs: Annotated[
        int | None, typer.Option(min=1, help="Processes that film. Default one a core.")
    ] = None,
) -> None:
    """Film the scripted expert with generic objects, as a LeRobotDataset v3. Interrupted, the same command goes on.

    Example: python -m vap_core train demonstrations --suite simpler-bridge --stages 2 --out data/runs/small-demonstrations
    """
    from vap_core.base.errors import one_of
    from vap_core.simulation.suites import BENCHMARKS
    from vap_core.training.films.dataset import ABOUT, write
    from vap_core.training.policy.train import CACHE

    if suite not in BENCHMARKS:
        raise one_of("train demonstrations: suite", suite, BENCHMARKS)
    folder = out or Path(f"data/runs/demonstrations-{suite}")
    whole = (folder / ABOUT).exists()
    made = write(suite, stages, folder, cache=CACHE, seed=seed, jobs=jobs)
    print(
        f"{folder}: {len(made['episodes'])} episodes of {stages} stages, sha256 {made['data_sha256']}"
        + ("; it was whole already." if whole else "")
    )


@train_app.command()
def vlm(
    out: Annotated[
        Path, typer.Option(help="Folder of the model; a training found there goes on.")
    ] = Path("data/runs/mini-paligemma"),
    stages: Annotated[
        int,
        typer.Option(
            min=2, help="Scenes with generic objects, of about sixteen views each; rendered first."
        ),
    ] = 540,
    steps: Annotated[int, typer.Option(min=1, help="Optimiser steps.")] = 1600,
    seed: Annotated[int, typer.Option(min=0)] = 0,
    minutes: Annotated[
        float | None, typer.Option(help="Stop after this long; the same command goes on.")
    ] = None,
) -> None:
    """Train the mini-PaliGemma that policies grow from, on questions about generic objects. Interrupted, the same command goes on.

    Example: python -m vap_core train vlm --stages 20 --steps 100 --out data/runs/small-vlm
    """
    from vap_core.training.vlm.train import Recipe, train

    print(
        json.dumps(
            train(Recipe(stages, steps, seed=seed), out, minutes=minutes)["held_out"], indent=1
        )
    )
    print(f"next: python -m vap_core train policy --suite simpler-bridge --vlm {out}")


@train_app.command()
def policy(
    suite: Annotated[
        str, typer.Option(help="The benchmark whose robot, cameras and kinds of task it learns.")
    ],
    out: Annotated[
        Path | None,
        typer.Option(
            help="Folder of the checkpoint; a training found there goes on. Default data/runs/trained/mini-pi0-SUITE."
        ),
    ] = None,
    stages: Annotated[
        int,
        typer.Option(
            min=2,
            help="Scenes with generic objects, of about eight demonstrations each; filmed first.",
        ),
    ] = 400,
    steps: Annotated[int, typer.Option(min=1, help="Optimiser steps.")] = 12_000,
    batch: Annotated[int, typer.Option(min=1, help="Frames of one optimiser step.")] = 64,
    vlm: Annotated[
        Path | None,
        typer.Option(help="The mini-PaliGemma that it grows from. Default the shipped one."),
    ] = None,
    start: Annotated[
        Path | None,
        typer.Option(help="A mini-pi0 to go on from instead, of the same suite or of another."),
    ] = None,
    demonstrations: Annotated[
        Path | None,
        typer.Option(
            "--demonstrations",
            help="A dataset of train demonstrations to learn from, instead of filming.",
        ),
    ] = None,
    seed: Annotated[int, typer.Option(min=0)] = 0,
    minutes: Annotated[
        float | None, typer.Option(help="Stop after this long; the same command goes on.")
    ] = None,
) -> None:
    """Train a mini-pi0, the small frozen policy, on demonstrations with generic objects. Interrupted, the same command goes on.

    Example: python -m vap_core train policy --suite simpler-bridge --stages 40 --steps 500 --out data/runs/small-policy
    """
    from vap_core.base.errors import one_of
    from vap_core.policies.mini_pi0.teach_token import MODEL
    from vap_core.simulation.suites import BENCHMARKS
    from vap_core.training.policy.train import Recipe, train

    if suite not in BENCHMARKS:
        raise one_of("train policy: suite", suite, BENCHMARKS)
    folder = out or Path(f"data/runs/trained/mini-pi0-{suite}")
    recipe = Recipe(suite, stages, steps, batch, seed=seed)
    print(
        json.dumps(
            train(
                recipe,
                folder,
                vlm=vlm or MODEL,
                start=start,
                demonstrations=demonstrations,
                minutes=minutes,
            )["held_out"],
            indent=1,
        )
    )
    print(
        f"next: python -m vap_core eval --suite {suite} --policy {folder} --methods generic,vap --episodes 4 --out {folder}-eval"
    )
