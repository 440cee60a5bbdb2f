"""Shared scenes: their lists, whose every object is, what the words mean, what cannot be run."""

import hashlib
import json
from dataclasses import asdict, replace
from functools import cache

import numpy as np
import pandas as pd
import pytest

from vap_core.base.errors import BadInstruction, BadStudy, BadSuite, UnknownName
from vap_core.base.files import DATA
from vap_core.base.types import PersonalObject
from vap_core.instruction.expressions import decompose
from vap_core.instruction.parsers import rule_parser
from vap_core.memory import recall
from vap_core.policies.scripted.scripted import read
from vap_core.simulation import suites
from vap_core.simulation.assets import objects
from vap_core.simulation.suites import SHARED, layout, lists, shared
from vap_core.simulation.suites.layout import radius_m
from vap_core.simulation.types import Owned
from vap_core.study.engine import result_key
from vap_core.study.report import suites_table
from vap_core.study.trials import Study, shipped
from vap_make.lists import shared as drawn


def memory(row):
    """The owned objects of a row, without photos that matter."""
    found = {}
    for owned in row.owned:
        found[owned.model] = PersonalObject(
            name=owned.model,
            category=objects.get_object(owned.model).category,
            embeddings=np.eye(1, 4, dtype=np.float32),
            crops=(np.zeros((2, 2, 3), np.uint8),),
            encoder="none",
            owner=owned.owner,
            known_as=owned.known_as,
        )
    return found


def meant(row, text):
    """The objects that a text means to the row's speaker, in order."""
    known = memory(row)
    parsed = rule_parser(known)(text, {obj.category for obj in known.values()})
    return [recall(known, target, None, row.speaker).name for target in parsed.targets]


@pytest.fixture(params=sorted(SHARED))
def name(request):
    return request.param


def test_a_list_has_twenty_layouts_a_task(name):
    rows = lists.read(name)
    for task in shared.TASKS[name]:
        mine = [row for row in rows if row.task == task.name]
        assert len(mine) == (24 if name == "shared-sequence-bridge" else 20)


def test_the_table_of_suites_has_lists_and_hashes(name):
    table = suites_table()
    data = (lists.FOLDER / f"{name}.jsonl").read_bytes()
    assert hashlib.sha256(data).hexdigest() == lists.digest(name)
    assert lists.digest(name)[:12] in table
    for task in SHARED[name].tasks:
        assert task.name in table


def test_the_hardest_lookalikes_are_those_that_the_encoder_takes_most_for_the_personal_one():
    table = pd.read_parquet(DATA / "results" / "lookalike_hardness.parquet")
    assert len(shared.HARDEST) == table.object.nunique()
    for stem in shared.HARDEST:
        alike = table[table.object == stem.replace("-", " ")].set_index("lookalike").cosine
        assert tuple(alike.nlargest(2).index) == shared.hardest(stem)


def test_every_target_stands_beside_its_hardest_lookalike(name):
    for row in lists.read(name):
        placed = {place.model for place in row.placements}
        for owned in row.owned:
            stem = owned.model.removesuffix("-personal").partition("-lookalike")[0]
            assert {f"{stem}-personal", shared.hardest(stem)[0]} <= placed


def test_objects_keep_apart(name):
    for row in lists.read(name):
        for i, one in enumerate(row.placements):
            for other in row.placements[:i]:
                apart = np.hypot(one.x - other.x, one.y - other.y)
                assert apart > 0.6 * (radius_m(one.model) + radius_m(other.model))


def test_the_words_mean_the_targets_and_the_planner_gives_the_steps(name):
    seen = {}
    for row in lists.read(name):
        seen.setdefault(row.task, row)
    for row in seen.values():
        if not row.subgoals:
            assert meant(row, row.instruction) == [row.target, row.goal]
            continue
        commands = decompose(row.instruction)
        assert commands == tuple(subgoal.instruction for subgoal in row.subgoals)
        for command, subgoal in zip(commands, row.subgoals, strict=True):
            assert meant(row, command) == [subgoal.target]


