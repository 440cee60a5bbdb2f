"""Commands about what is your own: photos, 3-D scans, checkpoints, datasets."""

import json
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

import typer

from vap_core.cli.command import BANK, Memory, ObjectNames, Replace, Speaker, StackName

app = typer.Typer()
objects = typer.Typer(
    no_args_is_help=True, help="The objects of the scenes: what there is, and your own 3-D scans."
)
app.add_typer(objects, name="objects")


@app.command()
def register(
    name: Annotated[str, typer.Argument(help="What to call the object, for example mug.")],
    category: Annotated[
        str, typer.Option(help="What kind of thing it is: the word you will use after 'my'.")
    ],
    photos: Annotated[
        list[Path] | None,
        typer.Argument(
            help="One to about ten photos of this very object, or folders of them; five are best."
        ),
    ] = None,
    video: Annotated[
        Path | None,
        typer.Option(help="A short clip around the object: sharp frames of it are the photos."),
    ] = None,
    frames: Annotated[int, typer.Option(min=1, help="Frames that --video gives.")] = 5,
    box: Annotated[
        list[str] | None,
        typer.Option(
            metavar="PHOTO=X0,Y0,X1,Y1",
            help="Where the object is in a photo, in pixels of the upright photo; repeatable.",
        ),
    ] = None,
    mask: Annotated[
        list[str] | None,
        typer.Option(
            metavar="PHOTO=MASK",
            help="A picture as large as the photo, bright on the object; its box is cropped.",
        ),
    ] = None,
    accept: Annotated[
        bool, typer.Option("--accept", help="Use doubtful crops as the contact sheet shows them.")
    ] = False,
    whole: Annotated[
        bool,
        typer.Option(
            "--whole", help="The photos are cut out already: use them whole, without the detector."
        ),
    ] = False,
    memory: Memory = BANK,
    stack: StackName = "embedded",
    describe: Annotated[
        str,
        typer.Option(
            help="Who puts it into words: offline, chat (OPENAI_BASE_URL, _MODEL, _API_KEY), "
            "or a URL."
        ),
    ] = "offline",
    owner: Annotated[
        str, typer.Option(help="Whose it is, for example anna; default nobody in particular.")
    ] = "",
    known_as: Annotated[
        list[str] | None,
        typer.Option(
            help='Another word for the owner, for example brother or "anna\'s brother"; repeatable.'
        ),
    ] = None,
    note: Annotated[
        str, typer.Option(help='What it is for, for example "for the morning coffee".')
    ] = "",
    replace: Replace = False,
) -> None:
    """Remember a personal object from photos; a contact sheet beside the memory shows the crops.

    Example: ./vap register mug --category cup photos/mug-*.jpg
    Example: ./vap register mug --category cup mug.jpg --box mug.jpg=40,60,180,220
    Example: ./vap register mug --category cup --video mug.mp4
    Example: ./vap register mug --category cup photos/mug-*.jpg
        --stack embedded:encoder=dinov2-small
    Example: ./vap register mug --category cup photos/mug-*.jpg --owner anna
        --note "for the morning coffee"
    """
    import dataclasses
    import os.path
    from contextlib import suppress

    from vap_core.base.errors import an, command, number_of
    from vap_core.instruction.context import check_owner
    from vap_core.memory import check_names, object_path, save, taken
    from vap_core.perception.describe import load_captioner, with_description
    from vap_core.perception.stacks import load_stack
    from vap_core.study import register as registering
    from vap_core.study.register import leave_one_out, warnings

    check_names(name, category)
    check_owner(owner, known_as or [], note)
    if os.path.lexists(object_path(memory, name)) and not replace:
        raise taken(object_path(memory, name))
    known, damaged = registering.load_others(memory, name)
    for error in damaged:
        if not replace:
            raise error
        print(f"note: {error}", file=sys.stderr)
    paths = registering.gather_photos(photos or [])
    if video is not None:
        paths += registering.film_photos(video, memory / f"{name}.frames", frames)
    given = registering.parse_given(box or [], mask or [], paths)
    models = load_stack(stack)
    _print_unknown([category], stack)
    references = registering.choose(paths, category, models, given, whole=whole)
    doubtful = memory / f"{name}.doubtful.png"
    kept, notes = [*range(len(paths))], list[str]()
    if not accept:
        kept, notes = registering.leave_out_doubtful(references, paths, doubtful)
    used = [references[i] for i in kept]
    obj = registering.remember_references(name, category, used, models)
    notes = [f"left out: {line}" for line in notes]
    for line in (*notes, *warnings(obj, used, [paths[i].name for i in kept])):
        print(f"note: {line}", file=sys.stderr)
    obj = with_description(obj, load_captioner(models.segmenter, describe))
    obj = dataclasses.replace(obj, owner=owner, known_as=tuple(known_as or []), note=note)
    path = save(memory, obj, replace=replace)
    photos_of = number_of(len(obj.crops), "reference")
    print(f"{obj.name}: {an(obj.category)} with {photos_of}, saved to {path}")
    sheet = memory / f"{name}.references.png"
    registering.write_sheet(sheet, references, paths)
    with suppress(OSError):
        doubtful.unlink(missing_ok=True)
    print(f"look at the crops: {sheet}")
    print(leave_one_out(obj, used, {**known, name: obj}, models.encoder))
    print(f"next: {command(*registering.next_words(obj, memory, stack, known))}")


