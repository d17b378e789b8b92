"""Functions written in JAX against themselves: traced, interpreted, compiled, called; and random graphs against NumPy."""

import warnings

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
from jax.extend.core import ClosedJaxpr

import dirax as dx
import dirax.program.rules
from dirax.engines.native.ir.compiled_function import compiled
from dirax.program import pairs
from dirax.program.evaluation.functions import in_numpy
from dirax.program.graph import Graph
from dirax.program.graph_derivatives import jacobian
from dirax.program.interpreter import Interpreter, Unavailable
from dirax.program.operations import NUMPY


def traced(function, *shapes):
    """(graph, input nodes, output nodes) of a function of float64 arrays."""
    closed: ClosedJaxpr = jax.make_jaxpr(function)(*(jax.ShapeDtypeStruct(s, jnp.float64) for s in shapes))
    g = Graph()
    arrays = []
    for i, shape in enumerate(shapes):
        names = [g.input(f"x{i}_{j}") for j in range(int(np.prod(shape)))]
        arrays.append(np.array(names, dtype=np.int64).reshape(shape))
    results = Interpreter(g).run(closed, *arrays)
    for result in results:
        if isinstance(result, Unavailable):
            raise result.error
    inputs = [node for a in arrays for node in a.ravel().tolist()]
    return g, inputs, [node for r in results for node in r.ravel().tolist()]


V, M, S = (3,), (3, 3), ()
CONSTANT = np.arange(12.0).reshape(3, 4) - 5
spd = lambda a: a @ a.T + 3 * jnp.eye(3)

z_of, ROOT = jax.lax.complex, jnp.array(0.3 - 0.8j)
parts = lambda z: jnp.stack([z.real, z.imag])


@jax.custom_jvp
def halved(x):
    return x / 2


halved.defjvp(lambda primals, tangents: (halved(*primals), 7 * tangents[0]))


@jax.custom_vjp
def doubled(x):
    return 2 * x


