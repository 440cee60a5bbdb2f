"""Tokens learned and measured: the rotation into a policy's space, methods that use it, and the study with its tables."""

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest
from scipy import stats
from scipy.stats import ortho_group
from typer.testing import CliRunner

from vap_core.base.errors import BadMemory, BadOutput, BadPolicy, BadStudy, UnknownName
from vap_core.base.files import DATA
from vap_core.base.types import Rgb
from vap_core.cli import app
from vap_core.policies.mini_pi0 import learned_token
from vap_core.policies.mini_pi0.learned_token import TokenTraining
from vap_core.policies.mini_pi0.vlm import load_from_policy, load_vlm
from vap_core.policies.tables import open_table
from vap_core.simulation import suites
from vap_core.simulation.assets.objects import ObjectModel
from vap_core.study import engine, tokens, trials
from vap_core.study.measurement import measure
from vap_core.study.stats import rate
from vap_core.study.tokens import OTHER, Job, Scene, Tokens
from vap_core.study.trials import Study

from .test_soft_prompt import SUITE, TASK, grown  # noqa: F401


@pytest.fixture
def tiny(
    grown: tuple[Path, Path],  # noqa: F811
    monkeypatch: pytest.MonkeyPatch,
) -> tuple[Path, Path]:
    """A tiny model and policy in place of those that ship, and few photos."""
    home, far = grown
    monkeypatch.setattr(learned_token, "MODEL", home)
    monkeypatch.setattr(learned_token, "VIEWS", 2)
    monkeypatch.setattr(learned_token, "OTHERS", 1)
    monkeypatch.setattr(tokens, "shipped", lambda suite: far)

    def views(model: ObjectModel, n: int = 5, seed: int = 0) -> list[Rgb]:
        """Noise of the object's own: rendering takes longer than all that is tested."""
        rng = np.random.default_rng([seed, n, *model.name.encode()])
        return list(rng.integers(0, 256, (n, 32, 32, 3)).astype(np.uint8))

    for module in (tokens, learned_token):
        monkeypatch.setattr(module, "reference_views", views)

    def training(epochs: int = 2) -> TokenTraining:
        return TokenTraining(epochs=epochs, augmentations=1)

    def scenes(suite: str, task: str) -> tuple[Scene, ...]:
        """Two episodes of noise in place of rendered views."""
        rows = suites.rows(suite, task)
        target = rows[0].target
        names = (target, learned_token.lookalikes(rows)[0])
        rng = np.random.default_rng(0)
        crops = {
            name: tuple(rng.integers(0, 256, (2, 32, 32, 3)).astype(np.uint8)) for name in names
        }
        return tuple(Scene(episode=i, target=target, crops=crops) for i in range(2))

    monkeypatch.setattr(tokens, "TokenTraining", training)
    monkeypatch.setattr(tokens, "scenes", scenes)
    for cached in (tokens._model, tokens._policy_model, tokens._negatives):
        cached.cache_clear()
    yield grown
    for cached in (tokens._model, tokens._policy_model, tokens._negatives):
        cached.cache_clear()


def test_what_no_word_says_stays_as_it_is() -> None:
    """Eight words in sixteen dimensions: a direction without words is not turned."""
    rng = np.random.default_rng(0)
    source = np.zeros((8, 16), np.float32)
    source[:, :8] = rng.normal(size=(8, 8))
    target = np.zeros_like(source)
    target[:, :8] = source[:, :8] @ ortho_group.rvs(8, random_state=1)
    found = learned_token.orthogonal_map(source, target)
    assert np.allclose(found[8:, 8:], np.eye(8), atol=1e-4)
    assert np.allclose(source @ found, target, atol=0.05)


def test_the_model_inside_a_policy_has_the_policys_weights(grown: tuple[Path, Path]) -> None:  # noqa: F811
    home, far = grown
    inside = load_from_policy(far)
    table = open_table(far)
    words = inside.towers.paligemma.model.language_model.embed_tokens.weight.numpy()
    assert np.array_equal(table.block(0, table.shape[0]), words)
    assert open_table(home).shape == table.shape
    assert inside.sha256() == load_from_policy(far).sha256()
    with pytest.raises(BadPolicy, match="is no mini-pi0"):
        load_from_policy(home)


