"""The command, or the code, that makes a run: what a report tells of where its numbers are from."""

from pathlib import Path

from vap_core.simulation import suites
from vap_core.study.results import command_line, load_runs, provenance, read_published
from vap_core.study.trials import Study, shipped


def test_the_command_of_a_run_is_told() -> None:
    whole = [["simpler-bridge", task.name] for task in suites.suite("simpler-bridge").tasks]
    study = {
        "tasks": whole,
        "methods": ["generic", "vap"],
        "policy": "scripted",
        "episodes": None,
        "seed": 2,
    }
    told = (
        "./vap eval --suite simpler-bridge --method generic --method vap --seed 2 --policy scripted"
    )
    assert command_line(study) == told
    part = (
        "./vap rollout --suite simpler-bridge --task pick-shaver --method vap "
        "--episodes 3 --seed 2 --policy scripted"
    )
    assert command_line({**study, "tasks": whole[:1], "methods": ["vap"], "episodes": 3}) == part
    assert (
        command_line({**study, "seeds": 5, "images_every": 0, "audit": True})
        == f"{told} --seeds 5 --audit"
    )
    assert command_line({**study, "seeds": 1, "follow": "step"}) == f"{told} --follow step"
    assert (
        command_line({**study, "split": "visual matching", "temperature": 0.5})
        == f"{told} --split 'visual matching' --temperature 0.5"
    )
    assert "images_every=4" in command_line({**study, "images_every": 4})
    demo = [["widowx-pick", "pick-straw-cup"], ["franka-pick", "pick-cup"]]
    assert (
        command_line({**study, "tasks": demo, "episodes": 20})
        == "./vap demo --episodes 20 --seed 2"
    )
    for other in ({"methods": ["vap"]}, {"policy": "expert"}, {"seeds": 2}, {"episodes": None}):
        told = command_line({**study, "tasks": demo, "episodes": 20, **other})
        assert told.startswith("Study("), "demo has no option for it"
        assert all(name in told for name in other if other[name] is not None)


def test_a_whole_list_of_one_task_is_told_in_code_and_an_own_object_by_eval() -> None:
    study = {"methods": ["vap"], "policy": "scripted", "seed": 0, "episodes": None}
    part = {**study, "tasks": [["vlabench", "select-cup"]]}
    assert command_line(part).startswith("Study("), "rollout plays 20 by itself"
    assert command_line({**part, "episodes": 5}).startswith("./vap rollout")
    warm_up = {**study, "tasks": [["widowx-pick", "pick-straw-cup"]], "follow": "call"}
    del warm_up["follow"]
    assert "rollout --suite widowx-pick --task pick-straw-cup" in command_line(warm_up)
    tabletop = [["tabletop", "select-cup"]]
    told = command_line({**study, "tasks": tabletop, "object": "cup-lookalike-1"})
    assert told.startswith("./vap eval --suite tabletop --method vap")
    assert "--object cup-lookalike-1" in told
    elsewhere = command_line({**study, "tasks": tabletop, "object": "nowhere-known"})
    assert elsewhere.startswith("Study(")


def test_parts_of_one_run_are_told_apart() -> None:
    """Published parts of a run share its digest: one command stood for both."""
    table = Path(__file__).parents[1] / "data" / "results" / "mini_pi0.parquet"
    told = provenance(load_runs([table]))
    assert len(told) == len(read_published(table))
    assert told.run.is_unique
    shared = told[told.digest.duplicated(keep=False)]
    assert sorted(shared.run.str.extract(r"\((.+)\)$")[0]) == ["generic", "vap"]
    assert shared.command.str.extract("--method (.+?) --")[0].tolist() == ["generic", "vap"]


def test_the_command_names_the_policy_that_was_run_and_not_todays_default() -> None:
    """Published runs name the default of their day, or the folder of a training."""
    told = {}
    for name in ("first_policy", "mini_pi0"):
        table = Path(__file__).parents[1] / "data" / "results" / f"{name}.parquet"
        commands = provenance(load_runs([table])).command
        named = commands.str.extract(r"--suite (\S+) .*--policy (\S+)").drop_duplicates()
        told[name] = sorted(named.itertuples(index=False, name=None))
    first = [(suite, f"data/policies/mini-pi0-{suite}") for suite in sorted(suites.BENCHMARKS)]
    assert told["first_policy"] == first
    assert {suite for suite, _ in told["mini_pi0"]} == set(suites.BENCHMARKS)
    for suite, policy in told["mini_pi0"]:
        assert policy in ("mini-pi0", f"data/policies/{shipped(suite).name}")


def test_a_run_that_no_command_makes_is_told_in_code() -> None:
    several = {"tasks": [["widowx-pick", "pick-straw-cup"], ["simpler-bridge", "pick-shaver"]]}
    study = several | {"methods": ["vap"], "episodes": 3, "seed": 0, "policy": "scripted"}
    told = (
        "Study(tasks=(('widowx-pick', 'pick-straw-cup'), ('simpler-bridge', 'pick-shaver')), "
        "methods=('vap',), episodes=3)"
    )
    assert command_line(study) == told
    part = {**study, "tasks": [["simpler-bridge", "pick-shaver"]], "follow": "call"}
    told = (
        "Study(tasks=(('simpler-bridge', 'pick-shaver'),), methods=('vap',), episodes=3, "
        "follow='call')"
    )
    assert command_line(part) == told
    made = Study((("simpler-bridge", "pick-shaver"),), ("vap",), episodes=3, follow="call")
    assert command_line(made.configuration()) == told
