"""The checkpoint converter reads plain tensors and never runs anything."""

from __future__ import annotations

import argparse
import io
import os
import pickle
import sys
import zipfile
from collections import OrderedDict, defaultdict
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from sceneexpander.cli.convert_checkpoint import ALLOWED, convert, main, read_checkpoint
from sceneexpander.errors import UserError


def write_archive(path: Path, data: bytes, storages: dict[str, bytes] | None = None, compressed: bool = False) -> Path:
    method = zipfile.ZIP_DEFLATED if compressed else zipfile.ZIP_STORED
    with zipfile.ZipFile(path, "w", method) as archive:
        archive.writestr("archive/data.pkl", data)
        for key, raw in (storages or {}).items():
            archive.writestr(f"archive/data/{key}", raw)
    return path


def forged(offset: int, size: tuple[int, ...], stride: tuple[int, ...]) -> bytes:
    """A pickle of one tensor with any geometry over a storage of 4 floats."""

    marker = object()

    class Forger(pickle.Pickler):
        def persistent_id(self, obj: Any) -> Any:
            return ("storage", torch.FloatStorage, "0", "cpu", 4) if obj is marker else None

    class Tensorlike:
        def __reduce__(self) -> Any:
            return torch._utils._rebuild_tensor_v2, (marker, offset, size, stride, False, OrderedDict())

    buffer = io.BytesIO()
    Forger(buffer, protocol=2).dump({"x": Tensorlike()})
    return buffer.getvalue()


def test_state_dicts_come_through_unchanged(tmp_path: Path) -> None:
    generator = torch.Generator().manual_seed(0)
    base = torch.randn(4, 6, generator=generator)
    tensors = {
        "plain": base,
        "transposed": base.t(),
        "sliced": base[1:, ::2],
        "half": base.half(),
        "bfloat": base.bfloat16(),
        "count": torch.tensor(7),
        "flags": torch.tensor([True, False]),
        "empty": torch.empty(0, 3),
        "parameter": torch.nn.Parameter(base[0].clone()),
    }
    torch.save(tensors, tmp_path / "in.pt")
    assert convert(tmp_path / "in.pt", tmp_path / "out.safetensors") == len(tensors)
    loaded = load_file(tmp_path / "out.safetensors")
    assert loaded.keys() == tensors.keys()
    for name, value in tensors.items():
        assert loaded[name].dtype == value.dtype
        assert torch.equal(loaded[name], value.detach())


def test_weights_are_found_inside_a_training_checkpoint(tmp_path: Path) -> None:
    module = torch.nn.Sequential(torch.nn.Linear(2, 3), torch.nn.BatchNorm1d(3))
    torch.save({"epoch": 3, "state_dict": module.state_dict(), "ema": {"w": torch.ones(1)}}, tmp_path / "in.ckpt")
    assert read_checkpoint(tmp_path / "in.ckpt").keys() == module.state_dict().keys()
    assert read_checkpoint(tmp_path / "in.ckpt", key="ema").keys() == {"w"}
    with pytest.raises(UserError, match="its entries: epoch, state_dict, ema"):
        read_checkpoint(tmp_path / "in.ckpt", key="nothing")


class Malicious:
    """Creates a folder when it is unpickled carelessly."""

    def __init__(self, target: Path) -> None:
        self.target = target

    def __reduce__(self) -> Any:
        return os.mkdir, (str(self.target),)


