"""From silhouettes to a closed surface: one scan a frame."""