doubled.defvjp(lambda x: (2 * x, None), lambda _, g: (5 * g,))
CASES = {
    "arithmetic": (lambda x, y: (x + y) * (x - y) / (1 + x**2) - -x, V, V),
    "powers": (lambda x: jnp.abs(x) ** 1.5 + x**3 + x**-2 + jnp.abs(x) ** 0.3 + 2.0**x, V),
    "elementary": (lambda x: jnp.sin(x) * jnp.cos(2 * x) + jnp.exp(-x) + jnp.log1p(x**2) + jnp.tanh(x) * jnp.cosh(x), V),
    "inverse": (lambda x: jnp.arctan2(x, 2.0) + jnp.arcsin(x / 9) + jnp.arccos(x / 9) + jnp.arctan(x) + jnp.arcsinh(x), V),
    "softplus and friends": (lambda x: jax.nn.softplus(x) + jax.nn.sigmoid(x) + jax.nn.relu(x) + jnp.sinc(x), V),
    "error function": (lambda x: jax.scipy.special.erf(x) + jax.scipy.special.erfc(x) + jnp.cbrt(x), V),
    "rounding": (lambda x: jnp.floor(x) + jnp.ceil(2 * x) + jnp.round(3 * x) + jnp.sign(x) + jnp.trunc(5 * x), V),
    "halves": (
        lambda x: (
            jnp.round(jnp.floor(x) + jnp.array([0.5, 1.5, -0.5]))
            + 100 * jax.lax.round(0 * x + jnp.array([0.5 - 2**-54, -0.5, 2.5]))
            + jnp.rint(jnp.floor(x) + 0.5)
        ),
        V,
    ),
    "remainders": (lambda x: jnp.mod(x, 0.7) + jnp.fmod(x, 0.3) + jnp.remainder(5 * x, 2.0), V),
    "extremes": (lambda x, y: jnp.maximum(x, y) - jnp.minimum(x, 0.3) + jnp.clip(y, -0.5, 0.5), V, V),
    "where": (lambda x, y: jnp.where((x > y) & ~(x < 0) | (y == x), x, jnp.where(x != 0, 2 * y, 0.0)), V, V),
    "booleans as numbers": (
        lambda x: jnp.sum((x > 0).astype(float)) + jnp.isfinite(x).astype(float) + jnp.any(x > 1).astype(float) * x,
        V,
    ),
    "truth values": (
        lambda x: (
            jnp.select([x > 0.2, x < -0.2], [(x - 0.2) ** 3, (x + 0.2) ** 2], 0.5)
            + jnp.argmax(x > 0.1).astype(float)
            + jnp.stack([(x > 0.1).max(), (x > 0.1).min(), jnp.any(x > 1)]).astype(float) @ jnp.array([1.0, 2.0, 4.0])
            + jnp.stack([jnp.maximum(x > 0.2, x < -0.2), jnp.minimum(x > -1, x < 1)], 1).astype(float) @ jnp.array([8.0, 16.0])
            + jnp.stack([(x > 0.1) < (x < 1), (x > 0.1) >= (x < 1)], 1).astype(float) @ jnp.array([32.0, 64.0])
            + jnp.stack([(x > 0) ^ (x < 1), (x > 0) == (x < 1)], 1).astype(float) @ jnp.array([128.0, 256.0])
        ),
        V,
    ),
    "whole numbers": (
        lambda x: (
            (jnp.uint8(200) + (x > -9).astype(jnp.uint8) * jnp.uint8(100)).astype(float)
            + (jnp.int32(2**31 - 1) + (x > 0).astype(jnp.int32)).astype(float)
            + (jnp.floor(90 * x).astype(int) + 300).astype(jnp.int8).astype(float)
            + jnp.floor(x).astype(int).astype(jnp.uint32).astype(float)
            + (5e9 * x).astype(jnp.int32).astype(float)
            + (jnp.floor(x).astype(int) ** 2).astype(float) * jnp.arange(9.0)[jnp.clip((2 * x).astype(jnp.int32) + 1, 0, 8)]
        ),
        V,
    ),
    "products": (lambda a, x: a @ a.T @ x + jnp.einsum("ij,ik,k->j", a, a, x) + jnp.outer(x, x) @ x, M, V),
    "batched product": (lambda a: jnp.einsum("bij,bjk->bik", jnp.stack([a, a.T]), jnp.stack([a, a + 1])), M),
    "reductions": (lambda a: a.sum(0) + a.max(1) + a.min() + jnp.prod(a, axis=0) + jnp.linalg.norm(a), M),
    "cumulative": (lambda a: jnp.cumsum(a, 0) + jnp.cumprod(a, 1) + jax.lax.cummax(a, 0, reverse=True), M),
    "positions": (lambda a: a[0, jnp.argmax(a[1])] + jnp.argmin(a, axis=0).astype(float) + a[jnp.argmin(a[:, 0])], M),
    "indexing": (lambda a: a[1:, ::2] @ a[::-1, 2][:2] + a[jnp.array([0, 2]), jnp.array([1, 1])].sum() + a[-1, -2], M),
    "shapes": (lambda a: jnp.concatenate([a.ravel(), jnp.pad(a, 1).T[1], jnp.tile(a[0], 2), jnp.roll(a[1], 1)]), M),
    "stack and split": (lambda a: jnp.stack([*jnp.split(a, 3)], axis=-1).squeeze() + jnp.repeat(a[:, :1], 3, axis=1), M),
    "diagonals": (lambda a: jnp.diag(jnp.diag(a)) + jnp.tril(a) - jnp.triu(a) + jnp.eye(3) * jnp.trace(a), M),
    "cross": (lambda x, y: jnp.cross(x, jnp.cross(x, y)) + jnp.vdot(x, y), V, V),
    "updates": (lambda x: jnp.zeros((2, 2)).at[0, 1].set(x[0]).at[jnp.array([0, 1]), 0].add(x[1:]).at[1].multiply(3.0), V),
    "dropped updates": (lambda x: x.at[jnp.array([1, 7])].set(9.0, mode="drop"), V),
    "index that depends on x": (lambda x: x[jnp.clip(jnp.floor(jnp.abs(x[0])).astype(int), 0, 2)] + CONSTANT[0, 1], V),
    "slice that depends on x": (lambda x: jax.lax.dynamic_slice(x, (jnp.where(x[0] > 0, 1, 0),), (2,)), V),
    "update that depends on x": (lambda x: jax.lax.dynamic_update_slice(x, x[:1] * 2, (jnp.where(x[0] > 0, 2, 1),)), V),
    "captured constants": (lambda x: x @ CONSTANT + np.pi, V),
    "cond": (lambda x: jax.lax.cond(x[0] > 0, lambda x: x * 2, lambda x: jnp.log(jnp.abs(x)), x), V),
    "switch": (lambda x: jax.lax.switch(jnp.floor(x[0]).astype(int), [jnp.sin, jnp.cos, jnp.abs], x), V),
    "fori_loop": (lambda x: jax.lax.fori_loop(0, 5, lambda i, c: jnp.sin(c) + x[i % 3] * i, x), V),
    "scan": (lambda a: jax.lax.scan(lambda c, row: (c * 0.5 + row, c @ row), a[0], a, reverse=True), M),
    "scan without steps": (lambda x: jax.lax.scan(lambda c, _: (c, c), x, None, length=0)[0], V),
    "while of known length": (lambda x: jax.lax.while_loop(lambda c: c[0] < 4, lambda c: (c[0] + 1, c[1] * x), (0, x))[1], V),
    "jit": (lambda x: jax.jit(lambda y: y * jnp.sin(y))(x) + jax.checkpoint(jnp.cos)(x), V),
    "vmap": (lambda a: jax.vmap(lambda x, y: jnp.dot(x, y) * x)(a, a.T), M),
    "custom jvp": (lambda x: halved(x) + jax.grad(lambda x: halved(x).sum())(x), V),
    "custom vjp": (lambda x: doubled(x) + jax.grad(lambda x: doubled(x).sum())(x), V),
    "solve": (lambda a, x: jnp.linalg.solve(a, x) + jnp.linalg.inv(a) @ x, M, V),
    "solve several": (lambda a: jax.vmap(jnp.linalg.solve)(jnp.stack([a, a.T + 2]), jnp.stack([a, a @ a])), M),
    "determinant": (lambda a: jnp.linalg.det(a) + jnp.linalg.slogdet(a)[1], M),
    "cholesky": (lambda a, x: jnp.linalg.cholesky(spd(a)) @ x + jax.scipy.linalg.cho_solve((spd(a), True), x), M, V),
    "lu": (lambda a, x: jax.scipy.linalg.lu_solve(jax.scipy.linalg.lu_factor(a), x), M, V),
    "triangular": (lambda a, x: jax.scipy.linalg.solve_triangular(a, x, lower=True, trans=1), M, V),
    "gradient of a solve": (lambda a, x: jax.grad(lambda x: jnp.sum(jnp.linalg.solve(a, jnp.sin(x)) ** 2))(x), M, V),
    "hessian": (lambda x: jax.hessian(lambda x: jnp.sqrt(x @ x) * jnp.cos(x[0] * x[1]))(x), V),
    "complex arithmetic": (
        lambda x, y: parts(z_of(x, y) * z_of(y, x) / (z_of(x, x * y) - ROOT) + (-z_of(x, y)) ** 3 + z_of(y, x) ** -2),
        V,
        V,
    ),
    "complex functions": (
        lambda x, y: parts(
            jnp.exp(z_of(x, y))
            + jnp.sin(z_of(x, y)) * jnp.cos(z_of(y, x))
            + jnp.tan(z_of(x, y))
            + jnp.expm1(z_of(x, y) / ROOT)
            + jnp.sinh(z_of(x, y))
            - jnp.cosh(z_of(y, x)) * jnp.tanh(z_of(y, x))
        ),
        V,
        V,
    ),
    "complex roots": (
        lambda x, y: (
            parts(jnp.sqrt(z_of(x, y)) + jnp.log(z_of(x, y)) + jnp.log1p(z_of(x, y) / 100) + z_of(x, y) ** z_of(y, x))
            + jnp.abs(z_of(x, y))[None]
            + jnp.angle(z_of(x, y))[None]
            + (z_of(x, y) == ROOT).astype(float)[None]
        ),
        V,
        V,
    ),
    "complex branches": (
        lambda x, y: (
            jax.grad(
                lambda x: parts(jax.lax.cond(x[0] > 0, lambda z: z**2 + jax.nn.sigmoid(z), lambda z: ROOT * z, z_of(x, y))).sum()
            )(x)
            + parts(jax.lax.rsqrt(z_of(x, y)))[1]
        ),
        V,
        V,
    ),
    "complex signs": (lambda x, y: parts(jnp.sign(z_of(x, y)) + jnp.sign(z_of(0 * x, 0 * x))), V, V),
    "complex zero": (
        lambda x, y: (
            jnp.abs(z_of(0 * x, 0 * y)) ** 2 + (jnp.sqrt(z_of(0 * x, 0 * y)) + z_of(0 * x, 0 * y) ** jnp.real(ROOT)).real
        ),
        V,
        V,
    ),
    "complex arrays": (
        lambda a, x: parts(
            z_of(a, a.T) @ z_of(x, x)[::-1]
            + jnp.vdot(z_of(x, x), z_of(a[0], x))
            + jnp.conj(z_of(x, x)).sum()
            + jnp.concatenate([z_of(x, a[1])[1:], z_of(x, x)[:1].at[0].add(ROOT)])[jnp.array([2, 0, 1])]
            + jnp.where(x > 0, z_of(x, x), ROOT)
            + jnp.cumsum(z_of(x, a[0]))
            + jnp.roll(jnp.zeros(3, complex).at[1].set(z_of(x, x)[2]), 1)
        ),
        M,
        V,
    ),
    "complex loops": (
        lambda x, y: parts(
            jax.lax.fori_loop(0, 3, lambda i, z: jax.jit(jnp.sin)(z) + ROOT, z_of(x, y))
            + jax.lax.scan(lambda z, w: (z * w, z - w), z_of(x, y)[0], z_of(y, x))[1]
            + jax.lax.while_loop(lambda c: c[0] < 3, lambda c: (c[0] + 1, c[1] * ROOT), (0, z_of(x, y)))[1]
            + jax.lax.cond(x[0] > 0, jnp.exp, lambda z: z * z, z_of(x, y))
        ),
        V,
        V,
    ),
    "transforms": (
        lambda a: jnp.concatenate(
            [
                jnp.ravel(parts(jnp.fft.fft(a)) + parts(jnp.fft.ifft2(z_of(a, a.T)))),
                jnp.ravel(jnp.fft.irfft(jnp.fft.rfft(a) * jnp.arange(2).astype(complex)[None], 3)),
                jnp.ravel(jnp.fft.irfft2(jnp.fft.rfft2(a[:2, :2] * a[1:, 1:]))),
                jnp.ravel(parts(jnp.fft.rfftn(jnp.tile(a, (2, 2))))),
            ]
        ),
        M,
    ),
    "dead code that is not supported": (lambda x: (jnp.linalg.eigvalsh(jnp.outer(x, x)), 2 * x)[1], V),
}


