"""Commands about photos of your own objects: register remembers them, ground finds them."""

import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

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
    detector: DetectorName = "",
    encoder: EncoderName = "",
    tracker: TrackerName = "",
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
    replace: Annotated[
        bool, typer.Option("--replace", help="Overwrite an object of this name.")
    ] = False,
) -> None:
    """Remember a personal object from photos; a contact sheet beside the memory shows the crops.

    Example: python -m vap_core register mug --category cup photos/mug-*.jpg
    Example: python -m vap_core register mug --category cup mug.jpg --box mug.jpg=40,60,180,220
    Example: python -m vap_core register mug --category cup --video mug.mp4
    Example: python -m vap_core register mug --category cup photos/mug-*.jpg --encoder dinov2-small
    Example: python -m vap_core register mug --category cup photos/mug-*.jpg --owner anna
        --note "for the morning coffee"
    """
    import dataclasses
    import os.path
    from contextlib import suppress

    from vap_core.base.commands import command
    from vap_core.evaluation.photos import register as registering
    from vap_core.evaluation.photos.trust import leave_one_out, warnings
    from vap_core.instruction.owners import check_owner
    from vap_core.memory import check_names, object_path, save, taken
    from vap_core.perception.describe import load_captioner, with_description
    from vap_core.perception.stacks import load_stack

    stack = stack_of(stack, detector, encoder, tracker)
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
    references = registering.choose(paths, category, models, given, whole=whole)
    doubtful = memory / f"{name}.doubtful.png"
    if not accept:
        registering.refuse_doubtful(references, paths, doubtful)
    obj = registering.remember_references(name, category, references, models)
    for line in warnings(obj, references, [path.name for path in paths]):
        print(f"note: {line}", file=sys.stderr)
    obj = with_description(obj, load_captioner(models.segmenter, describe))
    obj = dataclasses.replace(obj, owner=owner, known_as=tuple(known_as or []), note=note)
    path = save(memory, obj, replace=replace)
    print(f"{obj.name}: a {obj.category} with {len(obj.crops)} references, saved to {path}")
    sheet = memory / f"{name}.references.png"
    registering.write_sheet(sheet, references, paths)
    with suppress(OSError):
        doubtful.unlink(missing_ok=True)
    print(f"look at the crops: {sheet}")
    print(leave_one_out(obj, references, {**known, name: obj}, models.encoder))
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
    detector: DetectorName = "",
    encoder: EncoderName = "",
    tracker: TrackerName = "",
    box: Annotated[
        list[str] | None,
        typer.Option(
            help="A candidate x0,y0,x1,y1 in pixels, instead of the detector; repeatable."
        ),
    ] = None,
    tiles: Annotated[
        bool | None,
        typer.Option(
            help="Look for small objects in nine overlapping tiles, too; default from 3 megapixels "
            "on."
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

    Example: python -m vap_core ground desk.jpg "bring my cup"
    Example: python -m vap_core ground desk.jpg "bring my cup" --box 40,60,180,220
        --box 300,80,420,230
    Example: python -m vap_core ground desk.mp4 "bring my cup"
    Example: python -m vap_core ground desk.jpg "bring the one I used last" --parser embedding
        --speaker anna
    """
    from vap_core.analysis.ground import (
        GROUND_SIDE,
        ground_image,
        parse_boxes,
        to_json,
        write_evidence,
    )
    from vap_core.analysis.ground_clip import ground_clip, is_clip
    from vap_core.base.commands import command
    from vap_core.base.errors import BadInstruction
    from vap_core.base.photos import load_photo, shrink
    from vap_core.instruction.parsers import Parsing
    from vap_core.perception.tiles import SMALL_MEGAPIXELS

    stack = stack_of(stack, detector, encoder, tracker)
    parsing = Parsing(parser=parser, speaker=speaker, fall_back=fall_back)
    if is_clip(image):
        if box or as_json or tiles:
            raise BadInstruction(
                "ground: --box, --tiles and --json are for single pictures; leave them out for a "
                "clip."
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
    if tiles is None:  # by the file's own size
        tiles = rgb.shape[0] * rgb.shape[1] >= SMALL_MEGAPIXELS * 1e6
    if not box:
        rgb = shrink(rgb, GROUND_SIDE)
    boxes = parse_boxes(box, rgb) if box else None
    if max(rgb.shape[:2]) == GROUND_SIDE:
        print(
            f"note: boxes are pixels of the picture at {rgb.shape[1]}x{rgb.shape[0]}.",
            file=sys.stderr,
        )
    if tiles and boxes is None:
        print(
            "note: looking at the whole picture and at nine overlapping half-size tiles of it, for "
            "small objects; --no-tiles turns it off.",
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
        tiles=tiles,
        parsing=parsing,
    )
    note_uses(memory, found.used, speaker)
    _print_notes(stack, found.notes, always_tint)
    written = write_evidence(out, image.stem, found)
    if as_json:
        print(json.dumps(to_json(found)))
        return
    print(found)
    paths = " and ".join(map(str, written))
    print(f"wrote {paths}; look: {command('view', written[1])}")


def note_uses(memory: Path, objects: Sequence[str], speaker: str) -> None:
    """Add what was found to the memory's history; a note where that cannot be written."""
    from datetime import datetime

    from vap_core.base.errors import BadOutput
    from vap_core.instruction.history import add_uses

    try:
        add_uses(memory, objects, speaker, datetime.now().astimezone())
    except BadOutput as error:
        print(f"note: {error}", file=sys.stderr)


def _print_notes(stack: str, warnings: Sequence[str], always_tint: bool) -> None:
    """What `ground` says beside its answer."""
    from vap_core.analysis.ground import missing_threshold

    missing = "" if always_tint else missing_threshold(stack)
    for line in filter(None, (missing, *warnings)):
        print(f"note: {line}", file=sys.stderr)
