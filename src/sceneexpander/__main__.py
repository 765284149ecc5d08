"""``python -m sceneexpander``: the same as ``sceneexpander``, where the script is not installed."""

from sceneexpander.cli.main import main

main()
