"""Runs cells of the benchmark: scene x grade x row x seed. Every finished cell is kept, so an interrupted run continues."""

from __future__ import annotations

import hashlib
import json
import logging
import shutil
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from multiprocessing import get_context
from pathlib import Path

import torch

from sceneexpander.artifacts.reconstruction import Reconstruction
from sceneexpander.artifacts.store import keep_newest, read_json, to_plain, write_json_atomic
from sceneexpander.expandbench.grades import grade_named
from sceneexpander.expandbench.measure import BenchNumbers, measure
from sceneexpander.expandbench.prepared import PreparedCase, PreparedScene, prepare_case, prepare_scene
from sceneexpander.expandbench.scenes import BenchScene, build_scene
from sceneexpander.expansion import (
    Adapted,
    LoadedModel,
    MethodConfig,
    ModelConfig,
    Procedure,
    Watch,
    compose_procedure,
    judge_round,
    load_model,
)
from sceneexpander.frontend.prior import FrontendConfig
from sceneexpander.insertion.acceptance import Acceptance
from sceneexpander.photometric.config import RefineConfig, WarmupConfig
from sceneexpander.photometric.fitting import fit_to_views
from sceneexpander.reconstruction.views import reconstruct

CAPTURED = "captured"  # the pre-insertion scene
CELL_SCHEMA = "cell/2"
PREPARED_KEPT = 4  # codes and configurations whose prepared scenes stay, the last used first
BASELINE = "baseline"  # the same weights given the inserted view
_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings:
    """What all cells share. ``code`` identifies the programs: results of other code are made again unless ``any_code``."""

    model: ModelConfig
    frontend: FrontendConfig
    warmup: WarmupConfig
    refine: RefineConfig
    cache: Path
    code: str = ""
    any_code: bool = False
    threads: int = 1
    finished_only: bool = False  # nothing is run: cells that are not there are left out


@dataclass(frozen=True, slots=True, kw_only=True)
class Plan:
    """Which cells. ``rows`` are configurations by name; `CAPTURED` and `BASELINE` are always measured, with every seed.

    The seed is that of the adaptation and of the fit: rows of one scene, grade and seed differ in nothing but the row.
    """

    scenes: tuple[str, ...]
    grades: tuple[str, ...]
    rows: Mapping[str, MethodConfig]
    seeds: tuple[int, ...]

    def __len__(self) -> int:
        return len(self.scenes) * len(self.seeds) * (1 + len(self.grades) * (1 + len(self.rows)))


@dataclass(frozen=True, slots=True, kw_only=True)
class CellResult:
    """One reconstruction's numbers. ``alone``: the same weights given the captured views only (None for the two fixed rows).

    ``grade`` is empty for `CAPTURED`, which no grade changes. ``candidate`` is the judgement of the inserted view, in `BASELINE` cells.
    """

    scene: str
    grade: str
    row: str
    seed: int
    steps: int
    seconds: float
    code: str
    numbers: BenchNumbers
    alone: BenchNumbers | None = None
    candidate: Acceptance | None = None

    @classmethod
    def from_plain(cls, item: dict[str, object]) -> CellResult:
        """From the JSON form."""
        values = dict(item)
        for name in ("numbers", "alone"):
            content = values[name]
            if isinstance(content, dict):
                values[name] = BenchNumbers(**content)
        candidate = values.get("candidate")
        if isinstance(candidate, dict):
            values["candidate"] = Acceptance(**{**candidate, "reasons": tuple(candidate["reasons"])})
        return cls(**values)  # type: ignore[arg-type]


def run(
    plan: Plan, settings: Settings, *, processes: int = 1, on_cell: Callable[[CellResult], None] | None = None
) -> list[CellResult]:
    """Measure every cell of the plan, from the cache where it has been measured before. Results are in the plan's order.

    Args:
        processes: how many scenes are worked on at the same time.
        on_cell: called as each cell becomes known.
    """
    results: list[CellResult] = []
    if processes <= 1:
        for name in plan.scenes:
            results.extend(_collect(_scene_cells(name, plan, settings), on_cell))
        return results
    with ProcessPoolExecutor(processes, mp_context=get_context("spawn")) as pool:
        for cells in pool.map(_scene_results, *zip(*[(name, plan, settings) for name in plan.scenes], strict=True)):
            results.extend(_collect(iter(cells), on_cell))
    return results


def _collect(cells: Iterator[CellResult], on_cell: Callable[[CellResult], None] | None) -> Iterator[CellResult]:
    for cell in cells:
        if on_cell is not None:
            on_cell(cell)
        yield cell


def _scene_results(name: str, plan: Plan, settings: Settings) -> list[CellResult]:
    return list(_scene_cells(name, plan, settings))


