"""Scenes to walk through: a live viewer on this machine, and a page of its own that needs neither server nor network."""
