"""The rows of every table: what each method is called, what it starts from, which stage makes it."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from sceneexpander.errors import UserError, did_you_mean


class Kind(StrEnum):
    """What sort of method."""

    CAPTURED = "captured"  # the scene before the insertion
    BACKBONE = "backbone"  # the reconstructor as it is, given the inserted view
    CORRECTED = "corrected"  # the round's corrections without Algorithm 1
    ADAPTED = "adapted"  # Algorithm 1
    RIVAL = "rival"  # another reconstructor
    OPTIMISED = "optimised"  # per-scene optimisation of another method's Gaussians


@dataclass(frozen=True, slots=True, kw_only=True)
class Method:
    """One row. In texts, ``{model}`` stands for the reconstructor's own name.

    Attributes:
        name: where methods are selected, in folders, in tables of numbers and in MLflow.
        kind: what sort of method.
        stage: which stage of the pipeline makes it.
        starts_from: the method whose result it needs, if any.
        title: its name for people.
        short: what it is, in a few words.
        meaning: what it is, in a sentence or two.
        needs_weights: runs only with the public checkpoint that its section of the configuration names.
    """

    name: str
    kind: Kind
    stage: str
    title: str
    short: str
    meaning: str
    starts_from: str | None = None
    needs_weights: bool = False

    @property
    def always_made(self) -> bool:
        """The pipeline makes it whether or not it is asked for: later rounds need it."""
        return self.kind in (Kind.CAPTURED, Kind.BACKBONE, Kind.ADAPTED)

    def called(self, model: str) -> str:
        """The title with the reconstructor's name."""
        return self.title.format(model=model)

    def explained(self, model: str) -> str:
        """The meaning with the reconstructor's name."""
        return self.meaning.format(model=model)


def _rival(name: str, title: str, meaning: str) -> Method:
    return Method(
        name=name,
        kind=Kind.RIVAL,
        stage="rival",
        title=title,
        short="another reconstructor",
        meaning=meaning,
        needs_weights=True,
    )


def _optimised(start: str, title: str, short: str, meaning: str) -> Method:
    return Method(
        name=f"{start}_optimised",
        kind=Kind.OPTIMISED,
        stage="optimise",
        starts_from=start,
        title=title,
        short=short,
        meaning=meaning,
    )


# In the order of tables: every rival and baseline before the method itself.
METHODS = (
    Method(
        name="captured",
        kind=Kind.CAPTURED,
        stage="precompute_anchors",
        title="Captured only",
        short="before the insertion",
        meaning="The scene before this insertion: in the first round {model} given the captured photos alone. Nothing new is shown.",
    ),
    Method(
        name="gaussian_splatting",
        kind=Kind.OPTIMISED,
        stage="gaussian_splatting",
        starts_from="backbone",
        title="3DGS per scene, from {model}",
        short="optimised on all views",
        meaning="Gaussians optimised on the captured photos and the inserted picture, started from the cameras and Gaussians of {model} "
        "with the inserted view. PSNR and SSIM are those of pictures it was fitted to.",
    ),
    _rival(
        "omnivggt",
        "OmniVGGT, pixel-aligned",
        "OmniVGGT given the same pictures, as they are; it has no Gaussians, so every pixel of its depth becomes one by the "
        "project's rule.",
    ),
    _optimised(
        "omnivggt",
        "OmniVGGT, optimised",
        "3DGS from its points",
        "3DGS optimised on the same pictures, started from OmniVGGT's own points and cameras.",
    ),
    _rival(
        "ttt3r",
        "{model}, pixel-aligned",
        "{model} given the same pictures, as they are, one after the other, the inserted one last; its points become Gaussians by "
        "the same rule.",
    ),
    _optimised(
        "ttt3r",
        "{model}, optimised",
        "3DGS from its points",
        "3DGS optimised on the same pictures, started from {model}'s own points and cameras.",
    ),
    Method(
        name="backbone",
        kind=Kind.BACKBONE,
        stage="reconstruct_inserted",
        title="{model} + inserted view",
        short="unadapted",
        meaning="{model} with unadapted weights, given the captured photos and the inserted picture, which counts like a photo.",
    ),
    Method(
        name="corrected",
        kind=Kind.CORRECTED,
        stage="correct",
        title="Corrections on {model}, no steps",
        short="what Algorithm 1 starts from",
        meaning="What SceneExpander does beyond Algorithm 1, without a step of it: the inserted picture in the photos' colours, cameras "
        "that may stay as they were, generated Gaussians that fade where photos contradict them and reach each other where nothing else "
        "is, and a fit that doubts contradicted pixels, each if it is configured. The weights are those that the round starts from.",
    ),
    Method(
        name="sceneexpander",
        kind=Kind.ADAPTED,
        stage="adapt",
        title="SceneExpander on {model}",
        short="corrections and Algorithm 1",
        meaning="The same corrections, after the weights were adapted to this scene by Algorithm 1. What this row has more than the "
        "corrections without steps is the adaptation's doing; the rest of its gain is the corrections'.",
    ),
    _optimised(
        "sceneexpander",
        "SceneExpander on {model} + post-optimisation",
        "adapted, then optimised",
        "SceneExpander's Gaussians fitted further to the same pictures: an addition, not the method.",
    ),
)
_known = {method.name: method for method in METHODS}
MAIN = next(method.name for method in METHODS if method.kind is Kind.ADAPTED)
CAPTURED = next(method.name for method in METHODS if method.kind is Kind.CAPTURED)
BACKBONE = next(method.name for method in METHODS if method.kind is Kind.BACKBONE)
CORRECTED = next(method.name for method in METHODS if method.kind is Kind.CORRECTED)


def register_method(method: Method) -> None:
    """Add a method from outside the package. Raises `ValueError` for a name that another method has."""
    if _known.get(method.name, method) != method:
        raise ValueError(f"there is another method {method.name!r}")
    _known[method.name] = method


def known_methods() -> tuple[Method, ...]:
    """All methods in the order of tables, registered ones last."""
    return tuple(_known.values())


def method_named(name: str, *, where: str = "methods") -> Method:
    """The method of that name. Raises `UserError` with a suggestion if there is none."""
    if name not in _known:
        raise UserError(f"unknown {name!r}", where=where, fix=did_you_mean(name, _known))
    return _known[name]


def known_method(name: str) -> Method | None:
    """The method of that name, or None: rows of tables may be of experiments that are none of ours."""
    return _known.get(name)


def method_title(name: str, model: str) -> str:
    """Title of a method with the reconstructor's name; methods that are not in the catalogue go by their names."""
    known = known_method(name)
    return name if known is None else known.called(model)


def methods_of(*kinds: Kind) -> tuple[str, ...]:
    """Names of the methods of some kinds, in the order of tables."""
    return tuple(method.name for method in known_methods() if method.kind in kinds)


def method_order(name: str) -> tuple[int, str]:
    """Key that sorts names as tables have them; unknown ones come last, by name."""
    names = list(_known)
    return (names.index(name) if name in _known else len(names), name)
