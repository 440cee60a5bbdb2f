"""What learned tokens recognize, as text: shares of photos with n and 95 % intervals."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from vap_core.base.tables import align
from vap_core.evaluation.metrics import Rate, rate
from vap_core.evaluation.perception.estimates import Estimate
from vap_core.evaluation.tokens.study import OTHER, USUAL_K

if TYPE_CHECKING:
    import pandas as pd

KINDS = ("own", "look-alikes", "other objects")
READINGS = {
    "as learned": ("vlm", "as learned", "vlm"),
    "copied into the policy": ("vlm", "copied", "policy"),
    "rotated into the policy": ("vlm", "aligned", "policy"),
    "learned in the policy": ("policy", "as learned", "policy"),
}
"""Where a token is learned, which form of it is read, and by whom."""
NOTE = (
    "yes, % of photos that no training saw [95 % Wilson interval] n; right: as many photos of the "
    "object as of others, each kind with half of the weight (no interval: it is of two rates). The "
    "paper asks for more than 95 % right. Photos of one object are not independent of each other: "
    "intervals over objects would be wider. What the model chooses has its interval over objects, "
    "of which each has one token."
)


def kind_of(table: "pd.DataFrame") -> "pd.Series":
    """Of every row, whether its photos show the object itself, a look-alike, or another."""
    kinds = table.shown.map({OTHER: "other objects"}).fillna("look-alikes")
    return kinds.where(table.shown != table.object, "own")


def final(answers: "pd.DataFrame") -> "pd.DataFrame":
    """The rows after the last step of each training."""
    training = answers.groupby(["object", "k", "learned_in"]).step
    return answers[answers.step == training.transform("max")]


def reading(answers: "pd.DataFrame", name: str) -> "pd.DataFrame":
    """The rows of one of READINGS."""
    learned_in, token, read_by = READINGS[name]
    return answers[
        (answers.learned_in == learned_in) & (answers.token == token) & (answers.read_by == read_by)
    ]


def said_yes(rows: "pd.DataFrame") -> Rate:
    """The share of the rows' photos to which the answer was yes."""
    return rate(int(rows.yes.sum()), int(rows.n.sum()))


def right(rows: "pd.DataFrame") -> float:
    """The share of right answers, the object's photos and all others with equal weight."""
    is_own = kind_of(rows) == "own"
    return (said_yes(rows[is_own]).value + 1 - said_yes(rows[~is_own]).value) / 2


def curve(answers: "pd.DataFrame") -> "pd.DataFrame":
    """By number of photos and step: yes to each kind of photo, over all objects of the rows.

    Columns: k, step, kind, objects, n, yes, low, high.
    """
    import pandas as pd

    rows = reading(answers, "as learned")
    lines = []
    for (k, step, kind), part in rows.groupby(["k", "step", kind_of(rows)]):
        found = said_yes(part)
        lines.append((k, step, kind, part.object.nunique(), *_numbers(found)))
    return pd.DataFrame(lines, columns=["k", "step", "kind", "objects", "n", "yes", "low", "high"])


def readings(answers: "pd.DataFrame", k: int = USUAL_K) -> "pd.DataFrame":
    """By object and reading: right, and yes to each kind of photo as `Rate`s."""
    import pandas as pd

    ends = final(answers)
    ends = ends[ends.k == k]
    lines = []
    for name in READINGS:
        for (suite, obj), part in reading(ends, name).groupby(["suite", "object"], sort=False):
            kinds = kind_of(part)
            rates = {kind: said_yes(part[kinds == kind]) for kind in KINDS}
            lines.append({"suite": suite, "object": obj, "reading": name, "right": right(part)})
            lines[-1] |= rates
    return pd.DataFrame(lines, columns=["suite", "object", "reading", "right", *KINDS])


def pooled(answers: "pd.DataFrame", k: int = USUAL_K) -> "pd.DataFrame":
    """By reading, over all objects: right as a mean over objects, yes to each kind of photo.

    All are `Estimate`s: yes has Wilson's interval over photos, right has Student's over objects.
    """
    import pandas as pd

    ends = final(answers)
    ends = ends[ends.k == k]
    lines = []
    for name in READINGS:
        part = reading(ends, name)
        if part.empty:
            continue
        kinds = kind_of(part)
        of_objects = [right(rows) for _, rows in part.groupby("object", sort=False)]
        line = {"reading": name, "right": mean_of_tokens(of_objects)}
        for kind in KINDS:
            found = said_yes(part[kinds == kind])
            line[kind] = Estimate(value=found.value, low=found.low, high=found.high, n=found.n)
        lines.append(line)
    return pd.DataFrame(lines, columns=["reading", "right", *KINDS]).set_index("reading")


