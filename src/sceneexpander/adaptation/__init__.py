"""Test-time adaptation: Algorithm 1 of the paper. Modules are imported one by one: a stage depends on what it runs."""
