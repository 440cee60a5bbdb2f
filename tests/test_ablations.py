"""Ablations: arms by name, the table by hand, and the command."""

import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import pytest

from tests.command import refused, vap
from vap_core.attend import Prompting
from vap_core.base.errors import BadOutput, BadStudy
from vap_core.base.files import signed
from vap_core.base.types import Colour, Mask, Rgb
from vap_core.prompt import PALETTE, PromptForm, Tint, tint
from vap_core.rollout.types import MaskCoverage
from vap_core.study import ablations as ablation_run
from vap_core.study import logs, methods, paper
from vap_core.study.ablations import (
    ablation_table,
    arm_folder,
    arm_table,
    effect_text,
    effects_figure,
    findings_table,
    rates_figure,
    shown_table,
    sweep_figure,
    verdict,
)
from vap_core.study.charts import stacked
from vap_core.study.forms import Arrow
from vap_core.study.methods import (
    ABLATIONS,
    ARMS,
    METHODS,
    PUBLISHED,
    Ablation,
    Hidden,
    find,
    known_methods,
    references_needed,
)
from vap_core.study.report import comparison_table
from vap_core.study.stats import rate, rate_over_layouts
from vap_core.study.trials import Study

WORDS = ("--suite", "widowx-pick", "--policy", "scripted", "--episodes", "1", "--workers", "1")


def test_every_arm_is_a_method_with_a_name_of_its_own() -> None:
    names = [name for ablation in ABLATIONS.values() for name in ablation.arms]
    assert len(names) == len(set(names)) == len(ARMS)
    assert not set(ARMS) & set(METHODS)
    for ablation in ABLATIONS.values():
        assert len(ablation.names) >= 2
        assert set(ablation.names) <= set(known_methods())
        assert set(ablation.rows) <= set(ablation.names)
    assert references_needed("references-7") == 7
    assert references_needed("vap") == references_needed("references-1") == 5
    assert find("arrow") == Arrow()
    assert find("hidden-3") == Hidden(3)


def test_every_number_of_the_paper_that_an_arm_names_is_in_its_table() -> None:
    facts = paper.ledger()
    for ablation in ABLATIONS.values():
        for row in ablation.rows.values():
            held = facts[facts["table"].eq(ablation.paper) & facts["row"].eq(row)]
            assert set(held["column"]) >= {"Google Robot", "WidowX"}, row


def outcomes(arm: str, won: list[bool]) -> pd.DataFrame:
    rows = []
    for i, success in enumerate(won):
        rows.append({
            "suite": "simpler-bridge", "task": "pick-shaver", "split": "", "variant": "base", "episode": i, "seed": 0, "policy": "p",
            "method": arm, "outcome": "success" if success else "failure", "success": success, "cmr": success, "case": "" if success else "case 1",
        })  # fmt: skip
    return pd.DataFrame(rows)


def headings(axes: Any) -> list[str]:
    return [text.get_text() for text in axes.texts if text.get_fontweight() == "bold"]


def test_the_table_by_hand() -> None:
    ablation = ABLATIONS["rewrite"]
    table = pd.concat([
        outcomes("vap", [True] * 9 + [False]),
        outcomes("mask-only", [True] * 2 + [False] * 8),
        outcomes("rewrite-only", [True] * 9 + [False]),
    ], ignore_index=True)  # fmt: skip
    found = arm_table(ablation, table)
    vap_arm, mask_only, rewrite_only = found.itertuples()
    assert (vap_arm.sr.k, vap_arm.sr.n, found["case 1"][0].k) == (9, 10, 1)
    assert np.isnan(vap_arm.difference)
    assert mask_only.difference == pytest.approx(-0.7)
    assert mask_only.p == pytest.approx(2 / 2**7)
    assert mask_only.p_holm == pytest.approx(4 / 2**7), "two arms"
    assert rewrite_only.difference == 0
    assert (vap_arm.paper, mask_only.paper) == pytest.approx((0.835, 0.052))
    text = shown_table(found).to_numpy().tolist()
    assert text[1][1:4] == ["mask-only", 10, "20 % [6, 51]"]
    assert text[1][-1] == "5.2"
    (axes,) = effects_figure(found, "why").axes
    assert headings(axes) == ["against vap, 90 % of 10"]
    labels = [text.get_text() for text in axes.get_yticklabels()]
    assert labels == ["", "mask-only", "rewrite-only"]


