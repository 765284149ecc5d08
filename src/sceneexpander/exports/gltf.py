"""GLB files by trimesh, with the statement in the asset and the axes that glTF asks for."""

from __future__ import annotations

from typing import Any

import numpy as np

from sceneexpander.artifacts.store import to_plain
from sceneexpander.errors import UserError
from sceneexpander.exports.statement import Statement

# glTF has y up and z towards the viewer. The root node turns the scene; vertices keep the numbers of the other exports.
GLTF_FROM_WORLD = np.diag([1.0, -1.0, -1.0, 1.0])
AXES = "vertices are in the scene's frame (y down); the root node turns them to glTF's (y up)"


def load_trimesh() -> Any:
    """The package. Raises `UserError` if it is not installed."""
    try:
        import trimesh
    except ImportError:
        raise UserError("needs the package trimesh", where="GLB", fix="pip install 'sceneexpander[exports]'") from None
    return trimesh


def glb_bytes(content: Any, statement: Statement) -> bytes:
    """A trimesh scene as GLB; ``asset.extras`` holds the statement, ``asset.copyright`` its sentence."""
    content.apply_transform(GLTF_FROM_WORLD)

    def add_statement(tree: dict[str, Any]) -> None:
        asset = tree["asset"]
        asset["generator"] = f"{statement.software}, {asset.get('generator', 'trimesh')}"
        asset["copyright"] = statement.sentence()
        asset["extras"] = {"axes": AXES, "statement": statement.sentence(), "about": to_plain(statement)}

    return bytes(content.export(file_type="glb", tree_postprocessor=add_statement))
