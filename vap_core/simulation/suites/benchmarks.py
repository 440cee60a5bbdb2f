"""The four personalised benchmarks, protocol-matched in MuJoCo (P 4, tab:object_specs).

SIMPLER's Google Robot (Fractal) and WidowX (Bridge); VLABench, whose personal object is selected by
touching it; and the paper's real desk, an SO-101 whose cameras' noise, exposure and place are drawn
per episode. Their episodes are lists in `data/suites`; vap_make.lists drew them.
"""

from vap_core.simulation.looks import WEBCAM
from vap_core.simulation.suites.layout import Area
from vap_core.simulation.suites.suite import Suite, Task

FRACTAL = Suite(
    name="simpler-fractal",
    robot="google",
    hz=3.0,
    cameras=("head",),
    tasks=(
        Task("pick-pen-holder", "pen holder", "pick my pen holder", 80),
        Task(
            "move-bottle-near-coke-can",
            "bottle",
            "move my bottle near coke can",
            80,
            "near",
            "coke-can-prop",
        ),
    ),
)
BRIDGE = Suite(
    name="simpler-bridge",
    robot="wx250s",
    hz=5.0,
    cameras=("front",),
    tasks=(
        Task("pick-shaver", "shaver", "pick up my shaver", 60),
        *(
            Task(
                f"put-{category.replace(' ', '-')}",
                category,
                f"put my {category} {where}",
                steps,
                "put",
                goal,
            )
            for category, where, steps, goal in (
                ("camera", "on the plate", 60, "plate-prop"),
                ("owl figurine", "on the plate", 60, "plate-prop"),
                ("straw cup", "in the basket", 120, "basket-prop"),
            )
        ),
    ),
)


def _select(category: str, max_steps: int = 150, slug: str = "") -> Task:
    name, words = f"select-{category.replace(' ', '-')}", f"select my {category}"
    return Task(name, category, words, max_steps, "selected", slug=slug)


VLABENCH = Suite(
    name="vlabench",
    robot="panda",
    hz=10.0,
    cameras=("front", "side", "wrist"),
    control="joint",
    tasks=(
        *map(_select, ("leather bag", "shoe", "cat figurine", "miniature house")),
        _select("cup", 200, "paper-cup"),
    ),
)
BOWL = "plastic-bowl-prop"


def _put(category: str) -> Task:
    name, words = f"put-{category.replace(' ', '-')}", f"put my {category} into the plastic bowl"
    return Task(name, category, words, 300, "put", BOWL)


TABLETOP = Suite(
    name="tabletop",
    robot="so101",
    hz=30.0,
    cameras=("front", "side", "wrist"),
    control="joint",
    sensor=WEBCAM,
    tasks=(
        *map(_select, ("vase", "plushie", "cup", "slipper")),
        *map(_put, ("plant", "stuffed toy", "pouch", "scrubber")),
    ),
)
FILMED_AREA = Area(0.18, 0.35, -0.095, 0.095)
"""Where the films of simpler-bridge's policies show objects."""
