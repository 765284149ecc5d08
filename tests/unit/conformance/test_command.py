"""``python -m sceneexpander.conformance``: exit codes, one line per problem, damaged cases."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file

from sceneexpander.conformance.__main__ import main
from sceneexpander.conformance.registry import find_cases
from sceneexpander.geometry.checks import OutputCheck, compare_tensors
from sceneexpander.models.worldmirror import WorldMirror
from tests.support.tiny_worldmirror import TINY, random_images, tiny_worldmirror


@pytest.fixture(scope="module")
def case(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A case in the recorded layout whose expected outputs are our own."""
    folder = tmp_path_factory.mktemp("cases") / "own"
    folder.mkdir()
    dense = {"features": 16, "out_channels": [8, 8, 8, 8], "head_hidden": 8}
    model = {"img_size": 42, "patch_size": 14, "embed_dim": 32, "enable_cond": True}
    config = {
        "is_inference": True,
        "model": model | dict.fromkeys(("enable_pts", "enable_depth", "enable_norm", "enable_gs"), True),
        "dino": {"depth": 1, "num_heads": 2},
        "trunk": {
            "depth": 4,
            "num_heads": 2,
            "num_register_tokens": 4,
            "rope_freq": 100,
            "intermediate_idxs": [0, 1, 2, 3],
        },
        "camera_head": {"trunk_depth": 1, "num_heads": 4, "steps": 4},
        "dpt_heads": dense,
        "gs_head": dense,
        "gs_renderer": {"feature_dim": 8, "scale_clamp_max": 0.3, "enable_prune": True, "voxel_size": 0.05},
        "inputs": {"cond_flags": [0, 0, 0]},
    }
    (folder / "config.json").write_text(json.dumps(config))
    network = tiny_worldmirror()
    images = random_images(2)[None]
    save_file(network.state_dict(), folder / "weights.safetensors")
    save_file({"img": images}, folder / "inputs.safetensors")
    with torch.inference_mode():
        depth = network(images).depth
    save_file({"depth": depth[..., None].clone()}, folder / "outputs.safetensors")
    return folder


def copied(case: Path, target: Path) -> Path:
    target.mkdir()
    for file in case.iterdir():
        (target / file.name).write_bytes(file.read_bytes())
    return target


def exit_code(*arguments: str | Path) -> int:
    try:
        return main([str(argument) for argument in arguments])
    except SystemExit as stop:
        return int(stop.code or 0)


