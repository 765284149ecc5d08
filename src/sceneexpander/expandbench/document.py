"""``docs/ablation.md`` from the results file: every number on the page comes from here, so none outlives its measurement."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from sceneexpander.artifacts.store import ArtifactError, read_json, read_typed, to_plain, write_json_atomic
from sceneexpander.catalogue import Metric, Views, metric_named
from sceneexpander.catalogue.metrics import metrics_named
from sceneexpander.expandbench.power import without_power
from sceneexpander.expandbench.run import BASELINE, CAPTURED, CellResult
from sceneexpander.expandbench.scenes import DEVELOPMENT, TEST
from sceneexpander.expandbench.studies import REFERENCES, STUDIES, Study
from sceneexpander.expandbench.table import (
    acceptance_table,
    alone_table,
    compare_rows,
    components_table,
    curve_table,
    main_table,
    paired_table,
    scenes_table,
)
from sceneexpander.expansion import MethodConfig

SCHEMA = "ablation/3"
DEFAULT, PAPER, CORRECTED = "default", "paper", "corrected"
READING = "<!-- Above: written by the command. Below: written by hand, without numbers. -->"
_SHORT = metrics_named(
    "psnr_at_photo_size_db", "psnr_from_others_db", "psnr_inserted_db", "psnr_new_region_db", "psnr_half_way_db"
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Measured:
    """A study as it was measured."""

    cells: tuple[CellResult, ...]
    rows: Mapping[str, MethodConfig]
    visits: int  # of the fit, per view; 0: Gaussians as predicted

    def to_plain(self) -> dict[str, Any]:
        """The JSON form."""
        return {"cells": to_plain(self.cells), "rows": to_plain(self.rows), "visits": self.visits}


@dataclass(frozen=True, slots=True, kw_only=True)
class Results:
    """All studies that were measured, by one version of the package with one reconstructor."""

    version: str
    model: str
    machine: str
    studies: Mapping[str, Measured] = field(default_factory=dict)

    def save(self, path: Path) -> None:
        """Write the results file."""
        facts = {"schema": SCHEMA, "version": self.version, "model": self.model, "machine": self.machine}
        studies = {name: study.to_plain() for name, study in self.studies.items()}
        write_json_atomic(path, facts | {"studies": studies})

    @classmethod
    def load(cls, path: Path) -> Results:
        """Read it. Raises `ArtifactError` for a file of another schema."""
        content = read_json(path)
        if not isinstance(content, dict) or content.get("schema") != SCHEMA:
            raise ArtifactError(
                f"is not of schema {SCHEMA!r}", where=path, fix="remove it and measure again: make ablation"
            )
        studies = {
            name: Measured(
                cells=tuple(CellResult.from_plain(cell) for cell in study["cells"]),
                rows={
                    row: read_typed(MethodConfig, values, path, fix="make ablation")
                    for row, values in study["rows"].items()
                },
                visits=study["visits"],
            )
            for name, study in content["studies"].items()
        }
        return cls(version=content["version"], model=content["model"], machine=content["machine"], studies=studies)


def written(results: Results | None, path: Path) -> str:
    """The whole page: generated from the results, followed by what ``path`` holds below the line that ends the generated part."""
    before = path.read_text(encoding="utf-8") if path.is_file() else ""
    _, line, reading = before.partition(READING)
    return document(results) + f"\n{READING}\n" + (reading.lstrip("\n") if line else "")


def document(results: Results | None) -> str:
    """The generated part of the page.

    Args:
        results: None or with studies left out: their sections say that they were not measured.
    """
    parts = [_HEAD]
    if results is None:
        parts.append("**This version has not been measured yet.** `make ablation` does it and writes this page.")
    else:
        cells = [cell for study in results.studies.values() for cell in study.cells]
        codes = len({cell.code for cell in cells})
        mixed = f" **The cells are of {codes} versions of the code.**" if codes > 1 else ""
        parts.append(f"Version {results.version}, reconstructor `{results.model}`, {results.machine}.{mixed}")
        parts.append("## In short\n\n" + "\n".join(f"- {line}" for line in _in_short(results)))
    for study in STUDIES:
        measured = None if results is None else results.studies.get(study.name)
        body = "Not measured with this version." if measured is None else "\n\n".join(_sections(study, measured))
        parts.append(f"## {study.title}\n\n{study.meaning} {_about(study, measured)}\n\n{body}")
    return "\n\n".join(part.rstrip() for part in parts) + "\n"


_HEAD = """# What each part does: the ablation with known truth

