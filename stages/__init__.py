"""One thin file per pipeline stage: read the declared sections and artefacts, call the library once, save."""

import sceneexpander  # noqa: F401 - first of all: it says what an interrupt does while the rest is imported
