"""What a batch of a study needs: personal objects in memory, a scene, models and a policy."""

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32

from vap_core.base.types import Rgb
from vap_core.evaluation.methods import (
    FEWEST_REFERENCES,
    hidden_calls,
    make_prompter,
    needs_description,
    needs_memory,
    needs_stack,
    needs_token,
    references_needed,
    token_space,
)
from vap_core.evaluation.policy_names import POLICIES, make_policy
from vap_core.evaluation.study import Study
from vap_core.memory import load_bank, register, save
from vap_core.perception.describe import AttributeCaptioner, with_description
from vap_core.perception.protocols import Stack
from vap_core.perception.stacks import load_stack
from vap_core.policies.lerobot import checkpoints
from vap_core.policies.mini_pi0 import token_file
from vap_core.policies.mini_pi0.learned_token import WORD
from vap_core.policies.mini_pi0.teach_token import file_suffix, model_of, teach, teach_own
from vap_core.policies.protocol import Policy, PrivilegedPolicy
from vap_core.rollout.loop import Trial
from vap_core.rollout.policy_call import check_policy
from vap_core.simulation import suites
from vap_core.simulation.assets.objects import ObjectModel, get_object
from vap_core.simulation.occluder import Occlusion
from vap_core.simulation.scenes import Meshes, Scene
from vap_core.simulation.studio import reference_views
from vap_core.simulation.suites.open_row import build_scene, models_of
from vap_core.simulation.types import EpisodeRow

HIDDEN_FROM = 2
"""The call of the policy, counted from 0, from which an arm of `ablate` hides the target."""
_stack = cache(load_stack)
_last_scene: dict[tuple[str, tuple[str, ...], str, Meshes], Scene] = {}
"""The scene that was built last, by suite, objects, variant and meshes."""


def register_personal(study: Study, bank: Path) -> None:
    """Remember the personal object of every task from five rendered reference views, or more where
    a method wants them.

    An object that is in memory with enough of them stays. Where a method needs its description, it
    is described too, offline; for the soft prompt its token is learned. A study that prompts
    nothing needs no memory.

    Raises: as `load_stack`; BadMemory for a damaged memory; BadObject for a damaged scan;
        BadPolicy, BadStudy, as `teach` and `teach_own`; BadOutput when `bank` cannot be written.
    """
    if not study.any_method(needs_memory):
        return
    stack = load_stack(study.stack)
    known = load_bank(bank)
    n_references = max(map(references_needed, study.methods))
    for suite, task, target in _remembered(study):
        rows = study.rows(suite, task)
        obj = known.get(target)
        if obj is None or len(obj.crops) < n_references:
            model = get_object(target)
            photos = _photos(model, n_references)
            obj, _ = register(target, model.category, photos, stack.detector, stack.encoder)
        if study.any_method(needs_description) and obj.description is None:
            seen = obj.first(FEWEST_REFERENCES)
            described = with_description(seen, AttributeCaptioner(stack.segmenter))
            obj = replace(obj, description=described.description)
        spaces = {token_space(method) for method in study.methods}
        if spaces & {"copied", "aligned"}:
            initialised_from = checkpoints.config_field(study.checkpoint(suite), "vlm")
            teach(rows, bank, initialised_from)
        if "own" in spaces:
            teach_own(rows, bank, checkpoints.locate(study.checkpoint(suite)))
        if obj is not known.get(target):
            save(bank, obj, replace=True)
            known[target] = obj


def _photos(model: ObjectModel, n: int) -> list[Rgb]:
    """The reference photos of which each method takes as many as it wants, the first of them.

    The first five do not depend on `n`: methods differ in nothing else, whatever else is run.
    """
    photos = reference_views(model, FEWEST_REFERENCES)
    if n > FEWEST_REFERENCES:
        photos += reference_views(model, n - FEWEST_REFERENCES, seed=1)
    return photos


def _remembered(study: Study) -> list[tuple[str, str, str]]:
    """Suite, task and object of all that a study remembers; in shared scenes what is owned."""
    found = []
    for suite, task in study.tasks:
        row = study.rows(suite, task)[0]
        models = [owned.model for owned in row.owned] or [row.target]
        found += [(suite, task, model) for model in models]
    return found


