"""The arms of every ablation: what each changes, and the paper's numbers beside it.

A new arm is a line in `ABLATIONS`: its name is a method that `eval --methods` takes, too.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

from vap_core.associate import PAIRINGS
from vap_core.attend import Prompting
from vap_core.base.types import Colour
from vap_core.evaluation.ablations.arrow import Arrow
from vap_core.evaluation.ablations.forms import (
    Circle,
    Contour,
    DimmedBackground,
    FilledBox,
    NumberedMarker,
    OthersErased,
    Point,
)
from vap_core.prompt import PALETTE, Tint
from vap_core.rollout.prompters.oracle import Oracle
from vap_core.rollout.prompters.switch import Switch
from vap_core.rollout.prompters.text import OtherCommand

DEFAULT = "vap"
"""The arm that every other is compared with."""


@dataclass(frozen=True)
class Hidden:
    """The method, while the target is hidden from all cameras for some calls of the policy."""

    calls: int
    prompting: Prompting = field(default_factory=Prompting)


type Arm = Prompting | Oracle | Hidden | Switch | OtherCommand | Arrow


@dataclass(frozen=True)
class Ablation:
    """One ablation: a question, and its arms by method name.

    `paper` is the paper's table (data/paper_tables.csv), `rows` its row for each arm that it has.
    Arms named in `methods` are methods already (evaluation.methods), or arms of another ablation.
    `suites` are those that it runs on where none is named. `policies` are checkpoints by label: the
    methods are run with each of them, and the last method is compared over them. `retired` counts
    arms that were tried on the same lists and are no longer here: Holm's correction counts them.
    """

    question: str
    arms: Mapping[str, Arm]
    methods: tuple[str, ...] = (DEFAULT,)
    suites: tuple[str, ...] = ("simpler-bridge",)
    paper: str = ""
    rows: Mapping[str, str] = field(default_factory=dict)
    policies: Mapping[str, str] = field(default_factory=dict)
    retired: int = 0

    @property
    def names(self) -> tuple[str, ...]:
        """All its methods, the default first."""
        return (*self.methods, *self.arms)


_OF_BRIDGE = "data/policies/mini-pi0-simpler-bridge"
TINT_SHARES = {
    "share-0": f"{_OF_BRIDGE}-any-start",
    "share-0.1": f"{_OF_BRIDGE}-tint-share-0.1",
    "share-0.2": f"{_OF_BRIDGE}-tint-share-0.2",
    "share-0.5": f"{_OF_BRIDGE}-tint-share-0.5",
}
"""Policies of one recipe, of the same films, seed and mini-PaliGemma, by the share of their
training scenes that were tinted."""
UNTRAINED = (Colour("orange", (255, 128, 0)), Colour("purple", (128, 0, 255)))
"""Colours that no shipped policy was trained with as tints.

