"""What the paper reports, quoted: figures of its own scenes, checkpoint, judge and participants, never measured here.

Source: its tables "Quantitative comparison" and "Ablation study". Names are those of our metrics that ask the same; 3DGS is there what
`gaussian_splatting` is here, WorldMirror what `backbone` is.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

QUOTED = "the paper"


@dataclass(frozen=True, slots=True, kw_only=True)
class QuotedRow:
    """One line of one of its tables.

    Attributes:
        name: our method or row of the ablation.
        title: as the paper calls it.
        figures: as printed, by our metrics' names.
    """

    name: str
    title: str
    figures: Mapping[str, str]


def _row(name: str, title: str, columns: tuple[str, ...], figures: str) -> QuotedRow:
    return QuotedRow(name=name, title=title, figures=dict(zip(columns, figures.split(), strict=True)))


IMAGE_COLUMNS = ("psnr_captured_db", "ssim_captured", "lpips_captured")
JUDGE_COLUMNS = ("judge_insertion", "judge_quality")
HUMAN_COLUMNS = ("human_insertion", "human_quality")
_COMPARED = (*IMAGE_COLUMNS, *JUDGE_COLUMNS, *HUMAN_COLUMNS)
_ABLATED = (*IMAGE_COLUMNS, *JUDGE_COLUMNS)

COMPARISON = (
    _row("omnivggt", "OmniVGGT", _COMPARED, "14.969 0.3647 0.370 3.16 2.66 2.26 2.40"),
    _row("ttt3r", "TTT3R", _COMPARED, "13.483 0.2747 0.457 2.94 2.38 1.72 1.71"),
    _row("backbone", "WorldMirror", _COMPARED, "19.295 0.614 0.357 3.50 2.61 4.04 4.07"),
    _row("gaussian_splatting", "3DGS", _COMPARED, "14.046 0.3045 0.418 3.16 2.61 2.40 2.32"),
    _row("sceneexpander", "SceneExpander", _COMPARED, "21.206 0.776 0.276 3.72 3.05 4.56 4.53"),
)
ABLATION = (
    _row("baseline", "Baseline", _ABLATED, "19.295 0.614 0.357 3.50 2.61"),
    _row("anchor", "+ Anchor distillation", _ABLATED, "20.763 0.714 0.329 3.52 2.96"),
    _row("subset_aug", "+ Subset sampling and augmentation", _ABLATED, "20.892 0.720 0.322 3.56 3.24"),
    _row("self_distill", "+ Self-distillation (p = 0.5)", _ABLATED, "21.124 0.757 0.294 3.70 3.08"),
    _row("self_distill_p1", "+ Self-distillation (p = 1.0)", _ABLATED, "20.856 0.704 0.318 3.84 2.88"),
    _row("paper", "+ Stochastic restoration (full)", _ABLATED, "21.206 0.776 0.276 3.72 3.05"),
)