@app.command()
def ground(
    image: Annotated[
        Path,
        typer.Argument(
            help="Picture of the scene; or a video or a folder of frames, which is tracked through."
        ),
    ],
    instruction: Annotated[
        str, typer.Argument(help='What you would tell the robot, for example "bring my cup".')
    ],
    object: ObjectNames = None,
    memory: Memory = BANK,
    stack: StackName = "embedded",
    box: Annotated[
        list[str] | None,
        typer.Option(
            help="A candidate x0,y0,x1,y1 in pixels, instead of the detector; repeatable."
        ),
    ] = None,
    always_tint: Annotated[
        bool,
        typer.Option(
            "--always-tint", help="Highlight the best candidate, however unlike it is (the paper)."
        ),
    ] = False,
    parser: Annotated[
        str,
        typer.Option(
            help="Who parses: rule, embedding (implicit references, offline), chat "
            "(OPENAI_BASE_URL, _MODEL, _API_KEY), or a URL."
        ),
    ] = "rule",
    speaker: Speaker = "",
    fall_back: Annotated[
        bool,
        typer.Option("--fall-back", help="Where the chat endpoint fails, warn and take the rule."),
    ] = False,
    out: Annotated[Path, typer.Option(help="Folder for the overlay PNG and the recording.")] = Path(
        "data/runs/ground"
    ),
    as_json: Annotated[
        bool, typer.Option("--json", help="Print one JSON object and nothing else.")
    ] = False,
) -> None:
    """Find a remembered object in a picture, and show why that box won; or track it through a clip.

    Example: ./vap ground desk.jpg "bring my cup"
    Example: ./vap ground desk.jpg "bring my cup" --box 40,60,180,220
        --box 300,80,420,230
    Example: ./vap ground desk.mp4 "bring my cup"
    Example: ./vap ground desk.jpg "bring the one I used last" --parser embedding
        --speaker anna
    """
    from vap_core.base.errors import BadInstruction, command
    from vap_core.base.media import load_photo, shrink
    from vap_core.instruction.parsers import Parsing
    from vap_core.study.grounding import (
        GROUND_SIDE,
        ground_clip,
        ground_image,
        is_clip,
        parse_boxes,
        to_json,
        write_evidence,
    )

    parsing = Parsing(parser=parser, speaker=speaker, fall_back=fall_back)
    if is_clip(image):
        if box or as_json:
            raise BadInstruction(
                "ground: --box and --json are for single pictures; leave them out for a clip."
            )
        summary, rrd, mp4 = ground_clip(
            image,
            instruction,
            memory,
            stack,
            out,
            objects=object,
            parsing=parsing,
            always_tint=always_tint,
        )
        if summary.grounded is not None:
            note_uses(memory, [summary.object], speaker)
        _print_notes(stack, summary.notes, always_tint)
        print(summary)
        print(f"wrote {mp4} and {rrd}; look: {command('view', rrd)}")
        return
    rgb = load_photo(image, long_side=None)
    if not box:
        rgb = shrink(rgb, GROUND_SIDE)
    boxes = parse_boxes(box, rgb) if box else None
    if max(rgb.shape[:2]) == GROUND_SIDE:
        print(
            f"note: boxes are pixels of the picture at {rgb.shape[1]}x{rgb.shape[0]}.",
            file=sys.stderr,
        )
    found = ground_image(
        rgb,
        instruction,
        memory,
        stack,
        objects=object,
        boxes=boxes,
        always_tint=always_tint,
        parsing=parsing,
    )
    note_uses(memory, found.used, speaker)
    _print_notes(stack, found.notes, always_tint)
    is_unknown = _print_unknown([obj.category for obj in found.objects], stack)
    written = write_evidence(out, image.stem, found)
    if as_json:
        print(json.dumps(to_json(found)))
    else:
        print(found)
        paths = " and ".join(map(str, written))
        print(f"wrote {paths}; look: {command('view', written[1])}")
    if is_unknown and not found.used:
        raise typer.Exit(1)


