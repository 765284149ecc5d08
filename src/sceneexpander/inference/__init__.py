"""A reconstructor run once on given views, and what it predicted as an artefact."""
