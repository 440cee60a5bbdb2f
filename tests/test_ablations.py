"""Ablations: forms of a prompt, arms by name, the table by hand, and the command."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.command import refused, vap
from vap_core.analysis.ablation_findings import findings_table, verdict
from vap_core.analysis.ablations import (
    ablation_results,
    all_effects_figure,
    cases_figure,
    cases_text,
    effect_text,
    rates_of_arms_figure,
    sweep_figure,
)
from vap_core.analysis.agreements import gate_figure, gated_cases
from vap_core.analysis.prompt_forms import (
    forms_figure,
    marked_frames,
    tinted_frames,
    tints_figure,
)
from vap_core.attend import Prompting
from vap_core.base.types import Camera
from vap_core.evaluation import hiding, paper
from vap_core.evaluation.ablations.arms import ABLATIONS, ARMS, TINT_SHARES, Ablation, Hidden
from vap_core.evaluation.ablations.arrow import Arrow, hand_pixel
from vap_core.evaluation.ablations.forms import draw_arrow
from vap_core.evaluation.ablations.picture import effects_figure, policies_figure
from vap_core.evaluation.ablations.run import arm_folder
from vap_core.evaluation.ablations.table import (
    across_policies,
    arm_results,
    arm_rows,
    policy_results,
)
from vap_core.evaluation.methods import METHODS, find, known_methods, references_needed
from vap_core.evaluation.statistics import Comparison
from vap_core.evaluation.study import Study
from vap_core.prompt import PALETTE, Tint, has_colour, tint
from vap_core.rollout.prompters.oracle import Oracle, OraclePrompter
from vap_core.rollout.types import MaskCoverage
from vap_core.simulation import suites
from vap_core.simulation.assets.objects import get_object, texture_image

FORMS = {
    name: arm.form for name, arm in ABLATIONS["form"].arms.items() if isinstance(arm, Prompting)
}
RED = PALETTE[0]


def blob(h: int, w: int, y: int, x: int, r: int) -> np.ndarray:
    rows, cols = np.mgrid[0:h, 0:w]
    return (rows - y) ** 2 + (cols - x) ** 2 <= r * r


@settings(max_examples=15, deadline=None)
@given(
    h=st.integers(40, 90),
    w=st.integers(40, 90),
    y=st.integers(-5, 95),
    x=st.integers(-5, 95),
    seed=st.integers(0, 9),
)
@pytest.mark.parametrize("name", FORMS)
def test_a_form_marks_a_copy_of_any_picture(
    name: str, h: int, w: int, y: int, x: int, seed: int
) -> None:
    rgb = np.random.default_rng(seed).integers(0, 200, (h, w, 3), np.uint8)
    kept = rgb.copy()
    mask, other = blob(h, w, y, x, 9), blob(h, w, h // 4, w // 4, 6)
    marked = FORMS[name](rgb, mask, RED, [other & ~mask])
    assert (rgb == kept).all()
    assert (marked.shape, marked.dtype) == (rgb.shape, np.uint8)
    if mask.any() and name != "others-erased":
        assert (marked != rgb).any()


@pytest.mark.parametrize("name", sorted(set(FORMS) - {"marker", "others-erased"}))
def test_without_a_target_nothing_is_marked(name: str) -> None:
    rgb = np.full((64, 64, 3), 90, np.uint8)
    nothing = np.zeros((64, 64), bool)
    assert (FORMS[name](rgb, nothing, RED, []) == rgb).all()


def test_each_form_does_what_its_name_says() -> None:
    rgb = np.random.default_rng(0).integers(60, 120, (112, 112, 3), np.uint8)
    mask, other = blob(112, 112, 60, 40, 14), blob(112, 112, 60, 85, 12)
    changed = {
        name: (form(rgb, mask, RED, [other]) != rgb).any(axis=2) for name, form in FORMS.items()
    }
    assert (changed["opaque"] == mask).all()
    box = np.zeros_like(mask)
    box[46:75, 26:55] = True
    assert (changed["box"] == box).all()
    assert not changed["contour"][60, 40]
    assert changed["point"][60, 40]
    assert changed["point"].sum() < 0.2 * mask.sum()
    assert not changed["circle"][mask].any()
    assert changed["marker"][60, 85]
    assert not changed["dimmed"][mask].any()
    assert changed["dimmed"][~mask].all()
    assert not changed["others-erased"][mask].any()
    assert changed["others-erased"][other].mean() > 0.9


def test_the_default_form_is_the_papers_tint() -> None:
    rgb = np.random.default_rng(1).integers(0, 255, (32, 32, 3), np.uint8)
    mask = blob(32, 32, 16, 16, 7)
    assert (Prompting().form(rgb, mask, RED, []) == tint(rgb, mask, RED)).all()
    assert Prompting().form == Tint(0.5)


def test_every_arm_is_a_method_with_a_name_of_its_own() -> None:
    names = [name for ablation in ABLATIONS.values() for name in ablation.arms]
    assert len(names) == len(set(names)) == len(ARMS)
    assert not set(ARMS) & set(METHODS)
    for ablation in ABLATIONS.values():
        assert len(ablation.names) >= 3
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


@pytest.mark.parametrize(("area", "shift"), [(0.25, 0.0), (2.0, 0.0), (1.0, 0.5)])
def test_a_spoiled_mask_has_its_area_and_its_shift(area: float, shift: float) -> None:
    mask = blob(224, 224, 100, 90, 30)
    prompter = OraclePrompter.__new__(OraclePrompter)
    prompter.oracle = Oracle("track", area=area, shift=shift)
    spoiled = prompter._spoil(mask)
    assert spoiled.sum() == pytest.approx(area * mask.sum(), rel=0.05)
    centre = np.argwhere(spoiled).mean(axis=0)
    assert centre == pytest.approx([100, 90 + shift * 61], abs=1.0)


def outcomes(arm: str, won: list[bool]) -> pd.DataFrame:
    rows = []
    for i, success in enumerate(won):
        rows.append({
            "suite": "simpler-bridge", "task": "pick-shaver", "split": "", "variant": "base", "episode": i, "seed": 0, "policy": "p",
            "method": arm, "outcome": "success" if success else "failure", "success": success, "cmr": success, "case": "" if success else "case 1",
        })  # fmt: skip
    return pd.DataFrame(rows)


def test_the_table_by_hand() -> None:
    ablation = ABLATIONS["rewrite"]
    table = pd.concat([
        outcomes("vap", [True] * 9 + [False]),
        outcomes("mask-only", [True] * 2 + [False] * 8),
        outcomes("rewrite-only", [True] * 9 + [False]),
    ], ignore_index=True)  # fmt: skip
    vap_arm, mask_only, rewrite_only = arm_results(ablation, table)
    assert (vap_arm.sr.k, vap_arm.sr.n, vap_arm.against, vap_arm.case_1.k) == (9, 10, None, 1)
    assert mask_only.against is not None
    assert mask_only.against.difference == pytest.approx(-0.7)
    assert mask_only.against.p == pytest.approx(2 / 2**7)
    assert mask_only.against.p_holm == pytest.approx(4 / 2**7), "two arms"
    assert rewrite_only.against is not None
    assert rewrite_only.against.difference == 0
    assert (vap_arm.paper, mask_only.paper) == pytest.approx((0.835, 0.052))
    text = arm_rows([vap_arm, mask_only, rewrite_only])
    assert text[2][1:4] == ["mask-only", "10", "20 % [6, 51]"]
    assert text[2][-1] == "5.2"
    figure = effects_figure([vap_arm, mask_only, rewrite_only], "why")
    labels = [label.get_text() for label in figure.axes[0].get_yticklabels()]
    assert labels == ["rewrite-only, n 10", "mask-only, n 10"]


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


WORDS = ("--suite", "widowx-pick", "--policy", "scripted", "--episodes", "1", "--workers", "1")


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
    sorted(set(ABLATIONS) - {"selection", "association", "language", "colour", "tint-share"}),
)
def test_every_ablation_runs(name: str, tmp_path: Path) -> None:
    # The scripted policy knows the palette's colour words alone, and needs a command and one view.
    done = vap("ablate", name, *WORDS, "--out", tmp_path / "run")
    assert done.returncode == 0, done.stderr
    assert "0 errors" in done.stdout


@pytest.mark.sweep
def test_an_ablation_of_policies_runs_them_all(tmp_path: Path) -> None:
    done = vap("ablate", "tint-share", "--suite", "widowx-pick", "--episodes", "1",
               "--workers", "1", "--out", tmp_path / "run")  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "0 errors" in done.stdout
    assert all(checkpoint in done.stdout for checkpoint in TINT_SHARES.values())
    assert len(list((tmp_path / "run").glob("*/run.json"))) == 3 * 4
    assert (tmp_path / "run" / "tint-share.png").stat().st_size > 5_000


def test_an_ablation_of_policies_takes_no_other() -> None:
    assert "leave --policy out" in refused("ablate", "tint-share", "--policy", "scripted")


def camera(x: float = 0.0) -> Camera:
    """Looks straight down from one metre above the table; `x` is its place (metres)."""
    pose = np.diag([1.0, -1.0, -1.0, 1.0])
    pose[:3, 3] = x, 0, 1
    k = np.array([[100.0, 0, 50], [0, 100, 50], [0, 0, 1]])
    return Camera(name="top", width=100, height=100, k=k, pose_world=pose)


def test_the_arrow_begins_at_the_hand_and_ends_on_the_target() -> None:
    assert hand_pixel(camera(), np.array([0.1, 0.2, 0.5])) == (70, 10)
    assert hand_pixel(camera(), np.array([0.0, 0.0, 1.5])) is None, "behind the camera"
    assert hand_pixel(camera(), np.array([500.0, 0.0, 0.5])) == (4096, 50), "far outside"
    rgb = np.full((100, 100, 3), 90, np.uint8)
    drawn = draw_arrow(rgb, blob(100, 100, 70, 30, 8), RED, (70, 10))
    changed = (drawn != rgb).any(axis=2)
    assert changed[10, 70]
    assert changed[70, 30]
    assert not changed[:, 80:].any()


def test_every_look_alike_can_be_red_by_nature() -> None:
    for row in suites.benchmark("simpler-bridge-red"):
        listed = suites.benchmark("simpler-bridge")
        same = next(one for one in listed if (one.task, one.episode) == (row.task, row.episode))
        changed = [a.model for a, b in zip(row.placements, same.placements, strict=True)
                   if a.model != b.model]  # fmt: skip
        assert len(changed) == 1
        assert changed[0].endswith("-red")
        assert get_object(changed[0]).category == row.category
    red = get_object("shaver-lookalike-1-red")
    assert red is get_object("shaver-lookalike-1-red"), "meshes are kept by object"
    assert (
        has_colour(texture_image(red), RED).mean()
        > 3 * has_colour(texture_image(get_object("shaver-lookalike-1")), RED).mean() + 0.1
    )


def test_the_track_is_kept_that_is_on_the_target_soon_after_it_is_seen_again() -> None:
    def seen(shown: str | None, pixels: int = 500) -> list[MaskCoverage]:
        return [MaskCoverage(camera="c", object=shown, iou=0.9, pixels=pixels, proposal=np.nan)]

    assert hiding.is_track_kept([[], seen("mine")], "mine") is True
    assert hiding.is_track_kept([seen(None), [], seen("mine")], "mine") is True
    assert hiding.is_track_kept([seen(None), seen("other"), seen("mine")], "mine") is False
    assert hiding.is_track_kept([seen("mine", pixels=20), []], "mine") is None
    rows = []
    for kept in (True, True, False, None):
        rows.append({"suite": "s", "method": "hidden-2", "hidden_s": 1.6, "track_kept": kept})
    (line,) = hiding.hiding_lines(pd.DataFrame(rows))
    assert line.startswith("s hidden-2: hidden for 1.6 s, track kept in 67 %")
    assert hiding.hiding_lines(outcomes("vap", [True])) == []


def test_an_arm_runs_once_for_all_ablations(tmp_path: Path) -> None:
    study = Study((("widowx-pick", "pick-bottle"),), ("vap", "opaque"), episodes=1)
    assert "opaque" in ABLATIONS["form"].arms
    assert "opaque" in ABLATIONS["opacity"].methods
    other = replace(study, methods=ABLATIONS["opacity"].names)
    assert arm_folder(study, tmp_path, "opaque") == arm_folder(other, tmp_path, "opaque")
    longer = replace(study, episodes=2)
    assert arm_folder(study, tmp_path, "vap") != arm_folder(longer, tmp_path, "vap")


def test_the_target_is_hidden_from_the_third_call_on() -> None:
    from vap_core.evaluation.study import _occlusion

    occlusion = _occlusion("hidden-2", execute=4)
    assert occlusion is not None
    assert [step for step in range(40) if occlusion.covers("front", step)] == list(range(8, 16))
    assert _occlusion("vap", execute=4) is None
    assert suites.rows("simpler-bridge", "pick-shaver", n=1)


@pytest.mark.parametrize("name", FORMS)
def test_a_form_that_marks_others_says_so(name: str) -> None:
    rgb = np.random.default_rng(2).integers(60, 120, (112, 112, 3), np.uint8)
    mask, other = blob(112, 112, 60, 30, 12), blob(112, 112, 60, 80, 12)
    differs = bool((FORMS[name](rgb, mask, RED, [other]) != FORMS[name](rgb, mask, RED, [])).any())
    assert differs == bool(getattr(FORMS[name], "marks_others", False))


def test_figures_of_published_ablations() -> None:
    table = pd.concat([
        outcomes("vap", [True] * 9 + [False]),
        outcomes("opaque", [True] * 6 + [False] * 4),
        outcomes("opacity-0.1", [True] * 2 + [False] * 8),
        outcomes("mask-only", [True] * 2 + [False] * 8),
    ], ignore_index=True)  # fmt: skip
    results = ablation_results(table)
    assert set(results) == {"rewrite", "form", "opacity"}, "the others have no arm there"
    assert [one.arm for one in results["opacity"]] == ["vap", "opaque", "opacity-0.1"]
    labels = [tick.get_text() for tick in all_effects_figure(results).axes[0].get_yticklabels()]
    assert labels[:2] == ["rewrite: against vap, 90 % of 10", "mask-only"]
    places = {"opacity-0.1": 0.1, "vap": 0.5, "opaque": 1.0, "opacity-0.3": 0.3}
    (line, *_) = sweep_figure(results["opacity"], places, "opacity").axes[0].containers[0]
    assert line.get_xdata().tolist() == [0.1, 0.5, 1.0]
    assert line.get_ydata().tolist() == pytest.approx([20, 90, 60])
    assert len(rates_of_arms_figure(results["form"]).axes[0].get_yticklabels()) == 2
    assert effect_text(results["opacity"], "opaque").startswith("-30 [")
    assert effect_text(results["opacity"], "vap") == "90 % of 10"
    assert cases_text(results["rewrite"]).splitlines()[0].split() == (
        "vap SR 90 % [60, 98], Case 1 1 of 10, Case 2 0 of 10".split()
    )


def test_an_ablation_of_two_suites_has_a_heading_each() -> None:
    arms = {"vap": [True] * 4 + [False] * 6, "vap-associated": [True] * 7 + [False] * 3}
    table = pd.concat([
        outcomes(arm, won).assign(suite=suite, case=["case 2" if suite == "tabletop" else "case 1"] * 10)
        for suite in ("vlabench", "tabletop") for arm, won in arms.items()
    ], ignore_index=True)  # fmt: skip
    results = ablation_results(table)
    (axes,) = all_effects_figure(results, columns=1).axes
    labels = [tick.get_text() for tick in axes.get_yticklabels()]
    assert labels == [
        "association on vlabench: against vap, 40 % of 10",
        "vap-associated",
        "association on tabletop: against vap, 40 % of 10",
        "vap-associated",
    ]
    assert len(all_effects_figure(results, columns=2).axes) == 2
    assert effect_text(results["association"], "vap-associated", "tabletop").startswith("+30 [")
    left, right = cases_figure(results["association"]).axes
    assert [left.get_title(), right.get_title()] == ["vlabench", "tabletop"]
    widths = [[bar.get_width() for bar in bars] for bars in right.containers]
    assert widths == [[0, 0], [100, 100]]


@pytest.mark.parametrize(("low", "high", "p", "theirs", "said"), [
    (-0.9, -0.7, 0.001, -0.78, "holds"),
    (-0.3, -0.1, 0.001, -0.58, "holds, weaker"),
    (-0.9, -0.7, 0.001, -0.4, "holds, stronger"),
    (0.1, 0.3, 0.001, -0.2, "the other way round"),
    (-0.1, 0.1, 0.7, -0.2, "not here: as much is excluded"),
    (-0.1, 0.1, 0.7, 0.05, "cannot tell"),
    (-0.1, -0.02, 0.06, -0.05, "cannot tell"),
])  # fmt: skip
def test_what_a_difference_says_about_the_papers_finding(
    low: float, high: float, p: float, theirs: float, said: str
) -> None:
    found = Comparison(
        suite="s", task="", split="", policy="p", one="vap", other="arm", pairs=96, layouts=96,
        both=0, only_one=0, only_other=0, neither=0, difference=(low + high) / 2, low=low,
        high=high, p_mcnemar=p, p=p, p_holm=p,
    )  # fmt: skip
    assert verdict(found, theirs) == said


def test_the_table_of_findings_holds_the_papers_arms_only() -> None:
    table = pd.concat([
        outcomes("vap", [True] * 9 + [False]),
        outcomes("mask-only", [False] * 10),
        outcomes("contour", [False] * 10),
    ], ignore_index=True)  # fmt: skip
    (row,) = findings_table(ablation_results(table)).to_dict("records")
    assert (row["ablation"], row["arm"], row["n"], row["paper"]) == (
        "rewrite", "mask-only", 10, "-78",
    )  # fmt: skip
    assert row["here, points [95 %]"].startswith("-90 [")
    assert row["the paper's finding"] == "holds"


def test_policies_stand_side_by_side_and_each_is_compared_with_itself() -> None:
    shares = ABLATIONS["tint-share"]
    older, newer = (Path(shares.policies[label]).name for label in ("share-0", "share-0.5"))
    episodes = pd.concat(
        [
            outcomes("vap", [True] * 9 + [False]).assign(policy=f"mini_pi0:{older}@00aa"),
            outcomes("generic", [True] * 3 + [False] * 7).assign(policy=f"mini_pi0:{older}@00aa"),
            outcomes("vap", [True] * 2 + [False] * 8).assign(policy=f"mini_pi0:{newer}@00bb"),
            outcomes("generic", [False] * 10).assign(policy=f"mini_pi0:{newer}@00bb"),
            outcomes("vap", [True] * 10).assign(policy=f"mini_pi0:{newer}-longer@00cc"),
        ],
        ignore_index=True,
    )
    found = policy_results(shares, episodes)
    assert list(found) == ["share-0", "share-0.5"]
    assert [(one.arm, one.sr.k) for one in found["share-0"]] == [("generic", 3), ("vap", 9)]
    assert [(one.arm, one.sr.k) for one in found["share-0.5"]] == [("generic", 0), ("vap", 2)]
    assert effect_text(found["share-0"], "vap").startswith("+60 [")
    across = across_policies(shares, episodes)
    assert [(one.arm, one.sr.k) for one in across] == [("share-0", 9), ("share-0.5", 2)]
    assert effect_text(across, "share-0.5").startswith("-70 [")
    (axes,) = policies_figure(found, "share").axes
    assert [label.get_text() for label in axes.get_xticklabels()] == ["share-0", "share-0.5"]
    assert [len(bars.lines[0].get_xdata()) for bars in axes.containers] == [2, 2]


def test_every_form_is_shown_on_one_frame() -> None:
    frames = marked_frames(suites.rows("simpler-bridge", "put-camera", n=1)[0])
    assert set(frames) == {"vap", *ABLATIONS["form"].arms, *ABLATIONS["opacity"].arms}
    assert len({frame.shape for frame in frames.values()}) == 1
    pictures = {frame.tobytes() for frame in frames.values()}
    assert len(pictures) == len(frames), "no two forms look the same"
    assert len(
        forms_figure(suites.rows("simpler-bridge", "put-camera", n=1)[0]).axes[0].images
    ) == len(frames)


def test_the_chosen_tint_is_none_that_a_red_look_alike_has() -> None:
    (plain, row) = (
        suites.rows(name, "put-camera", n=1)[0] for name in ("simpler-bridge", "simpler-bridge-red")
    )
    frames = tinted_frames(row)
    unmarked, chosen, always = frames
    assert (unmarked, always) == ("no tint", f"always: {RED.name}")
    assert chosen.startswith("chosen: ")
    assert RED.name not in chosen
    assert len({frame.tobytes() for frame in frames.values()}) == 3
    red_share = {label: has_colour(frame, RED).mean() for label, frame in frames.items()}
    assert red_share["no tint"] > 0.01, "the look-alike is red by nature"
    assert red_share[always] > red_share["no tint"]
    assert f"chosen: {RED.name}" in tinted_frames(plain), "nothing is red there"
    assert len(tints_figure(row).axes[0].images) == 3


def test_views_agree_only_where_the_margin_is_large_enough() -> None:
    rows = []
    for episode, (alone, joint, margin) in enumerate(
        [("case 2", "right", 2.0), ("case 2", "case 1", 0.5), ("right", "right", 0.1),
         ("case 1", "case 1", np.nan)]
    ):  # fmt: skip
        for way, case in (("off", alone), ("geometry", joint)):
            rows.append({"suite": "s", "task": "t", "episode": episode, "associate": way,
                         "case": case, "margin": margin if way != "off" else np.nan})  # fmt: skip
    cases = gated_cases(pd.DataFrame(rows), "geometry", [0.0, 1.0, np.inf])
    assert cases[["right", "case 1", "case 2"]].to_numpy().tolist() == [
        [2, 2, 0],
        [2, 1, 1],
        [1, 1, 2],
    ]
    (part,) = gate_figure(pd.DataFrame(rows), "geometry").axes
    assert part.get_title() == "s, n 4"
