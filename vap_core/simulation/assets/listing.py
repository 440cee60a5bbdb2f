"""The list of objects, as a table for people."""

from vap_core.simulation.assets.objects import (
    OBJECTS,
    ObjectModel,
    extent_m,
    get_object,
    mesh_of,
    tier,
)
from vap_core.simulation.assets.scans.storage import scan_folders


def object_table() -> str:
    """Every object by name, the user's own last.

    Columns: name, category, split, tier of a look-alike, size (cm), faces, mass (g).
    """
    header = (
        f"{'name':28} {'category':14} {'split':10} {'tier':7} {'size, cm':>18} {'faces':>6} "
        f"{'mass, g':>8}"
    )
    lines = [header]
    for model in OBJECTS.values():
        lines.append(_object_line(model))
    for name in scan_folders():
        lines.append(_object_line(get_object(name)))
    return "\n".join(lines)


def _object_line(model: ObjectModel) -> str:
    grade = "-"
    if model.split == "lookalike":
        grade = tier(model)
    size = " x ".join(f"{100 * side:.1f}" for side in extent_m(model))
    return (
        f"{model.name:28} {model.category:14} {model.split:10} {grade:7} {size:>18} "
        f"{len(mesh_of(model).face):6} {1000 * model.mass_kg:8.0f}"
    )
