"""Success against coverage by a threshold on the vote's margin, by hand."""

import pandas as pd

from vap_core.study.stats import ACTS, THRESHOLDS, abstentions

EPISODES = [
    ("tabletop", "vap", 1.0, True, True),
    ("tabletop", "vap", 1.0, False, True),
    ("tabletop", "vap", 0.6, True, True),
    ("tabletop", "vap", 0.2, False, True),
    ("tabletop-absent", "vap", 0.2, False, True),
    ("tabletop-absent", "vap", 0.0, False, False),
    ("vlabench", "vap", 1.0, True, True),
    ("tabletop", "generic", None, True, True),
    ("tabletop-absent", "generic", None, False, True),
]


def test_the_curve_by_hand() -> None:
    table = pd.DataFrame(EPISODES, columns=["suite", "method", "margin", "success", "touched"])
    table = table.assign(policy="scripted")
    found = abstentions(table)
    lines = found[["suite", "method"]].itertuples(index=False, name=None)
    assert list(lines) == [("tabletop", "vap")] * len(THRESHOLDS)
    by_threshold = found.set_index("threshold")

    def counts(threshold: float) -> list[tuple[int, int]]:
        return [(each.k, each.n) for each in by_threshold.loc[threshold, list(ACTS)]]

    assert counts(0.0) == [(4, 4), (2, 4), (2, 2), (1, 2)]
    assert counts(0.2) == [(4, 4), (2, 4), (1, 2), (1, 2)]
    assert counts(0.4) == [(3, 4), (2, 3), (0, 2), (0, 2)]
    assert counts(1.0) == [(2, 4), (1, 2), (0, 2), (0, 2)]
    assert str(found["SR when it acts"][0]) == "50 % [15, 85]"
    assert abstentions(table.drop(columns="margin")).empty


def test_an_episode_that_ended_before_the_vote_does_not_act() -> None:
    columns = ["suite", "method", "margin", "success", "touched"]
    died = ("tabletop", "vap", None, False, False)
    table = pd.DataFrame([*EPISODES, died], columns=columns).assign(policy="scripted")
    first = abstentions(table).iloc[0]
    assert (first.threshold, first.acts.k, first.acts.n) == (0.0, 4, 5)


def test_policies_are_counted_apart() -> None:
    table = pd.DataFrame(EPISODES, columns=["suite", "method", "margin", "success", "touched"])
    one, other = table.assign(policy="one"), table.assign(policy="other", success=True)
    both = abstentions(pd.concat([one, other]))
    for policy, alone in (("one", one), ("other", other)):
        of_policy = both[both.policy == policy].reset_index(drop=True)
        assert of_policy.astype(str).equals(abstentions(alone).astype(str))
    halves = pd.concat([one[one.suite == "tabletop"], other[other.suite != "tabletop"]])
    assert abstentions(halves).empty
