"""Where the numbers of a report come from: digests, versions, and the commands of the runs."""

from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vap_core.base.commands import command
from vap_core.base.errors import VapError
from vap_core.evaluation.policy_names import policy_today
from vap_core.evaluation.report.runs import Runs
from vap_core.evaluation.study import DEMO, Study
from vap_core.simulation import suites

if TYPE_CHECKING:
    import pandas as pd

EVAL_ONLY = ("seeds", "temperature", "images_every", "follow", "split", "audit")
"""Fields of a study that `eval` has options for, and `rollout` has none."""


def provenance(runs: Runs) -> "pd.DataFrame":
    """One row per run: its digest, versions, seed, checksums, and the command that makes it.

    `policy` is what the run was given; the command names it as it is named here today, so that a
    default that has been replaced since is told by its folder.
    """
    import pandas as pd

    lines = []
    for name, manifest in runs.manifests.items():
        study: dict[str, Any] = manifest["configuration"]
        today = {**study, "policy": _policy(runs, name)}
        lines.append(
            {
                "run": str(name),
                "digest": manifest["digest"],
                "version": study.get("version", ""),
                "policy": study["policy"],
                "seed": _seeds(study),
                "stack": study.get("stack", ""),
                "robots": study.get("robots", ""),
                "world": study.get("world", ""),
                "weights": _shortened(study.get("weights", {})),
                "lists": _shortened(study.get("lists", {})),
                "command": str(manifest.get("command") or command_line(today)),
            }
        )
    return pd.DataFrame(lines)


def _policy(runs: Runs, name: Path) -> str:
    """How the policy of a run is named here; as the run named it, where its suites have several."""
    given = str(runs.manifests[name]["configuration"]["policy"])
    of_run = runs.wanted[runs.wanted["run"] == str(name)]
    pairs = of_run[["policy", "suite"]].drop_duplicates().itertuples(index=False, name=None)
    named = {policy_today(given, label, suite) for label, suite in pairs}
    return named.pop() if len(named) == 1 else given


def command_line(study: dict[str, Any]) -> str:
    """The command line that runs a configuration, without --out; in code where no command does.

    It finds the user's own suites, where they are known here.
    """
    files = suites.own_files(suite for suite, _ in study["tasks"])
    study = {**study, "suite_files": files}
    tasks_by_suite: dict[str, list[str]] = {}
    for suite, task in study["tasks"]:
        tasks_by_suite.setdefault(suite, []).append(task)
    changed = _changed(study)
    whole = _are_whole_suites(changed["tasks"], study.get("object", ""))
    if _is_demo(study, changed):
        return command("demo", "--episodes", str(study["episodes"]), "--seed", str(study["seed"]))
    if not whole and not _suits_rollout(study, changed):
        return f"Study({', '.join(f'{name}={setting!r}' for name, setting in changed.items())})"
    words = ["eval" if whole else "rollout"]
    for suite, tasks in tasks_by_suite.items():
        words += ["--suite", suite]
        if not whole:
            for task in tasks:
                words += ["--task", task]
    for method in study["methods"]:
        words += ["--method", method]
    for name, setting in _options(study, whole).items():
        if setting is not None:
            words += [f"--{name}", str(setting)]
    if study.get("audit"):
        words.append("--audit")
    return command(*words, environment=suites.own.environment(files))


def _is_demo(study: dict[str, Any], changed: dict[str, Any]) -> bool:
    """Whether `demo` makes it, which has options for the number of episodes and the seed alone."""
    if (changed["tasks"], changed["methods"]) != (DEMO.tasks, DEMO.methods):
        return False
    rest = changed.keys() - {"tasks", "methods", "seed"}
    return study.get("episodes") is not None and rest == {"episodes"}


def _changed(study: dict[str, Any]) -> dict[str, Any]:
    """The fields of a configuration that differ from a study's defaults."""
    changed: dict[str, Any] = {
        "tasks": tuple(tuple(task) for task in study["tasks"]),
        "methods": tuple(study["methods"]),
    }
    for field in fields(Study)[len(changed) :]:
        setting = study.get(field.name, field.default)
        if setting != field.default:
            changed[field.name] = setting
    return changed


def _suits_rollout(study: dict[str, Any], changed: dict[str, Any]) -> bool:
    """Whether `rollout` runs some tasks: of one suite, and of a list never the whole."""
    names = {suite for suite, _ in study["tasks"]}
    if len(names) > 1 or not changed.keys().isdisjoint(EVAL_ONLY):
        return False
    return study.get("episodes") is not None or not suites.has_list(names.pop())


def _are_whole_suites(tasks: tuple[tuple[str, str], ...], own: str) -> bool:
    """Whether `eval` runs these tasks: every one, or with an `own` object those of its category."""
    try:
        return tasks == suites.tasks_of(dict(tasks), own)
    except VapError:
        if not own:
            raise
        return False  # the object was imported elsewhere


def _options(study: dict[str, Any], whole: bool) -> dict[str, Any]:
    """The options of a command and their settings, None where the default holds."""
    options = {}
    for name in ("episodes", "seed", "policy", "stack", "robots", "object", "split", "temperature"):
        options[name] = study.get(name)
    if whole:
        options["seeds"] = None
        if study.get("seeds", 1) > 1:
            options["seeds"] = study["seeds"]
        options["follow"] = study.get("follow")
        options["images-every"] = study.get("images_every") or None
    return options


def _seeds(study: dict[str, Any]) -> str:
    first = study["seed"]
    count = study.get("seeds", 1)
    if count == 1:
        return str(first)
    return f"{first}..{first + count - 1}"


def _shortened(checksums: Any) -> str:
    if not isinstance(checksums, dict):
        return str(checksums)
    parts = []
    for name, digest in checksums.items():
        parts.append(f"{name}:{str(digest)[:12]}")
    return " ".join(parts)
