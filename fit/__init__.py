"""From scans to one body moving (JAX)."""
