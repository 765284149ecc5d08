"""Test-time adaptation: Algorithm 1 of the paper."""

from sceneexpander.adaptation.config import AdaptConfig, AugmentConfig, DepthDistance, DriftForm, Gauge, SubsetRule

__all__ = ["AdaptConfig", "AugmentConfig", "DepthDistance", "DriftForm", "Gauge", "SubsetRule"]
