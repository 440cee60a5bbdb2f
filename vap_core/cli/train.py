"""Commands that train shipped parts again: train perception, demonstrations, vlm, policy."""

import json
from pathlib import Path
from typing import Annotated

import typer

Jobs = Annotated[int | None, typer.Option(min=1, help="Processes that render. Default one a core.")]
Rendered = Annotated[
    Path | None, typer.Option(help="Folder of rendered scenes. Default data/cache.")
]
app = typer.Typer(
    no_args_is_help=True,
    help="Train shipped parts again; every training resumes after an interruption.",
)


@app.command()
def perception(
    out: Annotated[Path, typer.Option(help="Folder of the weights and their manifest.")] = Path(
        "data/weights"
    ),
    scenes: Annotated[int, typer.Option(min=1, help="Rendered training views.")] = 6480,
    seed: Annotated[int, typer.Option(min=0)] = 0,
    minutes: Annotated[
        float | None,
        typer.Option(
            min=0.0, help="Stop after this long, with nothing written; the same command goes on."
        ),
    ] = None,
    cache: Rendered = None,
    jobs: Jobs = None,
) -> None:
    """Train the heads of detector, segmenter and encoder on rendered generic objects, and evaluate
    them on unseen ones.

    Example: python -m vap_core train perception --out data/runs/weights --scenes 400
    """
    from vap_make.perception.train import CACHE, train

    rendered = CACHE if cache is None else cache / CACHE.name
    entry = train(out, scenes=scenes, seed=seed, minutes=minutes, cache=rendered, jobs=jobs)
    if entry is None:
        print(
            f"stopped after {minutes:g} minutes; nothing is written yet, the same command goes on."
        )
        return
    print(json.dumps(entry, indent=1))


@app.command()
def demonstrations(
    suite: Annotated[
        str, typer.Option(help="The benchmark whose robot, cameras and kinds of task are shown.")
    ],
    stages: Annotated[
        int | None,
        typer.Option(
            min=1,
            help="Scenes with generic objects, of about eight demonstrations each. Default the "
            "recipe's.",
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(help="Folder of the dataset. Default data/runs/demonstrations-SUITE."),
    ] = None,
    seed: Annotated[int, typer.Option(min=0)] = 0,
    jobs: Annotated[
        int | None, typer.Option(min=1, help="Processes that film. Default one a core.")
    ] = None,
) -> None:
    """Film the scripted expert with generic objects, as a LeRobotDataset v3. Interrupted, the same
    command goes on.

    Example: python -m vap_core train demonstrations --suite simpler-bridge --stages 2
        --out data/runs/small-demonstrations
    """
    from vap_core.base.errors import one_of
    from vap_core.simulation.suites import BENCHMARKS

    if suite not in BENCHMARKS:
        raise one_of("train demonstrations: suite", suite, BENCHMARKS)
    from vap_make.films.dataset import ABOUT, write
    from vap_make.films.scenes import CACHE
    from vap_make.policy.train import FILMS
    from vap_make.recipe import RECIPES

    folder = out or Path(f"data/runs/demonstrations-{suite}")
    was_complete = (folder / ABOUT).exists()
    stages = stages or RECIPES[suite].stages
    made = write(suite, stages, folder, cache=CACHE / FILMS, seed=seed, jobs=jobs)
    digest = made["data_sha256"]
    text = f"{folder}: {len(made['episodes'])} episodes of {stages} stages, sha256 {digest}"
    if was_complete:
        text += "; it was whole already."
    print(text)


@app.command()
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
        float | None, typer.Option(min=0.0, help="Stop after this long; the same command goes on.")
    ] = None,
    cache: Rendered = None,
    jobs: Jobs = None,
) -> None:
    """Train the mini-PaliGemma that policies grow from, on questions about generic objects.
    Interrupted, the same command goes on.

    Example: python -m vap_core train vlm --stages 20 --steps 100 --out data/runs/small-vlm
    """
    from vap_core.base.commands import command
    from vap_make.films.scenes import CACHE
    from vap_make.vlm.train import Recipe, train

    recipe = Recipe(stages=stages, steps=steps, seed=seed)
    about = train(recipe, out, minutes=minutes, cache=cache or CACHE, jobs=jobs)
    print(json.dumps(about["held_out"], indent=1))
    print(f"CPU hours: {json.dumps(about['cpu_hours'])}")
    print(f"next: {command('train', 'policy', '--suite', 'simpler-bridge', '--vlm', out)}")


