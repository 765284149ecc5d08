"""An install without a compiler succeeds, says so, and renders all the same."""

from __future__ import annotations

import logging
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from sceneexpander.errors import UserError
from sceneexpander.geometry.cameras import Cameras
from sceneexpander.splatting import RasterSettings, kernel_backend, render
from sceneexpander.splatting.kernel import recipe
from sceneexpander.splatting.rasterise import active_backend
from tests.worlds.random_gaussians import cameras, intrinsics, random_gaussians

ROOT = Path(__file__).parents[3]
KERNEL = "src/sceneexpander/splatting/kernel"
LOCKS = ("requirements.lock", "requirements-nodeps.lock")


def test_a_broken_compiler_does_not_fail_the_build(tmp_path: Path) -> None:
    missing = str(tmp_path / "no-such-compiler")
    done = subprocess.run(
        [sys.executable, "setup.py", "build_ext", f"--build-lib={tmp_path}/lib", f"--build-temp={tmp_path}/temp"],
        cwd=ROOT,
        env={**os.environ, "CC": missing, "CXX": missing},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert "compiled rasteriser not built, the slower torch rasteriser will be used" in done.stdout + done.stderr
    assert not list(tmp_path.rglob("_rasteriser_*"))


def test_without_a_library_one_line_says_so_and_torch_renders(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    scene, poses, lens = random_gaussians(50), cameras(1), intrinsics(1, 20, 30)
    exact = render(scene, Cameras(poses, lens, 20, 30), settings=RasterSettings(backend="torch"))
    monkeypatch.setattr(kernel_backend, "KERNEL_DIRECTORY", tmp_path)
    kernel_backend.load_kernel.cache_clear()
    try:
        with caplog.at_level(logging.INFO):
            seen = [render(scene, Cameras(poses, lens, 20, 30)) for _ in range(3)]
        assert active_backend(torch.device("cpu"), torch.float32, RasterSettings()) == "torch"
        assert [record.getMessage().partition(",")[0] for record in caplog.records] == [
            "rasteriser: no compiled kernel beside the package"
        ]
        assert torch.equal(seen[2].rgb, exact.rgb)
        with pytest.raises(RuntimeError, match="install the package with a C\\+\\+ compiler"):
            render(scene, Cameras(poses, lens, 20, 30), settings=RasterSettings(backend="cpu"))
    finally:
        monkeypatch.undo()
        kernel_backend.load_kernel.cache_clear()


def test_a_library_that_does_not_load_is_passed_over(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(kernel_backend, "KERNEL_DIRECTORY", tmp_path)
    (tmp_path / "_rasteriser_v3.so").write_bytes(b"not a library")
    assert kernel_backend.open_build("v3") is None
    assert "cannot use _rasteriser_v3.so" in caplog.text


def test_a_library_of_another_source_is_refused_in_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    if kernel_backend.load_kernel() is None:
        pytest.skip("no compiled kernel (no compiler at install)")
    edited = tmp_path / "rasteriser.cpp"
    edited.write_text(recipe.SOURCE.read_text().replace("kMinTransmittance = 1e-4f", "kMinTransmittance = 2e-4f"))
    monkeypatch.setattr(recipe, "SOURCE", edited)
    kernel_backend.load_kernel.cache_clear()
    try:
        with pytest.raises(UserError, match=r"_rasteriser_.*built from another source.*make setup") as refused:
            render(random_gaussians(5), Cameras(cameras(1), intrinsics(1, 8, 8), 8, 8))
        assert "\n" not in refused.value.line()
    finally:
        monkeypatch.undo()
        kernel_backend.load_kernel.cache_clear()


def test_another_flag_is_another_source(monkeypatch: pytest.MonkeyPatch) -> None:
    before = recipe.source_hash("v3")
    monkeypatch.setattr(recipe, "FLAGS", [*recipe.FLAGS, "-ffast-math"])
    assert recipe.source_hash("v3") != before


@pytest.mark.parametrize("edited", ["setup.py", *(f"{KERNEL}/{name}" for name in ("rasteriser.cpp", "recipe.py"))])
def test_an_edit_of_what_the_library_is_made_from_installs_again(edited: str, tmp_path: Path) -> None:
    shutil.copy(ROOT / "Makefile", tmp_path)
    for name in (
        *LOCKS,
        "pyproject.toml",
        "setup.py",
        f"{KERNEL}/rasteriser.cpp",
        f"{KERNEL}/recipe.py",
        ".venv/.stamp",
    ):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()

    def commands(*options: str) -> str:
        make = ["make", "-n", *options, "setup"]
        return subprocess.run(make, cwd=tmp_path, capture_output=True, text=True, check=True).stdout

    assert "pip install" not in commands()
    assert "pip install" in commands("-W", edited)


def test_the_library_in_use_is_named_once(caplog: pytest.LogCaptureFixture) -> None:
    if kernel_backend.load_kernel() is None:
        pytest.skip("no compiled kernel (no compiler at install)")
    kernel_backend.load_kernel.cache_clear()
    with caplog.at_level(logging.INFO):
        for _ in range(2):
            kernel_backend.load_kernel()
    assert [
        record.getMessage().startswith("rasteriser: compiled CPU kernel _rasteriser_") for record in caplog.records
    ] == [True]