@pytest.mark.parametrize("name", CASES)
@pytest.mark.soak_of("elementary", "inverse", "fori_loop", "solve", "solve several", "hessian")
def test_compiled_functions_do_what_jax_does(name):
    function, *shapes = CASES[name]
    g, inputs, outputs = traced(function, *shapes)
    rng = np.random.default_rng(7)
    points = rng.uniform(-2.5, 2.5, (6, len(inputs)))
    got = compiled(g, inputs, outputs, 2)(points.T)
    splits = np.cumsum([int(np.prod(s)) for s in shapes])[:-1]
    reference = jax.jit(function)
    for k, point in enumerate(points):
        arrays = [part.reshape(s) for part, s in zip(np.split(point, splits), shapes, strict=True)]
        expected = np.concatenate([np.ravel(leaf).astype(float) for leaf in jax.tree.leaves(reference(*arrays))])
        np.testing.assert_allclose(got[:, k], expected, rtol=3e-12, atol=3e-12)


UNSUPPORTED = {
    "eigh": lambda x: jnp.linalg.eigvalsh(jnp.outer(x, x)),
    "while": lambda x: jax.lax.while_loop(lambda c: c[0] < 9, lambda c: c * 2, x),
    "while of each": lambda x: jax.vmap(lambda y: jax.lax.while_loop(lambda c: c < 9, lambda c: c * 2, y))(x),
    "convert_element_type": lambda x: x.astype(jnp.float32).astype(float),
    "acos": lambda x: jnp.arccos(jax.lax.complex(x, x)).real,
    "sort": lambda x: jnp.sort(x),
    "mul": lambda x: (jnp.floor(x).astype(int) * 1103515245 % 1000).astype(float),
    "lu": lambda x: jnp.linalg.det(jnp.outer(jnp.tile(x, 5), jnp.tile(x, 5))),
}