def note_uses(memory: Path, objects: Sequence[str], speaker: str) -> None:
    """Add what was found to the memory's history; a note where that cannot be written."""
    from datetime import datetime

    from vap_core.base.errors import BadOutput
    from vap_core.instruction.context import add_uses

    try:
        add_uses(memory, objects, speaker, datetime.now().astimezone())
    except BadOutput as error:
        print(f"note: {error}", file=sys.stderr)


def _print_unknown(categories: Sequence[str], stack: str) -> bool:
    """A note for every word that the detector does not know, and whether there is one."""
    from vap_core.perception.stacks import load_stack
    from vap_core.study.register import unknown_word

    lines = [unknown_word(category, load_stack(stack)) for category in dict.fromkeys(categories)]
    for line in filter(None, lines):
        print(f"note: {line}", file=sys.stderr)
    return any(lines)


def _print_notes(stack: str, warnings: Sequence[str], always_tint: bool) -> None:
    """What `ground` says beside its answer."""
    from vap_core.study.grounding import missing_threshold

    for line in filter(None, ("" if always_tint else missing_threshold(stack), *warnings)):
        print(f"note: {line}", file=sys.stderr)


@objects.command("import")
def import_object(
    file: Annotated[Path, typer.Argument(help="A closed, coloured GLB, OBJ, PLY or STL file.")],
    category: Annotated[
        str, typer.Option(help="What kind of thing it is: the word you will use after 'my'.")
    ],
    name: Annotated[
        str | None, typer.Option(help="What to call it; default the file's name.")
    ] = None,
    height_cm: Annotated[
        float | None,
        typer.Option(min=0.1, help="Its real height, where the file's units are not metres."),
    ] = None,
    up: Annotated[
        Literal["y", "z"] | None,
        typer.Option(
            help="Axis that points up in the file; default a guess: y for GLB and OBJ, z for PLY "
            "and STL, unless it stands flat on the other."
        ),
    ] = None,
    mass_kg: Annotated[
        float | None, typer.Option(help="Its mass; default from its volume.")
    ] = None,
    colour: Annotated[
        str | None, typer.Option(help="Paint it all over, for example '#aa3322'.")
    ] = None,
    licence: Annotated[
        str, typer.Option(help="Kept with the object, for example 'CC-BY 4.0, Jane Doe'.")
    ] = "",
    repair: Annotated[
        bool,
        typer.Option(
            "--repair", help="Close holes and turn triangles alike where that is possible."
        ),
    ] = False,
    replace: Replace = False,
    out: Annotated[
        Path | None,
        typer.Option(help="Folder of your objects; default VAP_OBJECTS or data/objects."),
    ] = None,
) -> None:
    """Make an object of your own 3-D scan, in some seconds, and a picture of it beside it.

    Example: ./vap objects import mug.glb --category cup --height-cm 9
    """
    from vap_core.base.errors import an, command
    from vap_core.simulation.assets.objects import extent_m, load_scanned_object
    from vap_core.simulation.assets.scans import import_scan, storage
    from vap_core.simulation.grasps import too_wide_for
    from vap_core.simulation.studio import write_preview

    folder = out or storage.scans_folder()
    name = name or import_scan.default_name(file)
    storage.target_folder(folder, name, replace)
    metadata, scan = import_scan.import_scan(
        file,
        name,
        category,
        height_cm=height_cm,
        up=up,
        mass_kg=mass_kg,
        colour=colour,
        repair=repair,
        licence=licence,
        report=lambda line: print(line, file=sys.stderr),
    )
    saved = storage.save_scan(folder, metadata, scan, replace=replace)
    model = load_scanned_object(saved)
    x_m, y_m, z_m = extent_m(model)
    size = f"{100 * x_m:.1f} x {100 * y_m:.1f} x {100 * z_m:.1f}"
    print(
        f"{metadata.name}: {an(metadata.category)}, {size} cm, {metadata.mass_kg:g} kg, "
        f"{len(scan.hulls)} convex parts, saved to {saved}"
    )
    preview = folder / f"{metadata.name}.preview.png"
    write_preview(model, preview)
    print(f"look: {preview}")
    environment = {}
    if folder == storage.scans_folder():
        too_wide = too_wide_for(metadata.name)
        if too_wide:
            print(
                f"note: too wide for the gripper of {', '.join(too_wide)}; it can stand in their "
                "scenes, but not be picked. A smaller --height-cm makes it fit.",
                file=sys.stderr,
            )
    else:
        environment[storage.VARIABLE] = str(folder)
    words = ("eval", "--suite", "SUITE", "--object", metadata.name)
    line = command(*words, "--out", f"data/runs/{metadata.name}", environment=environment)
    print(f"next: {line}  # of a suite that asks for {an(category)}")