def test_agreement_is_exit_zero_with_a_line_per_output(case: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert exit_code(case) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("ok   own/depth: error/tolerance 0")
    assert "2e-05 + 0.0002*|b|" in lines[0]
    assert lines[-1] == "1 outputs compared: all agree"


def test_a_folder_of_cases_runs_them_all(case: Path) -> None:
    assert [path for path, _ in find_cases(case.parent)] == [case]


def test_disagreement_is_exit_one(case: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    other = copied(case, tmp_path / "other")
    save_file({"depth": torch.ones(1, 2, 28, 42, 1)}, other / "outputs.safetensors")
    assert exit_code(other, case) == 1
    out = capsys.readouterr().out
    assert "FAIL other/depth" in out
    assert "ok   own/depth" in out


def test_an_output_we_do_not_compute_is_a_disagreement(case: Path, tmp_path: Path) -> None:
    other = copied(case, tmp_path / "other")
    save_file({"mystery": torch.ones(1)}, other / "outputs.safetensors")
    assert exit_code(other) == 1


@pytest.mark.parametrize("missing", ["weights.safetensors", "inputs.safetensors", "outputs.safetensors"])
def test_a_missing_file_is_exit_two_and_one_line(
    case: Path, tmp_path: Path, missing: str, capsys: pytest.CaptureFixture[str]
) -> None:
    other = copied(case, tmp_path / "other")
    (other / missing).unlink()
    assert exit_code(other) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert missing in error


def test_unknown_models_empty_folders_and_missing_paths_are_exit_two(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "unknown").mkdir()
    (tmp_path / "unknown" / "config.json").write_text(json.dumps({"model": "Nobody's"}))
    (tmp_path / "empty").mkdir()
    for path, words in (("unknown", "unknown model"), ("empty", "holds no config.json"), ("none", "does not exist")):
        assert exit_code(tmp_path / path) == 2
        error = capsys.readouterr().err
        assert words in error
        assert error.count("\n") == 1
    assert exit_code() == 2


def test_weights_that_do_not_fit_are_exit_two(case: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    other = copied(case, tmp_path / "other")
    save_file({"a": torch.ones(1)}, other / "weights.safetensors")
    assert exit_code(other) == 2
    assert "does not fit the model" in capsys.readouterr().err


def test_an_incomplete_configuration_is_exit_two(case: Path, tmp_path: Path) -> None:
    other = copied(case, tmp_path / "other")
    config = json.loads((other / "config.json").read_text())
    del config["inputs"]
    (other / "config.json").write_text(json.dumps(config))
    assert exit_code(other) == 2


def key_list() -> dict[str, list[object]]:
    with torch.device("meta"):
        state = WorldMirror(TINY).state_dict()
    return {name: [list(value.shape), "float32"] for name, value in state.items()}


def test_a_key_list_of_other_sizes_disagrees(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "tiny.keys.json").write_text(json.dumps(key_list()))
    assert exit_code("--keys", tmp_path / "tiny.keys.json") == 1
    assert "of another shape" in capsys.readouterr().out


def test_key_lists_nobody_knows_are_exit_two(tmp_path: Path) -> None:
    (tmp_path / "a.keys.json").write_text(json.dumps({"nobody": [[1], "float32"]}))
    (tmp_path / "b.keys.json").write_text(json.dumps({"nobody": 3}))
    (tmp_path / "c.keys.json").write_text("{")
    assert [exit_code("--keys", tmp_path / f"{name}.keys.json") for name in "abc"] == [2, 2, 2]


def test_comparison_measures_in_units_of_the_tolerance() -> None:
    expected = torch.tensor([1.0, 100.0])
    check = compare_tensors("x", expected + torch.tensor([0.0, 0.01]), expected, atol=0.0, rtol=1e-3)
    assert check.error == pytest.approx(0.1, rel=1e-3)
    assert check.ok
    assert not compare_tensors("x", expected + 1, expected, atol=0.0, rtol=1e-3).ok
    assert not compare_tensors("x", expected * torch.nan, expected, atol=1.0, rtol=1.0).ok
    assert compare_tensors("x", expected[:1], expected, atol=1.0, rtol=1.0).ratio == math.inf
    assert compare_tensors("x", torch.tensor([torch.inf]), torch.tensor([torch.inf]), atol=1.0, rtol=1.0).ok
    assert compare_tensors("x", expected, expected, atol=0.0, rtol=0.0).ok
    assert not compare_tensors("x", expected + 1e-6, expected, atol=0.0, rtol=0.0).ok
    assert not OutputCheck(name="x", error=math.nan, tolerance=1.0).ok


@pytest.mark.parametrize(
    "text",
    ["[" * 100_000, '{"a":' * 50_000, "9" * 5000, '{"a": [[' + "9" * 5000 + '], "f"]}', '{"a": [[1e400], "f"]}', '{"a": [["1"], "f"]}',
     '{"a": [[NaN], "f"]}', '{"a": 3}', '{"a": [[-1], "f"]}', "[]", "", "\x00"],
    ids=lambda text: text[:20],
)  # fmt: skip
def test_a_key_list_that_is_none_is_one_line(tmp_path: Path, text: str, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "a.keys.json"
    path.write_text(text)
    with pytest.raises(SystemExit) as stop:
        main(["--keys", str(path)])
    assert stop.value.code == 2
    said = capsys.readouterr().err
    assert str(path) in said
    assert said.count("\n") == 1
    assert len(said) < 500


@pytest.mark.parametrize("name", ["x" * 5000, "x" * 300, "a\0b", "nothing", "/dev/zero"])
@pytest.mark.parametrize("option", [[], ["--keys"]])
def test_a_name_that_is_no_case_is_one_line(
    name: str, option: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as stop:
        main([*option, str(tmp_path / name)])
    assert stop.value.code == 2
    assert capsys.readouterr().err.count("\n") == 1
