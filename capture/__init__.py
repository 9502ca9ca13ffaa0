"""From files on disk to calibrated silhouettes (numpy, OpenCV, pycolmap; never JAX)."""
