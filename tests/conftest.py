"""Shared test configuration: a compilation cache, reproducible examples, strict promotion, figures without a screen."""

import atexit
import functools
import gc
import os
import tempfile

os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", os.path.join(tempfile.gettempdir(), "dirax-jax-cache"))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
os.environ.setdefault("JAX_PLATFORMS", "cpu")
os.environ.setdefault("MPLBACKEND", "Agg")
# most of a test's time is compilation: less optimization halves it, and changes last digits at most; small modules
# are compiled faster in one piece than cut up for several threads
QUICK = ("backend_optimization_level=0", "cpu_use_fusion_emitters=false", "cpu_parallel_codegen_split_count=1")
os.environ.setdefault("XLA_FLAGS", " ".join(f"--xla_{flag}" for flag in QUICK))
# what is compiled does not say from which lines it comes, which takes a twentieth of the time
os.environ.setdefault("JAX_TRACEBACK_IN_LOCATIONS_LIMIT", "0")

gc.set_threshold(50_000, 20, 100)  # tracing makes many objects that live

import hypothesis
import jax
import pytest

from dirax.engines.native import kernels

jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")

kernels.FEW = 0  # code of few operations is compiled with little optimization too, which changes no bit

hypothesis.settings.register_profile("dirax", deadline=None, derandomize=True)
hypothesis.settings.load_profile("dirax")

# each of many small modules is made in a context of its own, which takes as long as a tenth of the module and is kept
mlir = jax._src.interpreters.mlir
mlir.make_ir_context = functools.cache(mlir.make_ir_context)

atexit.unregister(jax._src.api.clean_up)  # seconds, in which all that was compiled is let go, one by one


def pytest_itemcollected(item):
    """`@pytest.mark.soak_of("id", …)`: of the parameters of a test those with these ids are soaked, or all `but` some."""
    if (marker := item.get_closest_marker("soak_of")) is not None:
        kept = marker.kwargs.get("but")
        if item.callspec.id not in kept if kept is not None else item.callspec.id in marker.args:
            item.add_marker("soak")


def pytest_collection_modifyitems(items):
    """The pages of the documentation and walks through the whole package are long: they go first, so that no worker is left with
    one at the end."""
    items.sort(key=lambda item: len(item.path.relative_to(item.config.rootpath).parts))


def pytest_collection_finish():
    """Before its first test hypothesis looks through all objects there are, which are few now."""
    hypothesis.given(hypothesis.strategies.none())(lambda nothing: None)()


def pytest_sessionfinish():
    gc.freeze()  # pytest collects garbage several times when it ends: nothing of what lives now is looked at again


@pytest.fixture
def compiled():
    """The compilations of XLA since the test began."""
    found = []
    listener = lambda event, duration, **_: found.append(event) if event.endswith("backend_compile_duration") else None
    jax.monitoring.register_event_duration_secs_listener(listener)
    yield found
    jax.monitoring.unregister_event_duration_listener(listener)
