"""The declared pipeline (``dvc.yaml``) and what runs it: DVC, or the plain runner where there is no DVC.

`dvc_adapter` is the one place that touches DVC's Python code; `declared` reads ``dvc.yaml`` without it; `plain` runs what it reads.
"""
