"""One scene as one HTML file: no server, no network, no other file; a browser with WebGL 2 is all it needs."""

from __future__ import annotations

import base64
import gzip
import io
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from typing import Any

from jaxtyping import Float
from PIL import Image
from torch import Tensor

from sceneexpander.artifacts.views import to_uint8
from sceneexpander.geometry.rigid import rigid_inverse
from sceneexpander.splatting.video import GENERATED_TINT
from sceneexpander.viewer.cameras import ShownCameras, alignment, frustum_length, up_direction
from sceneexpander.viewer.packed import PackedSplats

PICTURE_SIDE_PX = 192  # of the pictures in the frusta
BACKGROUND = 0.5  # grey: what is not there looks like nothing, and not like something black
TINT_STRENGTH = 0.45  # as in the provenance video


@dataclass(frozen=True, slots=True, kw_only=True)
class ShownMethod:
    """A method of the page and what its button says."""

    splats: PackedSplats
    label: str


def viewer_page(
    title: str,
    subtitle: str,
    methods: Sequence[ShownMethod],
    pictures: Mapping[str, Float[Tensor, "3 height width"]],
    *,
    background: float = BACKGROUND,
) -> str:
    """The HTML text. The same input gives the same bytes.

    Args:
        title: name of the scene.
        subtitle: the sentence of the round.
        methods: in the order of their buttons; the last one is shown first, and all are brought into its frame.
        pictures: by view id, for the frusta; views without one get an empty frustum.
        background: grey, in [0, 1].
    """
    if not methods:
        raise ValueError("a page needs at least one method")
    main = methods[-1].splats.cameras
    facts = {
        "methods": [_method(item, main) for item in methods],
        "pictures": {view: _data_uri(picture) for view, picture in pictures.items()},
        "up": up_direction(main).tolist(),
        "frustum": frustum_length(main),
        "background": background,
        "tint": [*GENERATED_TINT, TINT_STRENGTH],
    }
    import jinja2
    from markupsafe import Markup

    folder = files("sceneexpander.viewer") / "templates"
    texts = {
        name: (folder / name).read_text(encoding="utf-8") for name in ("viewer.html.j2", "viewer.css", "viewer.js")
    }
    environment = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    # Script text is not HTML: only what ships with the package, and JSON in which nothing can end the script, goes in as it is.
    return environment.from_string(texts["viewer.html.j2"]).render(
        title=title,
        subtitle=subtitle,
        css=Markup(texts["viewer.css"]),  # noqa: S704
        js=Markup(texts["viewer.js"]),  # noqa: S704
        facts=Markup(_script_json(facts)),  # noqa: S704
        splats=[{"name": item.splats.method, "data": _compressed(item.splats)} for item in methods],
    )


def _method(item: ShownMethod, main: ShownCameras) -> dict[str, Any]:
    splats = item.splats
    main_from_method = alignment(splats.cameras, main)
    cameras = splats.cameras.transformed(main_from_method)
    return {
        "name": splats.method,
        "label": item.label,
        "count": splats.count,
        "total": splats.total,
        "worst_view_db": splats.worst_view_db,
        "origin": splats.origin,
        "reach": splats.reach,
        "log_scale": [splats.log_scale_low, splats.log_scale_high],
        "antialiased": splats.antialiased,
        "main_from_method": {
            "scale": main_from_method.scale,
            "rotation": main_from_method.rotation.tolist(),
            "translation": main_from_method.translation.tolist(),
        },
        "width": cameras.width,
        "height": cameras.height,
        "views": [
            {
                "id": view,
                "generated": bool(cameras.generated[index]),
                "posed": bool(cameras.posed[index]),
                "world_from_cam": cameras.world_from_cam[index].tolist(),
                "cam_from_world": rigid_inverse(cameras.world_from_cam[index]).tolist(),
                "intrinsics": [
                    float(cameras.intrinsics_px[index][place]) for place in ((0, 0), (1, 1), (0, 2), (1, 2))
                ],
                "focus": float(cameras.focus[index]),
            }
            for index, view in enumerate(cameras.view_ids)
        ],
    }


def _compressed(splats: PackedSplats) -> str:
    # No time stamp inside: the bytes depend on the scene alone.
    return base64.b64encode(gzip.compress(splats.data.numpy().tobytes(), compresslevel=9, mtime=0)).decode("ascii")


def _data_uri(picture: Float[Tensor, "3 height width"]) -> str:
    small = Image.fromarray(to_uint8(picture))
    small.thumbnail((PICTURE_SIDE_PX, PICTURE_SIDE_PX))
    buffer = io.BytesIO()
    small.save(buffer, format="JPEG", quality=80)
    return "data:image/jpeg;base64," + base64.b64encode(buffer.getvalue()).decode("ascii")


def _script_json(content: object) -> str:
    return json.dumps(content, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")