def test_a_malicious_pickle_never_fires(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    target = tmp_path / "side-effect"
    data = pickle.dumps({"w": Malicious(target)}, protocol=2)
    # The fixture is real: a careless reader would have run it.
    pickle.loads(data)  # noqa: S301
    assert target.exists()
    target.rmdir()
    path = write_archive(tmp_path / "evil.pt", data)
    with pytest.raises(UserError, match=r"asks for (posix|nt|os)\.mkdir, which is not allowed"):
        read_checkpoint(path)
    with pytest.raises(SystemExit) as stop:
        main([str(path), str(tmp_path / "out.safetensors")])
    assert stop.value.code == 2
    assert "mkdir" in capsys.readouterr().err
    assert not target.exists()
    assert not (tmp_path / "out.safetensors").exists()


@pytest.mark.parametrize(
    ("module", "name"),
    [
        ("builtins", "eval"),
        ("builtins", "getattr"),
        ("torch", "load"),
        ("torch", "Tensor"),
        ("torch._utils", "_rebuild_qtensor"),
        ("torch.nn.modules.linear", "Linear"),
        ("collections", "OrderedDict.__class__"),
        ("argparse", "FileType"),
        ("omegaconf.omegaconf", "OmegaConf"),
        ("numpy._core.multiarray", "_reconstruct"),
    ],
)
def test_names_off_the_list_are_refused_by_name(tmp_path: Path, module: str, name: str) -> None:
    path = write_archive(tmp_path / "in.pt", f"c{module}\n{name}\n.".encode())
    with pytest.raises(UserError) as error:
        read_checkpoint(path)
    assert f"{module}.{name}, which is not allowed" in error.value.line()


def test_settings_beside_the_weights_are_left_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The layout of CUT3R's checkpoint: settings with a constructor call as text, an optimiser, wrapped names."""
    module = ModuleType("omegaconf.dictconfig")
    config = type("DictConfig", (), {"__module__": module.__name__})
    module.DictConfig = config  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "omegaconf", ModuleType("omegaconf"))
    monkeypatch.setitem(sys.modules, module.__name__, module)
    settings = config()
    target = tmp_path / "side-effect"
    call = f"__import__('os').mkdir({str(target)!r})"
    settings.__dict__ |= {"_content": {"model": call, "types": [dict, Any, defaultdict(dict)]}, "_parent": settings}
    content = {
        "args": settings,
        "namespace": argparse.Namespace(model=call, folder=Path("runs")),
        "best_so_far": np.float64(0.25),
        "optimizer": {"state": {0: {"exp_avg": torch.zeros(3)}}},
        "epoch": 7,
        "model": {"module.a.weight": torch.arange(6.0).view(2, 3), "module.a.alias": torch.ones(2)},
    }
    torch.save(content, tmp_path / "in.pth")
    monkeypatch.undo()
    assert convert(tmp_path / "in.pth", tmp_path / "out.safetensors") == 2
    loaded = load_file(tmp_path / "out.safetensors")
    assert loaded.keys() == {"a.weight", "a.alias"}
    assert torch.equal(loaded["a.weight"], torch.arange(6.0).view(2, 3))
    assert not target.exists()


def test_settings_hide_no_code(tmp_path: Path) -> None:
    target = tmp_path / "side-effect"
    settings = argparse.Namespace(hook=Malicious(target))
    path = write_archive(tmp_path / "in.pth", pickle.dumps({"args": settings}, protocol=2))
    with pytest.raises(UserError, match="mkdir, which is not allowed"):
        read_checkpoint(path)
    assert not target.exists()


@pytest.mark.parametrize(
    "name",
    [
        "torch._utils\n_rebuild_tensor_v2",
        "torch\nFloatStorage",
        "collections\nOrderedDict",
        "argparse\nNamespace",
    ],
)
def test_allowed_objects_cannot_be_changed_by_a_pickle(tmp_path: Path, name: str) -> None:
    # BUILD with a (None, attributes) state would set attributes on the object before it.
    path = write_archive(tmp_path / "in.pt", f"c{name}\n(NdVhacked\nI1\ns".encode() + b"tb.")
    with pytest.raises(UserError):
        read_checkpoint(path)
    assert not any(hasattr(entry, "hacked") for entry in ALLOWED.values())


@pytest.mark.parametrize(
    ("offset", "size", "stride"),
    [(0, (5,), (1,)), (3, (2,), (1,)), (0, (2, 2), (1, 3)), (0, (1 << 40,), (0,)), (-1, (1,), (1,)), (0, (2,), (-1,))],
)
def test_tensors_that_leave_their_storage_are_refused(
    tmp_path: Path, offset: int, size: tuple[int, ...], stride: tuple[int, ...]
) -> None:
    path = write_archive(tmp_path / "in.pt", forged(offset, size, stride), {"0": b"\0" * 16})
    with pytest.raises(UserError, match="a tensor"):
        read_checkpoint(path)


def test_the_forged_pickle_is_good_when_its_geometry_is(tmp_path: Path) -> None:
    path = write_archive(tmp_path / "in.pt", forged(1, (3,), (1,)), {"0": b"\0" * 16})
    assert read_checkpoint(path)["x"].shape == (3,)


