"""Shared test configuration: 64-bit, strict promotion, a persistent compilation cache."""

import os
import tempfile

os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", os.path.join(tempfile.gettempdir(), "dirax-jax-cache"))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.2")

import jax

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_platforms", "cpu")
