"""Whether a task's instruction asks for what the task is about."""

from vap_core.base.errors import BadInstruction, BadSuite
from vap_core.instruction import parse
from vap_core.simulation.suites.suite import Task


def check(task: Task) -> None:
    """Refuse an instruction that does not name one personal object, of the task's category.

    Raises: BadSuite, naming the task.
    """
    where = f"task {task.name}: the instruction {task.instruction!r}"
    mend = f'write "my {task.category}" in it once, or correct the category'
    try:
        targets = parse(task.instruction, (task.category,)).targets
    except BadInstruction:
        raise BadSuite(f"{where} names no personal object; {mend}.") from None
    named = [target.category for target in targets]
    if named != [task.category]:
        asked = " and ".join(f"my {category}" for category in named)
        raise BadSuite(f"{where} asks for {asked}, and the category is {task.category!r}; {mend}.")
