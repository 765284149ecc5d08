"""Text-guided 3D scene expansion by test-time adaptation of feed-forward reconstructors."""

__version__ = "0.3.0"

import sys
from pathlib import Path

# A command can be run by its own name as well: `python -m sceneexpander.expand` is found in cli/. Imports name the room.
__path__.append(str(Path(__file__).with_name("cli")))

if sys.argv[:1] == ["-m"]:  # the interpreter is looking for the program of `python -m sceneexpander...`
    from sceneexpander.errors import quiet_start

    quiet_start()
