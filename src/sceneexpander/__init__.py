"""Text-guided 3D scene expansion by test-time adaptation of feed-forward reconstructors."""

__version__ = "0.1.0"
