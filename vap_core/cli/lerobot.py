"""Commands for lerobot's own: attach VAP to a checkpoint, look into a dataset."""

import shlex
from pathlib import Path
from typing import Annotated, Literal

import typer

from vap_core.cli.options import (
    BANK,
    DetectorName,
    EncoderName,
    Memory,
    ObjectNames,
    Speaker,
    StackName,
    TrackerName,
    stack_of,
)

app = typer.Typer()


@app.command("attach")
def attach_command(
    checkpoint: Annotated[
        str, typer.Argument(help="A lerobot checkpoint: its folder, or its hub id, downloaded.")
    ],
    out: Annotated[Path, typer.Argument(help="Folder for the checkpoint with VAP.")],
    memory: Memory = BANK,
    object: ObjectNames = None,
    speaker: Speaker = "",
    stack: StackName = "embedded",
    detector: DetectorName = "",
    encoder: EncoderName = "",
    tracker: TrackerName = "",
    alpha: Annotated[float, typer.Option(min=0, max=1, help="Opacity of the tint.")] = 0.5,
    episodes: Annotated[
        Literal["auto", "vap_step", "reset"],
        typer.Option(
            help="How the start of an episode is known: by the observation vap_step, by a reset of "
            "the preprocessor, or by whichever there is; without either a picture is refused."
        ),
    ] = "auto",
) -> None:
    """Put VAP into a frozen lerobot checkpoint, for lerobot-eval and lerobot-rollout.

    Its files are linked, not changed; one step is added to its preprocessor.

    Example: python -m vap_core attach data/policies/mini-pi0-simpler-bridge-wide-seed-0
        data/runs/mine --memory data/runs/bridge/memory
    """
    from vap_core.base.extras import require

    require("policy", "attach")
    from vap_core.policies.lerobot.step import attach

    stack = stack_of(stack, detector, encoder, tracker)
    attach(
        checkpoint,
        out,
        memory,
        stack=stack,
        objects=object,
        speaker=speaker,
        alpha=alpha,
        episodes=episodes,
    )
    print(f"wrote {out}: the checkpoint, and VAP before it in its preprocessor")
    words = ["lerobot-eval", f"--policy.path={out}", "--env.type=vap"]
    words += [f"--env.task={_task_to_try(checkpoint, memory)}", "--eval.n_episodes=20", "--seed=0"]
    print(f"next: {shlex.join(words)}")


def _task_to_try(checkpoint: str, memory: Path) -> str:
    """A task of the suite that a checkpoint was trained for, of an object in the memory if any.

    SUITE/TASK where the checkpoint does not say its suite.
    """
    from vap_core.memory import load_bank
    from vap_core.policies.lerobot.checkpoints import trained_for
    from vap_core.simulation import suites

    name = trained_for(checkpoint)
    if name not in suites.SUITES:
        return "SUITE/TASK"
    tasks = suites.suite(name).tasks
    known = {remembered.category for remembered in load_bank(memory).values()}
    task = next((task for task in tasks if task.category in known), tasks[0])
    return f"{name}/{task.name}"


@app.command("inspect-dataset")
def inspect_dataset_command(
    path: Annotated[Path, typer.Argument(help="Folder of a LeRobotDataset v3.")],
    instruction: Annotated[
        str, typer.Argument(help='What the robot is to do, for example "pick my cup".')
    ],
    memory: Memory = BANK,
    object: ObjectNames = None,
    speaker: Speaker = "",
    stack: StackName = "embedded",
    detector: DetectorName = "",
    encoder: EncoderName = "",
    tracker: TrackerName = "",
    episodes: Annotated[
        int | None, typer.Option(min=1, help="The first so many episodes; default all.")
    ] = None,
    copy: Annotated[
        Path | None,
        typer.Option(
            help="Folder for a copy of the dataset as the method would show it: prompted pictures "
            "and rewritten tasks, for fine-tuning or replay."
        ),
    ] = None,
    masks: Annotated[
        bool,
        typer.Option(
            "--masks", help="In the copy, the target's mask of every picture, too: vap.mask.CAMERA."
        ),
    ] = False,
    out: Annotated[Path, typer.Option(help="Folder for recordings and the table.")] = Path(
        "data/runs/inspection"
    ),
) -> None:
    """Ground and track a remembered object through recorded episodes: where a view does not find
    it or loses it. Interrupted, the same command goes on.

    Example: python -m vap_core inspect-dataset ~/datasets/desk "pick my cup"
    Example: python -m vap_core inspect-dataset ~/datasets/desk "pick my cup" --episodes 3
        --copy ~/datasets/desk-vap
    """
    from vap_core.base.extras import require

    require("policy", "inspect-dataset")
    from vap_core.analysis.dataset_inspection import TABLE, inspect_dataset, report_table
    from vap_core.base.commands import command
    from vap_core.base.errors import BadDataset

    if masks and copy is None:
        raise BadDataset("inspect-dataset: --masks go into a copy; name its folder with --copy.")
    reports = inspect_dataset(
        path,
        instruction,
        memory,
        stack_of(stack, detector, encoder, tracker),
        out,
        objects=object,
        speaker=speaker,
        episodes=episodes,
        copy=copy,
        masks=masks,
    )
    print(report_table(reports))
    first = out / "episode_000000.rrd"
    copied = f" and the dataset {copy}" if copy is not None else ""
    print(f"wrote {out / TABLE}, {len({r.episode for r in reports})} recordings{copied}")
    print(f"look: {command('view', first)}")
