"""From results to pictures, films and pages; and from a body to a synthetic recording (pyrender)."""
