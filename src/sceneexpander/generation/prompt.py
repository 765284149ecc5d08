"""From the user's words to the full instruction for an image generator."""

from __future__ import annotations

import re
from dataclasses import dataclass

from sceneexpander.artifacts.scene import RoundSpec

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
    """The template with the round's words.

    ``motion`` fills the first field and ``new_object`` the second. A free sentence (``prompt`` without ``new_object``) takes the place
    of the second field. Without ``motion`` the first field and the separator are left out. Words of the user are inserted as they are;
    only white space, a separator at the end of the motion and a full stop at the end of the object are tidied.
    """
    motion = " ".join(spec.motion.split()).rstrip(" ,;.")
    content = " ".join((spec.new_object or spec.prompt).split()).rstrip(" .")
    if motion and not spec.new_object and content == motion:
        content = ""  # the sentence was made from the motion alone
    values = f"{motion}{template.separator}{content}" if motion and content else motion or content
    if not values:
        raise ValueError("a round without words cannot fill the template")
    both = re.escape(f"{MOTION_FIELD}{template.separator}{OBJECT_FIELD}")
    # A function as replacement: what the user wrote is never read as a pattern or as a field.
    return re.sub(both, lambda _: values, template.text, count=1)
