"""From the user's words to the full instruction for an image generator."""

from __future__ import annotations

import re
from dataclasses import dataclass

from sceneexpander.artifacts.scene import RoundSpec
from sceneexpander.errors import UserError
from sceneexpander.generation.motion import is_motion

_BREAK = re.compile(
    r"\s*[,;]\s*(?:and\s+)?|\s*\.(?!\d)\s*|\s+(?:and then|and|then)\s+|\s+(?:to (?:see|show|reveal)|so that (?:we|you) see)\s+",
    re.IGNORECASE,
)
MOTION_FIELD = "[CAMERA_MOTION]"
OBJECT_FIELD = "[NEW_OBJECT]"


@dataclass(frozen=True, slots=True, kw_only=True)
class PromptTemplate:
    """An instruction with the two fields of the paper. ``separator`` is what stands between them and goes when one is not filled."""

    text: str
    separator: str = ", "

    def __post_init__(self) -> None:
        both = f"{MOTION_FIELD}{self.separator}{OBJECT_FIELD}"
        if self.text.count(both) != 1:
            raise ValueError(f"the template must hold {both!r} exactly once: {self.text!r}")


# Paper, appendix "Inserted View Generation Details".
EXPLORATION = PromptTemplate(
    text="You are exploring. Please generate a new viewpoint following the requirements: [CAMERA_MOTION], [NEW_OBJECT]."
)


def fill_prompt(spec: RoundSpec, template: PromptTemplate = EXPLORATION) -> str:
    """The template with the round's words, as `split_words` reads them.

    Without a motion the first field and the separator are left out. Words of the user are inserted as they are; only white space, a
    separator at the end of the motion and a full stop at the end of the object are tidied.

    Raises:
        UserError: there are no words at all.
    """
    motion, content = split_words(spec)
    values = f"{motion}{template.separator}{content}" if motion and content else motion or content
    if not values:
        raise UserError(
            "has no words in it", where="prompt", fix='say what to add, e.g. "Behind the table is a bench."'
        )
    both = re.escape(f"{MOTION_FIELD}{template.separator}{OBJECT_FIELD}")
    # A function as replacement: what the user wrote is never read as a pattern or as a field.
    return re.sub(both, lambda _: values, template.text, count=1)


def split_words(spec: RoundSpec) -> tuple[str, str]:
    """(camera motion, new object) of a round; either may be empty.

    ``motion`` and ``new_object`` are what they are where they are given. A free sentence (``prompt``) is split by these rules, in order:

    1. The longest beginning that is a camera motion (`sceneexpander.generation.motion`: a verb such as *move*, *turn*, *look*, *orbit*
       comes first, and all of it is understood) and ends at a comma, semicolon, full stop, *and* or *then* is the motion: *"Turn right
       30 degrees, there is a well"*.
    2. *to see*, *to show*, *to reveal*, *so that we see* end a motion as well, and belong to neither field: *"Move back to reveal a
       bench"*.
    3. Everything else is the new object. A sentence about a place (*"Behind the table is a bench"*) has no motion.
    """
    motion, content = _tidied(spec.motion, ",;."), _tidied(spec.new_object or spec.prompt, ".")
    if motion or spec.new_object:
        # Of a motion alone the sentence was made from the motion.
        return motion, "" if not spec.new_object and _tidied(content, ",;.") == motion else content
    for end, start in reversed(_breaks(content)):
        if is_motion(content[:end]):
            return _tidied(content[:end], ",;."), _tidied(content[start:], ".")
    return "", content


def _breaks(text: str) -> list[tuple[int, int]]:
    """Where a motion may end, and where what follows it begins."""
    found = [(match.start(), match.end()) for match in _BREAK.finditer(text)]
    return [*found, (len(text), len(text))]


def _tidied(text: str, ends: str) -> str:
    return " ".join(text.split()).rstrip(f" {ends}")
