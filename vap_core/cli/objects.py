"""Commands about your own objects.

Remember them from photos, find them in a picture, import them as 3-D scans.
"""

import json
import sys
from pathlib import Path
from typing import Annotated, Literal

import typer

from vap_core.cli.options import StackName

app = typer.Typer()
objects_app = typer.Typer(
    no_args_is_help=True, help="The objects of the scenes: what there is, and your own 3-D scans."
)
app.add_typer(objects_app, name="objects")

Memory = Annotated[Path, typer.Option(help="Folder of remembered objects.")]
BANK = Path("data/memory")


@app.command()
def register(
    name: Annotated[str, typer.Argument(help="What to call the object, for example mug.")],
    photos: Annotated[
        list[Path],
        typer.Argument(help="One to about ten photos of this very object, five are best."),
    ],
    category: Annotated[
        str, typer.Option(help="What kind of thing it is: the word you will use after 'my'.")
    ],
    memory: Memory = BANK,
    stack: StackName = "embedded",
    whole: Annotated[
        bool,
        typer.Option(
            "--whole", help="The photos are cut out already: use them whole, without the detector."
        ),
    ] = False,
    describe: Annotated[
        str,
        typer.Option(
            help="Who puts it into words: offline, chat (OPENAI_BASE_URL, _MODEL, _API_KEY), "
            "or a URL."
        ),
    ] = "offline",
    replace: Annotated[
        bool, typer.Option("--replace", help="Overwrite an object of this name.")
    ] = False,
) -> None:
    """Remember a personal object from photos.

    Example: python -m vap_core register mug --category cup photos/mug-*.jpg
    """
    from vap_core.memory import load_photo, remember, save
    from vap_core.memory import register as find_and_remember
    from vap_core.perception.describe import load_captioner, with_description
    from vap_core.perception.stacks import load_stack

    pictures = [load_photo(photo) for photo in photos]
    models = load_stack(stack)
    if models.domain and not whole:
        remedy = "look at what it cropped, or cut the photos out yourself and pass --whole"
        _warn_of_domain(models.domain, remedy)
    if whole:
        obj = remember(name, category, pictures, models.encoder)
    else:
        obj, uncropped = find_and_remember(
            name, category, pictures, models.detector, models.encoder
        )
        for index in uncropped:
            print(
                f"note: no sure {obj.category} found in {photos[index]}; the whole photo is used.",
                file=sys.stderr,
            )
    captioner = load_captioner(models.segmenter, describe)
    obj = with_description(obj, captioner)
    path = save(memory, obj, replace=replace)
    print(f"{obj.name}: a {obj.category} with {len(obj.crops)} references, saved to {path}")
    print(f'next: python -m vap_core ground IMAGE "bring my {obj.category}" --memory {memory}')


@app.command()
def ground(
    image: Annotated[Path, typer.Argument(help="Picture of the scene.")],
    instruction: Annotated[
        str, typer.Argument(help='What you would tell the robot, for example "bring my cup".')
    ],
    object: Annotated[
        list[str] | None,
        typer.Option(
            "--object",
            help="Remembered object of each 'my ...', where the category alone does not decide.",
        ),
    ] = None,
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
    out: Annotated[Path, typer.Option(help="Folder for the overlay PNG and the recording.")] = Path(
        "data/runs/ground"
    ),
    as_json: Annotated[
        bool, typer.Option("--json", help="Print one JSON object and nothing else.")
    ] = False,
) -> None:
    """Find a remembered object in a picture, and show why that box won.

    Example: python -m vap_core ground desk.jpg "bring my cup" --box 40,60,180,220
        --box 300,80,420,230
    """
    from vap_core.analysis.ground import ground_image, parse_boxes, to_json, write_evidence
    from vap_core.memory import load_photo

    rgb = load_photo(image, long_side=None)
    boxes = parse_boxes(box, rgb) if box else None
    found = ground_image(
        rgb,
        instruction,
        memory,
        stack,
        objects=object,
        boxes=boxes,
        always_tint=always_tint,
    )
    if found.domain and boxes is None:
        _warn_of_domain(found.domain, "on a real photo give the candidates with --box")
    written = write_evidence(out, image.stem, found)
    if as_json:
        print(json.dumps(to_json(found)))
        return
    print(found)
    paths = " and ".join(map(str, written))
    print(f"wrote {paths}; look: python -m vap_core view {written[1]}")


@objects_app.command("import")
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
            help="Axis that points up in the file; default y for GLB and OBJ, z for PLY, STL."
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
    replace: Annotated[
        bool, typer.Option("--replace", help="Overwrite an object of this name.")
    ] = False,
    out: Annotated[
        Path | None,
        typer.Option(help="Folder of your objects; default VAP_OBJECTS or data/objects."),
    ] = None,
) -> None:
    """Make an object of your own 3-D scan; it takes about half a minute.

    Example: python -m vap_core objects import mug.glb --category cup --height-cm 9
    """
    from vap_core.simulation.assets import objects
    from vap_core.simulation.assets.scans import import_scan, storage

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
    model = objects.load_scanned_object(saved)
    x_m, y_m, z_m = objects.extent_m(model)
    size = f"{100 * x_m:.1f} x {100 * y_m:.1f} x {100 * z_m:.1f}"
    print(
        f"{metadata.name}: a {metadata.category}, {size} cm, {metadata.mass_kg:g} kg, "
        f"{len(scan.hulls)} convex parts, saved to {saved}"
    )
    setting = ""
    if folder != storage.scans_folder():
        setting = f"VAP_OBJECTS={folder} "
    print(
        f"next: {setting}python -m vap_core objects photograph '{metadata.name}', or in Python "
        f"scenes.build('wx250s', ['{metadata.name}'])"
    )


@objects_app.command("list")
def list_objects() -> None:
    """Every object there is, your own last.

    Example: python -m vap_core objects list
    """
    from vap_core.simulation.assets.listing import object_table

    print(object_table())


@objects_app.command()
def photograph(
    name: Annotated[str, typer.Argument(help="An object; see python -m vap_core objects list.")],
    out: Annotated[Path, typer.Option(help="Folder for the pictures.")] = Path("data/photos"),
    views: Annotated[int, typer.Option(min=1, max=20, help="Pictures, taken all around it.")] = 5,
) -> None:
    """Take reference photos of an object, as one walks around it.

    Example: python -m vap_core objects photograph cup-personal
    """
    from vap_core.simulation.assets.objects import get_object
    from vap_core.simulation.studio import write_views

    model = get_object(name)
    paths = write_views(model, out, views)
    print(f"wrote {views} pictures to {out}")
    photos = " ".join(f"'{path}'" for path in paths)
    print(f"next: python -m vap_core register '{name}' --category '{model.category}' {photos}")


def _warn_of_domain(domain: str, remedy: str) -> None:
    """Note that the embedded detector finds things in pictures of its domain only."""
    print(
        f"note: the embedded detector knows {domain} only, not real photos; {remedy}.",
        file=sys.stderr,
    )
