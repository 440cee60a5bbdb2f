"""Two tables of word embeddings: measures against slow references, what must not change them, and real checkpoints read by name."""

import json
import struct
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import save_file
from scipy.stats import ortho_group

from vap_core.base.errors import BadPolicy
from vap_core.policies.tables import open_table
from vap_core.study.embeddings import compare, paired_cosines

from . import tiny_lerobot

N, WIDTH = 700, 48


def tables(noise: float, n: int = N, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """A table, and the same with noise; they lie off the origin, and two rows are alike."""
    rng = np.random.default_rng(seed)
    scales = np.linspace(3, 0.5, WIDTH)
    one = (rng.normal(size=(n, WIDTH)) * scales + 1).astype(np.float32)
    other = (one + noise * rng.normal(size=one.shape)).astype(np.float32)
    other[5] = other[3]
    return one, other


def slow_cka(one: np.ndarray, other: np.ndarray) -> float:
    """From the kernels of all tokens by all tokens."""
    n = len(one)
    centre = np.eye(n) - 1 / n
    k, m = (centre @ (x @ x.T) @ centre for x in (one.astype(float), other.astype(float)))
    return float((k * m).sum() / np.sqrt((k * k).sum() * (m * m).sum()))


def slow_debiased(one: np.ndarray, other: np.ndarray) -> float:
    """Song et al., equation 5, word for word, without centring the rows."""

    def hsic(x: np.ndarray, y: np.ndarray) -> float:
        n = len(x)
        k, m = x @ x.T, y @ y.T
        np.fill_diagonal(k, 0)
        np.fill_diagonal(m, 0)
        last = k.sum() * m.sum() / ((n - 1) * (n - 2)) - 2 / (n - 2) * (k @ m).sum()
        return float((np.trace(k @ m) + last) / (n * (n - 3)))

    x, y = one.astype(float), other.astype(float)
    return hsic(x, y) / np.sqrt(hsic(x, x) * hsic(y, y))


def slow_nearest(one: np.ndarray, other: np.ndarray) -> float:
    """The share whose own row no other row is nearer than."""
    x, y = (
        each.astype(float) / np.linalg.norm(each.astype(float), axis=1, keepdims=True)
        for each in (one, other)
    )
    cosines = x @ y.T
    own = np.diag(cosines)
    return float((cosines <= own[:, None] + 1e-12).all(1).mean())


@pytest.mark.parametrize("noise", [0.01, 1.0, 3.0, 10.0])
def test_measures_are_those_of_slow_references(noise: float) -> None:
    one, other = tables(noise)
    found = compare(one, other)
    cosines = [
        float(a @ b / np.linalg.norm(a) / np.linalg.norm(b))
        for a, b in zip(one.astype(float), other.astype(float), strict=True)
    ]
    assert (found.tokens, found.without_direction) == (N, 0)
    assert found.cosine_mean == pytest.approx(np.mean(cosines), abs=1e-9)
    assert found.cosine_std == pytest.approx(np.std(cosines), abs=1e-9)
    assert found.cosine_min == pytest.approx(np.min(cosines), abs=1e-9)
    assert found.cka == pytest.approx(slow_cka(one, other), abs=2e-6)
    assert found.cka_debiased == pytest.approx(slow_debiased(one, other), abs=2e-6)
    assert found.nearest == pytest.approx(slow_nearest(one, other), abs=1e-9)


def test_the_references_span_right_and_wrong_neighbours() -> None:
    assert [slow_nearest(*tables(noise)) for noise in (0.01, 10.0)] == [
        pytest.approx(0.9975, abs=0.003),
        pytest.approx(0.02, abs=0.03),
    ]


def test_some_tokens_are_compared_among_themselves_and_found_in_the_whole_table() -> None:
    one, other = tables(3.0)
    tokens = np.array([600, 3, 44, 97, 98, 5, 250, 11])
    found = compare(one, other, tokens)
    assert found.tokens == 8
    assert found.cka == pytest.approx(slow_cka(one[tokens], other[tokens]), abs=2e-6)
    assert found.cka_debiased == pytest.approx(slow_debiased(one[tokens], other[tokens]), abs=2e-5)
    x, y = (
        each.astype(float) / np.linalg.norm(each.astype(float), axis=1, keepdims=True)
        for each in (one, other)
    )
    cosines = x[tokens] @ y.T
    own = cosines[np.arange(8), tokens]
    right = (cosines <= own[:, None] + 1e-12).all(1).mean()
    assert found.nearest == pytest.approx(right, abs=1e-9)
    assert 0 < found.nearest < 1


def test_a_table_is_like_itself_and_its_twin_rows_are_no_mistake() -> None:
    _, other = tables(0.5)
    found = compare(other, other.copy())
    assert found.cosine_min == pytest.approx(1, abs=1e-12)
    assert (found.cka, found.cka_debiased) == (pytest.approx(1), pytest.approx(1))
    assert found.nearest == 1


def test_a_rotation_changes_cosines_and_no_cka() -> None:
    one, other = tables(1.0)
    turn = ortho_group.rvs(WIDTH, random_state=0).astype(np.float32)
    plain = compare(one, other)
    turned = compare(one, other @ turn * 3 + 2)
    assert turned.cka == pytest.approx(plain.cka, abs=1e-5)
    assert turned.cka_debiased == pytest.approx(plain.cka_debiased, abs=1e-5)
    assert turned.cosine_mean < 0.5 < plain.cosine_mean


def test_the_order_of_tokens_does_not_matter_but_their_pairing_does() -> None:
    one, other = tables(1.0)
    order = np.random.default_rng(1).permutation(N)
    plain = compare(one, other)
    same = compare(one[order], other[order])
    for name in ("cosine_mean", "cka", "cka_debiased", "nearest"):
        assert getattr(same, name) == pytest.approx(getattr(plain, name), abs=1e-6)
    wrong = compare(one, other[order])
    assert wrong.nearest < 0.1 < plain.nearest
    assert abs(wrong.cka_debiased) < 0.1 < plain.cka_debiased


def test_few_unrelated_tokens_are_alike_by_plain_cka_alone() -> None:
    rng = np.random.default_rng(3)
    one, other = rng.normal(size=(2, 12, 600)).astype(np.float32)
    found = compare(one, other)
    assert found.cka > 0.9
    assert abs(found.cka_debiased) < 0.3


def test_rows_of_zeros_have_no_direction() -> None:
    one, other = tables(1.0)
    one[7] = 0
    other[8] = 0
    found = compare(one, other)
    assert found.without_direction == 2
    kept = np.setdiff1d(np.arange(N), [7, 8])
    cosines = paired_cosines(one[kept], other[kept])
    assert found.cosine_mean == pytest.approx(cosines.mean())
    with pytest.raises(BadPolicy, match="every row of a table is zero"):
        compare(one, np.zeros_like(other))


def test_the_longer_vocabulary_is_cut_and_other_widths_are_refused() -> None:
    one, other = tables(1.0)
    longer = np.concatenate([other, other[:30]])
    cut = compare(one, longer)
    plain = compare(one, other)
    assert cut.tokens == N
    assert cut.nearest == pytest.approx(plain.nearest)
    with pytest.raises(BadPolicy, match="48 and 47 features"):
        compare(one, other[:, :47].copy())


@pytest.mark.parametrize("kind", [torch.float32, torch.float16, torch.bfloat16])
def test_a_table_is_read_in_blocks_by_every_name(kind: torch.dtype, tmp_path: Path) -> None:
    rows = torch.randn(30, 8, generator=torch.Generator().manual_seed(0)).to(kind)
    names = (
        "model.paligemma_with_expert.paligemma.model.language_model.embed_tokens.weight",
        "paligemma_with_expert.paligemma.lm_head.weight",
        "language_model.model.embed_tokens.weight",
        "model.language_model.embed_tokens.weight",
        "lm_head.weight",
    )
    for i, name in enumerate(names):
        folder = tmp_path / str(i)
        folder.mkdir()
        others = {"model.gemma_expert.lm_head.weight": torch.zeros(30, 4)}
        save_file({"a.first": torch.ones(3)}, folder / "model-00001-of-00002.safetensors")
        save_file({**others, name: rows}, folder / "model-00002-of-00002.safetensors")
        table = open_table(folder)
        assert table.shape == (30, 8)
        assert np.array_equal(table.block(7, 19), rows[7:19].float().numpy())
        assert np.array_equal(table.block(20, 99), rows[20:].float().numpy())


def test_input_embeddings_come_before_an_untied_output(tmp_path: Path) -> None:
    ours, head = torch.ones(4, 2), torch.zeros(4, 2)
    save_file(
        {"paligemma.lm_head.weight": head, "paligemma.language_model.embed_tokens.weight": ours},
        tmp_path / "model.safetensors",
    )
    assert open_table(tmp_path).block(0, 4).all()


@pytest.mark.parametrize("make", [tiny_lerobot.pi0, tiny_lerobot.pi05, tiny_lerobot.smolvla])
def test_checkpoints_of_the_real_classes_hold_a_table(make: object, tmp_path: Path) -> None:
    from lerobot.policies import get_policy_class

    from vap_core.policies.lerobot.toy_pi0 import toy_sizes

    folder = make(tmp_path / "checkpoint")
    kind = json.loads((folder / "config.json").read_text())["type"]
    with toy_sizes(tiny_lerobot.TOY):
        policy = get_policy_class(kind).from_pretrained(folder)
    model = policy.model
    if kind == "smolvla":
        loaded = model.vlm_with_expert.get_vlm_model().text_model.embed_tokens.weight
    else:
        loaded = model.paligemma_with_expert.paligemma.model.language_model.embed_tokens.weight
    table = open_table(folder)
    assert np.array_equal(table.block(0, table.shape[0]), loaded.detach().float().numpy())
    found = compare(table.rows(), table.rows())
    assert found.cka == pytest.approx(1)


def test_a_saved_paligemma_holds_a_table(tmp_path: Path) -> None:
    """transformers' own class, small, and in several files."""
    from transformers import PaliGemmaConfig, PaliGemmaForConditionalGeneration

    text = {
        "model_type": "gemma", "vocab_size": 80, "hidden_size": 16, "intermediate_size": 16, "num_hidden_layers": 1,
        "num_attention_heads": 2, "num_key_value_heads": 1, "head_dim": 8,
    }  # fmt: skip
    vision = {
        "model_type": "siglip_vision_model", "hidden_size": 16, "intermediate_size": 16, "num_hidden_layers": 1,
        "num_attention_heads": 2, "image_size": 28, "patch_size": 14, "projection_dim": 16,
    }  # fmt: skip
    model = PaliGemmaForConditionalGeneration(
        PaliGemmaConfig(text_config=text, vision_config=vision, projection_dim=16)
    )
    model.save_pretrained(tmp_path, max_shard_size="4KB")
    assert len(list(tmp_path.glob("*.safetensors"))) > 1
    table = open_table(tmp_path)
    loaded = model.get_input_embeddings().weight.detach().numpy()
    assert np.array_equal(table.block(0, 80), loaded)


def test_damaged_files_are_one_line(tmp_path: Path) -> None:
    with pytest.raises(BadPolicy, match="holds no table"):
        open_table(tmp_path)
    file = tmp_path / "model.safetensors"
    save_file({"language_model.embed_tokens.weight": torch.ones(30, 8)}, file)
    whole = file.read_bytes()
    header = json.loads(whole[8 : 8 + struct.unpack("<Q", whole[:8])[0]])

    def rewritten(**changes: object) -> bytes:
        name = "language_model.embed_tokens.weight"
        text = json.dumps({name: {**header[name], **changes}}).encode()
        return struct.pack("<Q", len(text)) + text + bytes(960)

    for data, words in (
        (whole[:5], "is damaged"),
        (whole[:-1], "is damaged"),
        (b"\xff" * 8 + whole[8:], "is damaged"),
        (struct.pack("<Q", 4) + b"[[[[", "is damaged"),
        (rewritten(shape=[30, 9]), "is damaged"),
        (rewritten(shape=[-30, -8]), "is damaged"),
        (rewritten(shape=[240]), r"is F32 of \(240,\)"),
        (rewritten(data_offsets=[-960, 0]), "is damaged"),
        (rewritten(data_offsets=None), "is damaged"),
        (rewritten(dtype="I64"), "is damaged"),
        (rewritten(dtype="I32"), "is I32 of"),
    ):
        file.write_bytes(data)
        with pytest.raises(BadPolicy, match=words) as error:
            open_table(tmp_path)
        assert "\n" not in str(error.value)
        assert len(str(error.value)) < 300 + len(str(tmp_path))