Written by `make ablation`, which measures every number below on expandbench: procedural worlds that no training saw, five captured views
(168 x 224, photographs of twice that for the features), one view inserted beyond the end of the captured walk, true cameras and depths of
both. The picture is drawn with a known misalignment (`expandbench/grades.py`); the geometric front-end runs as it does for photos, and
nothing of the truth reaches a method. Finished cells are kept in `.cache/expandbench`: the command continues where it was stopped.
Prepared scenes stay there for the four codes and configurations used last.

```
make ablation                                              # all studies below; some three hours of one core
make ablation ARGS="--study rows,long"                     # some of them
make ablation ARGS="--finished"                            # nothing is run: the page from the cells that are there
make ablation ARGS="--rows paper,default --grades mixed_2 --seeds 0"   # a table of your own, this page is left alone
sceneexpander sweep --multirun ablation=baseline,paper,default seed=0,1,2    # rows as whole pipelines
python scripts/real_ablation.py FOLDER ... --rows paper,default                        # on scene folders without truth
```

*What rows hold.* `captured`: the scene before the insertion. `baseline`: the same weights given the inserted view like a photo.
`corrected`: what SceneExpander changes without a step of adaptation (the inserted picture's colours, cameras, fading, free space, closed
gaps, a doubting fit). `default`: the same with Algorithm 1, nothing left out. `paper`: the paper's method, Algorithm 1 without the
corrections; the rows before it in the paper's table have fewer of its components. `no_...`: the default without one correction.
`control_...`: see `conf/ablation/`.

*How they are compared.* Rows of one scene, grade and seed differ in nothing but the row: the same estimate of the front-end, the same seed
of the adaptation and of the fit, the same number of the fit's visits to every view. Differences are means over scenes, ± is the standard
deviation over seeds of that mean, *worst* the worst scene's mean, and *a/b* says in how many of the scenes the row is better. A row that
cannot differ from what it is compared with in so few steps says "no power" and why, instead of a number.