def confusions(answers: "pd.DataFrame", k: int = USUAL_K) -> "pd.DataFrame":
    """By object and look-alike: the share of its photos that are taken for the object's."""
    import pandas as pd

    ends = final(reading(answers, "as learned"))
    ends = ends[(ends.k == k) & (kind_of(ends) == "look-alikes")]
    lines = []
    for row in ends.itertuples():
        lines.append((row.suite, row.object, row.shown, *_numbers(rate(row.yes, row.n))))
    columns = ["suite", "object", "look-alike", "n", "yes", "low", "high"]
    return pd.DataFrame(lines, columns=columns)


def success_by_token(episodes: "pd.DataFrame", other: str, one: str = "soft") -> "pd.Series":
    """By task, how much more often `other` succeeds than `one` in the episodes that both ran.

    A task has one target, and so one learned token of each form: tasks are the independent units.
    """
    key = ["suite", "task", "episode"]
    wide = episodes.pivot(index=key, columns="method", values="success")[[one, other]].dropna()
    gain = wide[other].astype(float) - wide[one].astype(float)
    return gain.groupby(["suite", "task"], sort=False).mean()


def mean_of_tokens(values: Sequence[float], least: float = 0.0) -> Estimate:
    """The mean of one value per token with Student's 95 % interval, inside `least` to 1.

    A single token has no interval. `least` is -1 for differences.
    """
    import numpy as np
    from scipy import stats

    n = len(values)
    middle = float(np.mean(values))
    if n < 2:
        return Estimate(value=middle, low=float("nan"), high=float("nan"), n=n)
    half = float(stats.t.ppf(0.975, n - 1) * np.std(values, ddof=1) / np.sqrt(n))
    return Estimate(value=middle, low=max(least, middle - half), high=min(1.0, middle + half), n=n)


def report(tables: Mapping[str, "pd.DataFrame"]) -> str:
    """What the command prints."""
    answers = tables["answers"]
    found = readings(answers)
    rows = [["object", "token", "right, %", *(f"yes to {kind}" for kind in KINDS)]]
    for line in found.to_dict("records"):
        cells = [str(line["object"]), str(line["reading"]), f"{100 * line['right']:.1f}"]
        rows.append([*cells, *(text(line[kind]) for kind in KINDS)])
    by_k = [["photos, steps", "objects", *(f"yes to {kind}" for kind in KINDS)]]
    whole = curve(answers)
    for (k, step), part in whole.groupby(["k", "step"]):
        of_kind = part.set_index("kind")
        cells = [f"{k}, {step}", str(int(part.objects.max()))]
        for kind in KINDS:
            line = of_kind.loc[kind]
            cells.append(_text(line.yes, line.low, line.high, int(line.n)))
        by_k.append(cells)
    parts = [align(rows), align(by_k)]
    if "choices" in tables:
        parts.append(align(_choice_rows(tables["choices"])))
    return "\n\n".join([*parts, NOTE])


def _choice_rows(table: "pd.DataFrame") -> list[list[str]]:
    """By suite: whether the model chooses the target among the objects of listed episodes."""
    from vap_core.evaluation.perception.estimates import share_by
    from vap_core.evaluation.tokens.choices import OBJECTS, chosen

    rows = [["objects of first views", "seen in", "chance", "the model chooses the target"]]
    usual = reading(table, "as learned")
    usual = usual[usual.k == USUAL_K]
    several = usual["epochs"].nunique() > 1
    for (suite, epochs, seen_in), part in usual.groupby(["suite", "epochs", "seen_in"], sort=False):
        found = chosen(part)
        name = f"{suite}, {epochs} epochs" if several else str(suite)
        chance = f"{100 * found.chance.mean():.1f}"
        rows.append([name, str(seen_in), chance, share_by(found, "right", OBJECTS).text()])
    return rows


def text(found: Rate) -> str:
    """A rate with its interval and n: "97.2 [94.0, 98.7] 180"."""
    return _text(found.value, found.low, found.high, found.n)


def _numbers(found: Rate) -> tuple[int, float, float, float]:
    return found.n, found.value, found.low, found.high


def _text(value: float, low: float, high: float, n: int) -> str:
    return Estimate(value=float(value), low=float(low), high=float(high), n=n).text()