@pytest.mark.parametrize("name", UNSUPPORTED)
def test_unsupported_primitives_are_named_with_the_users_line(name):
    from dirax.program.interpreter import UnsupportedPrimitive

    with pytest.raises(UnsupportedPrimitive, match=r"test_primitives\.py:\d+") as caught:
        traced(UNSUPPORTED[name], V)
    assert caught.value.primitive == name.split()[0]


def test_expressions_are_built_once_and_simplified():
    g = Graph()
    x, y = g.input("x"), g.input("y")
    assert g.add(x, y) == g.add(y, x) and g.mul(x, y) == g.mul(y, x)
    assert g.mul(g.zero, x) == g.zero and g.mul(g.one, x) == x and g.add(x, g.zero) == x and g.sub(x, x) == g.zero
    assert g.neg(g.neg(x)) == x and g.sub(x, g.neg(y)) == g.add(x, y) and g.neg(g.sub(x, y)) == g.sub(y, x)
    assert g.div(x, x) == g.one and g.recip(g.recip(x)) == x
    assert g.mul(g.constant(2.0), g.mul(g.constant(3.0), x)) == g.mul(g.constant(6.0), x)
    assert g.make("select", g.true, x, y) == x and g.make("not", g.make("not", g.make("lt", x, y))) == g.make("lt", x, y)
    assert g.number(g.make("sin", g.constant(0.5))) == np.sin(0.5)
    assert g.constant(0.0) != g.constant(-0.0) and g.constant(True) != g.constant(1.0)


