"""Random systems: L = ½ vᵀM(q)v + A(q)·v − V(t, q) with forces, one-forms, affine parts, holonomic constraints, moving ones and
ones that follow from others.

All coefficients are parameters, so that what is compiled serves every system of one kind."""

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import dirax as dx

WAVES = 3
"""Terms of each random function of q."""


@dataclass(frozen=True)
class Kind:
    """What a system has; `m` one-forms and `c` holonomic constraints of `n` coordinates."""

    n: int
    m: int = 0
    c: int = 0
    curved: bool = True
    magnetic: bool = False
    timed: bool = False
    forced: bool = False
    affine: bool = False
    moving: bool = False
    redundant: bool = False

    @classmethod
    def drawn(cls, draw: np.random.Generator) -> "Kind":
        """A random one that leaves a degree of freedom."""
        n = int(draw.integers(2, 5))
        m, c = draw.multinomial(int(draw.integers(0, n)), [0.5, 0.5]).tolist() if draw.random() < 0.7 else (0, 0)
        m, c = min(m, 1), min(c, 1)
        flags = draw.random(7) < 0.4
        curved, magnetic, timed, forced = map(bool, flags[:4])
        affine, moving, redundant = bool(flags[4] and m), bool(flags[5] and c), bool(flags[6] and (m or c) and n > 2)
        return cls(n, m, c, curved, magnetic, timed, forced, affine, moving, redundant)


def waves(coefficients: dict, q: Any) -> Any:
    """Σ a cos(w·q + φ), one number for each leading axis of the coefficients."""
    return jnp.sum(coefficients["a"] * jnp.cos(coefficients["w"] @ q + coefficients["phase"]), axis=-1)


def drawn_waves(draw: np.random.Generator, n: int, *shape: int, size: float = 1.0) -> dict:
    return {
        "a": size * draw.uniform(-1, 1, (*shape, WAVES)),
        "w": draw.uniform(-1.2, 1.2, (*shape, WAVES, n)),
        "phase": draw.uniform(0, 6, (*shape, WAVES)),
    }


class RandomSystem:
    """The functions of a kind; `parameters(draw)` makes a system of it, with its initial data."""

    def __init__(self, kind: Kind):
        self.kind = kind
        timed = lambda function: (
            (lambda t, q, v, p: function(t, q, v, p)) if kind.timed else (lambda q, v, p: function(0.0, q, v, p))
        )
        given: dict[str, Any] = {}
        if kind.m:
            given["one_forms"] = lambda q, params: self.one_forms(q, params)
            if kind.affine:
                given["affine"] = lambda q, params: self.drift(q, params)
        if kind.c:
            given["holonomic"] = (
                (lambda t, q, params: self.position(t, q, params))
                if kind.moving
                else lambda q, params: self.position(0.0, q, params)
            )
        if kind.forced:
            given["forces"] = lambda t, q, v, params: self.force(t, q, v, params)
        self.system = dx.LagrangeDirac(timed(self.lagrangian), **given)

    def lagrangian(self, t, q, v, params):
        energy = v @ (params["mass"] * v) / 2 - waves(params["V"], q) - q @ (params["stiff"] * q) / 2
        if self.kind.curved:
            along = params["u"] @ v
            energy = energy + (1.2 + jnp.cos(params["w"] @ q)) * along**2 / 4
        if self.kind.magnetic:
            energy = energy + waves(params["A"], q) @ v
        return energy + q @ params["push"] * jnp.sin(2.0 * t + 0.3) if self.kind.timed else energy

    def force(self, t, q, v, params):
        return -params["drag"] * v + waves(params["f"], q) * jnp.cos(t)

    def one_forms(self, q, params):
        rows = params["W0"] + 0.4 * jnp.stack([waves(params["W"], q)])
        return jnp.concatenate([rows, 2.0 * rows]) if self.kind.redundant else rows

    def drift(self, q, params):
        b = params["b"] * jnp.stack([1.0 + 0.3 * jnp.sin(q[0])])
        return jnp.concatenate([b, 2.0 * b]) if self.kind.redundant else b

    def position(self, t, q, params):
        g = jnp.stack(
            [params["g"] @ q + waves(params["G"], q) - params["level"] + (0.2 * jnp.sin(t) if self.kind.moving else 0.0)]
        )
        return jnp.concatenate([g, g * 3.0]) if self.kind.redundant and not self.kind.m else g

    def velocity_rows(self, t, q, params):
        """(C, d) of the independent constraints C v + d = 0 on velocities."""
        rows, rest = [], []
        if self.kind.m:
            rows.append(self.one_forms(q, params)[:1])
            rest.append(self.drift(q, params)[:1] if self.kind.affine else jnp.zeros(1))
        if self.kind.c:
            rows.append(jax.jacfwd(lambda q: self.position(t, q, params))(q)[:1])
            rest.append(jax.jacfwd(lambda t: self.position(t, q, params))(t)[:1])
        if not rows:
            return jnp.zeros((0, self.kind.n)), jnp.zeros(0)
        return jnp.concatenate(rows), jnp.concatenate(rest)

    def parameters(self, draw: np.random.Generator) -> tuple[dict, dict]:
        """(params, initial data) of a random system."""
        n, unit = self.kind.n, lambda: (lambda x: x / np.linalg.norm(x))(draw.normal(size=n))
        params: dict[str, Any] = {
            "mass": draw.uniform(0.5, 2.0, n),
            "stiff": draw.uniform(0.1, 1.0, n),
            "V": drawn_waves(draw, n, size=0.7),
            "u": unit(),
            "w": draw.uniform(-1, 1, n),
            "A": drawn_waves(draw, n, n, size=0.5),
            "push": draw.uniform(-0.5, 0.5, n),
            "drag": draw.uniform(0, 0.3, n),
            "f": drawn_waves(draw, n, n, size=0.3),
            "W0": 1.5 * unit()[None],
            "W": drawn_waves(draw, n, n, size=0.3),
            "b": 0.3 * draw.uniform(-1, 1),
            "g": 1.5 * unit(),
            "G": drawn_waves(draw, n, size=0.2),
            "level": 0.0,
        }
        q, v = draw.uniform(-1, 1, n), draw.normal(size=n)
        if self.kind.c:
            params["level"] = float(self.position(0.0, q, params)[0])
        c, d = map(np.asarray, self.velocity_rows(0.0, q, params))
        if len(c):
            v = v - np.linalg.pinv(c) @ (c @ v + d)
        return params, {"q": q, "v": v}
