"""The compiled CPU rasteriser behind `torch.autograd.Function`.

The library is found beside the sources (the install builds it, see ``setup.py``), one per x86-64 level; it has a plain C
ABI, so it depends on no version of torch or Python. It carries the hash of what it was built from, and one of another source is refused.
"""

from __future__ import annotations

import ctypes
import functools
import logging
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from sceneexpander.errors import UserError
from sceneexpander.splatting.kernel import recipe
from sceneexpander.splatting.scene import RasterScene

logger = logging.getLogger(__name__)

ABI_VERSION = 2
KERNEL_DIRECTORY = recipe.SOURCE.parent
# Builds by what the CPU can do, best first.
BUILDS = {"AVX512": ("v4", "v3", "plain"), "AVX2": ("v3", "plain")}

_SHARED = ("means", "quats", "scales", "opacities", "colours")  # by all views; the others have one row per view
_POINTERS_IN = (*_SHARED, "extras", "offsets", "cam_from_world", "intrinsics")
_POINTERS_OUT = _POINTERS_IN[:-1]


class _Scene(ctypes.Structure):
    """``SxScene`` of ``rasteriser.cpp``."""

    _fields_ = (
        [("count", ctypes.c_int64), ("band_bytes", ctypes.c_int64)]
        + [
            (name, ctypes.c_int32)
            for name in ("width", "height", "sh_coefficients", "with_depth", "extra_channels", "antialiased", "threads")
        ]
        + [(name, ctypes.c_float) for name in ("near_plane", "far_plane", "eps2d", "max_alpha")]
        + [(name, ctypes.c_void_p) for name in _POINTERS_IN]
    )


class _Gradients(ctypes.Structure):
    """``SxGradients`` of ``rasteriser.cpp``."""

    _fields_ = [("add", ctypes.c_int32)] + [(name, ctypes.c_void_p) for name in _POINTERS_OUT]


class _Kernel:
    """The functions of one loaded library."""

    def __init__(self, path: Path, build: str) -> None:
        library = ctypes.CDLL(str(path))
        self.path, self.build = path, build
        _require_own_source(library, path, build)
        if library.sx_abi_version() != ABI_VERSION:
            raise OSError(f"{path.name} has ABI {library.sx_abi_version()}, expected {ABI_VERSION}: install again")
        self.max_channels = int(library.sx_max_channels())
        self.forward = library.sx_forward
        self.forward.restype = ctypes.c_void_p
        self.forward.argtypes = [ctypes.POINTER(_Scene)] + [ctypes.c_void_p] * 3
        self.backward = library.sx_backward
        self.backward.restype = ctypes.c_int32
        self.backward.argtypes = [ctypes.POINTER(_Scene)] + [ctypes.c_void_p] * 5 + [ctypes.POINTER(_Gradients)]
        self.free = library.sx_free
        self.free.restype = None
        self.free.argtypes = [ctypes.c_void_p]


def _require_own_source(library: ctypes.CDLL, path: Path, build: str) -> None:
    """Raise `UserError` unless the library was built from the source beside it: results would belong to no code that there is."""
    carried = "none"  # of libraries before they carried one
    if hasattr(library, "sx_source_hash"):
        library.sx_source_hash.restype = ctypes.c_char_p
        carried = library.sx_source_hash().decode()
    expected = recipe.source_hash(build)
    if carried != expected:
        raise UserError(
            f"was built from another source (it carries the hash {carried[:12]}, {recipe.SOURCE.name} and its flags have {expected[:12]})",
            where=path,
            fix="build it again: make setup, or pip install --no-deps --no-build-isolation -e .",
        )


class _ViewState:
    """Owns the native state of one rendered view between forward and backward."""

    def __init__(self, kernel: _Kernel, handle: int) -> None:
        self._kernel, self.handle = kernel, handle

    def __del__(self) -> None:
        self._kernel.free(self.handle)


@functools.cache
def load_kernel() -> _Kernel | None:
    """The best library for this CPU, or None where the install could not build one (said once in the log)."""
    for build in BUILDS.get(torch.backends.cpu.get_cpu_capability(), ("plain",)):
        kernel = open_build(build)
        if kernel is not None:
            logger.info("rasteriser: compiled CPU kernel %s", kernel.path.name)
            return kernel
    logger.warning(
        "rasteriser: no compiled kernel beside the package, using torch (slower); install again with a C++ compiler"
    )
    return None


def kernel_build() -> str:
    """Which build of the kernel draws on this machine (a name in `BUILDS`); "torch" where none does."""
    kernel = load_kernel()
    return "torch" if kernel is None else kernel.build


def open_build(build: str) -> _Kernel | None:
    """One of the libraries that the install may have built (a name in `BUILDS`); the CPU must know its instructions.

    Raises:
        UserError: it was built from another source than the one beside it.
    """
    for path in sorted(KERNEL_DIRECTORY.glob(f"_rasteriser_{build}.*")):
        try:
            return _Kernel(path, build)
        except (OSError, AttributeError) as error:
            logger.warning("rasteriser: cannot use %s (%s)", path.name, error)
    return None


