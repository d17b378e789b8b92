"""Interconnection of port-Hamiltonian systems: composition of their Dirac structures through shared ports."""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dirax.numerics.arrays import is_whole
from dirax.program.sparse_matrix import SparseMatrix
from dirax.systems.port_hamiltonian import PortHamiltonian
from dirax.systems.port_matrices import ConstantFunction

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
    ports, other_ports, lengths = _whole(ports, "ports"), _whole(other_ports, "other_ports"), _whole(sizes, "sizes")
    if len(lengths) != 2 or min(lengths) < 1:
        raise ValueError(f"sizes must be the lengths of the two x, like (2, 2), but {lengths} were given.")
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
    width, other_width = (_count(system, size, params) for system, size in zip((one, other), lengths, strict=True))
    for count, chosen, name in ((width, ports, "ports"), (other_width, other_ports, "other_ports")):
        if max(chosen) >= count:
            raise ValueError(f"{name} {chosen} do not all exist: its B has {count} columns.")
    n, count, meeting = lengths[0], width + other_width, (list(ports), [width + port for port in other_ports])
    closed_one, closed_other = (system.closed if isinstance(system.closed, tuple) else () for system in (one, other))
    shut = [*closed_one, *(width + port for port in closed_other)]
    left = [port for port in range(count) if port not in (*meeting[0], *meeting[1], *shut)]
    unit = np.eye(count)
    joints = unit[:, meeting[0]] - unit[:, meeting[1]] if kind == "joint" else unit[:, :0]
    kept = np.concatenate([unit[:, left + shut], joints], axis=1)  # open ports left over, then closed ones, then the joints
    coupling = unit[:, meeting[1]] @ unit[meeting[0]] - unit[:, meeting[0]] @ unit[meeting[1]]

    def both(function, of_other, x, params):
        """Those of the two systems along the diagonal; None stands for no dissipation."""
        pairs = zip((function, of_other), (x[:n], x[n:]), lengths, strict=True)
        return _diagonal(*(SparseMatrix(((), ((), ())), (m, m)) if f is None else f(part, params) for f, part, m in pairs))

    def hamiltonian(x, params):
        return one.hamiltonian(x[:n], params) + other.hamiltonian(x[n:], params)

    def J(x, params):
        structure = both(one.J, other.J, x, params)
        if kind == "joint":
            return structure
        b = both(one.B, other.B, x, params)
        return structure + _product(_product(b, coupling), b.T)

    def R(x, params):
        return both(one.R, other.R, x, params)

    def B(x, params):
        return _product(both(one.B, other.B, x, params), kept)

    closed = kept.shape[1] - len(left)
    parts = [f for system in (one, other) for f in (system.J, system.B, system.R) if f is not None]
    sparse = all(isinstance(function, ConstantFunction) for function in parts)
    stated = lambda matrix: matrix(np.zeros(sum(lengths)), None) if sparse else matrix
    return PortHamiltonian(
        hamiltonian,
        stated(J),
        B=stated(B) if kept.shape[1] else None,
        R=stated(R) if one.R is not None or other.R is not None else None,
        closed=tuple(range(len(left), len(left) + closed)) or False,
    )


def _whole(given: Any, name: str) -> tuple[int, ...]:
    numbers: list[Any] = list(given) if isinstance(given, Sequence | np.ndarray) else [None]
    if not all(map(is_whole, numbers)):
        raise TypeError(f"{name} must be a list of whole numbers, like (0, 1), but {given!r:.100} was given.")
    return tuple(map(int, numbers))


def _count(system: PortHamiltonian, size: int, params: Any) -> int:
    """How many ports a system with x of this size has."""
    x, B = jnp.zeros(size), system.B
    assert B is not None
    functions = [f for f in (system.hamiltonian, system.J, B, system.R) if f is not None]
    try:
        if params is not None or not any(f.takes_params for f in functions):
            system.sizes({"x": x}, params)
        return B.shape(x, params).shape[1]
    except (ValueError, IndexError) as error:
        raise ValueError(f"with x of shape ({size},), as sizes has it: {error}") from error


def _diagonal(first: Any, second: Any) -> Any:
    """The two matrices along the diagonal of one that is zero beside them; sparse where both are."""
    if isinstance(first, SparseMatrix) and isinstance(second, SparseMatrix):
        from scipy.sparse import block_diag  # imported when it is used

        return SparseMatrix(block_diag([first.matrix, second.matrix]))
    return jax.scipy.linalg.block_diag(jnp.asarray(first), jnp.asarray(second))


def _product(first: Any, second: Any) -> Any:
    """Sparse where the first is."""
    if isinstance(first, SparseMatrix):
        return SparseMatrix(first.matrix @ getattr(second, "matrix", second))
    return first @ second