def test_seeds_of_the_same_layouts_do_not_narrow_an_arms_interval() -> None:
    won = [True] * 9 + [False]
    one_seed = pd.concat([outcomes("vap", won), outcomes("mask-only", won)], ignore_index=True)
    ten_seeds = pd.concat([one_seed.assign(seed=seed) for seed in range(10)], ignore_index=True)
    (few, _), (many, _) = (
        arm_table(ABLATIONS["rewrite"], rows).itertuples() for rows in (one_seed, ten_seeds)
    )
    assert (few.sr.n, many.sr.n) == (10, 100)
    assert many.sr.high - many.sr.low > 0.3 > rate(90, 100).high - rate(90, 100).low
    assert str(few.sr) == str(rate(9, 10)), "Wilson's where no layout returns"


def test_several_policies_of_a_suite_are_refused() -> None:
    """Their episodes would be pooled, and compared by the last policy alone."""
    ablation = ABLATIONS["rewrite"]
    of_one = pd.concat([outcomes("vap", [True] * 9), outcomes("mask-only", [False] * 9)])
    of_two = pd.concat([of_one, of_one.assign(policy="q")], ignore_index=True)
    with pytest.raises(BadOutput, match=r"2 policies \(p, q\); name one: keep its rows alone"):
        arm_table(ablation, of_two)
    other_arm = outcomes("generic", [True] * 9).assign(policy="q")
    beside = pd.concat([of_one, other_arm, of_two.assign(suite="vlabench", method="vap")])
    assert arm_table(ablation, beside).arm.tolist() == ["vap", "mask-only"]


def test_an_arm_that_shares_no_episode_with_the_first_is_refused() -> None:
    """It has no difference, and would be taken for the first arm itself."""
    both = outcomes("mask-only", [False] * 10)
    other_seed = outcomes("rewrite-only", [True] * 10).assign(seed=1)
    table = pd.concat([outcomes("vap", [True] * 10), both, other_seed], ignore_index=True)
    with pytest.raises(BadOutput, match=r"rewrite-only shares no episode with vap on simpler-br"):
        arm_table(ABLATIONS["rewrite"], table)
    results = arm_table(ABLATIONS["rewrite"], table[table["method"] != "rewrite-only"])
    assert results[results.p.isna()].arm.tolist() == ["vap"]


def test_an_error_is_a_failure_and_has_no_cmr_where_none_is_defined() -> None:
    table = pd.concat([outcomes("vap", [True] * 9 + [False]), outcomes("mask-only", [True] * 10)])
    table = table.reset_index(drop=True).assign(cmr=None)
    table.loc[9, "outcome"] = "error"
    found = arm_table(ABLATIONS["rewrite"], table)
    vap_arm = found.iloc[0]
    assert (vap_arm.sr.k, vap_arm.sr.n, vap_arm.cmr.n) == (9, 10, 0)
    assert shown_table(found)["CMR % [95 %]"][0] == "-"


