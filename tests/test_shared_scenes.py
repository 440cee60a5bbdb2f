"""Tables and figures of shared scenes: what is counted, and that they agree with what was published."""

import pandas as pd
import pytest

from vap_core import notebook
from vap_core.base.errors import BadOutput
from vap_core.base.files import DATA, SHIPPED
from vap_core.policies.lerobot.checkpoints import fingerprint
from vap_core.policies.names import policy_label, shipped_checkpoint
from vap_core.study import parsers
from vap_core.study import shared as shared_scenes
from vap_core.study.paper import ledger
from vap_core.study.results import read_runs
from vap_make.recipe import RECIPES

SUITE = "shared-sequence-bridge"


def sequence(ends):
    """Episodes of one task: (step 1, step 2, wrong object) each."""
    lines = []
    for i, (first, second, wrong) in enumerate(ends):
        line = {
            "suite": SUITE,
            "policy": "mini-pi0",
            "method": "vap",
            "task": "put-cameras",
            "episode": i,
            "success": first and second,
            "subgoal_1": first,
            "subgoal_2": second,
            "wrong_object": wrong,
            "first_object_correct": None if i == 0 else not wrong,
        }
        lines.append(line)
    return pd.DataFrame(lines)


ENDS = [
    (True, True, False),
    (True, True, True),
    (True, False, True),
    (False, False, True),
    (False, True, False),
]


def test_failures_of_a_sequence_divide_and_step_two_is_of_those_that_did_step_one():
    table = shared_scenes.sequence_table(sequence(ENDS))
    assert list(table["task"]) == ["put-cameras", "all"]
    line = table.iloc[-1]
    counts = {name: (line[name].k, line[name].n) for name in table.columns[5:]}
    assert counts == {
        "both": (2, 5),
        "step 1": (3, 5),
        "step 2 after 1": (2, 3),
        "first touch right": (1, 4),
        "wrong object": (3, 5),
        "failed, wrong object": (2, 5),
        "other failures": (1, 5),
    }


def test_a_pair_stands_beside_the_papers():
    lines = []
    for task in shared_scenes.PAPER_PAIRS:
        line = {
            "suite": "shared-pair",
            "policy": "scripted",
            "method": "vap",
            "task": task,
            "success": task == "put-pouch-near-cup",
            "cmr": True,
            "first_object_correct": True,
            "wrong_object": False,
        }
        lines.append(line)
    table = shared_scenes.pair_table(pd.DataFrame(lines)).set_index("task")
    assert dict(table["paper"]) == {
        "put-pouch-near-vase": 75,
        "move-plant-next-to-cup": 65,
        "put-scrubber-near-slipper": 70,
        "move-stuffed-toy-next-to-plant": 60,
        "put-pouch-near-cup": 70,
        "all": 68,
    }
    assert (table.loc["all", "SR"].k, table.loc["all", "n"]) == (1, 5)


def test_the_papers_sequences_and_parser_are_its_ledgers():
    assert shared_scenes.paper_sequence() == {
        "both": 65,
        "failed, wrong object": 20,
        "other failures": 15,
    }
    accuracy = shared_scenes.paper_parser()["implicit, parsing accuracy"]
    assert (accuracy.min(), accuracy.max()) == (94.7, 99.6)
    assert len(accuracy) == (ledger()["table"] == "llm_parser").sum() / 3


def test_parsers_are_as_the_command_prints_them():
    answers = pd.read_parquet(DATA / "results" / "parsers.parquet")
    answers = answers[answers["part"] == "test"]
    ours = parsers.accuracy(answers)
    printed = parsers.text(answers)
    for line in ours.to_dict("records"):
        low, high = round(100 * line["low"]), round(100 * line["high"])
        assert f"{line['right']} [{low}, {high}]" in printed
    figure = parsers.accuracy_figure(
        ours, shared_scenes.paper_parser()["implicit, parsing accuracy"], "finding"
    )
    assert figure.get_suptitle() == "finding"
    assert "94.7 to 99.6" in (figure.get_supxlabel() or figure.axes[0].get_xlabel())


def test_first_steps_divide_by_where_the_films_had_objects():
    table = shared_scenes.area_table(sequence(ENDS)).set_index("the films' area")
    assert set(table.index) == {"inside", "outside"}
    assert table["n"].sum() == len(ENDS)
    assert sum(each.k for each in table["step 1"]) == 3


