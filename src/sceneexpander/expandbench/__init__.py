"""expandbench: scene expansion with known truth. Procedural scenes, an inserted view with graded misalignment, errors of the result."""

from sceneexpander.expandbench.grades import GRADES, Grade
from sceneexpander.expandbench.measure import BenchNumbers, measure
from sceneexpander.expandbench.prepared import PreparedCase, prepare_case
from sceneexpander.expandbench.scenes import SCENES, BenchScene, build_scene

__all__ = [
    "GRADES",
    "SCENES",
    "BenchNumbers",
    "BenchScene",
    "Grade",
    "PreparedCase",
    "build_scene",
    "measure",
    "prepare_case",
]
