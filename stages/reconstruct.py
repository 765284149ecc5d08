"""reconstruct: round 0. Cameras and depth of the captured views, the warm-up, and the scene the model sees in them."""

from __future__ import annotations

from dataclasses import asdict, dataclass

from sceneexpander.artifacts.scene import Scene
from sceneexpander.artifacts.store import write_json_atomic
from sceneexpander.config.files import read_sections
from sceneexpander.files import directory_being_written
from sceneexpander.frontend.memory import MatchMemory
from sceneexpander.frontend.prior import FrontendConfig
from sceneexpander.photometric.config import WarmupConfig
from sceneexpander.pipeline.progress import progress_bar
from sceneexpander.reconstruction.cameras import report_cameras
from sceneexpander.reconstruction.initial import initial_state
from sceneexpander.reconstruction.loaded import ModelConfig, load_model
from sceneexpander.reconstruction.memory import save_memory
from stages import layout
from stages.machine import use_machine
from stages.runner import Cell, stage


@dataclass(frozen=True, slots=True, kw_only=True)
class Sections:
    """What this stage reads of the configuration."""

    seed: int
    device: str
    threads: int
    model: ModelConfig
    frontend: FrontendConfig
    warmup: WarmupConfig


@stage("scene")
def main(cell: Cell) -> None:
    """Make the state that round 1 starts from."""
    sections = read_sections(layout.config(cell.scene), Sections)
    use_machine(sections.threads)
    scene = Scene.load(layout.prepared(cell.scene))
    loaded = load_model(sections.model, sections.device)
    memory = MatchMemory()
    with progress_bar(f"warm-up {cell.scene}", sections.warmup.steps) as bar:
        state, reconstruction, sparse, warmup = initial_state(
            scene,
            loaded,
            sections.frontend,
            sections.warmup,
            seed=sections.seed,
            on_step=lambda step, loss: bar.update(step, loss),
            memory=memory,
        )
    cameras = None if sparse is None else report_cameras(state.views, sparse)
    with directory_being_written(layout.match_memory(cell.scene)) as folder:
        save_memory(folder, memory)
    with directory_being_written(layout.state(cell.scene, 0)) as folder:
        if cameras is not None:
            cameras.save(layout.cameras(folder))
        state.save(folder)
        reconstruction.save(folder / "reconstruction")
        facts = {
            "model": loaded.model.name,
            "weights_sha256": loaded.weights_sha256,
            "licence": loaded.licence,
            "warmup": None if warmup is None else asdict(warmup) | {"accepted": warmup.accepted},
            "sparse_points": None if sparse is None else int(sparse.sparse.points_world.shape[0]),
        }
        write_json_atomic(folder / "report.json", facts)


if __name__ == "__main__":
    main()
