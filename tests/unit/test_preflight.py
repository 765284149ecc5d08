"""What can be known before anything runs is refused before anything runs."""

from __future__ import annotations

import importlib.util

import pytest
import torch

from sceneexpander.errors import UserError
from sceneexpander.expansion import ModelConfig
from sceneexpander.preflight import check_device, check_weights


@pytest.mark.parametrize("spec", ["org/name@rev", "org/name@main", "some-org/some.model@0123abc"])
def test_weights_on_a_hub_that_may_not_be_downloaded_must_be_here(
    spec: str, monkeypatch: pytest.MonkeyPatch, tmp_path_factory: pytest.TempPathFactory
) -> None:
    if importlib.util.find_spec("huggingface_hub") is not None:
        from huggingface_hub import constants

        monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path_factory.mktemp("hub")))
        check_weights(ModelConfig(name="mini", weights=spec, allow_download=True))
    with pytest.raises(UserError, match=r"not in the local hub cache|not installed"):
        check_weights(ModelConfig(name="mini", weights=spec))


@pytest.mark.parametrize("spec", ["a@b", "x/y", "x" * 5000, "a\0b", "/dev/zero", "x" * 300 + ".safetensors", "."])
@pytest.mark.parametrize("download", [False, True])
def test_weights_that_are_none_are_one_line(spec: str, download: bool) -> None:
    with pytest.raises(UserError) as caught:
        check_weights(ModelConfig(name="mini", weights=spec, allow_download=download))
    assert len(caught.value.line()) < 600


@pytest.mark.parametrize(("device", "count", "fine"), [
    ("cuda", 1, True), ("cuda:0", 1, True), ("cuda:1", 2, True), ("cuda:1", 1, False), ("cuda:9", 8, False), ("cuda", 0, False),
    ("cpu", 0, True),
])  # fmt: skip
def test_a_device_is_there(device: str, count: int, fine: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: count > 0)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: count)
    if fine:
        check_device(device)
    else:
        with pytest.raises(UserError, match=rf"^device: is '{device}'"):
            check_device(device)
