"""64-bit floats in JAX from its first import on, without importing it now."""

import sys
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from importlib.util import find_spec
from types import ModuleType
from typing import Any


def turn_on_in_jax() -> None:
    """Set `jax_enable_x64`, now if JAX has been imported, else as soon as it is."""
    if jax := sys.modules.get("jax"):
        jax.config.update("jax_enable_x64", True)
    else:
        sys.meta_path.insert(0, _FindsJax())


class _FindsJax(MetaPathFinder):
    """Finds JAX as Python does, with a loader that sets the option at the end."""

    def find_spec(self, fullname: str, path: Any = None, target: ModuleType | None = None) -> ModuleSpec | None:
        if fullname != "jax":
            return None
        sys.meta_path.remove(self)
        spec = find_spec(fullname)
        if spec is not None and spec.loader is not None:
            spec.loader = _LoadsJax(spec.loader)
        return spec


class _LoadsJax(Loader):
    """Loads JAX by its own loader and sets the option."""

    def __init__(self, loader: Any):
        self.loader = loader

    def create_module(self, spec: ModuleSpec) -> ModuleType | None:
        return self.loader.create_module(spec)

    def exec_module(self, module: ModuleType) -> None:
        if module.__spec__ is not None:
            module.__spec__.loader = module.__loader__ = self.loader
        self.loader.exec_module(module)
        module.config.update("jax_enable_x64", True)
