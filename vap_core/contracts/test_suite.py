"""The contract of a suite: a known robot and its cameras, and tasks whose objects exist."""

from vap_core.instruction import parse
from vap_core.simulation import robots
from vap_core.simulation.assets import objects
from vap_core.simulation.cameras import RIGS
from vap_core.simulation.suites import Suite, own, shared


def test_its_robot_and_cameras_exist(suite: Suite) -> None:
    robot = robots.get(suite.robot)
    assert suite.hz == robot.hz
    assert suite.cameras
    assert set(suite.cameras) <= {rig.name for rig in RIGS[robot.name]}


def test_its_tasks_have_names_of_their_own_and_a_limit(suite: Suite) -> None:
    names = [task.name for task in suite.tasks]
    assert names
    assert len(set(names)) == len(names)
    assert all(task.max_steps > 0 for task in suite.tasks)


def test_every_instruction_has_one_personal_object_of_the_tasks_category(suite: Suite) -> None:
    """Of shared scenes, which name several, the first."""
    for task in suite.tasks:
        if suite.name not in shared.SUITES:
            own.check_wording(task)
        target, *others = parse(task.instruction, [task.category]).targets
        assert target.category == task.category, task.name
        assert not others or suite.name in shared.SUITES, task.name


def test_every_target_exists_with_look_alikes_to_tell_it_from(suite: Suite) -> None:
    for task in suite.tasks:
        objects.get_object(task.personal)
        objects.get_object(f"{task.stem}-lookalike-1")
        if task.goal:
            objects.get_object(task.goal)
