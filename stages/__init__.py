"""One thin file per pipeline stage: read the declared sections and artefacts, call the library once, save."""
