"""The world does not change: digests of every suite, its episodes, and every object as MuJoCo receives it."""

import hashlib
from pathlib import Path

import numpy as np
import pytest

from vap_core.simulation import suites
from vap_core.simulation.assets import objects
from vap_core.simulation.assets.mujoco_object import add_object
from vap_core.study import world

import mujoco  # isort: skip

FROZEN = Path(__file__).parent / "frozen.txt"
"""`world SUITE DIGEST`, `rows SUITE DIGEST` and `object NAME DIGEST`, a line each."""


def names() -> list[str]:
    listed = [f"{name}{dev}" for name in suites.BENCHMARKS for dev in ("", "-dev")]
    variants = [f"{name}{end}" for name in listed for end in ("", "-absent", "-red")]
    return [*variants, *suites.SHARED, *suites.WARM_UPS]


def rows(name: str) -> list[suites.EpisodeRow]:
    tasks = suites.suite(name).tasks
    return [row for task in tasks for row in suites.rows(name, task.name)]


def object_digest(name: str) -> str:
    """Of the mesh, the texture and the geoms with which an object enters a scene."""
    model = objects.get_object(name)
    mesh = objects.mesh_of(model)
    found = hashlib.sha256()
    for part in (mesh.vertex, mesh.normal, mesh.uv):
        assert part.dtype == np.float64
        found.update(np.ascontiguousarray(part).tobytes())
    found.update(np.ascontiguousarray(mesh.face, np.int64).tobytes())
    found.update(np.ascontiguousarray(objects.texture_image(model)).tobytes())
    spec = mujoco.MjSpec()
    for geom in add_object(spec, model).geoms:
        quat = np.round(geom.quat, 12)
        about = (geom.name, int(geom.type), geom.group, geom.condim, geom.contype, geom.conaffinity)
        found.update(repr((about, geom.size.tolist(), geom.pos.tolist())).encode())
        found.update(repr((quat.tolist(), round(geom.mass, 12), geom.friction.tolist())).encode())
    return found.hexdigest()[:16]


def frozen(kind: str) -> dict[str, str]:
    lines = [line.split() for line in FROZEN.read_text().splitlines()]
    return {name: digest for found, name, digest in lines if found == kind}


def test_worlds_are_those_of_the_runs_that_there_are() -> None:
    assert {name: world.digest([(name, rows(name))]) for name in names()} == frozen("world")


def test_episodes_are_those_of_the_runs_that_there_are() -> None:
    found = {}
    for name in names():
        about = [repr((row.at(0), row.subgoals, row.inside)) for row in rows(name)]
        found[name] = hashlib.sha256("\n".join(about).encode()).hexdigest()[:16]
    assert found == frozen("rows")


@pytest.mark.slow
def test_objects_are_those_of_the_runs_that_there_are() -> None:
    placed = {place.model for name in names() for row in rows(name) for place in row.placements}
    assert placed | set(objects.OBJECTS) == set(frozen("object"))
    changed = [name for name, digest in frozen("object").items() if object_digest(name) != digest]
    assert changed == []
