"""The arms of the evaluation benchmark that run lerobot's own loop, of this checkout or another."""

import json
import os
import subprocess
import sys
from contextlib import ExitStack, suppress
from functools import partial
from pathlib import Path
from typing import Any

import vap_core
from vap_core.base.errors import BadStudy
from vap_core.base.version import code_version
from vap_core.cli.bench.eval_plan import Arm, Cost, Plan, count_of, threads

SCRIPT = Path(__file__).with_name("lerobot_process.py")
HERE = Path(vap_core.__file__).resolve().parents[1]


class LoopProcess:
    """lerobot_process.py with the package of one checkout, warm; it ends with the block.

    Raises: BadStudy when the folder is no checkout, or when the process ends early.
    """

    def __init__(self, checkout: Path, plan: Plan, folder: Path) -> None:
        self._package = package = checkout.resolve() / "vap_core" / "__init__.py"
        if not package.is_file():
            raise BadStudy(
                f"bench eval: {checkout} is no checkout of this package; "
                "make one: git worktree add DIR 1cce9d7"
            )
        folder.mkdir(parents=True)
        self.code = code_version(package.parent)
        self._errors = folder / "stderr.txt"
        (folder / "plan.json").write_text(json.dumps(plan.for_lerobot()))
        command = [sys.executable, "-P", str(SCRIPT), str(folder), str(folder / "plan.json")]
        with self._errors.open("w") as errors:
            self._process = subprocess.Popen(
                command,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=errors,
                text=True,
                cwd=folder,
                env={**os.environ, "PYTHONPATH": str(checkout.resolve())},
            )

    def __enter__(self) -> "LoopProcess":
        try:
            found = Path(self._answer()["ready"])
            if found != self._package:
                raise BadStudy(f"bench eval: python imports {found} in place of {self._package}.")
        except BadStudy:
            self.close()
            raise
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def close(self) -> None:
        """End the process; it closes its environments, which may be processes, first."""
        try:
            self._process.communicate(timeout=30)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.communicate()

    def run(self, **arm: Any) -> Cost:
        """One evaluation of all episodes: n_envs, in_processes, threads, videos.

        Raises: BadStudy when the process has ended.
        """
        assert self._process.stdin is not None
        # Where the process has died, the answer says why.
        with suppress(BrokenPipeError):
            self._process.stdin.write(json.dumps(arm) + "\n")
            self._process.stdin.flush()
        return Cost(**self._answer())

    def _answer(self) -> dict[str, Any]:
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            said = self._errors.read_text().strip().splitlines() or ["it said nothing"]
            raise BadStudy(f"bench eval: lerobot's loop of {self.code} ended: {said[-1][:160]}")
        answer: dict[str, Any] = json.loads(line)
        return answer


def lerobot_arms(
    plan: Plan, folder: Path, stack: ExitStack, earlier: Path | None = None
) -> list[Arm]:
    """lerobot as it comes (one environment, videos of the first ten episodes) and at its best.

    Of the checkout `earlier` first, where there is one of another version.

    Raises: BadStudy, as `LoopProcess`.
    """
    checkouts = [HERE]
    if earlier is not None and code_version(earlier) != code_version(HERE):
        checkouts.insert(0, earlier)
    arms = []
    for i, checkout in enumerate(checkouts):
        process = stack.enter_context(LoopProcess(checkout, plan, folder / f"lerobot-{i}"))
        for n_envs, in_processes in plan.loops:
            for n_threads in threads():
                comes = n_envs == 1
                equal = wall = ""
                if n_threads == 1 and not in_processes:
                    equal = "as it comes" if comes else "best"
                if comes and n_threads == threads()[-1]:
                    wall = "as it comes"
                if not comes:
                    wall = "best"
                arm = partial(
                    process.run,
                    n_envs=n_envs,
                    in_processes=in_processes,
                    threads=n_threads,
                    videos=comes,
                )
                arms.append(
                    Arm(
                        name=_name(n_envs, in_processes, n_threads, videos=comes),
                        loop="lerobot",
                        code=process.code,
                        run=arm,
                        equal_cpu=equal,
                        wall=wall,
                    )
                )
    return arms


def _name(n_envs: int, in_processes: bool, n_threads: int, videos: bool) -> str:
    place = "each a process" if in_processes else "one process"
    name = f"{count_of(n_envs, 'env')}, {place}, {count_of(n_threads, 'thread')}"
    return f"{name}, videos" if videos else name
