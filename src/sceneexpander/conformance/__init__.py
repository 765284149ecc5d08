"""Agreement with recorded outputs of reference implementations: ``sceneexpander conformance``.

Each family of cases registers a `CaseRunner` (how to recognise and run a case) and each released model a `KeyFamily` (how to
recognise its tensor names and build it) in `sceneexpander.conformance.registry`.
"""
