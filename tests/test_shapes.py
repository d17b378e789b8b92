"""The shapes written in signatures are those that come and go: a walk through the package under beartype.

In a process of its own, since what is checked must not have been imported before; whole test folders under the hook would take
several times as long.
"""

import subprocess
import sys
from pathlib import Path

ROOMS = "numerics program geometry systems reduction schemes engines solution run diagnostics"
CHECKED = tuple(f"dirax.{room}" for room in ROOMS.split())


def run(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, *arguments], capture_output=True, text=True)


def test_signatures_hold_on_a_walk_through_the_package():
    walk = run(str(Path(__file__).with_name("walk_through.py")), *CHECKED)
    assert walk.returncode == 0, walk.stderr


def test_a_wrong_shape_is_found():
    program = (
        "from jaxtyping import install_import_hook; install_import_hook(['dirax.geometry'], 'beartype.beartype')\n"
        "import jax.numpy as jnp, dirax; dirax.SphereProjection().forward(jnp.ones((2, 3)), jnp.ones(3))"
    )
    wrong = run("-c", program)
    assert wrong.returncode == 1 and "TypeCheckError" in wrong.stderr
