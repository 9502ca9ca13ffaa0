"""The one place where JAX is configured: double precision and a compilation cache that is kept."""

from functools import cache
from pathlib import Path


@cache
def setup_jax() -> Path | None:
    """Enable float64 and the persistent compilation cache; returns its folder (None where it cannot be
    written).

    Call before the first JAX array is made; further calls do nothing. Never called at import.
    """
    import jax
    from platformdirs import user_cache_path

    jax.config.update("jax_enable_x64", True)
    folder = user_cache_path("bodyhull", appauthor=False) / "jax"
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return None  # a read-only home only costs the compile time again
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)
    return folder
