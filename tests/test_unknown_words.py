"""A run says which words of its instructions its mini-pi0 does not know."""

from vap_core.simulation import suites
from vap_core.study.engine import policy_notes, unknown_words
from vap_core.study.trials import Study


def test_words_are_compared_in_lower_case_and_told_once() -> None:
    known = ("<pad>", "<unk>", "put", "my", "cup", "it's")
    said = ["Put my gizmo", "put my cup, gizmo; it's flat"]
    assert unknown_words(known, said) == ["gizmo", "flat"]
    assert unknown_words(known, ["put my cup"]) == []


def test_a_benchmarks_policy_knows_every_word_of_its_suite() -> None:
    for name in suites.BENCHMARKS:
        tasks = tuple((name, task.name) for task in suites.suite(name).tasks)
        assert policy_notes(Study(tasks, ("generic",), policy="mini-pi0")) == []


def test_the_words_of_another_suite_are_told_by_suite() -> None:
    tasks = tuple(("shared-pair", task.name) for task in suites.suite("shared-pair").tasks)
    (line,) = policy_notes(Study(tasks, ("generic",), policy="mini-pi0"))
    assert line == (
        "note: mini-pi0-tabletop-longer does not know her, next, which instructions of shared-pair "
        "say; where that reaches it, it reads <unk>. It was trained on the words of the benchmarks."
    )
    for policy in ("expert", "scripted"):
        assert policy_notes(Study(tasks, ("generic",), policy=policy)) == []


def test_what_a_served_policy_is_sent_is_said() -> None:
    tasks = (("simpler-bridge", "put-camera"),)
    (line,) = policy_notes(Study(tasks, ("generic",), policy="ws://127.0.0.1:9?map=bridge"))
    assert "images/primary <- camera 0" in line
    assert "actions -> delta-position, delta-axis-angle, opening; 1 a call" in line
