"""What `dirax cache` shows of the compiled kernels on the disk, and how it removes them."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from dirax.engines.native import kernel_cache


def described() -> dict[str, Any]:
    """Where the kernels are, how many and how large they are, and how many may be."""
    folder, most = kernel_cache.cache_folder(), kernel_cache.limits()
    held = _in(folder, kernel_cache.contents)
    place = None if folder is None else str(folder)
    return {"folder": place, "kernels": held.files, "bytes": held.size, "most_kernels": most.files, "most_bytes": most.size}


def cleared() -> dict[str, Any]:
    """Remove all kernels: the same then, and how many were removed."""
    removed = _in(kernel_cache.cache_folder(), kernel_cache.clear)
    return described() | {"removed_kernels": removed.files, "removed_bytes": removed.size}


def _in(folder: Path | None, action: Callable[[], kernel_cache.Contents]) -> kernel_cache.Contents:
    """What an action on the cache gives. Raises `NotADirectoryError` where a file is in the place of its folder."""
    try:
        return action()
    except NotADirectoryError:
        raise NotADirectoryError(
            f"the kernel cache cannot be in {folder}, since a part of that path is a file: set the environment variable "
            "DIRAX_CACHE to a folder, or to off."
        ) from None


def sentence(found: dict[str, Any]) -> str:
    """The description in words."""
    if found["folder"] is None:
        return "No compiled kernels are kept on the disk: DIRAX_CACHE is off, or the system does not say whose a file is."
    if "removed_kernels" in found:
        return f"{_amount(found['removed_kernels'], found['removed_bytes'])} removed from {found['folder']}."
    most = _amount(found["most_kernels"], found["most_bytes"])
    return f"{_amount(found['kernels'], found['bytes'])} in {found['folder']}, of at most {most}."


def _amount(kernels: int, size: int) -> str:
    return f"{kernels} kernel{'' if kernels == 1 else 's'} ({size / 1e6:.1f} MB)"