*Which scenes.* Settings and defaults were chosen on the development scenes, which are those whose captured views the front-end poses
completely, within 3 degrees. Test scenes have fresh seeds, nothing was chosen on them, and whether the front-end poses their views was not
looked at (`expandbench/scenes.py`)."""


def _about(study: Study, measured: Measured | None) -> str:
    scenes = study.scenes if measured is None else tuple(dict.fromkeys(cell.scene for cell in measured.cells))
    kinds = [f"{count} {kind}" for kind, count in _kinds(scenes).items()]
    steps = "" if measured is None else _steps(measured.rows)
    seeds = ", ".join(map(str, study.seeds))
    return f"{' and '.join(kinds)} scenes; {', '.join(f'`{grade}`' for grade in study.grades)}; seeds {seeds}{steps}."


def _kinds(scenes: Sequence[str]) -> dict[str, int]:
    found = {
        "development": sum(scene in DEVELOPMENT for scene in scenes),
        "test": sum(scene in TEST for scene in scenes),
    }
    return {kind: count for kind, count in found.items() if count}


def _steps(rows: Mapping[str, MethodConfig]) -> str:
    settings = {(row.adapt.steps, row.adapt.learning_rate) for row in rows.values() if row.adapt.steps}
    return "".join(f"; {steps} steps at {rate:g}" for steps, rate in sorted(settings))


def references_of(rows: Mapping[str, MethodConfig]) -> dict[str, str]:
    """What each row is compared with, see `REFERENCES`: the default, where nothing else is said."""
    return {row: reference for row in rows if (reference := REFERENCES.get(row, DEFAULT)) in {BASELINE, *rows}}


def powerless(rows: Mapping[str, MethodConfig]) -> dict[str, str]:
    """Rows that cannot differ from what they are compared with, and why."""
    pairs = {row: reference for row, reference in references_of(rows).items() if reference != BASELINE}
    return {
        row: reason for row, other in pairs.items() if (reason := without_power(rows[row], rows[other])) is not None
    }


def _sections(study: Study, measured: Measured) -> list[str]:
    cells = measured.cells
    rows = {row: measured.rows[row] for row in study.rows if row in measured.rows}  # a file's keys are sorted
    if len(study.grades) > 2:
        names = [row for row in (CORRECTED, DEFAULT) if row in rows]
        curves = [
            f"### {column.column}\n\n{curve_table(cells, names, column)}"
            for column in _SHORT
            if not column.scope.of_insertion
        ]
        picture = "![captured PSNR against misalignment](ablation.svg)"
        return [*curves, picture, "### Judging candidates before inserting them\n\n" + acceptance_table(cells)]
    names = [row for row in (PAPER, CORRECTED, DEFAULT) if row in rows]
    return [
        "### Differences to the baseline\n\n" + paired_table(cells),
        "### Component by component\n\n" + components_table(cells, references_of(rows), powerless(rows), _SHORT),
        "### Scene by scene\n\n" + scenes_table(cells, names),
        scenes_table(cells, names, metric_named("depth_abs_rel")),
        "### Means\n\n" + main_table(cells),
        "### The same weights without the inserted view\n\nWhat a row gains here is no repair.\n\n"
        + alone_table(cells),
    ]


def _in_short(results: Results) -> list[str]:
    """Sentences about what was measured; which way a number points is said by the number."""
    lines = []
    for study in STUDIES:
        measured = results.studies.get(study.name)
        if measured is None or study.name not in {"rows", "predicted", "test"}:
            continue
        cells = [cell for cell in measured.cells if cell.grade in ("", "mixed_2")]
        fit = "with the fit" if measured.visits else "as predicted"
        kinds = " and ".join(_kinds([cell.scene for cell in cells]))
        where = f"{kinds} scenes, {fit}, `mixed_2`"
        for title, row, against in (
            ("The insertion itself", BASELINE, CAPTURED),
            ("The default against the unadapted model", DEFAULT, BASELINE),
            ("The corrections alone against the unadapted model", CORRECTED, BASELINE),
            ("Algorithm 1 on top of the corrections", DEFAULT, CORRECTED),
            ("The paper's method without corrections against the unadapted model", PAPER, BASELINE),
        ):
            texts = [
                text
                for name in (
                    "psnr_at_photo_size_db",
                    "psnr_from_others_db",
                    "depth_abs_rel",
                    "psnr_new_region_db",
                    "psnr_half_way_db",
                )
                if (text := _said(cells, row, against, metric_named(name))) is not None
                # The scene before the insertion shows nothing there.
                and not (against == CAPTURED and metric_named(name).scope.views is Views.HELD_OUT)
            ]
            if texts:
                lines.append(f"{title} ({where}): {'; '.join(texts)}.")
    return lines or ["Nothing of this is measured yet."]


def _said(cells: Sequence[CellResult], row: str, against: str, column: Metric) -> str | None:
    found = compare_rows(cells, row, column, against=against)
    if found is None:
        return None
    spread = "" if found.seed_spread is None else f" ± {column.bare(found.seed_spread)}"
    worst = column.bare(found.lowest, sign=True)
    unit = f" {column.unit}" if column.unit else ""
    better = f"better in {found.better} of {found.scenes} scenes, worst {worst}"
    return f"{column.title} **{column.bare(found.mean, sign=True)}{spread}{unit}** ({better})"