def test_an_unknown_owner_is_one_line():
    row = lists.read("shared-sequence-bridge")[0]
    with pytest.raises(UnknownName, match="nobody is 'dora'; the memory knows anna, ben"):
        meant(row, "put dora's camera on the plate")
    with pytest.raises(BadInstruction, match="no personal object"):
        meant(row, "put it on the plate")


def test_the_scripted_policy_reads_owners_and_two_colours():
    command = read("put my brother's camera on the plate")
    assert (command.verb, command.category, command.goal) == ("put", "camera", "plate")
    command = read("put the red pouch near the blue vase")
    assert (command.verb, command.category, command.goal) == ("near", "pouch", "vase")
    assert (command.colour.name, command.goal_colour.name) == ("red", "blue")
    command = read("move my plant next to her cup")
    assert (command.verb, command.goal, command.goal_colour) == ("near", "cup", None)


def test_a_list_comes_back_as_it_was_written(tmp_path):
    rows = [replace(row, suite="mine") for row in lists.read("shared-sequence")[::23]]
    lists.write("mine", rows, tmp_path)
    assert [asdict(row) for row in lists.read("mine", tmp_path)] == [asdict(row) for row in rows]


@pytest.mark.parametrize(
    ("field", "given", "said"),
    [
        ("owned", ["camera-personal"], "field 'owned': TypeError: too many"),
        ("owned", [["cup-personal", "anna", []]], "field 'owned': 'cup-personal' is not placed"),
        ("speaker", None, "speaker is None; it must be of type str"),
        (
            "subgoals",
            [{}],
            "field 'subgoals': TypeError: missing a required argument: 'instruction'",
        ),
    ],
)
def test_damage_is_said_by_row_and_field(tmp_path, field, given, said):
    row = replace(lists.read("shared-sequence-bridge")[0], suite="mine")
    lists.write("mine", [row], tmp_path)
    fields = json.loads((tmp_path / "mine.jsonl").read_text())
    fields[field] = given
    data = (json.dumps(fields) + "\n").encode()
    (tmp_path / "mine.jsonl").write_bytes(data)
    manifest = {"mine": {"sha256": hashlib.sha256(data).hexdigest(), "episodes": 1}}
    (tmp_path / "manifest.json").write_text(json.dumps(manifest))
    lists.read.cache_clear()
    with pytest.raises(BadSuite, match=said):
        lists.read("mine", tmp_path)


def test_what_knows_one_object_is_refused(name):
    task = SHARED[name].tasks[0].name
    for method in ("hard-short", "soft-own", "oracle-mask"):
        with pytest.raises(BadStudy, match="knows one object"):
            Study(((name, task),), (method,), policy="mini-pi0")
    Study(((name, task),), ("generic", "vap"), policy="mini-pi0")


def test_a_shared_scene_has_its_benchmarks_policy(name):
    assert shipped(name) == shipped(shared.LIKE[name])
    assert suites.is_listed(name)
    assert not suites.list_name(name).endswith(suites.DEVELOPMENT)


def test_keys_of_other_results_are_as_before():
    row = lists.read("simpler-bridge")[0]
    assert result_key(row, "vap", "x") != result_key(
        replace(row, owned=(Owned(row.target, "anna"),)), "vap", "x"
    )


def test_a_list_is_its_builders_and_a_layout_that_was_drawn_again_alone_is_another(
    name, monkeypatch
):
    for often in ("_draw_free_spot", "_is_free"):  # called 100,000 times
        monkeypatch.setattr(layout, often, getattr(layout, often).__wrapped__)
    monkeypatch.setattr(drawn, "radius_m", cache(radius_m))
    again = {}
    for task in shared.TASKS[name]:
        for episode, draw in drawn.REDRAWN.get(task.name, {}).items():
            assert draw == 1
            again[f"{name}.{task.name}.{episode:03d}"] = lists.to_line(
                drawn.row(name, task, episode)
            )
    monkeypatch.setattr(drawn, "REDRAWN", {})
    first = {row.key: lists.to_line(row) for row in drawn.rows(name)}
    for row in lists.read(name):
        line = lists.to_line(row)
        assert line == again.get(row.key, first[row.key])
        assert (line != first[row.key]) == (row.key in again)
