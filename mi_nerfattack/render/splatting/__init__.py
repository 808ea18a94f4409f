"""A rasteriser of 3D Gaussian splats, for any rays."""
