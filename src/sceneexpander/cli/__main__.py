"""``python -m sceneexpander.cli``: the same as ``python -m sceneexpander``."""

from sceneexpander.cli.main import main

main()
