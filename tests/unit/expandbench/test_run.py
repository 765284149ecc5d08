"""The runner's cache: what is measured once is not measured again, unless what determines it changed."""

from __future__ import annotations

from pathlib import Path

import pytest

from sceneexpander.adaptation.config import AdaptConfig
from sceneexpander.expandbench import run as bench
from sceneexpander.expandbench.run import BASELINE, CAPTURED, CellResult, Plan, Settings, run
from sceneexpander.expansion import MethodConfig, ModelConfig
from sceneexpander.frontend.prior import FrontendConfig
from sceneexpander.photometric.config import RefineConfig, WarmupConfig
from tests.support.methods import make_method
from tests.worlds.cells import NUMBERS

PLAN = Plan(
    scenes=("room_1", "open_1"),
    grades=("mixed_1", "warp_1"),
    rows={"paper": make_method(AdaptConfig(steps=3)), "anchor": make_method(AdaptConfig(steps=3, lambda_gen=0))},
    seeds=(0, 1),
)


@pytest.fixture
def measured(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, ...]]:
    """The cells that were really measured; measuring itself is replaced, the cache is not."""
    calls: list[tuple[str, ...]] = []

    def fake(
        self: bench._Worker, grade: str, row: str, seed: int, config: MethodConfig | None, checkpoints: Path
    ) -> CellResult:
        calls.append((self.name, grade, row, str(seed)))
        alone = None if config is None else NUMBERS
        return CellResult(
            scene=self.name, grade=grade, row=row, seed=seed, steps=3, seconds=1.0, code=self.settings.code,
            numbers=NUMBERS, alone=alone,
        )  # fmt: skip

    monkeypatch.setattr(bench._Worker, "_measured", fake)
    return calls


def settings(folder: Path, **changes: object) -> Settings:
    values = {"model": ModelConfig(), "frontend": FrontendConfig(), "warmup": WarmupConfig(), "refine": RefineConfig()}
    return Settings(cache=folder, **values | {"code": "one"} | changes)  # type: ignore[arg-type]


def test_every_cell_once(tmp_path: Path, measured: list[tuple[str, ...]]) -> None:
    seen: list[CellResult] = []
    cells = run(PLAN, settings(tmp_path), on_cell=seen.append)
    assert len(cells) == len(PLAN) == len(measured) == 2 * 2 * (1 + 2 * (1 + 2))
    assert seen == cells
    assert {cell.row for cell in cells} == {CAPTURED, BASELINE, "paper", "anchor"}
    again = run(PLAN, settings(tmp_path))
    assert again == cells
    assert len(measured) == len(PLAN)


def test_an_interrupted_run_continues(
    tmp_path: Path, measured: list[tuple[str, ...]], monkeypatch: pytest.MonkeyPatch
) -> None:
    def stop(cell: CellResult) -> None:
        if len(measured) == 7:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run(PLAN, settings(tmp_path), on_cell=stop)
    assert len(measured) == 7
    run(PLAN, settings(tmp_path))
    assert len(measured) == len(PLAN)
    assert len(set(measured)) == len(PLAN)


def test_other_code_or_settings_are_measured_again(tmp_path: Path, measured: list[tuple[str, ...]]) -> None:
    run(PLAN, settings(tmp_path))
    count = len(measured)
    run(PLAN, settings(tmp_path, code="two", any_code=True))
    assert len(measured) == count
    run(PLAN, settings(tmp_path, code="two"))
    assert len(measured) == 2 * count
    run(PLAN, settings(tmp_path, code="two", warmup=WarmupConfig(steps=1)))
    assert len(measured) == 3 * count
    run(PLAN, settings(tmp_path, code="two", refine=RefineConfig(visits=1)))
    assert len(measured) == 4 * count


def test_a_changed_row_is_measured_again_and_a_renamed_one_is_not(
    tmp_path: Path, measured: list[tuple[str, ...]]
) -> None:
    plan = Plan(scenes=("room_1",), grades=("mixed_1",), rows={"paper": make_method(AdaptConfig(steps=3))}, seeds=(0,))
    run(plan, settings(tmp_path))
    count = len(measured)
    renamed = Plan(scenes=plan.scenes, grades=plan.grades, rows={"mine": make_method(AdaptConfig(steps=3))}, seeds=(0,))
    assert [cell.row for cell in run(renamed, settings(tmp_path))] == [CAPTURED, BASELINE, "mine"]
    assert len(measured) == count
    changed = Plan(
        scenes=plan.scenes, grades=plan.grades, rows={"paper": make_method(AdaptConfig(steps=4))}, seeds=(0,)
    )
    run(changed, settings(tmp_path))
    assert len(measured) == count + 1


def test_finished_cells_can_be_looked_at_without_running_any(tmp_path: Path, measured: list[tuple[str, ...]]) -> None:
    assert run(PLAN, settings(tmp_path, finished_only=True)) == []
    one = Plan(scenes=("room_1",), grades=("mixed_1",), rows={}, seeds=(0,))
    run(one, settings(tmp_path))
    assert [cell.row for cell in run(PLAN, settings(tmp_path, finished_only=True))] == [CAPTURED, BASELINE]
    assert len(measured) == 2
