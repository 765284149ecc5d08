"""A participant's page: one HTML text with style, script and pictures inside; only its videos lie beside it."""

from __future__ import annotations

import base64
import hashlib
import io
import json
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.resources import files

from PIL import Image

from sceneexpander.study.document import Participant, Study
from sceneexpander.study.spec import LETTERS, StudySpec

_PICTURE_SIDE_PX = 640


@dataclass(frozen=True, slots=True)
class PagePicture:
    """A picture as the page holds it, without anything that its file said besides."""

    data_uri: str

    @classmethod
    def of(cls, picture: Image.Image) -> PagePicture:
        """A JPEG of at most 640 px."""
        small = picture.convert("RGB")
        small.thumbnail((_PICTURE_SIDE_PX, _PICTURE_SIDE_PX))
        buffer = io.BytesIO()
        small.save(buffer, format="JPEG", quality=88)
        return cls("data:image/jpeg;base64," + base64.b64encode(buffer.getvalue()).decode("ascii"))


def study_page(study: Study, participant: Participant, spec: StudySpec, pictures: Mapping[str, PagePicture]) -> str:
    """The HTML text. It names no method, no scene and no token; addresses in it are relative to where it is served.

    Args:
        study: as built.
        participant: whose page it is.
        spec: for the words.
        pictures: by scene; scenes without one have words alone.
    """
    scenes = list(dict.fromkeys(screen.scene for screen in participant.screens))
    facts = {
        # Two studies, or two participants on one machine, must not share what the browser keeps.
        "keep": study.sign("browser", participant.name)[:16],
        "minimum_s": study.minimum_s,
        "letters": LETTERS[: len(study.methods)],
        "requests": [
            {"prompt": study.scene(name).prompt, "picture": pictures[name].data_uri if name in pictures else None}
            for name in scenes
        ],
        "questions": {
            screen.criterion.value: {
                "title": spec.questions.of(screen.criterion).title,
                "text": spec.questions.of(screen.criterion).text,
            }
            for screen in participant.screens
        },
        "screens": [
            {
                "name": screen.name,
                "request": scenes.index(screen.scene),
                "question": screen.criterion.value,
                "videos": screen.videos,
            }
            for screen in participant.screens
        ],
    }
    import jinja2
    from markupsafe import Markup

    folder = files("sceneexpander.study") / "templates"
    texts = {name: (folder / name).read_text(encoding="utf-8") for name in ("study.html.j2", "study.css", "study.js")}
    environment = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    # Script text is not HTML: only what ships with the package, and JSON in which nothing can end the script, goes in as it is.
    return environment.from_string(texts["study.html.j2"]).render(
        title=spec.title,
        contact=spec.contact,
        paragraphs=[part for part in spec.consent.split("\n\n") if part.strip()],
        screens=len(participant.screens),
        count=len(study.methods),
        css=Markup(texts["study.css"]),  # noqa: S704
        js=Markup(texts["study.js"]),  # noqa: S704
        css_hash=_hash(texts["study.css"]),
        js_hash=_hash(texts["study.js"]),
        facts=Markup(json.dumps(facts, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")),  # noqa: S704
    )


def _hash(text: str) -> str:
    return "sha256-" + base64.b64encode(hashlib.sha256(text.encode()).digest()).decode("ascii")
