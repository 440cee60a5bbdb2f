"""The command, or the code, that makes a run: what a report tells of where its numbers are from."""

from vap_core.evaluation.report.provenance import command_line
from vap_core.evaluation.study import Study
from vap_core.simulation import suites


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
        "python -m vap_core eval --suite simpler-bridge --method generic --method vap --seed 2 "
        "--policy scripted"
    )
    assert command_line(study) == told
    part = (
        "python -m vap_core rollout --suite simpler-bridge --task pick-shaver --method vap "
        "--episodes 3 --seed 2 --policy scripted"
    )
    assert command_line({**study, "tasks": whole[:1], "methods": ["vap"], "episodes": 3}) == part
    assert (
        command_line({**study, "seeds": 5, "images_every": 0, "audit": True})
        == f"{told} --seeds 5 --audit"
    )
    assert (
        command_line({**study, "seeds": 1, "follow": "step", "images_every": 4})
        == f"{told} --follow step --images-every 4"
    )
    assert (
        command_line({**study, "split": "visual matching", "temperature": 0.5})
        == f"{told} --split 'visual matching' --temperature 0.5"
    )
    demo = [["widowx-pick", "pick-straw-cup"], ["franka-pick", "pick-cup"]]
    assert (
        command_line({**study, "tasks": demo, "episodes": 20})
        == "python -m vap_core demo --episodes 20 --seed 2"
    )


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
