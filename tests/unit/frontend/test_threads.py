"""numpy's matrix products stay on one thread, however many a run has."""

from __future__ import annotations

import contextlib

import numpy as np  # noqa: F401 - loads the library that is asked
import threadpoolctl
import torch

from sceneexpander.frontend.sfm import estimate_cameras
from sceneexpander.frontend.sfm_types import SfmConfig
from sceneexpander.frontend.threads import on_one_blas_thread
from stages.runner import use_threads


def blas_threads() -> set[int]:
    """Of every library for matrix products in this process."""
    return {one["num_threads"] for one in threadpoolctl.threadpool_info() if one["user_api"] == "blas"}


def test_a_stage_has_its_threads_for_torch_and_one_for_small_products() -> None:
    before = torch.get_num_threads()
    with threadpoolctl.threadpool_limits(2):
        try:
            use_threads(2)
            assert torch.get_num_threads() == 2
            assert blas_threads() == {1}
        finally:
            torch.set_num_threads(before)


def test_the_front_end_takes_one_whoever_calls_it(monkeypatch) -> None:  # type: ignore[no-untyped-def]
    seen: list[set[int]] = []

    @on_one_blas_thread
    def work() -> None:
        seen.append(blas_threads())

    with threadpoolctl.threadpool_limits(2, user_api="blas"):
        work()
        assert seen == [{1}]
        assert blas_threads() == {2}, "and gives them back"
        monkeypatch.setattr("sceneexpander.frontend.sfm.prepare", lambda *_, **__: seen.append(blas_threads()) or 1 / 0)
        with contextlib.suppress(ZeroDivisionError):
            estimate_cameras(torch.zeros(2, 3, 32, 32), SfmConfig(), generator=torch.Generator())
    assert seen == [{1}, {1}]