def rasterise_kernel(scene: RasterScene) -> tuple[Tensor, Tensor, Tensor]:
    """(planes (C,channels,H,W), alpha (C,H,W), radius_px (C,N)) by the compiled kernel; float32 on the CPU only."""
    kernel = load_kernel()
    if kernel is None:
        raise RuntimeError("the compiled rasteriser is not available: install the package with a C++ compiler present")
    if scene.means.dtype != torch.float32 or scene.means.device.type != "cpu":
        raise ValueError(f"the cpu backend takes float32 CPU tensors, got {scene.means.dtype} on {scene.means.device}")
    if scene.channels > kernel.max_channels:
        raise ValueError(f"{scene.channels} channels, the cpu backend renders at most {kernel.max_channels} at once")
    return _Rasterise.apply(  # type: ignore[no-untyped-call]
        scene,
        scene.means,
        scene.quat_wxyz,
        scene.scales,
        scene.opacities,
        scene.colours,
        scene.features,
        scene.screen_offsets,
        scene.cam_from_world,
        scene.intrinsics_px,
    )


def _describe(scene: RasterScene, tensors: list[Tensor | None], view: int) -> _Scene:
    """The C structure of one view; ``tensors`` (contiguous, in the order of `_POINTERS_IN`) must outlive its use."""
    settings = scene.settings
    rows = [t if i < len(_SHARED) or t is None else t[view] for i, t in enumerate(tensors)]
    return _Scene(
        count=scene.count,
        band_bytes=settings.band_bytes,
        width=scene.width,
        height=scene.height,
        sh_coefficients=scene.colours.shape[1] if scene.colours.ndim == 3 else 0,
        with_depth=int(scene.with_depth),
        extra_channels=scene.feature_channels,
        antialiased=int(settings.antialiased),
        threads=settings.threads or torch.get_num_threads(),
        near_plane=settings.near,
        far_plane=settings.far,
        eps2d=settings.eps2d,
        max_alpha=settings.max_alpha,
        **{name: None if row is None else row.data_ptr() for name, row in zip(_POINTERS_IN, rows, strict=True)},
    )


class _Rasterise(torch.autograd.Function):
    """All views of a scene. Intrinsics get no gradient, as in gsplat."""

    @staticmethod
    def forward(ctx: Any, scene: RasterScene, *tensors: Tensor | None) -> tuple[Tensor, Tensor, Tensor]:
        kernel = load_kernel()
        assert kernel is not None  # noqa: S101 - checked by the only caller
        held = [None if t is None else t.detach().contiguous() for t in tensors]
        empty = scene.means.new_empty
        planes = empty(scene.views, scene.channels, scene.height, scene.width)
        transmittance = empty(scene.views, scene.height, scene.width)
        radius_px = empty(scene.views, scene.count)
        states = []
        for view in range(scene.views):
            handle = kernel.forward(
                _describe(scene, held, view),
                planes[view].data_ptr(),
                transmittance[view].data_ptr(),
                radius_px[view].data_ptr(),
            )
            if not handle:
                raise MemoryError(
                    f"rasterising {scene.count} Gaussians at {scene.height} x {scene.width} ran out of memory"
                )
            states.append(_ViewState(kernel, handle))
        if any(ctx.needs_input_grad):
            ctx.scene, ctx.states, ctx.kernel = scene, states, kernel
            ctx.save_for_backward(*tensors, planes, transmittance)
        ctx.mark_non_differentiable(radius_px)
        return planes, 1 - transmittance, radius_px

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, d_planes: Tensor, d_alpha: Tensor, _: Tensor) -> tuple[Tensor | None, ...]:
        *tensors, planes, transmittance = ctx.saved_tensors
        scene: RasterScene = ctx.scene
        held = [None if t is None else t.detach().contiguous() for t in tensors]
        planes, d_planes, d_alpha = planes.contiguous(), d_planes.contiguous(), d_alpha.contiguous()
        # Contiguous buffers: the kernel sets them for the first view, and adds to the shared ones for those after it.
        fresh = torch.empty if scene.views else torch.zeros
        gradients = [None if t is None else fresh(t.shape, dtype=t.dtype) for t in tensors[:-1]]
        for view in range(scene.views):
            rows = [g if i < len(_SHARED) or g is None else g[view] for i, g in enumerate(gradients)]
            described = _Gradients(int(view > 0), *(None if row is None else row.data_ptr() for row in rows))
            failed = ctx.kernel.backward(
                _describe(scene, held, view),
                ctx.states[view].handle,
                planes[view].data_ptr(),
                transmittance[view].data_ptr(),
                d_planes[view].data_ptr(),
                d_alpha[view].data_ptr(),
                described,
            )
            if failed:
                raise MemoryError(f"the gradients of {scene.count} Gaussians ran out of memory; lower band_bytes")
        return None, *gradients, None
