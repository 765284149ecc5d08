"""What was asked, as a name for what is kept of the answer."""

from __future__ import annotations

import json
from collections.abc import Mapping

from sceneexpander.artifacts.store import sha256_of_bytes, to_plain


def digest_of(content: Mapping[str, object]) -> str:
    """The same for the same content, whatever the order of its keys."""
    return sha256_of_bytes(json.dumps(to_plain(content), sort_keys=True).encode())[:32]