class _Worker:
    """One scene's cells; models and prepared inputs are made only when a cell is not in the cache."""

    def __init__(self, name: str, settings: Settings) -> None:
        self.name, self.settings = name, settings
        before = {name: to_plain(getattr(settings, name)) for name in ("model", "frontend", "warmup")}
        self.shared = json.dumps(before | {"refine": to_plain(settings.refine)}, sort_keys=True)
        # What the fit starts from is the same whatever the fit.
        code = "" if settings.any_code else settings.code
        key = hashlib.sha256(f"{json.dumps(before, sort_keys=True)}:{code}".encode()).hexdigest()
        prepared = settings.cache / "prepared" / key[:16]
        prepared.mkdir(parents=True, exist_ok=True)
        prepared.touch()
        keep_newest(prepared.parent, PREPARED_KEPT - 1, beside=prepared)
        self.folder = prepared / name
        self._scene: BenchScene | None = None
        self._loaded: LoadedModel | None = None
        self._prepared: PreparedScene | None = None
        self._cases: dict[str, PreparedCase] = {}
        self._last: tuple[tuple[str, Procedure, int], tuple[Adapted, float]] | None = None

    def cell(self, grade: str, row: str, seed: int, config: MethodConfig | None) -> CellResult | None:
        """The cell's result, kept or new; None if it is not there and nothing is to be run."""
        identity = {
            "schema": CELL_SCHEMA,
            "shared": self.shared,
            "scene": self.name,
            "grade": grade,
            "row": to_plain(config),
            "seed": seed,
        }
        if config is None:
            identity["row"] = row
        key = hashlib.sha256(json.dumps(identity, sort_keys=True).encode()).hexdigest()
        path = self.settings.cache / "results" / f"{key[:32]}.json"
        if path.exists():
            known = CellResult.from_plain(read_json(path) | {"row": row})
            if self.settings.any_code or known.code == self.settings.code:
                return known
        if self.settings.finished_only:
            return None
        checkpoints = self.settings.cache / "ckpt" / f"{key[:32]}-{self.settings.code[:32]}"
        result = self._measured(grade, row, seed, config, checkpoints)
        write_json_atomic(path, result)
        if checkpoints.exists():
            shutil.rmtree(checkpoints)
        return result

    def _measured(
        self, grade: str, row: str, seed: int, config: MethodConfig | None, checkpoints: Path | None = None
    ) -> CellResult:
        torch.set_num_threads(self.settings.threads)
        alone: BenchNumbers | None = None
        seconds, steps = 0.0, 0
        fit = self.settings.refine
        if row == CAPTURED:
            case, before = None, self.prepared
            reconstruction, _ = fit_to_views(before.captured, before.state.views, fit, seed=seed)
        else:
            case = self.case(grade)
            if config is None:
                views = case.inputs.state.views.append(case.inputs.inserted.view)
                reconstruction, _ = fit_to_views(case.backbone, views, fit, seed=seed)
            else:
                procedure = compose_procedure(config, fit)
                adapted, seconds = self._adapted(
                    grade, case, procedure, seed, checkpoints if config.adapt.checkpoint_every else None
                )
                steps = len(adapted.result.records)
                started = time.perf_counter()
                expanded = procedure.finish(adapted, self.loaded, seed=seed)
                reconstruction = expanded.scene
                seconds += time.perf_counter() - started
                start = adapted.inputs.state
                without = reconstruct(start.views, start.priors, self.loaded, expanded.state.weights, method="alone")
                without, _ = fit_to_views(without, start.views, fit, seed=seed)
                alone = self._numbers(without, None)
        return CellResult(
            scene=self.name,
            grade=grade,
            row=row,
            seed=seed,
            steps=steps,
            seconds=seconds,
            code=self.settings.code,
            numbers=self._numbers(reconstruction, case),
            alone=alone,
            candidate=judge_round(case.inputs) if case is not None and row == BASELINE else None,
        )

    def _adapted(
        self, grade: str, case: PreparedCase, procedure: Procedure, seed: int, checkpoints: Path | None
    ) -> tuple[Adapted, float]:
        """(the round after Algorithm 1, seconds): rows that differ in what follows share it. The last is kept."""
        key = grade, replace(procedure, weights=(), after=()), seed
        if self._last is None or self._last[0] != key:
            started = time.perf_counter()
            watch = Watch(checkpoint_folder=checkpoints)
            adapted = procedure.adapt(case.inputs, self.loaded, seed=seed, watch=watch)
            self._last = key, (adapted, time.perf_counter() - started)
        return self._last[1]

    def _numbers(self, reconstruction: Reconstruction, case: PreparedCase | None) -> BenchNumbers:
        views, truth = self.scene.captured, self.scene.truth
        if case is not None:
            views, truth = views.append(case.inputs.inserted.view), case.truth
        return measure(reconstruction, views, truth, self.scene)

    @property
    def scene(self) -> BenchScene:
        """The scene, rendered at the first call."""
        if self._scene is None:
            self._scene = build_scene(self.name)
        return self._scene

    @property
    def loaded(self) -> LoadedModel:
        """The model, loaded at the first call."""
        if self._loaded is None:
            self._loaded = load_model(self.settings.model)
        return self._loaded

    @property
    def prepared(self) -> PreparedScene:
        """The pre-insertion scene."""
        if self._prepared is None:
            s = self.settings
            self._prepared = prepare_scene(self.scene, self.loaded, s.frontend, s.warmup, self.folder)
        return self._prepared

    def case(self, grade: str) -> PreparedCase:
        """The scene with a view of that grade inserted."""
        if grade not in self._cases:
            s, chosen = self.settings, grade_named(grade)
            self._cases[grade] = prepare_case(self.scene, self.prepared, chosen, self.loaded, s.frontend, self.folder)
        return self._cases[grade]


def _scene_cells(name: str, plan: Plan, settings: Settings) -> Iterator[CellResult]:
    worker = _Worker(name, settings)
    wanted: list[tuple[str, str, int, MethodConfig | None]] = [("", CAPTURED, seed, None) for seed in plan.seeds]
    for grade in plan.grades:
        wanted += [(grade, BASELINE, seed, None) for seed in plan.seeds]
        wanted += [(grade, row, seed, config) for row, config in plan.rows.items() for seed in plan.seeds]
    for cell in wanted:
        result = worker.cell(*cell)
        if result is not None:
            yield result
