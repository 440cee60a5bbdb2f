"""The embeddings of policies beside those of the models that they grew from: the report, and what is measured of a space."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from typer.testing import CliRunner

from vap_core.analysis import embedding_report
from vap_core.analysis.token_space import (
    longest_word,
    mean_cosine,
    nearest_words,
    rotation_cosines,
    rotation_deg,
)
from vap_core.base.errors import BadOutput, BadPolicy
from vap_core.base.files import DATA
from vap_core.cli import app
from vap_core.evaluation.tokens import study
from vap_core.policies.embedding_table import open_table
from vap_core.policies.mini_pi0 import token_alignment
from vap_core.policies.names import SHIPPED, shipped_checkpoint
from vap_core.policies.token_groups import token_groups, vocabulary_of
from vap_core.simulation import suites
from vap_make.words import vocabulary

from . import tiny_lerobot
from .test_soft_prompt import SUITE, grown  # noqa: F401

OLDER = SHIPPED / "mini-paligemma"
"""The model that the first policies grew from."""


def test_the_report_compares_the_shipped_policies_beside_the_paper() -> None:
    found = CliRunner().invoke(app, ["measure", "embeddings"])
    assert found.exit_code == 0, found.output
    assert "words of simpler-bridge" in found.output
    assert found.output.count("paper: pi0") == 4
    assert "0.945626 ± 0.066187" in found.output
    defaults = ", ".join(shipped_checkpoint(suite).name for suite in suites.BENCHMARKS)
    assert f"{defaults} with mini-paligemma-tint-free" in found.output
    kept = pd.read_parquet(DATA / "results" / "token_spaces.parquet")
    measured = [str(SHIPPED / name) for name in kept.policy.unique()]
    named = CliRunner().invoke(app, ["measure", "embeddings", str(OLDER), *measured])
    whole = kept[kept.group == embedding_report.WHOLE]
    assert (whole.tokens == 113).all()
    for row in whole.itertuples():
        cosine = f"{row.cosine_mean:.6f} ± {row.cosine_std:.6f}"
        assert cosine in named.output
        assert cosine not in found.output  # it is of the first policies


def test_a_policy_is_measured_beside_the_model_that_it_grew_from() -> None:
    folders = {study._model_folder(name).name for name in suites.BENCHMARKS}
    assert folders == {"mini-paligemma-tint-free"}
    successor = SHIPPED / f"mini-pi0-{SUITE}-wide-seed-0"
    table = embedding_report.spaces(None, [successor])
    assert list(table.group) == [embedding_report.WHOLE, f"words of {SUITE}", "reserved"]
    assert (table.cosine_min > 0.999999).all()
    beside_another = embedding_report.spaces(OLDER, [successor])
    assert beside_another.cosine_mean[0] < 0.9


def test_real_checkpoints_are_compared_with_their_words(tmp_path: Path) -> None:
    """A tiny pi0 and pi0.5 of lerobot's classes, whose tokenizer lies beside the weights."""
    one, other = tiny_lerobot.pi0(tmp_path / "pi0"), tiny_lerobot.pi05(tmp_path / "pi05")
    table = embedding_report.spaces(one, [one, other], SUITE)
    assert list(table.policy) == ["pi0", "pi0", "pi05", "pi05"]
    assert list(table.group) == [embedding_report.WHOLE, f"words of {SUITE}"] * 2
    assert (table.cosine_mean[:2] > 0.999999).all()
    words = token_groups([one], ["put my camera on the plate", "put my camera"])["words"]
    vocabulary = tiny_lerobot.tokenizer(tmp_path / "again").get_vocab()
    expected = sorted(
        vocabulary[word]
        for word in ("put", "my", "camera", "on", "the", "plate")
        if word in vocabulary
    )
    assert words.tolist() == sorted({*expected})
    embedding_report.keep(table, tmp_path / "new" / "rows.csv")
    assert len(pd.read_csv(tmp_path / "new" / "rows.csv")) == 4
    with pytest.raises(BadOutput, match="neither"):
        embedding_report.keep(table, tmp_path / "other" / "rows.txt")
    assert not (tmp_path / "other").exists()
    with pytest.raises(BadPolicy, match="no suite 'nowhere'"):
        embedding_report.spaces(one, [other], "nowhere")
    (one / "tokenizer" / "tokenizer.json").write_text("{}")
    with pytest.raises(BadPolicy, match="is no tokenizer"):
        token_groups([one], ["put"])


