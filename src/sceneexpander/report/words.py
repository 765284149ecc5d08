"""What the report calls things, and what it says they mean."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

LAYERS = (("rgb", "Colour"), ("depth", "Depth"), ("provenance", "Provenance"))
Better = Literal["higher", "lower", ""]


@dataclass(frozen=True, slots=True, kw_only=True)
class Column:
    """One number of the table: its name in `MetricsRow`, its heading, and what it says."""

    name: str
    label: str
    meaning: str
    digits: int = 2
    better: Better = ""
    percent: bool = False

    def text(self, value: float | None) -> str:
        """A value as it is printed; a dash if there is none."""
        if value is None:
            return "\u2013"
        return f"{100 * value:.{self.digits}f} %" if self.percent else f"{value:.{self.digits}f}"


@dataclass(frozen=True, slots=True, kw_only=True)
class MethodWords:
    """How a method is introduced; ``{model}`` is replaced by the reconstructor's own name."""

    label: str
    short: str
    meaning: str


METHODS = {
    "captured": MethodWords(
        label="Captured only",
        short="before the insertion",
        meaning="{model} given the captured photos alone. The ceiling of preservation, and the floor of expansion: nothing new is shown.",
    ),
    "backbone": MethodWords(
        label="{model} + inserted view",
        short="unadapted",
        meaning="{model} given the captured photos and the inserted picture, with its weights as they were before this round.",
    ),
    "gaussian_splatting": MethodWords(
        label="3DGS per scene, from {model}",
        short="optimised on all views",
        meaning="Gaussians optimised on the captured photos and the inserted picture, started from the cameras and Gaussians of {model} "
        "with the inserted view. PSNR and SSIM are those of pictures it was fitted to.",
    ),
    "omnivggt": MethodWords(
        label="OmniVGGT, pixel-aligned",
        short="another reconstructor",
        meaning="OmniVGGT given the same pictures; it has no Gaussians, so every pixel of its depth becomes one by the project's rule.",
    ),
    "ttt3r": MethodWords(
        label="{model}, pixel-aligned",
        short="another reconstructor",
        meaning="{model} given the same pictures one after the other, the inserted one last; its points become Gaussians by the same rule.",
    ),
    "omnivggt_optimised": MethodWords(
        label="OmniVGGT, optimised",
        short="3DGS from its points",
        meaning="3DGS optimised on the same pictures, started from OmniVGGT's own points and cameras.",
    ),
    "ttt3r_optimised": MethodWords(
        label="{model}, optimised",
        short="3DGS from its points",
        meaning="3DGS optimised on the same pictures, started from {model}'s own points and cameras.",
    ),
    "sceneexpander_optimised": MethodWords(
        label="SceneExpander on {model} + post-optimisation",
        short="adapted, then optimised",
        meaning="SceneExpander's Gaussians fitted further to the same pictures: an addition, not the method.",
    ),
    "sceneexpander": MethodWords(
        label="SceneExpander on {model}",
        short="after the adaptation",
        meaning="The same reconstructor on the same pictures, after its weights were adapted to this scene.",
    ),
}

COLUMNS = (
    Column(
        name="psnr_db",
        label="PSNR, dB",
        better="higher",
        meaning="Preservation: captured views rendered at the method's own cameras, against the photos; mean over views.",
    ),
    Column(name="ssim", label="SSIM", digits=3, better="higher", meaning="The same, structural similarity."),
    Column(
        name="st_lpips",
        label="ST-LPIPS",
        digits=4,
        better="lower",
        meaning="The same, shift-tolerant perceptual distance.",
    ),
    Column(
        name="others_psnr_db",
        label="PSNR from others, dB",
        better="higher",
        meaning="Captured views painted only by what other views contributed: low where surfaces are doubled.",
    ),
    Column(
        name="inserted_psnr_db",
        label="Inserted PSNR, dB",
        better="higher",
        meaning="Expansion: the scene at the inserted camera against the inserted picture.",
    ),
    Column(
        name="inserted_ssim",
        label="Inserted SSIM",
        digits=3,
        better="higher",
        meaning="The same, structural similarity.",
    ),
    Column(
        name="inserted_st_lpips",
        label="Inserted ST-LPIPS",
        digits=4,
        better="lower",
        meaning="The same, shift-tolerant perceptual distance.",
    ),
    Column(
        name="inserted_others_psnr_db",
        label="Inserted from others, dB",
        better="higher",
        meaning="The overlap of inserted and captured views: the inserted camera shown only what the captured views contributed.",
    ),
    Column(
        name="navigation_coverage",
        label="Tour covered",
        digits=1,
        percent=True,
        better="higher",
        meaning="Share of the tour's pixels that show something.",
    ),
    Column(
        name="truth.camera_rotation_deg",
        label="Camera error, deg",
        better="lower",
        meaning="Against the known cameras: error of relative rotations between captured views.",
    ),
    Column(
        name="truth.depth_abs_rel",
        label="Depth error",
        digits=1,
        percent=True,
        better="lower",
        meaning="Against the known depth of the captured views, relative, after one common scale.",
    ),
    Column(
        name="truth.inserted_rotation_deg",
        label="Inserted camera, deg",
        better="lower",
        meaning="Rotation of the inserted camera against the one that the picture was really made with.",
    ),
    Column(
        name="truth.new_region_abs_rel",
        label="New region's depth error",
        digits=1,
        percent=True,
        better="lower",
        meaning="Against the known depth of what no captured view saw.",
    ),
)


# What a look at a running adaptation measures: names as in its entries, ``drift`` being the norm over all modules.
LOOK_COLUMNS = (
    Column(
        name="captured_psnr",
        label="Captured PSNR, dB",
        better="higher",
        meaning="Preservation: a few captured views rendered at the model's own cameras, against the photos.",
    ),
    Column(
        name="inserted_psnr",
        label="Inserted PSNR, dB",
        better="higher",
        meaning="Expansion: the picture above it against the inserted one.",
    ),
    Column(
        name="captured_depth_change",
        label="Captured depth moved",
        digits=1,
        percent=True,
        better="lower",
        meaning="Depth of the captured views against what the model believed before the insertion: mean absolute log ratio.",
    ),
    Column(
        name="head_disagreement",
        label="Heads disagree",
        digits=1,
        percent=True,
        better="lower",
        meaning="Depth that the model tells against the depth at which it puts its Gaussians: mean absolute log ratio.",
    ),
    Column(
        name="drift",
        label="Weights moved",
        digits=3,
        meaning="Norm of the change of all weights since the round began.",
    ),
)


def method_words(name: str, model: str) -> MethodWords:
    """Words for a method with the reconstructor's name filled in. Unknown methods speak for themselves."""
    words = METHODS.get(name, MethodWords(label=name, short="", meaning=""))
    return MethodWords(
        label=words.label.format(model=model), short=words.short, meaning=words.meaning.format(model=model)
    )
