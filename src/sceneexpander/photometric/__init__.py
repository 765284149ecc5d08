"""Learning from rendered pictures: warm-up, Gaussian head, and the fit of Gaussians. Modules are imported one by one."""
