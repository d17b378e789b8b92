"""Interconnection of port-Hamiltonian systems: composition of their Dirac structures through shared ports."""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Float

from dirax.numerics.arrays import Numbers
from dirax.systems.port_hamiltonian import PortHamiltonian

KINDS = ("feedback", "joint")


def interconnect(
    one: PortHamiltonian,
    other: PortHamiltonian,
    ports: Sequence[int],
    other_ports: Sequence[int],
    sizes: tuple[int, int],
    kind: str = "feedback",
    params: Any = None,
) -> PortHamiltonian:
    """Two port-Hamiltonian systems joined at some of their ports; again one, with H the sum, x = (x_one, x_other).

    `ports[i]` of `one`, a column of its B, meets `other_ports[i]` of `other`; `sizes` are the lengths of the two x.
    "feedback": u = −y_other, u_other = y (a flow meets an effort: a motor's current and its load's speed).
    "joint": u = −u_other = λ with y = y_other (two efforts meet: a rigid joint), a closed port of the whole.
    Both are power-conserving, ⟨y, u⟩ + ⟨y_other, u_other⟩ = 0. Ports left over stay open, those of `one` first; closed
    ones stay closed. `params` are only needed where B takes them, to count its columns. Raises `ValueError` for ports that
    do not exist, meet twice, are closed, or have no partner.
    """
    ports, other_ports = tuple(map(int, ports)), tuple(map(int, other_ports))
    if kind not in KINDS:
        raise ValueError(f"kind must be one of {', '.join(map(repr, KINDS))}, but {kind!r} was given.")
    if not ports or len(ports) != len(other_ports):
        raise ValueError(
            f"each of ports needs a partner in other_ports, but there are {len(ports)} and {len(other_ports)}: a port without "
            "one stays open, leave it out."
        )
    for system, chosen, name in ((one, ports, "ports"), (other, other_ports, "other_ports")):
        if not isinstance(system, PortHamiltonian):
            raise TypeError(f"interconnect joins PortHamiltonian systems, but a {type(system).__name__} was given.")
        if system.B is None:
            raise ValueError(f"{name} {chosen} do not exist: the system has no ports; give it B.")
        if system.inputs is not None:
            raise ValueError("a system with inputs= is already driven: interconnect the open ones and drive the result.")
        if system.closed is True or (system.closed and set(chosen) & set(system.closed)):
            raise ValueError(f"{name} {chosen} are closed, and a closed port meets nothing.")
        if len(set(chosen)) < len(chosen) or min(chosen) < 0:
            raise ValueError(f"{name} must be different columns of B, but {chosen} were given.")
    n = sizes[0]
    at_one = lambda function, x, params: function(x[:n], params)
    at_other = lambda function, x, params: function(x[n:], params)

    def hamiltonian(x, params):
        return at_one(one.hamiltonian, x, params) + at_other(other.hamiltonian, x, params)

    def columns(x, params):
        b, c = at_one(one.input_matrix, x, params), at_other(other.input_matrix, x, params)
        for matrix, chosen, name in ((b, ports, "ports"), (c, other_ports, "other_ports")):
            if max(chosen) >= matrix.shape[1]:
                raise ValueError(f"{name} {chosen} do not all exist: its B has {matrix.shape[1]} columns.")
        return b, c

    def J(x, params):
        structure = jax.scipy.linalg.block_diag(at_one(one.J, x, params), at_other(other.J, x, params))
        if kind == "joint":
            return structure
        b, c = columns(x, params)
        coupling = b[:, list(ports)] @ c[:, list(other_ports)].T
        return structure + jnp.zeros_like(structure).at[:n, n:].set(-coupling).at[n:, :n].set(coupling.T)

    def R(x, params):
        sides = ((one.R, x[:n]), (other.R, x[n:]))
        losses = [jnp.zeros((part.size, part.size)) if r is None else r(part, params) for r, part in sides]
        return jax.scipy.linalg.block_diag(*losses)

    def B(x, params):
        """Open ports left over, then closed ones, then the joints."""
        b, c = columns(x, params)
        return _port_columns(one, other, b, c, ports, other_ports, joint=kind == "joint")

    def count(system: PortHamiltonian, size: int, taken: tuple[int, ...]) -> tuple[int, int]:
        closed = len(system.closed) if isinstance(system.closed, tuple) else 0
        width = jax.eval_shape(lambda x: system.input_matrix(x, params), jnp.zeros(size)).shape[1]
        return width - len(taken) - closed, closed

    for system, size, chosen, name in ((one, sizes[0], ports, "ports"), (other, sizes[1], other_ports, "other_ports")):
        if max(chosen) >= sum(count(system, size, ())):
            raise ValueError(f"{name} {chosen} do not all exist: its B has {sum(count(system, size, ()))} columns.")
    (open_one, closed_one), (open_other, closed_other) = count(one, sizes[0], ports), count(other, sizes[1], other_ports)
    left, shut = open_one + open_other, closed_one + closed_other + (len(ports) if kind == "joint" else 0)
    dissipates = one.R is not None or other.R is not None
    return PortHamiltonian(
        hamiltonian,
        J,
        B=B if left + shut else None,
        R=R if dissipates else None,
        closed=tuple(range(left, left + shut)) or False,
    )


def _port_columns(one, other, b, c, ports, other_ports, joint: bool) -> Float[Numbers, "N m"]:
    above = jnp.concatenate([b, jnp.zeros((c.shape[0], b.shape[1]))])
    below = jnp.concatenate([jnp.zeros((b.shape[0], c.shape[1])), c])
    shut = [system.closed if isinstance(system.closed, tuple) else () for system in (one, other)]
    kept = [
        [i for i in range(matrix.shape[1]) if i not in taken and i not in closed]
        for matrix, taken, closed in ((b, ports, shut[0]), (c, other_ports, shut[1]))
    ]
    parts = [above[:, kept[0]], below[:, kept[1]], above[:, list(shut[0])], below[:, list(shut[1])]]
    if joint:
        parts.append(above[:, list(ports)] - below[:, list(other_ports)])
    return jnp.concatenate(parts, axis=1)