def make_trial(
    study: Study,
    rows: Sequence[EpisodeRow],
    method: str,
    bank: Path,
    policy: Policy[Any] | PrivilegedPolicy[Any] | None = None,
) -> Trial:
    """The scene, models and policy of some rows of one task and variant, built or cached.

    The scene holds only what the rows place. It is closed when the next one is built. `policy`
    takes the place of the study's; an arm of `ablate` then hides the target for that one's calls.

    Raises: UnknownName for a suite that no registry holds; BadPolicy when the checkpoint is not on
        this machine or does not fit the suite, or `policy` lacks what the loop needs; BadMemory
        when a description or a token that the method needs is not in `bank`; MissingMeshes for a
        robot whose meshes are not here.
    """
    first = rows[0]
    suite = suites.suite(first.suite)
    scene = _scene(study, rows)
    scripted = policy is None and study.policy == "scripted"
    stack = _stack(study.stack) if needs_stack(method) or scripted else None
    if policy is None:
        policy = _policy(study=study, method=method, row=first, bank=bank, scene=scene, stack=stack)
    check_policy(policy)
    return Trial(
        method=method,
        scene=scene,
        policy=policy,
        prompter=make_prompter(method, first, bank=bank, scene=scene, stack=stack),
        control=suite.control,
        sensor=suite.sensor,
        occlusion=_occlusion(method, policy.execute),
        images_every=study.images_every,
        follow=study.follow,
        audit=study.audit,
    )


def _occlusion(method: str, execute: int) -> Occlusion | None:
    """When the method's target is hidden: from the policy's HIDDEN_FROM-th call on."""
    calls = hidden_calls(method)
    if not calls:
        return None
    return Occlusion(start=HIDDEN_FROM * execute, frames=calls * execute)


def _policy(
    study: Study, method: str, row: EpisodeRow, bank: Path, scene: Scene, stack: Stack | None
) -> Policy[Any] | PrivilegedPolicy[Any]:
    """The frozen policy of the study; for the soft prompt with the learned token's embedding."""
    suite = suites.suite(row.suite)
    if study.policy in POLICIES:
        return make_policy(study.policy, scene, suite, stack)
    from vap_core.policies.lerobot import adapter  # and torch

    policy = adapter.load_for_suite(
        study.checkpoint(row.suite), scene, suite, temperature=study.temperature
    )
    if not needs_token(method):
        return policy
    embedding = _token_embedding(study, method, row, bank)
    return policy.with_tokens({WORD: embedding})


def _token_embedding(
    study: Study, method: str, row: EpisodeRow, bank: Path
) -> Float32[np.ndarray, " d"]:
    """The embedding that the target's word has under a method with a soft prompt."""
    from vap_core.policies.mini_pi0.token_alignment import align
    from vap_core.policies.mini_pi0.vlm import load_from_policy

    folder = checkpoints.locate(study.checkpoint(row.suite))
    rows = study.rows(row.suite, row.task)
    space = token_space(method)
    if space == "own":
        own = load_from_policy(folder).sha256()
        suffix = file_suffix(rows, own, token_file.OWN_SUFFIX)
        return token_file.load(bank, row.target, own, suffix).embedding
    initialised_from = checkpoints.config_field(folder, "vlm")
    token = token_file.load(bank, row.target, initialised_from, file_suffix(rows, initialised_from))
    if space == "aligned":
        return align(token.embedding, model_of(initialised_from), folder)
    return token.embedding


def _scene(study: Study, rows: Sequence[EpisodeRow]) -> Scene:
    """The scene of what some rows of one task and variant place; the last one is kept.

    Objects are in the order of the variant's whole list, so that the physics of an episode does not
    depend on the rows beside it. Physics among 100 parked objects takes 2.6 times as long as among
    6.
    """
    first = rows[0]
    listed = []
    for row in study.rows(first.suite, first.task):
        if row.variant == first.variant:
            listed.append(row)
    placed = models_of(rows)
    names = [name for name in models_of([*listed, *rows]) if name in placed]
    key = (first.suite, tuple(names), first.variant, study.robots)
    if key not in _last_scene:
        for scene in _last_scene.values():
            scene.close()
        _last_scene.clear()
        _last_scene[key] = build_scene(*key)
    return _last_scene[key]