def test_storages_of_the_wrong_size_or_compressed_are_refused(tmp_path: Path) -> None:
    good = forged(0, (4,), (1,))
    with pytest.raises(UserError, match="has 12 bytes, expected 16"):
        read_checkpoint(write_archive(tmp_path / "a.pt", good, {"0": b"\0" * 12}))
    with pytest.raises(UserError, match="uncompressed"):
        read_checkpoint(write_archive(tmp_path / "b.pt", good, {"0": b"\0" * 16}, compressed=True))
    with pytest.raises(UserError, match="storage '0' is missing"):
        read_checkpoint(write_archive(tmp_path / "c.pt", good))


@pytest.mark.parametrize("cut", [10, 200])
def test_damaged_files_are_one_clear_line(tmp_path: Path, cut: int) -> None:
    torch.save({"w": torch.ones(100)}, tmp_path / "in.pt")
    data = (tmp_path / "in.pt").read_bytes()
    (tmp_path / "in.pt").write_bytes(data[:-cut])
    with pytest.raises(UserError) as error:
        read_checkpoint(tmp_path / "in.pt")
    assert "\n" not in error.value.line()


@pytest.mark.parametrize("data", [b"", b".", b"garbage", b"}q\x00.", b"I1\n.", b"(lp0\n.", b"]" * 50 + b"."])
def test_odd_pickles_are_one_clear_line(tmp_path: Path, data: bytes) -> None:
    with pytest.raises(UserError):
        read_checkpoint(write_archive(tmp_path / "in.pt", data))


def test_old_formats_and_wrong_targets_are_refused(tmp_path: Path) -> None:
    torch.save({"w": torch.ones(1)}, tmp_path / "old.pt", _use_new_zipfile_serialization=False)
    with pytest.raises(UserError, match="is not a zip-format"):
        read_checkpoint(tmp_path / "old.pt")
    with pytest.raises(UserError, match="does not exist"):
        read_checkpoint(tmp_path / "none.pt")
    torch.save({"w": torch.ones(1)}, tmp_path / "in.pt")
    with pytest.raises(UserError, match=r"must end in \.safetensors"):
        convert(tmp_path / "in.pt", tmp_path / "out.pt")


