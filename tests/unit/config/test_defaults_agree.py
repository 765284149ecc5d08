"""conf/ is the whole truth of a run; the code's own defaults must say the same, or a tuned value is silently lost."""

from pathlib import Path

import pytest
import yaml

from sceneexpander.adaptation.config import AdaptConfig
from sceneexpander.artifacts.store import to_plain
from sceneexpander.evaluation.config import EvaluateConfig
from sceneexpander.frontend.prior import FrontendConfig
from sceneexpander.inference.config import RivalConfig, RivalsConfig
from sceneexpander.ingest import IngestConfig
from sceneexpander.insertion.config import CorrectionsConfig
from sceneexpander.optimisation.config import OptimiseConfig
from sceneexpander.photometric.config import RefineConfig
from sceneexpander.rendering import RenderConfig

CONF = Path(__file__).parents[3] / "conf"


@pytest.mark.parametrize(
    ("group", "default"),
    [
        ("frontend", FrontendConfig()),
        ("adapt", AdaptConfig()),
        ("corrections", CorrectionsConfig()),
        ("evaluate", EvaluateConfig()),
        ("scene", IngestConfig()),
        ("optimise", OptimiseConfig()),
        ("refine", RefineConfig()),
        ("rivals", RivalsConfig(omnivggt=RivalConfig(), ttt3r=RivalConfig(long_side_px=512))),
        ("render", RenderConfig()),
    ],
)
def test_the_default_group_equals_the_default_of_the_code(group: str, default: object) -> None:
    assert yaml.safe_load((CONF / group / "default.yaml").read_text()) == to_plain(default)
