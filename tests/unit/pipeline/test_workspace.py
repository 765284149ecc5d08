from __future__ import annotations

from pathlib import Path

import pytest
import yaml

from sceneexpander.cli.expand import parse_arguments, stage_scene
from sceneexpander.errors import UserError
from sceneexpander.pipeline.selection import Selection, read_selection
from sceneexpander.pipeline.workspace import make_workspace, merged_overrides

ROOT = Path(__file__).parents[3]


def test_a_workspace_is_a_pipeline_folder_with_its_own_selection(tmp_path: Path) -> None:
    scene = tmp_path / "photos"
    scene.mkdir()
    (scene / "scene.yaml").write_text("rounds: []\n")
    selection = Selection(scenes=("mine",), rounds=2, overrides=("profile=smoke", 'x="a b"'))
    folder = make_workspace(tmp_path / "ws", selection, project=ROOT, scenes={"mine": scene})
    for name in (
        "dvc.yaml",
        "conf/config.yaml",
        "stages/adapt.py",
        "src/sceneexpander/errors.py",
        "scenes/mine/scene.yaml",
    ):
        assert (folder / name).is_file(), name
    assert read_selection(folder) == selection
    assert yaml.safe_load((folder / "params.yaml").read_text())["rounds"] == [{"k": 1, "prev": 0}, {"k": 2, "prev": 1}]
    local = (folder / ".dvc" / "config.local").read_text()
    assert "no_scm = true" in local
    assert f"dir = {ROOT / '.dvc' / 'cache'}" in local
    assert not list(folder.rglob("__pycache__"))


def test_refreshing_keeps_outputs_and_takes_edits(tmp_path: Path) -> None:
    scene = tmp_path / "photos"
    scene.mkdir()
    selection = Selection(scenes=("mine",), rounds=1)
    folder = make_workspace(tmp_path / "ws", selection, project=ROOT, scenes={"mine": scene})
    (folder / "outputs").mkdir()
    (folder / "outputs" / "result").write_text("kept")
    (folder / "stages" / "adapt.py").write_text("old")
    make_workspace(folder, selection, project=ROOT, scenes={"mine": scene})
    assert (folder / "outputs" / "result").read_text() == "kept"
    assert (folder / "stages" / "adapt.py").read_text() == (ROOT / "stages" / "adapt.py").read_text()


def test_later_overrides_stand_and_files_become_absolute(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "w.safetensors").write_text("x")
    merged = merged_overrides(
        ("seed=0", "ablation=paper"), ("ablation=anchor", "model.weights=w.safetensors"), project=tmp_path
    )
    assert merged == ("seed=0", "ablation=anchor", f"model.weights={tmp_path / 'w.safetensors'}")
    assert merged_overrides((), ("model.weights=org/name@main",), project=tmp_path) == ("model.weights=org/name@main",)


def test_a_malformed_selection_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "params.yaml").write_text("scenes: [a]\n")
    with pytest.raises(UserError, match=r"params\.yaml: does not select a run"):
        read_selection(tmp_path)


def test_options_may_stand_anywhere_and_repeat(tmp_path: Path) -> None:
    request = parse_arguments(
        ["--prompt", "one", str(tmp_path), "profile=smoke", "--inserted", "a.png", "--prompt", "two", "seed=1"]
    )
    assert request.photos == tmp_path
    assert request.prompts == ("one", "two")
    assert request.overrides == ("profile=smoke", "seed=1")
    with pytest.raises(UserError, match="is not a setting"):
        parse_arguments([str(tmp_path), "smoke"])


def test_photos_and_options_become_a_scene_folder(tmp_path: Path) -> None:
    from PIL import Image

    photos = tmp_path / "photos"
    photos.mkdir()
    for name in ("a.png", "b.png"):
        Image.new("RGB", (40, 30), (10, 200, 30)).save(photos / name)
    picture = tmp_path / "NEW.PNG"
    Image.new("RGB", (40, 30), (200, 10, 30)).save(picture)
    sentence = 'Behind it: a "bench", 5 m long.'
    request = parse_arguments([str(photos), "--inserted", str(picture), "--prompt", sentence, "--motion", "turn right"])
    stage_scene(request, "mine", tmp_path / "scene")
    facts = yaml.safe_load((tmp_path / "scene" / "scene.yaml").read_text())
    assert facts == {
        "name": "mine",
        "rounds": [{"prompt": sentence, "motion": "turn right", "inserted": "inserted/round_1.png"}],
    }
    assert sorted(path.name for path in (tmp_path / "scene" / "captured").iterdir()) == ["a.png", "b.png"]
    assert (tmp_path / "scene" / "inserted" / "round_1.png").read_bytes() == picture.read_bytes()
