"""The embeddings of policies beside those of the models that they grew from: the report, and what is measured of a space."""

from pathlib import Path

import pandas as pd
import pytest
from typer.testing import CliRunner

from vap_core.base.errors import BadOutput, BadPolicy
from vap_core.cli import app
from vap_core.policies.names import SHIPPED, shipped_checkpoint
from vap_core.policies.tables import token_groups
from vap_core.simulation import suites
from vap_core.study import embeddings as embedding_report
from vap_core.study import tokens

from . import tiny_lerobot
from .test_soft_prompt import SUITE, grown  # noqa: F401


def test_the_report_compares_the_shipped_policies_beside_the_paper() -> None:
    found = CliRunner().invoke(app, ["measure", "embeddings"])
    assert found.exit_code == 0, found.output
    assert "words of simpler-bridge" in found.output
    assert found.output.count("paper: pi0") == 4
    assert "0.945626 ± 0.066187" in found.output
    assert f"{shipped_checkpoint('vlabench').name} with mini-paligemma." in found.output
    assert all(shipped_checkpoint(suite).name in found.output for suite in suites.BENCHMARKS)


def test_a_policy_is_measured_beside_the_model_that_it_grew_from() -> None:
    folders = {tokens._model_folder(name).name for name in suites.BENCHMARKS}
    assert folders == {"mini-paligemma", "mini-paligemma-tint-free"}
    successor = SHIPPED / f"mini-pi0-{SUITE}-wide-seed-0"
    table = embedding_report.spaces(None, [successor])
    assert list(table.group) == [embedding_report.WHOLE, f"words of {SUITE}", "reserved"]
    assert (table.cosine_min > 0.999999).all()


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