DIFFERENTIABLE = ("arithmetic", "powers", "elementary", "inverse", "error function", "extremes", "where", "products", "hessian",
                  "solve", "fori_loop", "remainders", "determinant", "softplus and friends", "complex arithmetic",
                  "complex functions",
                  "complex roots", "complex arrays", "complex loops", "transforms")  # fmt: skip


@pytest.mark.parametrize("name", DIFFERENTIABLE)
@pytest.mark.soak_of(but=["inverse", "error function", "extremes", "fori_loop", "remainders"])
def test_jacobians_of_the_graph_are_jaxs(name):
    function, *shapes = CASES[name]
    g, inputs, outputs = traced(function, *shapes)
    rows = jacobian(g, outputs, inputs)
    nodes = [row.get(j, g.zero) for row in rows for j in range(len(inputs))]
    point = np.random.default_rng(3).uniform(0.2, 1.9, len(inputs))
    got = compiled(g, inputs, nodes)(point[:, None]).reshape(len(outputs), len(inputs))
    splits = np.cumsum([int(np.prod(s)) for s in shapes])[:-1]

    def flat(point):
        arrays = [part.reshape(s) for part, s in zip(jnp.split(point, splits), shapes, strict=True)]
        return jnp.concatenate([jnp.ravel(leaf) for leaf in jax.tree.leaves(function(*arrays))])

    np.testing.assert_allclose(got, jax.jacfwd(flat)(point), rtol=1e-9, atol=1e-9)


