"""The CPU rasteriser: `rasteriser.cpp` and the libraries that the install builds from it (none where there is no compiler)."""
