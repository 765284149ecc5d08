"""Text-guided 3D scene expansion by test-time adaptation of feed-forward reconstructors."""

__version__ = "0.1.0"

import sys

if sys.argv[:1] == ["-m"]:  # the interpreter is looking for the program of `python -m sceneexpander...`
    from sceneexpander.errors import quiet_start

    quiet_start()
