"""How a process of this project is set up: 64 bits and the persistent compilation cache.

The library itself leaves `jax.config` alone; programs (cli, experiments, benchmarks, tests, worker
processes) call `setup_jax` once, before the first array.
"""

import os
import tempfile
from pathlib import Path


def cache_folder() -> Path:
    """Folder of the user's compilation cache; a temporary one where the home cannot be written."""
    base = os.environ.get("XDG_CACHE_HOME")
    folder = Path(base) if base else Path(os.path.expanduser("~")) / ".cache"
    folder = folder / "hector_jax" / "jax"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe = tempfile.TemporaryFile(dir=folder)
        probe.close()
    except OSError:
        folder = Path(tempfile.gettempdir()) / f"hector_jax-{os.getuid()}" / "jax"
        folder.mkdir(parents=True, exist_ok=True)
    return folder


def setup_jax() -> None:
    """Turn on 64 bits, full precision and the compilation cache; call before the first array."""
    import jax

    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_default_matmul_precision", "highest")
    jax.config.update("jax_compilation_cache_dir", str(cache_folder()))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