def test_a_name_that_is_no_tables_is_refused_before_the_work(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    opened: list[Path] = []
    monkeypatch.setattr(embedding_report, "open_table", opened.append)
    out = tmp_path / "new" / "rows.txt"
    found = CliRunner().invoke(app, ["measure", "embeddings", "--out", str(out)])
    assert isinstance(found.exception, BadOutput)
    assert "ends with neither .parquet nor .csv" in str(found.exception)
    blocked = tmp_path / "file"
    blocked.touch()
    found = CliRunner().invoke(app, ["measure", "embeddings", "--out", str(blocked / "rows.csv")])
    assert isinstance(found.exception, BadOutput)
    assert opened == []
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_words_that_no_film_says_are_left_out_of_the_rotation(grown: tuple[Path, Path]) -> None:  # noqa: F811
    home, far = grown
    unmoved = rotation_cosines(home, home)
    assert [len(each) for each in unmoved.values()] == [0, 0, 0]
    assert [mean_cosine(each).text() for each in unmoved.values()] == ["-", "-", "-"]
    found = rotation_cosines(OLDER, SHIPPED / f"mini-pi0-{SUITE}")
    assert len(found["copied"]) == 56
    assert (found["copied"] < 0.9999).all()
    whole = mean_cosine(found["copied"])
    assert (whole.value, whole.n) == (pytest.approx(found["copied"].mean()), 56)
    assert whole.low < whole.value < whole.high
    assert found["rotated, fitted"].mean() > found["copied"].mean()
    table = open_table(far)
    rows = table.block(0, table.shape[0])
    assert longest_word(far) == pytest.approx(np.sqrt((rows**2).sum(1)).max())
    assert rotation_deg(rows[15], home, home) < 0.1
    bridge = SHIPPED / f"mini-pi0-{SUITE}"
    word = open_table(OLDER).block(15, 16)[0]
    moved = token_alignment.align(word, OLDER, bridge)
    cosine = np.cos(np.radians(rotation_deg(word, OLDER, bridge)))
    assert cosine * np.linalg.norm(word) ** 2 == pytest.approx(float(word @ moved), rel=1e-3)
    words = nearest_words(open_table(far).block(15, 16)[0], far, 3)
    assert words[0] == (vocabulary()[15], pytest.approx(1))


def test_a_space_that_does_not_fit_is_refused_in_one_line(
    grown: tuple[Path, Path],  # noqa: F811
    tmp_path: Path,
) -> None:
    """An embedding of another width, models of two widths, folders without a model or words."""
    home, far = grown
    word = open_table(home).block(15, 16)[0]
    with pytest.raises(BadPolicy, match="features and the embedding has 5; take a model"):
        nearest_words(word[:5], home)
    with pytest.raises(BadPolicy, match="features and the embedding has 5; take a model"):
        rotation_deg(word[:5], home, far)
    with pytest.raises(BadPolicy, match="holds no table of word embeddings"):
        nearest_words(word, tmp_path / "none")
    real = tiny_lerobot.pi0(tmp_path / "pi0")
    with pytest.raises(BadPolicy, match=f"{real} has 32 features and {home} has {len(word)}"):
        rotation_cosines(home, real)
    row = open_table(real).block(3, 4)[0]
    words = {token: word for word, token in vocabulary_of(real)[0].items()}
    assert nearest_words(row, real, 1) == [(words[3], pytest.approx(1))]
    (real / "tokenizer" / "tokenizer.json").unlink()
    with pytest.raises(BadPolicy, match="does not say what its tokens are; put .*tokenizer.json"):
        nearest_words(row, real)
