"""What a reconstruction or an adaptation will cost, found without its weights: on tensors that have shapes and no numbers."""

from sceneexpander.planning.cost import Cost, Meter
from sceneexpander.planning.simulate import PlanRequest, adaptation_cost, inference_cost, step_views

__all__ = ["Cost", "Meter", "PlanRequest", "adaptation_cost", "inference_cost", "step_views"]