@app.command()
def policy(
    suite: Annotated[
        str, typer.Option(help="The benchmark whose robot, cameras and kinds of task it learns.")
    ],
    out: Annotated[
        Path | None,
        typer.Option(
            help="Folder of the checkpoint; a training found there goes on. Default "
            "data/runs/trained/mini-pi0-SUITE."
        ),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of films, order and noise.")] = 0,
    tint_share: Annotated[
        float | None,
        typer.Option(min=0.0, max=1.0, help="Share of tinted scenes. Default the recipe's."),
    ] = None,
    angle_noise: Annotated[
        float | None,
        typer.Option(
            min=0.0,
            max=1.0,
            help="Deviation (rad) of the noise with which the arm's angles are read. Default the "
            "recipe's.",
        ),
    ] = None,
    stages: Annotated[
        int | None,
        typer.Option(
            min=2,
            help="Scenes with generic objects, of about eight demonstrations each. Default the "
            "recipe's.",
        ),
    ] = None,
    steps: Annotated[
        int | None, typer.Option(min=1, help="Optimiser steps. Default the recipe's.")
    ] = None,
    batch: Annotated[
        int | None,
        typer.Option(min=1, help="Frames a step. Default the recipe's."),
    ] = None,
    rate: Annotated[
        float | None,
        typer.Option(min=1e-8, help="The highest learning rate. Default the recipe's."),
    ] = None,
    vlm: Annotated[
        Path | None,
        typer.Option(
            help="The mini-PaliGemma that it grows from. Default mini-paligemma beside the "
            "checkpoint's folder, trained first."
        ),
    ] = None,
    start: Annotated[
        Path | None,
        typer.Option(
            help="A trained mini-pi0 of the suite whose weights it begins with; --vlm is then the "
            "model that learned words are taught in. Default the recipe's, which for the four "
            "benchmarks is none."
        ),
    ] = None,
    demonstrations: Annotated[
        Path | None,
        typer.Option(
            "--demonstrations",
            help="A dataset of train demonstrations to learn from, with all of its stages, instead "
            "of filming; not beside --stages.",
        ),
    ] = None,
    cache: Annotated[
        Path | None,
        typer.Option(help="Folder of rendered films and scenes. Default data/cache."),
    ] = None,
    jobs: Annotated[
        int | None,
        typer.Option(
            min=1,
            help="Processes that render, teach words and draw batches. Default one a core.",
        ),
    ] = None,
    device: Annotated[
        str | None,
        typer.Option(
            help="Where the policy's steps run: cpu or cuda; default VAP_DEVICE, or a GPU where "
            "there is one."
        ),
    ] = None,
    minutes: Annotated[
        float | None,
        typer.Option(
            min=0.0, help="Stop the policy's steps after this long; the same command goes on."
        ),
    ] = None,
) -> None:
    """Train a mini-pi0, the small frozen policy, from nothing, by the recipe of its suite: one to
    five CPU hours. Interrupted, the same command goes on.

    Example: python -m vap_core train policy --suite simpler-bridge --stages 40 --steps 500
        --vlm data/policies/mini-paligemma-tint-free --out data/runs/small-policy
    Example: python -m vap_core train policy --suite simpler-fractal --seed 1 --device cuda
    """
    from dataclasses import replace

    from vap_core.base.commands import command
    from vap_core.base.errors import BadStudy, one_of
    from vap_make.recipe import RECIPES

    if suite not in RECIPES:
        raise one_of("train policy: suite", suite, RECIPES)
    if demonstrations is not None and stages is not None:
        raise BadStudy(
            "train policy: --stages films scenes, --demonstrations takes all stages of a dataset "
            "that is there; leave one out."
        )
    from vap_make.films.scenes import CACHE
    from vap_make.policy.train import HELD_OUT, require_startable, train
    from vap_make.vlm.train import make

    folder = out or Path(f"data/runs/trained/mini-pi0-{suite}")
    standard = RECIPES[suite]
    recipe = replace(
        standard,
        seed=seed,
        tint_share=standard.tint_share if tint_share is None else tint_share,
        angle_noise_rad=standard.angle_noise_rad if angle_noise is None else angle_noise,
        stages=stages or standard.stages,
        steps=steps or standard.steps,
        batch=batch or standard.batch,
        rate=standard.rate if rate is None else rate,
        start=standard.start if start is None else str(start),
    )
    rendered = cache or CACHE
    grows_from = vlm
    if vlm is None and not recipe.start:
        model = folder.parent / "mini-paligemma"
        require_startable(
            recipe, folder, model, demonstrations=demonstrations, cache=rendered, device=device
        )
        grows_from = make(model, cache=rendered, jobs=jobs)
    about = train(
        recipe,
        folder,
        vlm=grows_from,
        demonstrations=demonstrations,
        minutes=minutes,
        cache=rendered,
        jobs=jobs,
        device=device,
    )
    if about["held_out"]:
        print(json.dumps(about["held_out"], indent=1))
    else:
        print(f"no film was held out (every {HELD_OUT}th stage is), so nothing was measured.")
    print(f"CPU hours: {json.dumps(about['cpu_hours'])}")
    words = ("eval", "--suite", suite, "--policy", folder, "--methods", "generic,vap")
    print(f"next: {command(*words, '--episodes', '4', '--out', f'{folder}-eval')}")
