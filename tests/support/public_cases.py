"""The small conformance cases that are part of the repository; `scripts/make_public_cases.py` made them."""

from __future__ import annotations

import json
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import torch
from torch import nn

from sceneexpander.conformance import omnivggt, ttt3r, worldmirror
from sceneexpander.models.omnivggt import OmniVGGT
from sceneexpander.models.ttt3r.model import TTT3R
from sceneexpander.models.worldmirror import WorldMirror
from tests.support.seeded_weights import write_seeded_weights

CASES = Path(__file__).parents[1] / "conformance" / "cases"


@contextmanager
def prepared_case(folder: Path) -> Iterator[Path]:
    """A copy of a case in the recorded layout: with a weights file, which the rule makes."""
    config = json.loads((folder / "config.json").read_text())
    with torch.device("meta"):
        model: nn.Module
        if "runs" not in config:
            model = WorldMirror(worldmirror.config_from_case(config))
        elif "aggregator" in config["model_config"]:
            model = OmniVGGT(omnivggt.config_from_case(config))
        else:
            model = TTT3R(ttt3r.config_from_case(config["model_config"], config["runs"][0]))
    with tempfile.TemporaryDirectory() as scratch:
        case = Path(scratch) / folder.name
        shutil.copytree(folder, case)
        write_seeded_weights(model, case / "weights.safetensors")
        yield case