def test_the_command_reports_what_it_wrote(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    torch.save({"w": torch.ones(2)}, tmp_path / "in.pt")
    assert main([str(tmp_path / "in.pt"), str(tmp_path / "sub" / "out.safetensors")]) == 0
    assert "1 tensors" in capsys.readouterr().out
    assert [p.name for p in (tmp_path / "sub").iterdir()] == ["out.safetensors"]


def dag(depth: int) -> tuple[Any, ...]:
    """A tuple of two equal tuples, and so on: a few bytes that take for ever to hash, compare or write out."""
    value: tuple[Any, ...] = ()
    for _ in range(depth):
        value = (value, value)
    return value


class Marker:
    """Stands for a storage of 4 floats in what `pickled` writes."""


def pickled(content: Any) -> bytes:
    class Forger(pickle.Pickler):
        def persistent_id(self, obj: Any) -> Any:
            return ("storage", torch.FloatStorage, "0", "cpu", 4) if isinstance(obj, Marker) else None

    buffer = io.BytesIO()
    Forger(buffer, protocol=2).dump(content)
    return buffer.getvalue()


class Call:
    """Pickled as the call of a function."""

    def __init__(self, function: Any, *arguments: Any) -> None:
        self.call = function, arguments

    def __reduce__(self) -> Any:
        return self.call


def tensor(offset: Any = 0, size: Any = (4,), stride: Any = (1,)) -> Call:
    return Call(torch._utils._rebuild_tensor_v2, Marker(), offset, size, stride, False, OrderedDict())


def with_key_tuple() -> bytes:
    # {(...): 1}, written by hand: making it here would hash it.
    return (
        pickle.PROTO
        + b"\2"
        + pickle.EMPTY_DICT
        + pickle.dumps(dag(60), 2)[2:-1]
        + pickle.BININT1
        + b"\1"
        + pickle.SETITEM
        + pickle.STOP
    )


def with_set() -> bytes:
    return (
        pickle.PROTO
        + b"\4"
        + pickle.EMPTY_SET
        + pickle.MARK
        + pickle.dumps(dag(60), 2)[2:-1]
        + pickle.ADDITEMS
        + pickle.STOP
    )


@pytest.mark.timeout(60)
@pytest.mark.parametrize(
    "data",
    [
        with_key_tuple(),
        with_set(),
        pickled({"x": tensor(size=dag(60))}),
        pickled({"x": tensor(size=(dag(60),), stride=(1,))}),
        pickled({"x": tensor(offset=dag(60))}),
        pickled({"x": tensor(size=(10**5000,), stride=(1,))}),
        pickled({"x": tensor(size=(1,) * 100, stride=(1,) * 100)}),
        pickled({"x": tensor(size=(True,), stride=(1,))}),
        pickled({"x": Call(OrderedDict, [(1, 2)])}),
        pickled({"x": Call(OrderedDict, dag(60))}),
        pickled([dag(60)]),
        pickled({f"{'y' * 100_000}": 1}),
        pickled({10**5000: 1}),
    ],
    ids=[
        "tuple as key",
        "set",
        "size",
        "in the size",
        "offset",
        "huge",
        "dimensions",
        "truth",
        "pairs",
        "argument",
        "list",
        "name",
        "number",
    ],
)
def test_a_small_pickle_that_stands_for_much_is_one_line(tmp_path: Path, data: bytes) -> None:
    path = write_archive(tmp_path / "in.pt", data, {"0": bytes(16)})
    with pytest.raises(UserError) as caught:
        read_checkpoint(path)
    assert len(caught.value.line()) < 500 + len(str(path))


@pytest.mark.parametrize("name", ["byteorder", "data.pkl"])
def test_an_entry_that_announces_gigabytes_is_not_read(tmp_path: Path, name: str) -> None:
    import tracemalloc

    path = tmp_path / "in.pt"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        if name != "data.pkl":
            archive.writestr("archive/data.pkl", pickled({"x": tensor()}))
        with archive.open(f"archive/{name}", "w") as entry:
            for _ in range(80):
                entry.write(bytes(1 << 20))
    tracemalloc.start()
    with pytest.raises(UserError, match="is refused"):
        read_checkpoint(path)
    assert tracemalloc.get_traced_memory()[1] < 20 << 20
    tracemalloc.stop()


def test_one_storage_under_many_names_is_not_written_out(tmp_path: Path) -> None:
    values = torch.zeros(100_000)
    torch.save({f"w{i}": values for i in range(200)}, tmp_path / "in.pt")
    with pytest.raises(UserError, match="under so many names that they would become 80000000"):
        convert(tmp_path / "in.pt", tmp_path / "out.safetensors")
    # Weights that are tied, and a few averages of them, are usual.
    torch.save({f"w{i}": values for i in range(4)}, tmp_path / "tied.pt")
    assert convert(tmp_path / "tied.pt", tmp_path / "out.safetensors") == 4


@pytest.mark.parametrize("name", ["\ud800", "a\udfffb", "__metadata__"])
def test_names_that_safetensors_cannot_hold_are_refused(tmp_path: Path, name: str) -> None:
    path = write_archive(tmp_path / "in.pt", pickled({name: tensor()}), {"0": bytes(16)})
    with pytest.raises(UserError, match="cannot hold"):
        convert(path, tmp_path / "out.safetensors")


@pytest.mark.parametrize(
    "target",
    [
        "folder.safetensors",
        "file/out.safetensors",
        "x" * 300 + ".safetensors",
        "a\0b.safetensors",
        "y" * 5000,
        "/proc/x/out.safetensors",
    ],
)
def test_a_target_that_cannot_be_written_is_one_line(tmp_path: Path, target: str) -> None:
    torch.save({"w": torch.zeros(2)}, tmp_path / "in.pt")
    (tmp_path / "folder.safetensors").mkdir()
    (tmp_path / "file").write_text("x")
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(UserError) as caught:
        convert(tmp_path / "in.pt", tmp_path / target)
    assert len(caught.value.line()) < 800
    assert sorted(tmp_path.rglob("*")) == before


def test_a_long_name_that_a_file_can_have_is_taken(tmp_path: Path) -> None:
    torch.save({"w": torch.zeros(2)}, tmp_path / "in.pt")
    assert convert(tmp_path / "in.pt", tmp_path / ("x" * 240 + ".safetensors")) == 1


@pytest.mark.parametrize("source", ["x" * 5000, "a\0b", "x" * 300, "."])
def test_a_source_that_is_no_file_is_one_line(tmp_path: Path, source: str) -> None:
    with pytest.raises(UserError, match=r"does not exist|is not a file"):
        read_checkpoint(tmp_path / source)
