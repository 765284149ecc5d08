"""TTT3R: the recurrent reconstructor CUT3R with a test-time rate for the update of its state."""

from sceneexpander.models.ttt3r.config import TTT3RConfig
from sceneexpander.models.ttt3r.model import TTT3R

__all__ = ["TTT3R", "TTT3RConfig"]
