"""From views to a reconstruction, before anything is adapted. Modules are imported one by one: a stage depends on what it runs."""