In its films things are painted in them (vap_make.words.PAINTS), and commands name them.
"""


def _tints() -> dict[str, Arm]:
    arms: dict[str, Arm] = {}
    for colour in (*PALETTE, *UNTRAINED):
        arms[f"only-{colour.name}"] = Prompting(palette=(colour,))
    return arms


ABLATIONS: dict[str, Ablation] = {
    "rewrite": Ablation(
        question="Are both halves of the prompt needed, the tint and the rewritten words?",
        arms={},
        methods=(DEFAULT, "mask-only", "rewrite-only"),
        paper="ablation_rewrite",
        rows={
            DEFAULT: "VAP (mask + rewrite)",
            "mask-only": "mask-only",
            "rewrite-only": "rewrite-only",
        },
    ),
    "selection": Ablation(
        question="Does it matter how references elect the candidate?",
        arms={
            "average-rule": Prompting(rule="average"),
            "best-rule": Prompting(rule="best"),
        },
        paper="ablation_vote",
        rows={DEFAULT: "voting (VAP)", "average-rule": "averaging"},
    ),
    "references": Ablation(
        question="How many references are needed?",
        arms={
            "references-1": Prompting(references=1),
            "references-3": Prompting(references=3),
            "references-7": Prompting(references=7),
        },
        paper="ablation_k",
        rows={DEFAULT: "K = 5", **{f"references-{k}": f"K = {k}" for k in (1, 3, 7)}},
    ),
    "form": Ablation(
        question="Is the tint better than other forms of a prompt?",
        arms={
            "opaque": Prompting(form=Tint(1.0)),
            "contour": Prompting(form=Contour()),
            "box": Prompting(form=FilledBox()),
            "point": Prompting(form=Point()),
            "circle": Prompting(form=Circle()),
            "arrow": Arrow(),
            "marker": Prompting(form=NumberedMarker()),
            "dimmed": Prompting(form=DimmedBackground(), rewrite=False),
            "others-erased": Prompting(form=OthersErased(), rewrite=False),
        },
        paper="ablation_prompt",
        rows={
            DEFAULT: "mask, alpha 0.5 (VAP)",
            "opaque": "mask, alpha 1.0",
            "box": "box, alpha 0.5",
            "point": "point",
            "circle": "circle",
            "arrow": "trajectory arrow",
            "marker": "numbered marker",
        },
    ),
    "opacity": Ablation(
        question="How strong must the tint be?",
        arms={f"opacity-{alpha}": Prompting(form=Tint(alpha)) for alpha in (0.1, 0.3, 0.7)},
        methods=(DEFAULT, "opaque"),
        paper="ablation_prompt",
        rows={
            DEFAULT: "mask, alpha 0.5 (VAP)",
            "opaque": "mask, alpha 1.0",
            **{f"opacity-{alpha}": f"mask, alpha {alpha}" for alpha in (0.1, 0.3, 0.7)},
        },
    ),
    "colour": Ablation(
        question="Does it matter which colour the tint has?",
        arms=_tints(),
    ),
    "red-lookalike": Ablation(
        question="Where a look-alike is red by nature, is a tint chosen for the scene better than "
        "always red?",
        arms={},
        methods=(DEFAULT, "only-red", "generic"),
        suites=("simpler-bridge-red",),
    ),
    "occlusion": Ablation(
        question="How long may the target be hidden?",
        arms={f"hidden-{n}": Hidden(n) for n in range(1, 7)},
        paper="occlusion_sweep",
        rows={DEFAULT: "0 frames", **{f"hidden-{n}": f"{n} frames" for n in range(1, 7)}},
    ),
    "language": Ablation(
        question="Does the policy listen to its command at all?",
        arms={
            "blank-text": OtherCommand("blank"),
            "other-text": OtherCommand("next task"),
        },
        methods=("generic",),
    ),
    "mask": Ablation(
        question="How exact must the mask be?",
        arms={
            **{f"mask-area-{r}": Oracle("track", area=r) for r in (0.25, 0.5, 1.5, 2.0)},
            "mask-shifted": Oracle("track", shift=0.5),
        },
        methods=("oracle-track",),
        paper="mask_quality",
        rows={
            "oracle-track": "ratio 1.0",
            **{f"mask-area-{r}": f"ratio {r}" for r in (0.25, 0.5, 1.5, 2.0)},
        },
    ),
    "association": Ablation(
        question="Should views agree on one candidate?",
        arms={
            "associated-objects": Prompting(associate=PAIRINGS["objects"]),
        },
        methods=(DEFAULT, "vap-associated"),
        suites=("vlabench", "tabletop"),
        retired=5,
    ),
    "switch": Ablation(
        question="Does the policy follow the tint to a look-alike in mid-episode?",
        arms={"switched-early": Switch("early"), "switched-moved": Switch("moved")},
        methods=("oracle-track",),
    ),
    "truth": Ablation(
        question="What would a perfect stage bring?",
        arms={},
        methods=(DEFAULT, "oracle-box", "oracle-mask", "oracle-track", "wrong-mask"),
    ),
    "tint-share": Ablation(
        question="How much of the gain was taught by tints in the policy's training?",
        arms={},
        methods=("generic", "rewrite-only", "mask-only", DEFAULT),
        policies=TINT_SHARES,
    ),
}
"""Every ablation by name; the first method of each is what the others are compared with."""

ARMS: dict[str, Arm] = {
    name: arm for ablation in ABLATIONS.values() for name, arm in ablation.arms.items()
}
"""Every arm that is no method of the main tables, by name."""
