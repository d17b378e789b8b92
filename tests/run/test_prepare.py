"""dx.prepare: the bits of simulate, every premise, whatever changes from call to call."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dirax as dx
from dirax.gallery import example_of, names  # noqa: F401  (replaced below)
