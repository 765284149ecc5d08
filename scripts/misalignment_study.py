"""What the misalignment report says of pictures whose errors are known: python scripts/misalignment_study.py --scenes room_2 --cache FOLDER

Per scene of the benchmark and grade one line: stretch and zoom as found, shares, and how the marks compare with the truth.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import torch

from sceneexpander.artifacts.views import to_uint8
from sceneexpander.config.compose import compose
from sceneexpander.config.parse import parse_dataclass
from sceneexpander.config.schema import ProjectConfig
from sceneexpander.errors import entry_point
from sceneexpander.expandbench import BenchScene, build_scene
from sceneexpander.expandbench.grades import Grade, grade_named
from sceneexpander.expandbench.prepared import PreparedScene, prepare_scene
from sceneexpander.expansion import load_model
from sceneexpander.generation import SceneSoFar
from sceneexpander.generation.assess import frame_of
from sceneexpander.generation.misalignment import Misaligned, report_misalignment
from sceneexpander.ingest.fit import fit_picture
from sceneexpander.pipeline.project import find_project

GRADES = "clean,stretch_4,stretch_8,zoom_10,zoom_20,shift_5,mixed_2,hallucinate"


def hallucinated(scene: BenchScene, grade: Grade) -> np.ndarray:
    """(height, width) pixels of the stored picture that show an object which is nowhere."""
    drawn = scene.draw(grade.misalignment)
    names = drawn.world.object_names
    made = [index for index, name in enumerate(names) if name.startswith("hallucinated ")]
    marked: np.ndarray = np.isin(drawn.object_id, made)[1::2, 1::2]
    return marked


def line(scene: BenchScene, grade: Grade, found: Misaligned) -> str:
    """The report and the truth."""
    report = found.report
    text = f"{scene.name:14s} {grade.name:12s} "
    if found.support is None:
        return text + report.words
    truly_new = float(scene.intended.new_region.float().mean())
    text += (
        f"stretch {report.stretch} focal {report.focal_factor:.3f} inliers {report.inliers}/{report.matches} "
        f"supported {report.supported:.2f} contradicted {report.contradicted:.3f} new {report.new:.2f} (truly {truly_new:.2f})"
    )
    object_px = hallucinated(scene, grade) & ~scene.intended.new_region.numpy()
    if object_px.sum() > 20:
        marked = found.support.numpy() < 0.5
        text += f" object: {marked[object_px].mean():.2f} of it marked, {marked[~object_px].mean():.3f} of the rest"
    return text


def study_scene(name: str, options: argparse.Namespace, config: ProjectConfig) -> None:
    """Print the lines of a scene."""
    scene, loaded = build_scene(name), load_model(config.model)
    cache = options.cache / name
    cache.mkdir(parents=True, exist_ok=True)
    before: PreparedScene = prepare_scene(scene, loaded, config.frontend, config.warmup, cache)
    so_far = SceneSoFar(views=before.state.views, reconstruction=before.captured)
    for grade in (grade_named(grade) for grade in options.grades.split(",")):
        view, _ = scene.insert(grade.misalignment)
        picture = fit_picture(to_uint8(view.detail_images[0]), frame_of(before.state.views), "crop")
        found = report_misalignment(picture, so_far, seed=config.seed)
        print(line(scene, grade, found), flush=True)


@entry_point
def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--scenes", required=True)
    parser.add_argument("--grades", default=GRADES)
    parser.add_argument("--cache", type=Path, required=True, help="prepared scenes, reused")
    parser.add_argument("overrides", nargs="*", metavar="key=value")
    options = parser.parse_intermixed_args()
    config = parse_dataclass(
        ProjectConfig, compose(find_project() / "conf", ["experiment=expandbench", *options.overrides])
    )
    torch.set_num_threads(config.threads or 1)
    for name in options.scenes.split(","):
        study_scene(name, options, config)


if __name__ == "__main__":
    main()
