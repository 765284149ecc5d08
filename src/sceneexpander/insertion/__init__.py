"""What is ours around Algorithm 1: corrections of a round's inputs, weights and scene. Modules are imported one by one."""
