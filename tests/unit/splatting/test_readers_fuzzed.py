"""Whatever bytes a file holds, a reader gives a scene or one line about what is wrong."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from sceneexpander.errors import UserError
from sceneexpander.geometry.gaussians import Gaussians
from sceneexpander.splatting.ply import read_ply, write_ply
from sceneexpander.splatting.spz import read_spz, write_spz
from tests.worlds.random_gaussians import random_gaussians

Reader = Callable[[Path], Gaussians]
FORMATS: dict[str, tuple[Reader, Callable[[Gaussians, Path], object]]] = {
    "ply": (read_ply, write_ply),
    "ply-rgb": (read_ply, lambda scene, path: write_ply(scene, path, rgb=True)),
    "spz3": (read_spz, write_spz),
    "spz4": (read_spz, lambda scene, path: write_spz(scene, path, version=4)),
}
Edit = tuple[str, float, bytes]
# At a share of the file's length: bytes put over what is there, put between, or a number of them taken away.
EDITS = st.lists(
    st.tuples(st.sampled_from(["over", "between", "away"]), st.floats(0, 1), st.binary(min_size=1, max_size=12)),
    min_size=1,
    max_size=4,
)
PLY_WORDS = st.lists(
    st.sampled_from(
        [b"ply\n", b"format ascii 1.0\n", b"format binary_big_endian 1.0\n", b"element vertex 2\n", b"property float x\n",
         b"property list uchar int y\n", b"element face 9999999999\n", b"end_header\n", b"1 2 nan\n", b"comment \xff\n"]
    ),
    max_size=12,
)  # fmt: skip


def edited(data: bytes, edits: list[Edit]) -> bytes:
    for kind, share, put in edits:
        at = int(share * len(data))
        end = at if kind == "between" else at + len(put)
        data = data[:at] + (b"" if kind == "away" else put) + data[end:]
    return data


def read_or_refuse(read: Reader, path: Path) -> None:
    with contextlib.suppress(UserError):
        assert bool(torch.isfinite(read(path).means).all())


@pytest.mark.parametrize("name", FORMATS)
def test_damaged_files(name: str, tmp_path: Path) -> None:
    read, write = FORMATS[name]
    write(random_gaussians(7, sh_coefficients=4), tmp_path / "whole")
    whole = (tmp_path / "whole").read_bytes()

    @settings(
        max_examples=200, deadline=None, database=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
    )
    @given(EDITS)
    def check(edits: list[Edit]) -> None:
        (tmp_path / "file").write_bytes(edited(whole, edits))
        read_or_refuse(read, tmp_path / "file")

    check()


@pytest.mark.parametrize("read", [read_ply, read_spz])
def test_any_bytes(read: Reader, tmp_path: Path) -> None:
    starts = st.sampled_from([b"", b"ply\n", b"NGSP\4\0\0\0", b"\x1f\x8b\x08\0"])

    @settings(max_examples=200, deadline=None, database=None)
    @given(st.one_of(st.tuples(starts, st.binary(max_size=200)).map(b"".join), PLY_WORDS.map(b"".join)))
    def check(data: bytes) -> None:
        (tmp_path / "file").write_bytes(data)
        read_or_refuse(read, tmp_path / "file")

    check()