# ---------------------------------------------------------------------- random graphs

UNARY = ("neg", "abs", "sqrt", "recip", "sin", "cos", "tan", "asin", "acos", "atan", "sinh", "cosh", "tanh", "asinh", "acosh",
         "atanh", "exp", "expm1", "log", "log1p", "cbrt", "erf", "floor", "ceil", "round", "trunc", "sign")  # fmt: skip
BINARY = ("add", "sub", "mul", "max", "min", "atan2", "pow", "rem", "add", "sub", "mul", "mul", "add")
CONSTANTS = (0.0, 1.0, -1.0, 2.0, 0.5, 3.0, -0.75, 0.1)
INPUTS, POINTS, NOISY = 4, 4, 8


def random_expression(rng) -> list[tuple[str, tuple[int, ...]]]:
    """Operations on numbered values: the inputs, the constants, then one more for each operation."""
    operations, reals, booleans = [], list(range(INPUTS + len(CONSTANTS))), []
    recent = lambda pool: int(pool[-1 - min(int(rng.exponential(4)), len(pool) - 1)])
    for _ in range(int(rng.integers(3, 25))):
        number = INPUTS + len(CONSTANTS) + len(operations)
        kind = rng.random()
        if kind < 0.08:
            operations.append((str(rng.choice(["lt", "le", "eq", "ne"])), (recent(reals), recent(reals))))
            booleans.append(number)
        elif kind < 0.12 and booleans:
            operations.append((str(rng.choice(["and", "or"])), (recent(booleans), recent(booleans))))
            booleans.append(number)
        elif kind < 0.2 and booleans:
            operations.append(("select", (recent(booleans), recent(reals), recent(reals))))
            reals.append(number)
        elif kind < 0.35:
            operations.append((str(rng.choice(UNARY)), (recent(reals),)))
            reals.append(number)
        else:
            operations.append((str(rng.choice(BINARY)), (recent(reals), recent(reals))))
            reals.append(number)
    last = reals[-1]  # the value of the expression
    return operations[: last - INPUTS - len(CONSTANTS) + 1] or random_expression(rng)


def build(g: Graph, inputs: list[int], expression) -> int:
    values = [*inputs, *map(g.constant, CONSTANTS)]
    for op, args in expression:
        values.append(g.make(op, *(values[a] for a in args)))
    return values[-1]


def with_numpy(expression, points: np.ndarray, rng, noise: float):
    """(values, whether every intermediate is finite) at points (INPUTS, P); each result moved by relative `noise`.

    With noise a zero gets a sign at random: the engine does not keep the signs of zeros, on which atan2 depends.
    """
    values = [*points, *(np.full(points.shape[1], c) for c in CONSTANTS)]
    fine = np.ones(points.shape[1], dtype=bool)
    for op, args in expression:
        result = np.asarray(NUMPY[op](*(values[a] for a in args)))
        if result.dtype != np.bool_:
            result = result * (1 + noise * rng.uniform(-1, 1, result.shape))
            if noise:
                result = np.where(result == 0, np.copysign(0.0, rng.random(result.shape) - 0.5), result)
            fine &= np.isfinite(result) & ((result == 0) | ((abs(result) > 1e-280) & (abs(result) < 1e280)))
        values.append(result)
    return values[-1].astype(float), fine


