"""Per-scene 3D Gaussian splatting: the Gaussians of a reconstruction optimised on its pictures.

A baseline of its own when it starts from the unadapted backbone, and an optimisation after the fact for every other method.
"""