@pytest.mark.parametrize("method", ["soft-aligned", "soft-own"])
def test_tokens_of_other_spaces_are_methods(
    method: str,
    tiny: tuple[Path, Path],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    home, far = tiny
    monkeypatch.setattr(learned_token, "MODEL", home)
    monkeypatch.setattr(
        learned_token, "TokenTraining", lambda: TokenTraining(epochs=1, augmentations=1)
    )
    asked = Study(((SUITE, TASK),), (method,), episodes=1, policy=str(far))
    engine.store.open_run(tmp_path, asked.configuration())
    bank = tmp_path / "memory"
    trials.register_personal(asked, bank)
    row = asked.rows(SUITE, TASK)[0]
    trial = trials.make_trial(asked, [row], method, bank)
    assert trial.prompter.rewrite(row.instruction) == "put <my_0> on the plate"
    (used,) = trial.policy.learned.values()
    suffix = learned_token.OWN_SUFFIX if method == "soft-own" else learned_token.SUFFIX
    model = load_from_policy(far) if method == "soft-own" else load_vlm(home)
    rows = asked.rows(SUITE, TASK)
    suffix = learned_token.file_suffix(rows, model.sha256(), suffix)
    token = learned_token.load(bank, row.target, model.sha256(), suffix)
    expected = token.embedding
    if method == "soft-aligned":
        expected = learned_token.align(token.embedding, home, far)
    assert np.allclose(used.numpy(), expected)
    (bank / f"{row.target}{suffix}").unlink()
    with pytest.raises(BadMemory, match="no learned word"):
        trials.make_trial(asked, [row], method, bank)


def test_the_study_measures_every_token_and_goes_on(
    tiny: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    jobs = Tokens.jobs
    monkeypatch.setattr(Tokens, "jobs", lambda asked: jobs(asked)[:2])
    asked = Tokens((SUITE,), (5,), epochs=2)
    tables = measure(asked, tmp_path / "run", progress=False)
    answers = tables["answers"]
    assert set(answers.groupby(["learned_in", "token", "read_by"]).groups) == set(
        tokens.READINGS.values()
    )
    assert set(answers[answers.learned_in == "policy"].step) == {0, 1, 2}
    own = answers[answers.shown == answers.object]
    assert (own.n == 2).all()
    assert OTHER in set(answers.shown)
    (kinds, counts) = np.unique(tokens.kind_of(answers), return_counts=True)
    assert list(kinds) == ["look-alikes", "other objects", "own"]
    assert counts[0] == 6 * counts[1]
    scored = tables["choices"]
    assert set(scored.episode) == {0, 1}
    assert set(scored.read_by) == {"vlm", "policy"}
    assert (scored.groupby(["read_by", "seen_in", "episode"]).size() == 2).all()
    widths = {len(embedding) for embedding in tables["embeddings"].embedding}
    assert widths == {16}
    learned = tables["embeddings"].set_index("learned_in").embedding
    rows = suites.rows(SUITE, tables["embeddings"].task[0])
    taught = learned_token.photographs(rows, 0, 5)
    training = TokenTraining(epochs=2, augmentations=1)
    *_, (_, method) = learned_token.lessons(load_vlm(tiny[0]), rows[0].target, taught, training)
    assert np.allclose(learned["vlm"], method, atol=1e-5)

    def must_not_run(asked: Tokens, job: Job, folder: Path) -> None:
        raise AssertionError(job)

    run_job = Tokens.run
    monkeypatch.setattr(Tokens, "run", must_not_run)
    again = measure(asked, tmp_path / "run", progress=False)
    assert again["answers"].equals(answers)
    monkeypatch.setattr(Tokens, "run", run_job)
    next((tmp_path / "run" / "parts").glob("*.json")).unlink()
    mended = measure(asked, tmp_path / "run", progress=False)
    assert mended["answers"].equals(answers), "a part that was deleted is made again"
    other = measure(Tokens((SUITE,), (5,), epochs=1), tmp_path / "other", progress=False)
    for _ in range(2):
        for path in tokens.publish(tmp_path / "run", tmp_path / "kept"):
            assert len(pd.read_parquet(path)) == len(tables[path.stem.removeprefix("token_")])
    for path in tokens.publish(tmp_path / "other", tmp_path / "kept"):
        name = path.stem.removeprefix("token_")
        assert len(pd.read_parquet(path)) == len(tables[name]) + len(other[name])
        runs = json.loads(pq.read_schema(path).metadata[b"runs"])
        assert [run["configuration"]["epochs"] for run in runs] == [2, 1]
    with pytest.raises(BadOutput):
        measure(Tokens((SUITE,), (5,), epochs=1), tmp_path / "run", progress=False)
    assert "learned in the policy" in tokens.report(tables)
    assert "the model chooses the target" in tokens.report(tables)


def test_the_usual_number_of_photos_comes_first_and_once_in_the_policy() -> None:
    jobs = Tokens((SUITE,), (1, 5), epochs=1).jobs()
    assert [(job.k, job.where) for job in jobs[:2]] == [(5, "vlm"), (5, "policy")]
    assert len(jobs) == 4 * 3
    assert {job.where for job in Tokens((SUITE,), places=("vlm",)).jobs()} == {"vlm"}
    with pytest.raises(BadStudy, match="from 5 photos alone"):
        measure(Tokens((SUITE,), (3,), places=("policy",)), Path("none"), progress=False)
    with pytest.raises(UnknownName, match="measure tokens: place"):
        Tokens((SUITE,), places=("here",))
    with pytest.raises(UnknownName, match="measure tokens: suite"):
        Tokens(("nowhere",))
    found = CliRunner().invoke(app, ["measure", "tokens", "--k", "1,none"])
    assert isinstance(found.exception, BadStudy)


def test_rates_are_counted_by_hand() -> None:
    """Own 3 of 4, a look-alike 1 of 4, others 0 of 2, after two steps of one token."""
    lines = []
    for step, own in ((0, 0), (9, 3)):
        for shown, yes, n in (("cup", own, 4), ("cup-lookalike-1", 1, 4), (OTHER, 0, 2)):
            lines.append(("s", "t", "cup", 5, "vlm", step, "as learned", "vlm", shown, yes, n))
    columns = ["suite", "task", "object", "k", "learned_in", "step", "token", "read_by"]
    answers = pd.DataFrame(lines, columns=[*columns, "shown", "yes", "n"])
    (line,) = tokens.readings(answers).to_dict("records")
    assert line["right"] == pytest.approx((3 / 4 + 5 / 6) / 2)
    assert (line["own"].k, line["look-alikes"].k, line["other objects"].k) == (3, 1, 0)
    whole = tokens.pooled(answers).loc["as learned"]
    assert whole["own"].text() == "75.0 [30.1, 95.4] 4"
    assert (whole["right"].n, whole["right"].value) == (1, line["right"])
    assert np.isnan(whole["right"].low)
    other = answers.assign(object="mug", shown=answers.shown.str.replace("cup", "mug"), yes=0)
    both = tokens.pooled(pd.concat([answers, other])).loc["as learned"]
    assert (both["own"].value, both["own"].n) == (3 / 8, 8)
    rights = [line["right"], 0.5]
    interval = stats.t.interval(0.95, 1, np.mean(rights), stats.sem(rights))
    assert (both["right"].n, both["right"].value) == (2, pytest.approx(np.mean(rights)))
    assert (both["right"].low, both["right"].high) == (max(0, interval[0]), min(1, interval[1]))
    (taken,) = tokens.confusions(answers).to_dict("records")
    assert (taken["look-alike"], taken["value"], taken["n"]) == ("cup-lookalike-1", 0.25, 4)
    curve = tokens.curve(answers).set_index(["step", "kind"]).value
    assert (curve[0, "own"], curve[9, "own"]) == (0, 0.75)


def test_a_crop_shows_the_object_as_a_photo_does() -> None:
    rgb = np.zeros((100, 100, 3), np.uint8)
    rgb[80:100, 90:100] = 200
    mask = rgb[..., 0] > 0
    crop = tokens.photo_crop(rgb, mask)
    assert crop is not None
    assert crop.shape == (36, 36, 3)
    assert (crop[18, 18] == 200).all()
    assert (crop[0, 0] == 0).all()
    assert (crop[-1, -1] == 200).all(), "the edge of the view is repeated"
    assert tokens.photo_crop(rgb, np.zeros_like(mask)) is None


def test_photos_take_the_place_of_crops() -> None:
    rng = np.random.default_rng(0)
    crops = {"cup": tuple(rng.integers(0, 256, (2, 4, 4, 3)).astype(np.uint8))}
    scenes = [Scene(episode=episode, target="cup", crops=crops) for episode in (3, 7)]
    photos = {"cup": tuple(rng.integers(0, 256, (3, 4, 4, 3)).astype(np.uint8)), OTHER: ()}
    found = tokens.in_photos(scenes, photos)
    assert [scene.episode for scene in found] == [3, 7]
    for scene, taken in zip(found, ((0, 1), (2, 0)), strict=True):
        for picture, i in zip(scene.crops["cup"], taken, strict=True):
            assert np.array_equal(picture, photos["cup"][i])


def test_the_highest_score_is_the_choice() -> None:
    lines = []
    for episode, scores in enumerate([(2.0, 1.0, 0.0), (-1.0, -0.5, -3.0)]):
        for name, score in zip(("cup", "cup-lookalike-1", "cup-lookalike-2"), scores, strict=True):
            lines.append(("s", "t", episode, "cup", name, score))
    lines.append(("s", "t", 2, "cup", "cup-lookalike-1", 1.0))
    table = pd.DataFrame(lines, columns=["suite", "task", "episode", "object", "shown", "score"])
    found = tokens.chosen(table)
    assert list(found.right) == [True, False, False]
    assert list(found.chance) == pytest.approx([1 / 3, 1 / 3, 0])
    even = tokens.chosen(table.assign(score=1.0))
    assert not even.right.any(), "a tie is no choice"
    rows = [("s", "t", i, m, i == 0) for i in range(3) for m in ("soft", "generic")]
    columns = ["suite", "task", "episode", "method", "first_object_correct"]
    both = pd.concat([table.assign(seen_in="scene"), table.assign(seen_in="photo", score=1.0)])
    beside = tokens.beside_policy(both, pd.DataFrame(rows, columns=columns), ["soft", "generic"])
    line = beside.loc["s"]
    assert (line[tokens.IN_SCENE].value, line[tokens.IN_SCENE].n) == (pytest.approx(1 / 3), 3)
    assert (line[tokens.IN_PHOTOS].value, line["soft"].value) == (0, pytest.approx(1 / 3))
    after = (line[tokens.AFTER_RIGHT], line[tokens.AFTER_WRONG])
    assert [(each.value, each.n) for each in after] == [(1, 1), (0, 2)]
    assert list(beside.index) == ["s"]
    losses = tokens.losses(both, pd.DataFrame(rows, columns=columns)).loss
    cost = losses[tokens.TO_SCENE, "s"]
    assert (cost.value, cost.n) == (pytest.approx(-1 / 3), 3)
    assert cost.low <= cost.value <= cost.high
    cost = losses[tokens.TO_POLICY, "s"]
    assert (cost.value, cost.n) == (0, 3), "one of three in the scene, and one of three touched"
    assert cost.low <= 0 <= cost.high


def chosen_in_both(right: dict[str, tuple[bool, bool]], episodes: int) -> pd.DataFrame:
    """Rows of `tokens.scores`: per object, whether it is chosen in photos and in the scene."""
    lines = []
    for target, by_view in right.items():
        for seen_in, is_right in zip((tokens.PHOTO, tokens.SCENE), by_view, strict=True):
            for episode in range(episodes):
                about = {"suite": "s", "task": target, "object": target, "episode": episode}
                for shown, score in ((target, float(is_right)), ("look-alike", 0.5)):
                    lines.append({**about, "seen_in": seen_in, "shown": shown, "score": score})
    return pd.DataFrame(lines)


def touches(right: dict[str, bool], episodes: int) -> pd.DataFrame:
    """Episodes of soft: per object, whether it is touched first."""
    lines = []
    for target, is_right in right.items():
        for episode in range(episodes):
            line = {"suite": "s", "task": target, "episode": episode, "method": "soft"}
            lines.append({**line, "first_object_correct": is_right})
    return pd.DataFrame(lines)


@pytest.mark.parametrize("episodes", [6, 24])
def test_objects_are_the_units_whatever_the_number_of_their_episodes(episodes: int) -> None:
    """Each object has one learned token: more episodes with it say nothing of other tokens."""
    table = chosen_in_both({"cup": (True, False), "owl": (True, True)}, episodes)
    touched = touches({"cup": False, "owl": False}, episodes)
    losses = tokens.losses(table, touched).loss
    cost = losses[tokens.TO_SCENE, "s"]
    assert (cost.value, cost.low, cost.high, cost.n) == (0.5, 0, 1, 2 * episodes)
    cost = losses[tokens.TO_POLICY, "s"]
    assert (cost.value, cost.low, cost.high) == (0.5, 0, 1)
    in_scene = tokens.beside_policy(table, touched, ["soft"]).loc["s", tokens.IN_SCENE]
    wilson = rate(1, 2)
    assert (in_scene.value, in_scene.n) == (0.5, 2 * episodes)
    assert (in_scene.low, in_scene.high) == pytest.approx((wilson.low, wilson.high))


def test_rows_of_several_trainings_of_one_word_are_refused() -> None:
    """The highest score would be over both: the same rows twice would halve chance."""
    table = chosen_in_both({"cup": (True, False)}, 6)
    again = pd.concat([table, table], ignore_index=True)
    with pytest.raises(BadStudy, match="of several trainings of one word; choose one by k, epochs"):
        tokens.losses(again, touches({"cup": False}, 6))


def test_the_loss_of_a_suite_is_corrected_for_the_others() -> None:
    right = {f"object-{i}": (True, False) for i in range(6)}
    one = chosen_in_both(right, 2)
    other = chosen_in_both({"cup": (True, False), "owl": (True, True)}, 2).assign(suite="other")
    touched = touches(dict.fromkeys([*right], False), 2)
    touched = pd.concat([touched, touches({"cup": False, "owl": True}, 2).assign(suite="other")])
    found = tokens.losses(pd.concat([one, other]), touched).loc[tokens.TO_SCENE]
    assert list(found.index) == ["s", "other", tokens.ALL_SUITES]
    assert list(found.objects) == [6, 2, 8]
    assert [each.value for each in found.loss] == pytest.approx([1, 0.5, 7 / 8])
    assert list(found.p) == pytest.approx([2**-5, 1, 2**-6])
    assert list(found.p_holm) == pytest.approx([2**-4, 1, 2**-6])


def test_the_differences_of_forms_of_the_token_are_by_token() -> None:
    """Those of the published table: four tokens, whose mean says little of a fifth."""
    loop = pd.read_parquet(DATA / "results" / "token_closed_loop.parquet")
    own = tokens.success_by_token(loop, "soft-own")
    assert {task: round(100 * gain) for (_, task), gain in own.items()} == {
        "pick-shaver": -50,
        "put-camera": -4,
        "put-owl-figurine": -17,
        "put-straw-cup": -42,
    }
    found = tokens.mean_of_tokens(list(own), least=-1.0)
    reference = stats.ttest_1samp(own, 0).confidence_interval()
    assert found.n == 4
    assert (found.low, found.high) == pytest.approx((reference.low, reference.high))
    assert found.low < 0 < found.high
    certain = tokens.mean_of_tokens([-1.0, -0.9], least=-1.0)
    assert certain.low == -1, "no success is lost twice"


def test_a_rotation_is_found_again() -> None:
    rng = np.random.default_rng(0)
    turn = ortho_group.rvs(16, random_state=1)
    source = rng.normal(size=(60, 16)).astype(np.float32)
    target = (source @ turn).astype(np.float32)
    found = learned_token.orthogonal_map(source, target)
    assert np.allclose(found, turn, atol=1e-2)
    assert np.allclose(found @ found.T, np.eye(16), atol=1e-6)
