"""Where artefacts live. The paths are the same in every workspace, because the pipeline's cache knows outputs by path."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from sceneexpander.catalogue import MAIN
from sceneexpander.pipeline.unasked import METHODS_FILE

SCENES = Path("scenes")
OUTPUTS = Path("outputs")
PAGES = OUTPUTS / "pages"  # what is shown of every scene, gathered from its artefacts
PAGE_CONFIG = "config.json"  # in a scene's folder of PAGES: its composed configuration
PAGE_GAUSSIANS = "gaussians.json"  # there as well: hashes of the Gaussians' files, which are too large to be gathered
REPORT = OUTPUTS / "report"
CODE = OUTPUTS / "code.json"
GIVEN = OUTPUTS / "given"  # links to files that the configuration names, by scene
ENVIRONMENT = OUTPUTS / "environment.json"  # that the hashes in CODE belong to
REPEATS = "repeat_*"
RECORDED = "recorded"  # in a round's folder of what was asked for: a copy of the pictures that scene.yaml names
REFINEMENT = "refinement.json"  # beside a reconstruction whose Gaussians were refined: what it changed


def gathered_scenes(scenes: Sequence[str]) -> list[str]:
    """Those of ``scenes`` that there is something to show of; the others failed on their way."""
    return [scene for scene in scenes if (PAGES / scene).is_dir()]


def source(scene: str) -> Path:
    """The user's folder: photos, scene.yaml, recorded pictures."""
    return SCENES / scene


def config(scene: str) -> Path:
    """The composed configuration."""
    return OUTPUTS / scene / "config.json"


def selection(scene: str) -> Path:
    """Which methods params.yaml asks for: one key per method that is not always made."""
    return OUTPUTS / scene / METHODS_FILE


def given(scene: str, kind: str) -> Path:
    """A folder of links to files that the configuration names, wherever they are: the pipeline depends on their bytes.

    ``kind``: ``generator`` and ``choice`` (a folder per round), ``judge`` (a prompt per criterion), ``lpips`` and ``model`` (weights), or a
    rival's name (weights).
    """
    return GIVEN / scene / kind


def prepared(scene: str) -> Path:
    """The `Scene` artefact."""
    return OUTPUTS / scene / "scene"


def asked(scene: str, number: int) -> Path:
    """The `RoundSpec` of a round, and in `RECORDED` the pictures that it names."""
    return OUTPUTS / scene / "asked" / f"round_{number}"


def round_settings(scene: str) -> Path:
    """How the picture of each round is obtained: sections by `round_key`, apart from `config` so that rounds share nothing here."""
    return OUTPUTS / scene / "rounds.json"


def round_key(number: int) -> str:
    """Of a round's sections in `round_settings`, and its folder of given files."""
    return f"round_{number}"


def proposals(scene: str, number: int) -> Path:
    """The `Proposals` after a round."""
    return round_folder(scene, number) / "proposals"


def held_out(scene: str) -> Path:
    """The `HeldOut` photos as prepared: of the stages, only the one that matches them reads it."""
    return OUTPUTS / scene / "held_out"


def matched_held_out(scene: str) -> Path:
    """The `HeldOut` photos with what ties them to the captured ones."""
    return OUTPUTS / scene / "matched_held_out"


def truth(scene: str) -> Path:
    """What is known of the truth, a `SceneTruth`; empty without any."""
    return OUTPUTS / scene / "truth"


def round_folder(scene: str, number: int) -> Path:
    """Everything of one round; round 0 is the captured scene."""
    return OUTPUTS / scene / f"round_{number}"


def state(scene: str, number: int) -> Path:
    """The `ExpansionState` after a round."""
    return round_folder(scene, number) / MAIN


def match_memory(scene: str) -> Path:
    """The `MatchMemory` of the captured views; empty for models that need no cameras."""
    return round_folder(scene, 0) / "matches"


def reconstruction(scene: str, number: int, method: str) -> Path:
    """The `Reconstruction` that a method made in a round, or why there is none (`Unavailable`)."""
    return round_folder(scene, number) / method / "reconstruction"


def repeat_name(repeat: int) -> str:
    """Folder of one of a method's runs with different seeds: the first is the reconstruction, further ones lie beside it."""
    return REPEATS.replace("*", str(repeat)) if repeat else "reconstruction"


def candidates(scene: str, number: int) -> Path:
    """The `CandidateSet` of a round."""
    return round_folder(scene, number) / "candidates"


def inserted(scene: str, number: int) -> Path:
    """The `InsertedView` of a round."""
    return round_folder(scene, number) / "inserted"


def anchors(scene: str, number: int) -> Path:
    """The `Anchors` of a round."""
    return round_folder(scene, number) / "anchors"


def cameras(folder: Path) -> Path:
    """The `CameraReport` beside the state or the joint priors in ``folder``; absent for models that need no cameras."""
    return folder / "cameras"


def joint_priors(scene: str, number: int) -> Path:
    """`Priors` of all views, the inserted one included."""
    return round_folder(scene, number) / "joint_priors"


def renders(scene: str, number: int, method: str) -> Path:
    """Videos and pictures of a method's reconstruction."""
    return round_folder(scene, number) / "renders" / method


def gaussians(scene: str, number: int, method: str) -> Path:
    """A method's Gaussians as PLY."""
    return renders(scene, number, method) / "gaussians.ply"


def packed(scene: str, number: int, method: str) -> Path:
    """`PackedSplats` of a method's reconstruction, for the page to walk through."""
    return round_folder(scene, number) / "packed" / method


def metrics(scene: str, number: int, method: str) -> Path:
    """Metrics of a method's reconstruction."""
    return round_folder(scene, number) / "metrics" / f"{method}.json"


def held_out_seen(scene: str, number: int, method: str) -> Path:
    """What a method's scene shows of held-out photos, a `HeldOutSeen`."""
    return round_folder(scene, number) / "held_out" / method


def judged(scene: str, number: int) -> Path:
    """The `JudgedRound` of a round."""
    return round_folder(scene, number) / "judged"


def statistics(stage: str, scene: str, number: int | None = None, method: str | None = None) -> Path:
    """Wall time and memory of one stage run: apart from its results, which must repeat bit for bit."""
    folder = OUTPUTS / scene if number is None else round_folder(scene, number)
    return folder / "stats" / f"{'-'.join(part for part in (stage, method) if part)}.json"
