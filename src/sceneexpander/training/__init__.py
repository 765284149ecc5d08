"""Training of the embedded reconstructor on procedural scenes with known truth, and its scores. Not needed to use the model."""
