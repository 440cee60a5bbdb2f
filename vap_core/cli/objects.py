"""The group objects: the objects of the scenes, and your own 3-D scans."""

import sys
from pathlib import Path
from typing import Annotated, Literal

import typer

app = typer.Typer(
    no_args_is_help=True, help="The objects of the scenes: what there is, and your own 3-D scans."
)


@app.command("import")
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
    replace: Annotated[
        bool, typer.Option("--replace", help="Overwrite an object of this name.")
    ] = False,
    out: Annotated[
        Path | None,
        typer.Option(help="Folder of your objects; default VAP_OBJECTS or data/objects."),
    ] = None,
) -> None:
    """Make an object of your own 3-D scan, in some seconds, and a picture of it beside it.

    Example: python -m vap_core objects import mug.glb --category cup --height-cm 9
    """
    from vap_core.base.commands import command
    from vap_core.simulation.assets import objects
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
    model = objects.load_scanned_object(saved)
    x_m, y_m, z_m = objects.extent_m(model)
    size = f"{100 * x_m:.1f} x {100 * y_m:.1f} x {100 * z_m:.1f}"
    print(
        f"{metadata.name}: a {metadata.category}, {size} cm, {metadata.mass_kg:g} kg, "
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
    print(f"next: {line}  # of a suite that asks for a {category}")


@app.command("designs")
def designs(
    out: Annotated[Path, typer.Argument(help="Folder for the GLB files and objects.csv.")],
    count: Annotated[int, typer.Option(min=1, max=200, help="How many.")] = 24,
    seed: Annotated[
        int, typer.Option(min=0, help="Another seed is another set, to be held back.")
    ] = 0,
) -> None:
    """Write made-up objects that nothing here was trained on, as 3-D files: with handles and
    without, plain and loud.

    Example: python -m vap_core objects designs data/designs --seed 1
    """
    from vap_core.base.commands import command
    from vap_core.simulation.assets.scans.designs import TABLE, write_designs

    paths = write_designs(out, count, seed)
    print(f"wrote {len(paths)} designs to {out}, and their kinds to {out / TABLE}")
    print(f"next: {command('measure', 'objects', out)}")


@app.command("list")
def list_objects() -> None:
    """Every object there is, your own last.

    Example: python -m vap_core objects list
    """
    from vap_core.simulation.assets.listing import object_table

    print(object_table())


@app.command()
def photograph(
    name: Annotated[str, typer.Argument(help="An object; see python -m vap_core objects list.")],
    out: Annotated[Path, typer.Option(help="Folder for the pictures.")] = Path("data/photos"),
    views: Annotated[int, typer.Option(min=1, max=20, help="Pictures, taken all around it.")] = 5,
) -> None:
    """Take reference photos of an object, as one walks around it.

    Example: python -m vap_core objects photograph camera-personal --out data/photos/camera
    """
    from vap_core.base.commands import command
    from vap_core.simulation.assets.objects import get_object
    from vap_core.simulation.studio import write_views

    model = get_object(name)
    paths = write_views(model, out, views)
    print(f"wrote {views} pictures to {out}")
    print(f"next: {command('register', name, '--category', model.category, *paths)}")
