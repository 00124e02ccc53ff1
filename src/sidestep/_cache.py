"""Compiled code that is kept from process to process.

The environment variable `SIDESTEP_CACHE` names the folder; `off` keeps nothing. Without it the folder is that of the
user's caches.
"""

import hashlib
import os
import warnings
from contextlib import suppress
from pathlib import Path
from typing import Any

from sidestep._files import write_whole
from sidestep.errors import InputError

_OFF = "off"
_UNREADABLE = "Error reading persistent compilation cache entry for '"
"""The beginning of JAX's warning of a damaged entry."""


_folder: Path | None = None


def cache_folder() -> Path | None:
    """Return the folder for compiled code; None where it is turned off or cannot be written."""
    setting = os.environ.get("SIDESTEP_CACHE")
    if setting == _OFF:
        return None
    if setting:
        folder = Path(setting)
    else:
        from platformdirs import user_cache_path

        folder = user_cache_path("sidestep")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return None
    return folder if os.access(folder, os.W_OK) else None


def kept_in() -> Path | None:
    """Return the folder in which this process keeps compiled code; None where it does not."""
    return _folder


def keep_entry(path: Path, content: bytes) -> None:
    """Write an entry with a checksum; a folder that cannot be written is no reason to stop."""
    with suppress(InputError):
        write_whole(path, lambda file: file.write(hashlib.sha256(content).digest() + content))


def kept_entry(path: Path) -> bytes | None:
    """Return the content of an entry; None if it is missing or damaged."""
    try:
        content = path.read_bytes()
    except OSError:
        return None
    digest = hashlib.sha256().digest_size
    return content[digest:] if hashlib.sha256(content[digest:]).digest() == content[:digest] else None


def keep_compiled_code() -> None:
    """Make JAX keep compiled code in `cache_folder`, for the command line; a library leaves JAX's settings alone.

    JAX recompiles a damaged entry but does not replace it. So the handler of its warning removes the entry, and JAX
    writes it anew.
    """
    global _folder  # noqa: PLW0603
    _folder = folder = cache_folder()
    if folder is None:
        return
    import jax

    jax.config.update("jax_compilation_cache_dir", str(folder / "jax"))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
    show = getattr(warnings.showwarning, "shows_by", warnings.showwarning)

    def remove_damaged(message: Warning | str, *arguments: Any, **options: Any) -> None:
        text = str(message)
        if not text.startswith(_UNREADABLE):
            show(message, *arguments, **options)
            return
        name = text.removeprefix(_UNREADABLE).partition("'")[0]
        for entry in (folder / "jax").glob(f"{name}-*"):
            with suppress(OSError):
                entry.unlink()

    remove_damaged.shows_by = show  # pyright: ignore[reportFunctionMemberAccess]
    warnings.showwarning = remove_damaged