def test_the_figure_has_a_panel_a_suite():
    pairs = sequence(ENDS).assign(suite="shared-pair", task="put-pouch-near-cup", cmr=True)
    figure = shared_scenes.shared_figure(pd.concat([sequence(ENDS), pairs]))
    titles = [axes.get_title().partition("\n")[0] for axes in figure.axes]
    assert titles == [SUITE, "shared-pair"]
    assert any("95 % interval" in axes.get_xlabel() for axes in figure.axes) or (
        "95 % interval" in figure.get_supxlabel()
    )


def test_the_first_success_is_shown_or_else_the_first_episode():
    episodes = sequence(ENDS)
    assert notebook.first_success(episodes, SUITE, "mini-pi0") == ("put-cameras", 0)
    assert notebook.first_success(episodes[1:], SUITE, "mini-pi0") == ("put-cameras", 1)
    assert notebook.first_success(episodes[2:], SUITE, "mini-pi0") == ("put-cameras", 2)


def test_what_the_pairs_training_lacked_and_reached():
    recipe = RECIPES["shared-pair"]
    assert recipe.held_out_category == "slipper"
    ran = pd.concat([rows for _, rows in read_runs(DATA / "results" / "shared.parquet")])
    desk = ran[(ran.suite == "shared-pair") & ran.policy.str.contains("mini-pi0-tabletop")]
    assert desk.groupby("method").cmr.sum().to_dict() == {"generic": 6, "vap": 2}


@pytest.mark.sweep
def test_a_film_of_a_sequence_has_a_row_a_step(tmp_path):
    episode = notebook.run_episode(SUITE, "put-cameras", 0, bank=tmp_path, policy="scripted")
    (sheet,) = notebook.steps_figure(episode, "front").axes
    assert len(sheet.images) == 5 * len(episode.subgoals)


def test_a_policy_that_was_taught_pairs_is_named_apart_from_the_benchmarks_own():
    names = [
        "mini_pi0:mini-pi0-tabletop-longer@99160be2",
        "mini_pi0:mini-pi0-shared-pair@c4a8f99e",
        "scripted",
        "expert",
    ]
    assert [shared_scenes._policy_name(name) for name in names] == list(shared_scenes.POLICY_ORDER)


def test_a_policy_of_ones_own_comes_last_under_its_label(monkeypatch, tmp_path):
    """Two of its checkpoints, and the shipped one with another sampling noise, are not pooled."""
    labels = [
        "pi0:second@0000aaaa",
        "expert",
        "mini_pi0:mini-pi0-tabletop-longer@99160be2",
        "mini_pi0:mini-pi0-tabletop-longer@99160be2, temperature 0.5",
        "pi0:first@0000bbbb",
        "mini_pi0:mini-pi0-tabletop-wide@0000cccc",
    ]
    tables = []
    for label in labels:
        tables.append(({}, sequence(ENDS).assign(policy=label)))
    monkeypatch.setattr(shared_scenes, "read_runs", lambda _: tables)
    found = shared_scenes.shared_episodes(tmp_path / "mine.parquet")
    own = [labels[i] for i in (3, 5, 4, 0)]
    assert list(dict.fromkeys(found["policy"])) == ["mini-pi0", "expert", *own]
    table = shared_scenes.sequence_table(found)
    assert set(table["n"]) == {len(ENDS)}
    shared_scenes.shared_figure(found)


def test_a_table_of_other_suites_is_refused():
    said = (
        "mini_pi0.parquet holds episodes of .*tabletop.*; publish the runs of shared scenes alone"
    )
    with pytest.raises(BadOutput, match=said):
        shared_scenes.shared_episodes(DATA / "results" / "mini_pi0.parquet")


def test_the_published_rows_are_of_the_policies_that_ship():
    """The defaults, and the shipped policy that was taught pairs."""
    ran = pd.concat([rows for _, rows in read_runs(DATA / "results" / "shared.parquet")])
    expected = {"scripted", "expert"}
    for folder in (
        shipped_checkpoint("simpler-bridge"),
        shipped_checkpoint("tabletop"),
        SHIPPED / "mini-pi0-shared-pair",
    ):
        expected.add(policy_label("mini_pi0", folder.name, fingerprint(folder)))
    assert set(ran["policy"]) == expected
