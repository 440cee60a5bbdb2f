"""The group measure: one part of the method or of a policy at a time."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer

from vap_core.cli.command import (
    Publish,
    RandomSeed,
    RunFolder,
    RunFolderOr,
    StackName,
    Suites,
    Workers,
    made,
    names,
    takes,
)

app = typer.Typer(
    no_args_is_help=True,
    help="Measure one part: perception, photos, objects, parsers, policy, obedience, tokens, "
    "embeddings, attention, calibration.",
)


def _print(text: str, written: Any = ()) -> None:
    print(text)
    if written:
        print(f"wrote {', '.join(map(str, written))}")


@dataclass(frozen=True)
class OfPerception:
    """The options of measure perception."""

    stack: StackName = "embedded"
    suite: Suites = None
    workers: Workers = 2
    out: RunFolder = Path("data/runs/perception")
    quick: Annotated[
        bool,
        typer.Option(
            "--quick", help="Two opening frames per task and one tracked episode per suite."
        ),
    ] = False
    publish: Publish = None


@app.command("perception")
@takes(OfPerception)
def eval_perception(asked: OfPerception) -> None:
    """Measure perception against the simulator: opening frames, tracks through whole expert
    episodes, and time. Interrupted, it goes on.

    Example: ./vap measure perception --suite simpler-bridge --quick
    """
    from vap_core.perception.foundation.weights import check_present
    from vap_core.perception.stacks import check_stack
    from vap_core.simulation.suites import BENCHMARKS
    from vap_core.study.survey import Survey, conclude, publish, run_survey

    check_stack(asked.stack)
    check_present(asked.stack)
    survey = made(Survey, asked, suites=tuple(dict.fromkeys(asked.suite or BENCHMARKS)))
    tables = run_survey(survey, asked.out, workers=asked.workers)
    text = conclude(tables, survey.stack, asked.out)
    _print(text, asked.publish and publish(asked.out, asked.publish))


@dataclass(frozen=True)
class OfPhotos:
    """The options of measure photos."""

    folder: Annotated[
        Path,
        typer.Argument(
            help="Holds references/OBJECT/*.jpg; scenes/*.jpg; scenes.csv with a line "
            "scene,object,x0,y0,x1,y1 for every object of every scene, without box where the "
            "object is absent; optional references/boxes.csv with photo,x0,y0,x1,y1 (photo as "
            "OBJECT/FILE) and objects.csv with object,category (else an object's name is its "
            "kind), masks/SCENE/OBJECT.png. Pixels of the upright photo, far corner exclusive.",
        ),
    ]
    stack: StackName = "embedded"
    clips: Annotated[
        bool,
        typer.Option(
            "--clips",
            help="Follow objects through clips, too: a window pans from each scene to a copy of "
            "it and back, with every object twice.",
        ),
    ] = False
    out: RunFolderOr = None


@app.command("photos")
@takes(OfPhotos)
def eval_photos(asked: OfPhotos) -> None:
    """Measure registering, grounding and the vote on photos of your own, against the boxes that you
    give. Interrupted, it goes on.

    Example: ./vap measure photos my-photos
    Example: ./vap measure photos my-photos --clips
    """
    from vap_core.study.photos import measure_photos

    out = asked.out or Path(f"data/runs/photos-{asked.folder.resolve().name}")
    print(measure_photos(asked.folder, out, asked.stack, clips=asked.clips))


@dataclass(frozen=True)
class OfObjects:
    """The options of measure objects."""

    folder: Annotated[
        Path,
        typer.Argument(
            help="Objects that `objects import --out` made; or 3-D files with objects.csv: a line "
            "file,category,height_cm,groups each, the last two may be empty.",
        ),
    ]
    suite: Annotated[
        list[str] | None,
        typer.Option(help="A suite; repeatable. Each object takes its tasks of the same category."),
    ] = None
    episodes: Annotated[
        int, typer.Option(min=1, help="Episodes per object and task, spread over its list.")
    ] = 4
    policy: Annotated[
        str, typer.Option(help="Default mini-pi0 where one ships for the suite, else scripted.")
    ] = ""
    views_only: Annotated[
        bool, typer.Option("--views-only", help="Look at the opening views, and run no episodes.")
    ] = False
    stack: StackName = "embedded"
    out: RunFolderOr = None


@app.command("objects")
@takes(OfObjects)
def eval_objects(asked: OfObjects) -> None:
    """Measure objects of your own in a suite's scenes, each in the target's place among its
    look-alikes: found in opening views, and fetched by VAP where the expert can. Interrupted, it
    goes on.

    Example: ./vap measure objects data/scans
    """
    from vap_core.study.objects import ObjectMeasurement, measure_objects

    suites = tuple(dict.fromkeys(asked.suite or ["tabletop"]))
    out = asked.out or Path(f"data/runs/objects-{asked.folder.resolve().name}")
    print(measure_objects(made(ObjectMeasurement, asked, suites=suites), out))


@app.command("calibration")
def calibrate(
    stack: StackName = "embedded",
    photos: Annotated[
        list[Path] | None,
        typer.Option(help="A photo set in the form of measure photos; repeatable."),
    ] = None,
    scenes: Annotated[
        int, typer.Option(min=0, help="Rendered development scenes; 0: photos alone.")
    ] = 24,
    price: Annotated[
        float,
        typer.Option(
            min=0.0,
            max=50.0,
            help="Per cent of the rightly elected objects that may be refused.",
        ),
    ] = 3.0,
    keep: Annotated[
        bool,
        typer.Option(
            "--keep",
            help="Write the chosen thresholds beside the weights of a foundation stack, which then "
            "uses them. Of the embedded stack it is the threshold for photos, which ground and "
            "inspect-dataset then use, and measure photos and attached checkpoints do not; of a "
            "stack of your own without thresholds it is both. A stack with an embedded part needs "
            "--photos.",
        ),
    ] = False,
    out: RunFolderOr = None,
) -> None:
    """Measure from which cosine on an object is in view: what each threshold costs and brings, on
    development scenes with and without the object. Interrupted, it goes on.

    Example: ./vap measure calibration --scenes 8
    Example: ./vap measure calibration --photos my-photos --scenes 0 --keep
    """
    from vap_make.calibration.run import calibrate, keep_choice, refuse_keep

    if keep:
        refuse_keep(stack, photos or ())
    report, chosen = calibrate(
        stack,
        out or Path(f"data/runs/calibrate-{stack}"),
        scenes=scenes,
        photos=photos or (),
        price=price / 100,
    )
    print(report)
    if keep:
        print(f"wrote {keep_choice(stack, chosen)}")


@dataclass(frozen=True)
class OfParsers:
    """The options of measure parsers."""

    parser: Annotated[
        str,
        typer.Option(
            help="Parsers, with commas: rule, embedding, chat, or addresses of endpoints."
        ),
    ] = "rule,embedding"
    suite: Annotated[str, typer.Option(help="Only these suites, with commas. Default: all.")] = ""
    part: Annotated[
        str,
        typer.Option(
            help="Only these parts, with commas: tune, check-1 to check-4, and the held-out test. "
            "Default: all."
        ),
    ] = ""
    limit: Annotated[
        int | None,
        typer.Option(min=1, help="So many paraphrases of every suite and part. Default: all."),
    ] = None
    publish: Publish = None


@app.command("parsers")
@takes(OfParsers)
def eval_parsers(asked: OfParsers) -> None:
    """Parse over 200 paraphrased instructions a suite, and print how often the object is right.

    Example: ./vap measure parsers
    Example: ./vap measure parsers --parser chat --part test --limit 20
    """
    import pandas as pd

    from vap_core.study.parsers import PARTS, ParserMeasurement, publish, text

    given = {"parsers": names(asked.parser), "suites": names(asked.suite)}
    measurement = made(ParserMeasurement, asked, **given, parts=names(asked.part) or PARTS)
    table = pd.DataFrame(measurement.rows())
    _print(text(table), asked.publish and publish(table, asked.publish))


@app.command("policy")
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
            help="How the target is named, with commas: tinted; coloured, of a dyed target; "
            "described; plain."
        ),
    ] = "tinted,coloured,described,plain",
    workers: Workers = 2,
    out: Annotated[
        Path | None,
        typer.Option(
            help="A table to add the episodes to, for example data/results/probe.parquet; those of "
            "the same suite, policy and way in it are replaced."
        ),
    ] = None,
) -> None:
    """Measure what a policy can do with generic objects that no film has shown, told by a tint, by
    its real colour, by words, or not at all.

    Example: ./vap measure policy --suite simpler-bridge --scenes 4
    Example: ./vap measure policy --suite simpler-bridge --ways tinted,coloured
    """
    from vap_core.base.errors import BadStudy
    from vap_core.simulation import suites
    from vap_core.study.trials import Study
    from vap_make.policy.probe import conclude, keep, kept, probe

    tasks = tuple((suite, task.name) for task in suites.suite(suite).tasks)
    checkpoint = Study(tasks, ("generic",), policy=policy).checkpoint(suite)
    if not checkpoint:
        raise BadStudy(
            f"measure policy: {policy!r} has no weights; "
            "take mini-pi0, or a lerobot checkpoint's folder or hub id."
        )
    if out is not None:
        kept(out)  # refused before the work; read again by keep: others may add to it meanwhile
    table = probe(
        checkpoint,
        suite,
        scenes=scenes,
        ways=names(ways),
        workers=workers,
    )
    print(conclude(table))
    if out is not None:
        keep(table, out)
        print(f"wrote {out}")


@app.command("obedience")
def eval_obedience(
    policy: Annotated[
        str, typer.Option(help="Any policy of eval: ws://HOST:PORT, a checkpoint, mini-pi0.")
    ],
    suite: Annotated[str, typer.Option(help="A suite with ground truth.")],
    stack: StackName = "embedded",
    seed: RandomSeed = 0,
    workers: Workers = 2,
    out: RunFolderOr = None,
) -> None:
    """Does a policy obey a tint? True, wrong and no masks on the same 30 to 150 episodes, stopped
    as soon as it is known; a page with one sentence and two recordings. Interrupted, it goes on.

    Example: ./vap measure obedience --policy "ws://gpu:8000?map=bridge"
        --suite simpler-bridge
    """
    from vap_core.base.errors import BadStudy
    from vap_core.policies.names import PRIVILEGED
    from vap_core.study.obedience import Obedience, run

    if policy in PRIVILEGED:
        raise BadStudy(f"measure obedience: {policy} sees no pictures; name another policy.")
    folder = out or Path("data/runs", f"obedience-{suite}")
    print(run(Obedience(suite, policy, stack, seed), folder, workers=workers))


@dataclass(frozen=True)
class OfTokens:
    """The options of measure tokens."""

    suite: Suites = None
    k: Annotated[str, typer.Option("--k", help="Numbers of photos to learn from, with commas.")] = (
        "1,3,5,7"
    )
    epochs: Annotated[
        int,
        typer.Option(min=1, help="Passes over the augmented photos; the soft prompt's own is 20."),
    ] = 20
    workers: Workers = 1
    out: RunFolder = Path("data/runs/tokens")
    publish: Publish = None


@app.command("tokens")
@takes(OfTokens)
def eval_tokens(asked: OfTokens) -> None:
    """Learn the token of every personal object from few and from many photos, in the
    vision-language model and in the policies; measure what it recognizes, and which object of
    listed episodes the model chooses by it. Interrupted, it goes on; about a minute and a half a
    token and core.

    Example: ./vap measure tokens --suite simpler-bridge --k 5 --epochs 2
        --out data/runs/few-tokens
    """
    from vap_core.base.errors import BadStudy
    from vap_core.simulation.suites import BENCHMARKS
    from vap_core.study.measurement import measure
    from vap_core.study.tokens import Tokens, publish, report

    ks = [int(number) for number in names(asked.k) if number.isdecimal() and int(number)]
    if len(ks) != len(names(asked.k)) or not ks:
        raise BadStudy(f"measure tokens: --k {asked.k}: give numbers of photos, such as 1,3,5,7.")
    suites = tuple(dict.fromkeys(asked.suite or BENCHMARKS))
    tables = measure(made(Tokens, asked, suites=suites, ks=ks), asked.out, workers=asked.workers)
    _print(report(tables), asked.publish and publish(asked.out, asked.publish))


@app.command("embeddings")
def embeddings(
    vlm: Annotated[
        Path | None,
        typer.Argument(
            help="Folder of a vision-language model, such as PaliGemma's. Default the shipped one "
            "that each policy grew from."
        ),
    ] = None,
    policies: Annotated[
        list[Path] | None,
        typer.Argument(
            help="Folders of policies that were initialised from it: pi0, pi0.5, mini-pi0. Default "
            "the suites' default policies."
        ),
    ] = None,
    suite: Annotated[
        str,
        typer.Option(
            help="Whose words to compare, too. Default the one in the policy's name, or all."
        ),
    ] = "",
    out: Annotated[
        Path | None, typer.Option(help="Keep the rows in this .parquet or .csv file, too.")
    ] = None,
) -> None:
    """Compare the word embeddings of a vision-language model with those of policies: cosine, CKA,
    kNN@1, with the paper's numbers below.

    Example: ./vap measure embeddings
    Example: ./vap measure embeddings models/paligemma-3b-pt-224 models/pi0 models/pi05
    """

    from vap_core.base.errors import BadPolicy
    from vap_core.simulation.suites import BENCHMARKS
    from vap_core.study.embeddings import check_output, keep, report, spaces
    from vap_core.study.trials import shipped

    folders = list(policies or ())
    if vlm is None:
        folders = [shipped(name) for name in BENCHMARKS if shipped(name).is_dir()]
    if not folders:
        raise BadPolicy("embeddings: name the folder of a policy after the model's.")
    if out is not None:
        check_output(out)
    table = spaces(vlm, folders, suite)
    print(report(table))
    if out is not None:
        keep(table, out)
        print(f"wrote {out}")


@app.command("attention")
def attention(
    run: Annotated[
        Path, typer.Argument(help="Run folder of eval or rollout, or a table that publish wrote.")
    ],
    suite: Annotated[
        str, typer.Option(help="Only these suites, with commas. Default: all of the run.")
    ] = "",
    method: Annotated[
        str,
        typer.Option(
            "--methods", "--method", help="Only these methods, with commas. Default: all."
        ),
    ] = "",
    policy: Annotated[
        str,
        typer.Option(
            help="Only the policy whose label in the table holds this, such as tabletop-longer@."
        ),
    ] = "",
    episodes: Annotated[
        int | None,
        typer.Option(
            min=1, help="Episodes per task and method, spread evenly. Default: all of the run."
        ),
    ] = None,
    explain: Annotated[
        int,
        typer.Option(
            min=0,
            help="Episodes per task and method that also get the causal measures: gradient times "
            "activation, and masked patches.",
        ),
    ] = 2,
    out: Annotated[
        Path | None,
        typer.Option(
            help="Folder of the tables; what is found there goes on. Default: RUN/attention, or "
            "data/runs/attention-TABLE."
        ),
    ] = None,
    publish: Publish = None,
    record: Annotated[
        str,
        typer.Option(
            metavar="SUITE/TASK/METHOD/EPISODE",
            help="Measure nothing: record this episode with its maps, in the folder of --out.",
        ),
    ] = "",
    workers: Workers = 2,
) -> None:
    """Run the episodes of a run again, measure where every query looks, and print the patterns; or
    record one of them with its maps.

    Example: ./vap measure attention data/results/mini_pi0.parquet --method soft,vap
        --suite vlabench
    Example: ./vap measure attention data/results/mini_pi0.parquet
        --record simpler-bridge/pick-shaver/soft/12
    """
    from vap_core.base.errors import command
    from vap_core.study import attention as study
    from vap_core.study.attention_figures import text

    if out is None:
        table = run.suffix == ".parquet"
        out = Path("data/runs") / f"attention-{run.stem}" if table else run / "attention"
    if record:
        path, step = study.record(run, record, out / "recordings", out / "memory", policy)
        words = ("view", path, "--png", f"{path.stem}.png", "--attention", "--frame", str(step))
        print(f"wrote {path}\nnext: {command(*words)}")
        return
    wanted = study.Wanted(
        suites=tuple(names(suite)),
        methods=tuple(names(method)),
        policy=policy,
        episodes=episodes,
        explain=explain,
    )
    found = study.run_replay(run, out, wanted, workers=workers)
    if publish is not None:
        study.publish(out, publish)
    print(text(found))
