"""``dvc dag`` draws the chain of rounds."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from pathlib import Path

from sceneexpander.pipeline.selection import PARAMS, Selection
from sceneexpander.pipeline.surroundings import LOCAL_CONFIG, local_config

ROOT = Path(__file__).parents[3]


def test_the_drawing_of_a_round_is_the_chain_that_leads_to_it(tmp_path: Path) -> None:
    """Round 3 went another way from round 1, so it knows nothing of round 2; DVC numbers rounds from 0."""
    shutil.copyfile(ROOT / "dvc.yaml", tmp_path / "dvc.yaml")
    (tmp_path / PARAMS).write_text(Selection(scenes=("room",), rounds=4, previous=(0, 1, 1, 3)).to_yaml())
    (tmp_path / LOCAL_CONFIG).parent.mkdir()
    (tmp_path / LOCAL_CONFIG).write_bytes(local_config(cache=None, site=tmp_path / "site", no_scm=True))
    command = [sys.executable, "-m", "dvc", "dag", "--mermaid", "adapt@room-round3"]
    drawn = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True).stdout
    names = dict(re.findall(r'(node\d+)\["(.+?)"\]', drawn))
    edges = {(names[before], names[after]) for before, after in re.findall(r"(node\d+)-->(node\d+)", drawn)}
    rounds = {f"adapt@room-round{k}" for k in range(4)}
    assert {edge for edge in edges if set(edge) <= rounds} == {
        ("adapt@room-round0", "adapt@room-round2"),
        ("adapt@room-round2", "adapt@room-round3"),
    }
    assert ("reconstruct@room", "adapt@room-round0") in edges
    assert not [name for name in names.values() if name.endswith("-round1")]
