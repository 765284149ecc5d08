"""What can be known before anything runs is refused before anything runs."""

from __future__ import annotations

import importlib.util
import shutil
import socket
from pathlib import Path

import pytest
import torch

from sceneexpander.errors import UserError
from sceneexpander.expansion import ModelConfig
from sceneexpander.pipeline import preflight
from sceneexpander.pipeline.preflight import Checked, check_device, check_scene, check_weights

ROOT = Path(__file__).parents[3]


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


@pytest.mark.parametrize("by_shell", [False, True])
def test_a_server_for_runs_is_there_before_anything_is_read(
    by_shell: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with socket.socket() as nobody:
        nobody.bind(("127.0.0.1", 0))  # and does not listen
        uri = f"http://127.0.0.1:{nobody.getsockname()[1]}"
        overrides = [] if by_shell else ["tracking=server", f"tracking.uri={uri}"]
        if by_shell:
            monkeypatch.setenv("MLFLOW_TRACKING_URI", uri)
        with pytest.raises(UserError, match=rf"^tracking\.uri {uri}: does not answer"):
            check_scene("none", tmp_path, conf=ROOT / "conf", overrides=overrides)
        with pytest.raises(UserError, match=r"scene\.yaml"):
            check_scene("none", tmp_path, conf=ROOT / "conf", overrides=overrides, store=False)


@pytest.mark.parametrize(
    ("override", "said"),
    [
        ("evaluate.hold_out=7", r"^evaluate\.hold_out: is 7, but the scene has 8 photos"),
        ("evaluate.lpips_weights=nowhere.pth", r"^evaluate\.lpips_weights nowhere\.pth: does not exist"),
        ("evaluate.lpips_weights=/dev/zero", r"^evaluate\.lpips_weights /dev/zero: is a character device"),
    ],
)
def test_what_only_the_last_stages_read_is_looked_at_first(override: str, said: str) -> None:
    """Otherwise it would cost the whole run."""
    overrides = ["profile=smoke", "scene.long_side_px=98", override]
    with pytest.raises(UserError, match=said):
        check_scene("courtyard", ROOT / "scenes" / "courtyard", conf=ROOT / "conf", overrides=overrides)


def test_scenes_and_jobs_of_one_command_share_what_was_looked_at(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = shutil.copytree(ROOT / "scenes" / "courtyard", tmp_path / "courtyard")
    seen: list[str] = []
    for name in ("load_model", "load_scene"):
        real = getattr(preflight, name)
        monkeypatch.setattr(preflight, name, lambda *a, name=name, real=real: (seen.append(name), real(*a))[1])
    checked = Checked()
    jobs = [("profile=smoke",), ("profile=smoke", "adapt.steps=3"), ("profile=smoke", "seed=4")]
    counts = {
        check_scene("courtyard", scene, conf=ROOT / "conf", overrides=job, rounds=1, checked=checked).rounds
        for job in jobs
    }
    assert counts == {1}
    assert sorted(seen) == ["load_model", "load_scene"]
    check_scene("courtyard", scene, conf=ROOT / "conf", overrides=["scene.long_side_px=98"], rounds=1, checked=checked)
    assert sorted(seen) == ["load_model", "load_scene", "load_scene"], "photos of another size are looked at"