@objects.command("list")
def list_objects() -> None:
    """Every object there is, your own last.

    Example: ./vap objects list
    """
    from vap_core.simulation.assets.objects import object_table

    print(object_table())


@objects.command()
def photograph(
    name: Annotated[str, typer.Argument(help="An object; see ./vap objects list.")],
    out: Annotated[Path, typer.Option(help="Folder for the pictures.")] = Path("data/photos"),
    views: Annotated[int, typer.Option(min=1, max=20, help="Pictures, taken all around it.")] = 5,
) -> None:
    """Take reference photos of an object, as one walks around it.

    Example: ./vap objects photograph camera-personal --out data/photos/camera
    """
    from vap_core.base.errors import command
    from vap_core.simulation.assets.objects import get_object
    from vap_core.simulation.studio import write_views

    model = get_object(name)
    paths = write_views(model, out, views)
    print(f"wrote {views} pictures to {out}")
    print(f"next: {command('register', name, '--category', model.category, *paths)}")


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

    Example: ./vap attach data/policies/mini-pi0-simpler-bridge-wide-seed-0
        data/runs/mine --memory data/runs/bridge/memory
    """
    from vap_core.base.errors import require

    require("policy", "attach")
    from vap_core.policies.lerobot.step import attach

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

    Example: ./vap inspect-dataset ~/datasets/desk "pick my cup"
    Example: ./vap inspect-dataset ~/datasets/desk "pick my cup" --episodes 3
        --copy ~/datasets/desk-vap
    """
    from vap_core.base.errors import require

    require("policy", "inspect-dataset")
    from vap_core.base.errors import BadDataset, command
    from vap_core.study.dataset import TABLE, inspect_dataset, report_table

    if masks and copy is None:
        raise BadDataset("inspect-dataset: --masks go into a copy; name its folder with --copy.")
    reports = inspect_dataset(
        path,
        instruction,
        memory,
        stack,
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
    print(f"wrote {out / TABLE}, {len({row['episode'] for row in reports})} recordings{copied}")
    print(f"look: {command('view', first)}")
