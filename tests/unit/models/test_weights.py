"""Finding weights files and loading them strictly."""

from __future__ import annotations

import builtins
import hashlib
import sys
import types
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import save_file
from torch import nn

from sceneexpander.errors import UserError
from sceneexpander.models.weights import load_weights, read_tensors, resolve_weights
from sceneexpander.models.worldmirror import WorldMirror
from tests.support.tiny_worldmirror import TINY, tiny_worldmirror


def layer() -> nn.Sequential:
    return nn.Sequential(nn.Linear(3, 4), nn.LayerNorm(4))


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "weights.safetensors"
    save_file(layer().state_dict(), path)
    return path


def line_of(error: pytest.ExceptionInfo[UserError]) -> str:
    line = error.value.line()
    assert "\n" not in line
    return line


def test_a_local_path_is_resolved_with_its_hash(file: Path) -> None:
    found = resolve_weights(str(file), model="worldmirror")
    assert found.path == file
    assert found.sha256 == hashlib.sha256(file.read_bytes()).hexdigest()


def test_a_whole_model_survives_the_way_through_a_file(tmp_path: Path) -> None:
    source = tiny_worldmirror()
    save_file(source.state_dict(), tmp_path / "w.safetensors")
    with torch.device("meta"):
        target = WorldMirror(TINY)
    load_weights(target, tmp_path / "w.safetensors")
    assert all(torch.equal(value, source.state_dict()[name]) for name, value in target.state_dict().items())
    assert all(parameter.requires_grad and not parameter.is_meta for parameter in target.parameters())


def test_half_precision_files_fill_single_precision_models(tmp_path: Path) -> None:
    source, target = layer(), layer()
    save_file({name: value.half() for name, value in source.state_dict().items()}, tmp_path / "w.safetensors")
    load_weights(target, tmp_path / "w.safetensors")
    assert target[0].weight.dtype == torch.float32
    assert torch.equal(target[0].weight, source[0].weight.half().float())


def test_every_kind_of_misfit_is_named_in_one_line(tmp_path: Path) -> None:
    tensors = layer().state_dict()
    del tensors["0.bias"]
    tensors["extra"] = torch.zeros(1)
    tensors["1.weight"] = torch.zeros(5)
    save_file(tensors, tmp_path / "w.safetensors")
    target = layer()
    before = target[0].weight.clone()
    with pytest.raises(UserError) as error:
        load_weights(target, tmp_path / "w.safetensors")
    line = line_of(error)
    assert "1 missing (0.bias)" in line
    assert "1 unexpected (extra)" in line
    assert "1 of another shape (1.weight (5,) instead of (4,))" in line
    assert torch.equal(target[0].weight, before)


def test_a_truncated_file_says_how_many_bytes_are_missing(file: Path) -> None:
    data = file.read_bytes()
    file.write_bytes(data[:-10])
    with pytest.raises(UserError) as error:
        read_tensors(file)
    assert f"expected {len(data)} bytes, found {len(data) - 10}" in line_of(error)
    file.write_bytes(data[:20])
    with pytest.raises(UserError, match="truncated"):
        resolve_weights(str(file), model="mini")


@pytest.mark.parametrize(
    "content", [b"", b"short", b"\x89PNG\r\n\x1a\n" + b"x" * 100, b"\x05\0\0\0\0\0\0\0[1,2]", b"{}" * 50]
)
def test_other_formats_are_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "w.safetensors"
    path.write_bytes(content)
    with pytest.raises(UserError, match="is not a safetensors file"):
        read_tensors(path)


def test_a_renamed_pytorch_checkpoint_points_to_the_converter(tmp_path: Path) -> None:
    path = tmp_path / "w.safetensors"
    torch.save(layer().state_dict(), path)
    with pytest.raises(UserError, match="sceneexpander convert"):
        read_tensors(path)


def test_missing_files_and_folders_are_named(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="does not exist"):
        resolve_weights(str(tmp_path / "none.safetensors"), model="mini")
    with pytest.raises(UserError, match="is not a file"):
        resolve_weights(str(tmp_path), model="mini")


def test_there_are_no_built_in_worldmirror_weights() -> None:
    with pytest.raises(UserError, match="no built-in weights for worldmirror"):
        resolve_weights("builtin", model="worldmirror")


def test_a_hub_id_needs_a_revision() -> None:
    with pytest.raises(UserError, match="names no revision"):
        resolve_weights("tencent/HunyuanWorld-Mirror", model="worldmirror")


def test_hub_without_its_package_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    real = builtins.__import__

    def without_hub(name: str, *args: Any, **kwargs: Any) -> Any:
        if name.startswith("huggingface_hub"):
            raise ImportError(name)
        return real(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", without_hub)
    with pytest.raises(UserError, match=r"sceneexpander\[hub\]"):
        resolve_weights("org/name@main", model="worldmirror")


def test_the_hub_client_stays_offline_unless_asked(monkeypatch: pytest.MonkeyPatch, file: Path) -> None:
    calls: list[dict[str, Any]] = []

    def download(repo: str, name: str, **options: Any) -> str:
        calls.append({"repo": repo, "name": name, **options})
        if options["local_files_only"]:
            raise FileNotFoundError("not cached")
        return str(file)

    monkeypatch.setitem(sys.modules, "huggingface_hub", types.SimpleNamespace(hf_hub_download=download))
    with pytest.raises(UserError, match="not in the local hub cache"):
        resolve_weights("org/name@abc123", model="worldmirror")
    found = resolve_weights("org/name@abc123", model="worldmirror", allow_download=True)
    assert found.path == file
    assert [call["local_files_only"] for call in calls] == [True, False]
    assert all(call["repo"] == "org/name" and call["revision"] == "abc123" for call in calls)


def with_header(folder: Path, header: bytes, tail: bytes = b"") -> Path:
    path = folder / "w.safetensors"
    path.write_bytes(len(header).to_bytes(8, "little") + header + tail)
    return path


def offsets(end: str) -> bytes:
    return b'{"a": {"dtype": "F32", "shape": [1], "data_offsets": [0, ' + end.encode() + b"]}}"


@pytest.mark.parametrize(
    "header",
    [b"[" * 200_000, b'{"a":' * 200_000, b"[]", b"3", b'{"a": "b"}', b'{"a": {"data_offsets": []}}', b"\xff\xfe",
     *(offsets(end) for end in ("Infinity", "-Infinity", "NaN", "4.0", "true", '"4"', "null", "[4]", "1e999", "9" * 5000, str(2**70)))],
    ids=lambda header: header[-16:].decode("latin-1"),
)  # fmt: skip
def test_a_header_that_is_none_is_one_line(tmp_path: Path, header: bytes) -> None:
    path = with_header(tmp_path, header, b"\0\0\0\0")
    with pytest.raises(UserError) as caught:
        read_tensors(path)
    assert len(line_of(caught)) < 400
