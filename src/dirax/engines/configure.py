"""configure(): choices that hold for the whole process and must be made before anything is computed."""

import os
import re

import jax

OPTION = "xla_cpu_small_while_loop_byte_threshold"
BYTES = 65536
FLAG = "--xla_backend_extra_options="


def configure(*, fast_loops: bool) -> None:
    """Make every JAX loop over small arrays on a CPU one compiled kernel (True), or leave loops as they are (False).

    This speeds up the xla engine on small systems, which is what gradients of a trajectory use, about three times, and
    compiles in less time; the native engine has no need of it. It sets an XLA option, which JAX does not document, for the
    whole process and all of JAX (`XLA_FLAGS=--xla_backend_extra_options=xla_cpu_small_while_loop_byte_threshold=65536`),
    and XLA reads it once: call this before the first computation.

        import dirax as dx
        dx.configure(fast_loops=True)

    Raises `RuntimeError` where it has no effect: JAX has computed already, or this version of XLA has no such option.
    """
    if not isinstance(fast_loops, bool):
        raise TypeError(f"fast_loops must be True or False, but {fast_loops!r} was given.")
    before = os.environ.get("XLA_FLAGS")
    os.environ["XLA_FLAGS"] = with_option(before or "", fast_loops)
    if small_loops_are_one_kernel() != fast_loops:
        os.environ.pop("XLA_FLAGS") if before is None else os.environ.update(XLA_FLAGS=before)
        raise RuntimeError(
            f"fast_loops={fast_loops} has no effect: JAX has computed something in this process already, after which XLA reads "
            "no flags, or this version of XLA has no such option. Call dx.configure right after the imports, or set "
            f"XLA_FLAGS='{FLAG}{OPTION}={BYTES}' before Python starts."
        )


def with_option(flags: str, on: bool) -> str:
    """The value of XLA_FLAGS with the option added to the others or taken out."""
    words = flags.split()
    given = [option for word in words if word.startswith(FLAG) for option in word.removeprefix(FLAG).split(",")]
    options = [option for option in given if not re.match(rf"{OPTION}\b", option)] + [f"{OPTION}={BYTES}"] * on
    others = [word for word in words if not word.startswith(FLAG)]
    return " ".join(others + [FLAG + ",".join(options)] * bool(options))


def fast_loops_asked_for() -> bool:
    """Whether XLA_FLAGS holds the option."""
    return OPTION in os.environ.get("XLA_FLAGS", "")


def small_loops_are_one_kernel() -> bool:
    """Whether XLA compiles a loop over 2 kB into one kernel on a CPU: its limit is 1 kB unless raised."""
    with jax.default_device(jax.devices("cpu")[0]):
        loop = jax.jit(lambda x, n: jax.lax.fori_loop(0, n, lambda _, y: jax.numpy.sin(y), x))
        shapes = jax.ShapeDtypeStruct((256,), "float64"), jax.ShapeDtypeStruct((), "int64")
        return "xla_cpu_small_call" in (loop.lower(*shapes).compile().as_text() or "")
