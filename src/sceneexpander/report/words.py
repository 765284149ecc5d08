"""What the report calls things, and what it says they mean."""

from __future__ import annotations

from dataclasses import dataclass

from sceneexpander.artifacts.metrics import Fit
from sceneexpander.artifacts.quantities import GEOMETRY, INSERTION, QUALITY, Quantity
from sceneexpander.artifacts.source_type import MADE_BY_MODEL, MADE_FROM_SCENE

# How an inserted picture came to be, as far as that is known.
PICTURE_KINDS = {
    MADE_BY_MODEL: "AI-generated picture",
    MADE_FROM_SCENE: "Picture rendered from the scene itself, with parts that nobody captured",
}
LAYERS = (("rgb", "Colour"), ("depth", "Depth"), ("provenance", "Provenance"))


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
        meaning="The scene before this insertion: in the first round {model} given the captured photos alone. Nothing new is shown.",
    ),
    "backbone": MethodWords(
        label="{model} + inserted view",
        short="unadapted",
        meaning="{model} with unadapted weights, given the captured photos and the inserted picture, which counts like a photo.",
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
        meaning="OmniVGGT given the same pictures, as they are; it has no Gaussians, so every pixel of its depth becomes one by the "
        "project's rule.",
    ),
    "ttt3r": MethodWords(
        label="{model}, pixel-aligned",
        short="another reconstructor",
        meaning="{model} given the same pictures, as they are, one after the other, the inserted one last; its points become Gaussians by "
        "the same rule.",
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
    "corrected": MethodWords(
        label="Corrections on {model}, no steps",
        short="what Algorithm 1 starts from",
        meaning="What SceneExpander does beyond Algorithm 1, without a step of it: the inserted picture in the photos' colours, cameras "
        "that may stay as they were, generated Gaussians that fade where photos contradict them and reach each other where nothing else "
        "is, and a fit that doubts contradicted pixels, each if it is configured. The weights are those that the round starts from.",
    ),
    "sceneexpander": MethodWords(
        label="SceneExpander on {model}",
        short="corrections and Algorithm 1",
        meaning="The same corrections, after the weights were adapted to this scene by Algorithm 1. What this row has more than the "
        "corrections without steps is the adaptation's doing; the rest of its gain is the corrections'.",
    ),
}


def _shown(quantities: tuple[Quantity, ...]) -> tuple[Quantity, ...]:
    return tuple(item for item in quantities if item.meaning)


# The tables of numbers: heading, what the columns say, and the columns. Short enough to be read without scrolling sideways.
TABLES = (
    ("The photos", _shown(QUALITY)),
    ("The inserted view", _shown(INSERTION)),
    ("Against known truth", _shown(GEOMETRY)),
)


def method_words(name: str, model: str, fit: Fit = Fit.PREDICTED) -> MethodWords:
    """Words for a method with the reconstructor's name filled in and its fit marked. Unknown methods speak for themselves."""
    words = METHODS.get(name, MethodWords(label=name, short="", meaning=""))
    return MethodWords(
        label=words.label.format(model=model) + fit.mark, short=words.short, meaning=words.meaning.format(model=model)
    )