def disagreements(expression, points, got, rng) -> tuple[np.ndarray, int]:
    """Points at which `got` is further from NumPy than rounding explains, measured by rounding at random many times; how many
    are compared."""
    exact, fine = with_numpy(expression, points, rng, 0.0)
    for samples in (NOISY, 30 * NOISY):
        noisy = with_numpy(expression, np.tile(points, samples), rng, 4e-16)[0].reshape(samples, -1)
        spread = np.max(np.abs(noisy - exact), axis=0)  # NaN where rounding decides whether there is a value at all
        bad = fine & np.isfinite(spread) & ~(np.abs(got - exact) <= 30 * spread + 1e-14 * np.abs(exact) + 1e-290)
        if not np.any(bad):
            break
    return bad, int(np.sum(fine))


def fuzz(seed: int, graphs: int, together: int = 100) -> int:
    """Compile random expressions, many in a module, and compare with NumPy; the number of values compared."""
    rng, compared = np.random.default_rng(seed), 0
    for _ in range(graphs // together):
        g = Graph()
        inputs = [g.input(f"x{i}") for i in range(INPUTS)]
        expressions = [random_expression(rng) for _ in range(together)]
        outputs = [build(g, inputs, e) for e in expressions]
        points = rng.uniform(-3, 3, (INPUTS, POINTS))
        got = compiled(g, inputs, outputs, int(rng.choice([1, 2, 4])))(points)
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("ignore")
            for expression, values in zip(expressions, got, strict=True):
                bad, fine = disagreements(expression, points, values, rng)
                assert not np.any(bad), (seed, expression, points[:, bad].tolist(), values[bad].tolist())
                compared += fine
    return compared


@pytest.mark.soak
def test_random_graphs_against_numpy():
    assert fuzz(1, 400, 50) > 400


@pytest.mark.soak
def test_a_hundred_thousand_random_graphs_against_numpy():
    assert sum(fuzz(1000 + seed, 1000) for seed in range(100)) > 100_000


def interpolated(q):
    places = jnp.linspace(-2.0, 2.0, 9)
    return jnp.interp(q[0], places, jnp.sin(2.0 * places))


def switched(q):
    return jax.lax.switch(jnp.int32(q[0] > 0.0), [lambda q: q @ q, lambda q: 2.0 * q @ q], q)


@pytest.mark.parametrize("potential", [interpolated, switched])
@pytest.mark.soak_of("interpolated")
def test_tables_and_switches_are_native(potential):
    system = dx.LagrangeDirac(lambda q, v: v @ v / 2 - potential(q))
    end = lambda q, engine: dx.simulate(system, dx.LagrangeDAlembert(), q=q, v=[0.3], step=0.02, steps=200, engine=engine).q[
        -1, 0
    ]
    q = jnp.array([-0.7])
    (expected, slope), ours = jax.jit(lambda q: (jax.value_and_grad(end)(q, "xla"), jax.grad(end)(q, "native")))(q)
    assert abs(end(q, "native") - expected) < 1e-13
    np.testing.assert_allclose(ours, slope, rtol=1e-10)


def test_whole_numbers_that_are_known_late_are_divided_towards_zero():
    numerators, divisors = jnp.arange(-60, 61), jnp.array([1, -1, 3, 7, -49, 64])

    def quotients(x):
        n = numerators + x[0].astype(int)
        return jax.lax.div(jnp.repeat(n, len(divisors)), jnp.tile(divisors, len(n))).astype(float)

    found = in_numpy(quotients, [np.array([[2.0], [-3.0]])], "quotients")
    np.testing.assert_array_equal(found, np.stack([quotients(jnp.array([x])) for x in (2.0, -3.0)]))


@pytest.mark.parametrize("z", [-1 + 1e-9j, -0.7 - 0.3j, 1e-12 + 1e-13j, -2 + 1e-20j])
def test_the_logarithm_of_one_and_a_complex_number(z):
    with mpmath.workdps(40):
        exact = complex(mpmath.log(1 + mpmath.mpmathify(z)))
    found = pairs.log1p(pairs.Pair(z.real, z.imag))
    np.testing.assert_allclose([float(found.re), float(found.im)], [exact.real, exact.imag], rtol=1e-15)
