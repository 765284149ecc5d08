"""LPIPS and FLIP: the published definitions, nothing downloaded, nothing pretended."""

from __future__ import annotations

import dataclasses
import importlib.util
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file

from sceneexpander.errors import UserError
from sceneexpander.evaluation import visual
from sceneexpander.evaluation.config import EvaluateConfig
from sceneexpander.evaluation.evaluate import evaluate
from sceneexpander.evaluation.visual import flip_map, lpips
from tests.worlds.wall import made_reconstruction, own_pictures

SHAPES = {0: (64, 3, 11), 3: (192, 64, 5), 6: (384, 192, 3), 8: (256, 384, 3), 10: (256, 256, 3)}
GOLDEN = 0.26431718468666077
FLIP = importlib.util.find_spec("flip_evaluator") is not None


def weights() -> tuple[dict[str, torch.Tensor], dict[str, torch.Tensor]]:
    """Of AlexNet and of the heads, drawn: any will do to compare two programs."""
    generator = torch.Generator().manual_seed(0)
    backbone, heads = {}, {}
    for number, (place, (out, into, side)) in enumerate(SHAPES.items()):
        scale = (2 / (into * side * side)) ** 0.5
        backbone[f"features.{place}.weight"] = scale * torch.randn(out, into, side, side, generator=generator)
        backbone[f"features.{place}.bias"] = 0.1 * torch.randn(out, generator=generator)
        heads[f"lin{number}.model.1.weight"] = torch.rand(1, out, 1, 1, generator=generator)
    return backbone, heads


def pictures() -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(1)
    first = torch.rand(3, 64, 96, generator=generator)
    return first, (first + 0.2 * torch.randn(3, 64, 96, generator=generator)).clamp(0, 1)


@pytest.fixture
def given(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """AlexNet's weights as a file, and a package ``lpips`` that has heads and cannot be imported."""
    backbone, heads = weights()
    package = tmp_path / "site" / "lpips"
    (package / "weights" / "v0.1").mkdir(parents=True)
    (package / "__init__.py").write_text("raise ImportError('nothing of it is run')\n")
    torch.save(heads, package / "weights" / "v0.1" / "alex.pth")
    torch.save(backbone, tmp_path / "alexnet.pth")
    save_file(backbone, str(tmp_path / "alexnet.safetensors"))
    monkeypatch.syspath_prepend(str(tmp_path / "site"))
    monkeypatch.delitem(sys.modules, "lpips", raising=False)
    visual._network.cache_clear()
    yield tmp_path / "alexnet.pth"
    visual._network.cache_clear()


def test_lpips_is_what_its_package_computes(given: Path) -> None:
    first, second = pictures()
    value = lpips(first, second, given)
    assert value == pytest.approx(GOLDEN, rel=1e-5)  # by lpips 0.1.4 with these weights
    assert lpips(first, second, given.with_suffix(".safetensors")) == value
    assert lpips(first, first, given) == 0
    assert lpips(first[:, :30], second[:, :30], given) is None


def test_other_weights_and_absent_heads_are_refused_in_one_line(
    given: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first, second = pictures()
    torch.save({"features.0.weight": torch.zeros(1)}, tmp_path / "other.pth")
    (tmp_path / "text.pth").write_text("no weights")
    for name in ("other.pth", "text.pth", "nowhere.pth"):
        with pytest.raises(UserError, match=f"lpips_weights: .*{name}"):
            lpips(first, second, tmp_path / name)
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(UserError, match="needs the package lpips"):
        lpips(first, second, given.with_suffix(".safetensors"))


def test_without_weights_there_is_no_lpips_and_with_them_it_is_in_the_row(given: Path) -> None:
    scene = made_reconstruction()
    views = own_pictures(scene)
    config = EvaluateConfig(st_lpips=False, ghosting=False, consistency_frames=0)
    row = evaluate(scene, views, config, scene="s", round_number=1, seed=0)
    assert not any(name.startswith("lpips") for name in row.values)
    large = dataclasses.replace(config, lpips_weights=str(given))
    # 28 x 42 pixels are too few for AlexNet: absent, not 0.
    assert not any(
        name.startswith("lpips") for name in evaluate(scene, views, large, scene="s", round_number=1, seed=0).values
    )


@pytest.mark.skipif(not FLIP, reason="flip-evaluator is not installed")
def test_flip_is_0_for_equal_pictures_1_for_black_and_white_and_in_the_row() -> None:
    first, second = pictures()
    same, apart = flip_map(first, first), flip_map(torch.zeros_like(first), torch.ones_like(first))
    noisy = flip_map(second, first)
    assert same is not None
    assert apart is not None
    assert noisy is not None
    assert float(same.max()) == 0
    assert float(apart.mean()) == pytest.approx(0.97, abs=0.03)
    assert 0 < float(noisy.mean()) < float(apart.mean())
    scene = made_reconstruction()
    config = EvaluateConfig(st_lpips=False, ghosting=False, consistency_frames=0)
    row = evaluate(scene, own_pictures(scene), config, scene="s", round_number=1, seed=0)
    assert row.values["flip_captured"] < 0.01


@pytest.mark.parametrize("measure", [flip_map, lambda a, b: lpips(a, b, Path("unused"))])
@pytest.mark.wrong_shapes
def test_what_cannot_be_compared_is_refused(measure) -> None:  # type: ignore[no-untyped-def]
    first, second = pictures()
    with pytest.raises(ValueError, match="cannot compare images of"):
        measure(first, second[:, :-1])
    broken = second.clone()
    broken[0, 0, 0] = float("nan")
    with pytest.raises(ValueError, match="non-finite"):
        measure(first, broken)


def test_pixels_that_do_not_count_are_black_on_both_sides(monkeypatch: pytest.MonkeyPatch) -> None:
    """And those that count are as they are."""
    given: list[tuple[torch.Tensor, torch.Tensor]] = []
    for name in ("lpips", "cvvdp"):
        monkeypatch.setattr(visual, name, lambda image, picture, *_: given.append((image, picture)) or 0.0)
    image, picture = torch.rand(2, 3, 40, 50, generator=torch.Generator().manual_seed(0)) * 0.9 + 0.1
    valid = torch.ones(40, 50, dtype=torch.bool)
    valid[:, :20] = False
    config = EvaluateConfig(lpips_weights="a file", cvvdp=True, flip=False)
    assert set(visual._looks(image, picture, valid, config, "captured")) == {"lpips_captured", "cvvdp_captured"}
    assert len(given) == 2
    for pair in given:
        for seen, whole in zip(pair, (image, picture), strict=True):
            assert torch.equal(seen[:, valid], whole[:, valid])
            assert not seen[:, ~valid].any()
