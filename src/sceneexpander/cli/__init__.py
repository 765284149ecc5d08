"""What people type: ``sceneexpander COMMAND``. Nothing heavy is imported before a command is known."""
