"""Commands about the stacks' weights: weights list, weights pull, weights export."""

from pathlib import Path
from typing import Annotated

import typer

app = typer.Typer(
    no_args_is_help=True,
    help="The foundation stack's weights: what is there, and how to get the rest; the embedded "
    "stack's graphs.",
)


@app.command("list")
def list_weights() -> None:
    """What is on this machine, what is missing, and how to get it.

    Example: python -m vap_core weights list
    """
    from vap_core.perception.foundation.store import weights_table

    print(weights_table())


@app.command("pull")
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

    Example: python -m vap_core weights pull --stack foundation-small
    Example: python -m vap_core weights pull --stack foundation:detector=llmdet-tiny --unpinned
    """
    from vap_core.perception.foundation.downloads import pull
    from vap_core.perception.foundation.sources import models_of
    from vap_core.perception.foundation.store import store_folder

    pull(models_of(stack), store_folder(), origin=origin, unpinned=unpinned)


@app.command("export")
def export_weights(
    folder: Annotated[
        Path, typer.Option(help="Folder of perception.safetensors and its manifest.")
    ] = Path("data/weights"),
) -> None:
    """Write the graphs of the embedded stack's networks beside their weights, for ONNX Runtime.

    Training does this by itself; needed again when a network's structure changes.

    Example: python -m vap_core weights export --folder data/runs/weights
    """
    from vap_core.base.files import writing
    from vap_core.perception.embedded.export import export_graphs

    with writing(folder, "weights export"):
        paths = export_graphs(folder)
    for path in paths:
        print(f"{path}  {path.stat().st_size:,} bytes")