@pytest.mark.parametrize("seeds", [1, 3])
def test_the_note_below_the_table_says_whose_the_intervals_are(
    seeds: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    won = [True] * 9 + [False]
    once = pd.concat([outcomes("vap", won), outcomes("mask-only", won)], ignore_index=True)
    table = pd.concat([once.assign(seed=seed) for seed in range(seeds)], ignore_index=True)
    monkeypatch.setattr(ablation_run, "run_arms", lambda *_, **__: table)
    study = Study((("simpler-bridge", "pick-shaver"),), ("vap",), episodes=10, seeds=seeds)
    text = ablation_run.ablate_text("rewrite", study, tmp_path)
    assert "Intervals of rates: over layouts where they return, else Wilson's" in text
    wilson = str(rate(9 * seeds, 10 * seeds))
    assert (wilson in text) == (seeds == 1)


def test_an_arm_takes_one_line() -> None:
    own = Ablation(question="Is green better?", arms={"green": Prompting(palette=PALETTE[2:3])})
    assert own.names == ("vap", "green")


def test_without_a_name_ablations_are_listed_and_unknown_ones_refused() -> None:
    listed = vap("ablate")
    assert listed.returncode == 0
    assert all(name in listed.stdout for name in ABLATIONS)
    assert "ablation 'shape' is unknown; known: association, colour, form" in refused(
        "ablate", "shape"
    )


@pytest.mark.sweep
def test_the_command_says_what_it_found_and_runs_nothing_twice(tmp_path: Path) -> None:
    words = ("ablate", "selection", *WORDS, "--out", tmp_path / "run")
    done = vap(*words)
    assert done.returncode == 0, done.stderr
    assert ABLATIONS["selection"].question in done.stdout
    assert "0 errors" in done.stdout
    assert (tmp_path / "run" / "selection.png").stat().st_size > 5_000
    assert vap(*words).stdout == done.stdout


@pytest.mark.sweep
@pytest.mark.parametrize(
    "name",
    sorted(set(ABLATIONS) - {"selection", "association", "language", "colour"}),
)
def test_every_ablation_runs(name: str, tmp_path: Path) -> None:
    # The scripted policy knows the palette's colour words alone, and needs a command and one view.
    done = vap("ablate", name, *WORDS, "--out", tmp_path / "run")
    assert done.returncode == 0, done.stderr
    assert "0 errors" in done.stdout


def test_the_track_is_kept_that_is_on_the_target_soon_after_it_is_seen_again() -> None:
    def seen(shown: str | None, pixels: int = 500) -> list[MaskCoverage]:
        return [MaskCoverage(camera="c", object=shown, iou=0.9, pixels=pixels, proposal=np.nan)]

    assert logs.is_track_kept([[], seen("mine")], "mine") is True
    assert logs.is_track_kept([seen(None), [], seen("mine")], "mine") is True
    assert logs.is_track_kept([seen(None), seen("other"), seen("mine")], "mine") is False
    assert logs.is_track_kept([seen("mine", pixels=20), []], "mine") is None
    rows = outcomes("hidden-2", [True] * 4).assign(hidden_s=1.6)
    rows["track_kept"] = [True, True, False, None]
    (line,) = logs.hiding_lines(rows)
    assert line == (f"simpler-bridge hidden-2: hidden for 1.6 s, track kept in {rate(2, 3)}")
    assert logs.hiding_lines(outcomes("vap", [True])) == []


def test_layouts_that_return_do_not_narrow_what_is_said_of_tracks_and_switches() -> None:
    held = [True] * 9 + [False]
    once = outcomes("arm", held).assign(hidden_s=1.6, track_kept=held, switched_s=1.0)
    once = once.assign(turned_s=None, obeyed=held)
    again = pd.concat([once.assign(seed=seed) for seed in range(10)], ignore_index=True)
    for lines in (logs.hiding_lines, logs.switching_lines):
        (few,), (many,) = lines(once), lines(again)
        assert f"in {rate(9, 10)}" in few, "Wilson's where no layout returns"
        assert f"in {rate_over_layouts(again)}" in many
        assert str(rate(90, 100)) not in many


def test_an_arm_runs_once_for_all_ablations(tmp_path: Path) -> None:
    study = Study((("widowx-pick", "pick-bottle"),), ("vap", "opaque"), episodes=1)
    assert "opaque" in ABLATIONS["form"].arms
    assert "opaque" in ABLATIONS["opacity"].methods
    other = replace(study, methods=ABLATIONS["opacity"].names)
    assert arm_folder(study, tmp_path, "opaque") == arm_folder(other, tmp_path, "opaque")
    longer = replace(study, episodes=2)
    assert arm_folder(study, tmp_path, "vap") != arm_folder(longer, tmp_path, "vap")


def test_another_definition_of_an_own_arm_is_another_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    forms: list[PromptForm] = [Tint(1.0), Tint(0.2), _all_red, _red_box]
    folders = []
    for form in forms * 2:
        monkeypatch.setitem(methods._ALL, "mine", Prompting(form=form))
        study = Study((("widowx-pick", "pick-bottle"),), ("mine",), episodes=1)
        folders.append(arm_folder(study, tmp_path, "mine"))
    assert len(set(folders)) == len(forms)
    assert folders[: len(forms)] == folders[len(forms) :], "an unchanged arm goes on"
    shipped = replace(study, methods=("vap", "opaque")).configuration()
    assert "arms" not in shipped, "digests are those of versions without it"
    assert set(known_methods()) >= PUBLISHED


def _all_red(rgb: Rgb, mask: Mask, colour: Colour, others: Sequence[Mask]) -> Rgb:
    return np.full_like(rgb, colour.rgb)


def _red_box(rgb: Rgb, mask: Mask, colour: Colour, others: Sequence[Mask]) -> Rgb:
    return tint(rgb, mask, colour)


def _mixed(rgb: Rgb, mask: Mask, colour: Colour, others: Sequence[Mask], alpha: float = 0.5) -> Rgb:
    return tint(rgb, mask, colour, alpha)


def _closure(alpha: float) -> PromptForm:
    def form(rgb: Rgb, mask: Mask, colour: Colour, others: Sequence[Mask]) -> Rgb:
        return tint(rgb, mask, colour, alpha)

    return form


def _local_class(alpha: float) -> PromptForm:
    @dataclass(frozen=True)
    class Form:
        def __call__(self, rgb: Rgb, mask: Mask, colour: Colour, others: Sequence[Mask]) -> Rgb:
            return tint(rgb, mask, colour, alpha)

    return Form()


class Slotted:
    """A form whose number is in no field of a dataclass."""

    __slots__ = ("alpha",)

    def __init__(self, alpha: float) -> None:
        self.alpha = alpha

    def __call__(self, rgb: Rgb, mask: Mask, colour: Colour, others: Sequence[Mask]) -> Rgb:
        return tint(rgb, mask, colour, self.alpha)

    def mark(self, rgb: Rgb, mask: Mask, colour: Colour, others: Sequence[Mask]) -> Rgb:
        return self(rgb, mask, colour, others)


class Named(NamedTuple):
    """A form that is a tuple."""

    alpha: float

    def __call__(self, rgb: Rgb, mask: Mask, colour: Colour, others: Sequence[Mask]) -> Rgb:
        return tint(rgb, mask, colour, self.alpha)


@dataclass(frozen=True)
class Table:
    """A form with an array, whose text leaves most numbers out."""

    weights: np.ndarray

    def __call__(self, rgb: Rgb, mask: Mask, colour: Colour, others: Sequence[Mask]) -> Rgb:
        return rgb


@pytest.mark.parametrize(
    "form",
    [
        _closure(0.3),
        _local_class(0.3),
        partial(_mixed, alpha=0.3),
        Slotted(0.3),
        Slotted(0.3).mark,
        Named(0.3),
        Table(np.zeros(2000)),
        lambda rgb, mask, colour, others, alpha=0.3: tint(rgb, mask, colour, alpha),
    ],
    ids=["closure", "local", "partial", "slots", "method", "tuple", "array", "lambda"],
)
def test_a_form_that_cannot_be_told_from_another_is_refused(
    form: PromptForm, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Else the numbers of alpha .3 are returned for alpha .7: nothing that is read differs."""
    monkeypatch.setitem(methods._ALL, "mine", Prompting(form=form))
    study = Study((("widowx-pick", "pick-bottle"),), ("mine",), episodes=1)
    with pytest.raises(BadStudy, match="take a dataclass or a function of a module") as refusal:
        study.configuration()
    assert "\n" not in str(refusal.value)


OWN_FORM = """
from dataclasses import dataclass

class Base:
    def __call__(self, rgb, mask, colour, others):
        return rgb + {level}

@dataclass(frozen=True)
class Form(Base):
    alpha: float = 0.5
"""


def test_what_a_form_inherits_is_its_code_too(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = []
    for level in (1, 1, 2):
        file = tmp_path / f"mine_{len(found)}.py"
        file.write_text(OWN_FORM.format(level=level))
        spec = spec_from_file_location(file.stem, file)
        assert spec is not None
        assert spec.loader is not None
        module = module_from_spec(spec)
        monkeypatch.setitem(sys.modules, file.stem, module)
        spec.loader.exec_module(module)
        found.append(methods.describe(module.Form()))
    assert found[0] == found[1] != found[2]


def test_figures_of_published_ablations() -> None:
    table = pd.concat([
        outcomes("vap", [True] * 9 + [False]),
        outcomes("opaque", [True] * 6 + [False] * 4),
        outcomes("opacity-0.1", [True] * 2 + [False] * 8),
        outcomes("mask-only", [True] * 2 + [False] * 8),
    ], ignore_index=True)  # fmt: skip
    results = ablation_table(table)
    assert set(results.ablation) == {"rewrite", "form", "opacity"}, "the others have no arm there"
    opacity, form = (results[results.ablation == name] for name in ("opacity", "form"))
    assert opacity.arm.tolist() == ["vap", "opaque", "opacity-0.1"]
    (axes,) = effects_figure(results).axes
    assert headings(axes)[0] == "rewrite: against vap, 90 % of 10"
    assert axes.get_yticklabels()[1].get_text() == "mask-only"
    places = {"opacity-0.1": 0.1, "vap": 0.5, "opaque": 1.0, "opacity-0.3": 0.3}
    line, _ = sweep_figure(opacity, places, "opacity").axes[0].lines
    assert list(line.get_xdata()) == [0.1, 0.5, 1.0]
    assert list(line.get_ydata()) == pytest.approx([20, 90, 60])
    assert len(rates_figure(form).axes[0].get_yticklabels()) == 2
    assert effect_text(opacity, "opaque").startswith("-30 [")
    assert effect_text(opacity, "vap") == "90 % of 10"


def test_arms_of_another_suite_are_read_by_its_name() -> None:
    arms = {"vap": [True] * 9 + [False], "mask-only": [False] * 10}
    fractal = [outcomes(arm, won).assign(suite="simpler-fractal") for arm, won in arms.items()]
    table = pd.concat([outcomes("vap", [True] * 10), *fractal], ignore_index=True)
    assert ablation_table(table).empty, "one arm on simpler-bridge, two on no default suite"
    default, tint_alone = ablation_table(table, "simpler-fractal").itertuples()
    assert (default.sr.k, default.sr.n, tint_alone.sr.k) == (9, 10, 0)
    assert (default.paper, tint_alone.paper) == pytest.approx((0.627, 0.073))


def test_pictures_of_two_suites_have_a_part_and_the_papers_robot_each() -> None:
    rates = {
        "simpler-bridge": {"vap": 9, "references-1": 6, "references-3": 8},
        "simpler-fractal": {"vap": 7, "references-1": 2},
    }
    table = pd.concat([
        outcomes(arm, [True] * k + [False] * (10 - k)).assign(suite=suite)
        for suite, arms in rates.items() for arm, k in arms.items()
    ], ignore_index=True)  # fmt: skip
    arms = ablation_table(table, *rates)
    arms = arms[arms.ablation == "references"]
    places = {"references-1": 1.0, "references-3": 3.0, "vap": 5.0, "references-7": 7.0}
    parts = sweep_figure(arms, places, "reference photos").axes
    assert [part.get_title() for part in parts] == ["simpler-bridge, n 10", "simpler-fractal, n 10"]
    ours, theirs = zip(
        *([list(line.get_ydata()) for line in part.lines] for part in parts), strict=True
    )
    assert list(ours) == [pytest.approx([60, 80, 90]), pytest.approx([20, 70])]
    assert list(theirs) == [pytest.approx([61.9, 78.4, 83.5]), pytest.approx([45.6, 62.7])]
    names = [
        [tick.get_text() for tick in axes.get_yticklabels()] for axes in rates_figure(arms).axes
    ]
    assert names == [["vap", "references-1", "references-3"], ["vap", "references-1"]]


def test_an_ablation_of_two_suites_has_a_heading_each() -> None:
    arms = {"vap": [True] * 4 + [False] * 6, "vap-associated": [True] * 7 + [False] * 3}
    table = pd.concat([
        outcomes(arm, won).assign(suite=suite, case=["case 2" if suite == "tabletop" else "case 1"] * 10)
        for suite in ("vlabench", "tabletop") for arm, won in arms.items()
    ], ignore_index=True)  # fmt: skip
    results = ablation_table(table)
    (axes,) = effects_figure(results).axes
    assert headings(axes) == [
        "vlabench: against vap, 40 % of 10",
        "tabletop: against vap, 40 % of 10",
    ]
    labels = [tick.get_text() for tick in axes.get_yticklabels()]
    assert labels == ["", "vap-associated", "", "vap-associated"]
    assert len(effects_figure(results, columns=2).axes) == 2
    assert effect_text(results, "vap-associated", "tabletop").startswith("+30 [")
    counts = results.assign(
        **{case: [each.k for each in results[case]] for case in ("case 1", "case 2")}
    )
    (bars,) = stacked(counts, "arm", ["case 1", "case 2"]).axes
    assert [round(bar.get_width()) for bar in bars.patches] == [100, 100, 0, 0, 0, 0, 100, 100]


@pytest.mark.parametrize(("low", "high", "p", "theirs", "said"), [
    (-0.9, -0.7, 0.001, -0.78, "holds"),
    (-0.3, -0.1, 0.001, -0.58, "holds, weaker"),
    (-0.9, -0.7, 0.001, -0.4, "holds, stronger"),
    (0.1, 0.3, 0.001, -0.2, "the other way round"),
    (-0.1, 0.1, 0.7, -0.2, "not here: as much is excluded"),
    (-0.1, 0.1, 0.7, 0.05, "cannot tell"),
    (-0.052, -0.004, 0.41, 0.001, "none is shown in either"),
    (-0.052, -0.004, 0.01, -0.001, "there is none, here is one"),
    (-0.1, -0.02, 0.06, -0.05, "cannot tell"),
    (-0.1, -0.02, 0.06, -0.01, "cannot tell"),
])  # fmt: skip
def test_what_a_difference_says_about_the_papers_finding(
    low: float, high: float, p: float, theirs: float, said: str
) -> None:
    about = dict(difference=(low + high) / 2, low=low, high=high, shown=p < 0.05)
    assert verdict(SimpleNamespace(**about, paper_difference=theirs)) == said


def test_the_table_of_findings_holds_the_papers_arms_only() -> None:
    table = pd.concat([
        outcomes("vap", [True] * 9 + [False]),
        outcomes("mask-only", [False] * 10),
        outcomes("contour", [False] * 10),
    ], ignore_index=True)  # fmt: skip
    (row,) = findings_table(ablation_table(table)).to_dict("records")
    assert (row["ablation"], row["arm"], row["n"], row["paper"]) == (
        "rewrite", "mask-only", 10, "-78",
    )  # fmt: skip
    assert row["here, points [95 %]"].startswith("-90 [")
    assert row["the paper's finding"] == "holds"


def test_a_difference_that_rounds_to_no_point_has_one_sign_in_every_table() -> None:
    rates = dict(sr=rate(9, 10), cmr=rate(9, 10), n=10) | {
        "case 1": rate(0, 10),
        "case 2": rate(0, 10),
    }
    nothing: dict[str, Any] = dict.fromkeys(
        ("difference", "low", "high", "p", "p_holm", "paper_difference")
    )
    first = {"ablation": "opacity", "suite": "s", "arm": "vap", **rates, **nothing, "paper": 0.5}
    difference = dict(difference=-0.0004, low=-0.0003, high=0.0004, p=1.0, p_holm=1.0)
    arm = {**first, "arm": "opaque", **difference, "paper": 0.499, "paper_difference": -0.001}
    arms = pd.DataFrame([first, arm]).assign(shown=False)
    (row,) = findings_table(arms).to_dict("records")
    assert (row["here, points [95 %]"], row["paper"]) == ("+0 [+0, +0]", "+0")
    assert effect_text(arms, "opaque") == "+0 [+0, +0]"
    assert shown_table(arms).iloc[1]["against the first, points [95 %]"] == "+0.0 [+0.0, +0.0]"
    names = dict.fromkeys(("suite", "task", "split", "policy", "one", "other"), "s")
    counts = dict.fromkeys(("pairs", "layouts", "only_one", "only_other"), 0)
    table = comparison_table(pd.DataFrame([{**names, **counts, **difference, "p_mcnemar": 1.0}]))
    assert table["difference [95 %]"][0] == "+0.0 [+0.0, +0.0]"
    assert signed(-0.4) == signed(0.4) == "+0"
    assert (signed(-0.6), signed(2.26, 1)) == ("-1", "+2.3")


def test_arms_that_were_tried_and_left_count_in_the_correction() -> None:
    ablation = Ablation("Which?", arms={}, methods=("vap", "vap-associated"))
    columns = {
        "suite": "s",
        "task": "t",
        "split": "",
        "seed": 0,
        "policy": "p",
        "case": "",
        "variant": "",
    }
    rows = [
        {
            **columns,
            "episode": i,
            "method": name,
            "success": won,
            "cmr": None,
            "outcome": "",
            "layout": i,
        }
        for i in range(20)
        for name, won in (("vap", i < 8), ("vap-associated", i < 14))
    ]
    p_holm = []
    for retired in (0, 5):
        found = arm_table(replace(ablation, retired=retired), pd.DataFrame(rows))
        p_holm.append(found.p_holm[1])
    assert p_holm[1] == pytest.approx(min(1.0, 6 * p_holm[0]))
