"""The energy of nonholonomic integrators over a million steps, on hard cases: the table of docs/hard_cases.md.

    python -m benchmarks.hard_cases [--steps 1000000] [--compensated] [SYSTEM …]      prints the table in Markdown

The energy is judged by `dirax.diagnostics.drift`: "bounded", "drifts", or how the run ended.
"""

import argparse
import sys

import numpy as np

import dirax as dx
from benchmarks.newmark import COMPOSED, Newmark
from dirax import gallery
from dirax.diagnostics.drift import judge
from dirax.gallery import contact_particle, transmission

METHOD_2 = dx.DiscreteDirac(constraints="resolve")
SCHEMES = {
    "(+)": dx.PlusLagrangeDirac(),
    "(−)": dx.MinusLagrangeDirac(),
    "midpoint": dx.LagrangeDAlembert("midpoint", "midpoint"),
    "Method 1": dx.DiscreteDirac(constraints="discretize"),
    "Method 2": METHOD_2,
    "Method 2, order 4": dx.Composition(METHOD_2, "suzuki4"),
    "Newmark, β = ¼, γ = ½": Newmark(0.25, 0.5),
    "Newmark, composed": COMPOSED,
    "Newmark, composed, order 4": dx.Composition(COMPOSED, "suzuki4"),
    "energy collocation, order 4": dx.EnergyCollocation(2),
    "energy collocation, order 6": dx.EnergyCollocation(3),
}
ROWS = 20_000
ROUNDINGS = 32


def cases() -> dict[str, tuple]:
    """Name → (example, changes of its run)."""
    found = {}
    for module in (contact_particle, transmission):
        for case, params in module.CASES.items():
            found[f"{module.EXAMPLE.title.lower()}, {case}"] = (module.EXAMPLE, {"params": params})
    for name, changes in {
        "rolling-disk": {"step": 0.01},
        "knife-edge": {},
        "chaplygin-sleigh": {},
        "snakeboard": {},
    }.items():
        example = gallery.get(name)
        found[example.title.lower()] = (example, changes)
    return found


def lagrangian_form(example):
    """The system as all schemes but Methods 1 and 2 take it."""
    system = example.system
    return system.lagrange_dirac() if hasattr(system, "lagrange_dirac") else system


def form_for(example, scheme):
    """The system as the scheme, or the one that it is composed of, takes it."""
    while hasattr(scheme, "scheme"):
        scheme = scheme.scheme
    return example.system if isinstance(scheme, dx.DiscreteDirac) else lagrangian_form(example)


def initial_energy(example, changes: dict) -> float:
    """H at the start."""
    return float(example.simulate(METHOD_2, **{**changes, "steps": 1}).energy()[0])


def verdict(example, scheme, steps: int, changes: dict, compensated: bool = False) -> str:
    """One cell: the verdict on the energy, its range in the first and last tenth of the run."""
    system = form_for(example, scheme)
    params = {**(example.params or {}), **changes.get("params", {})} or None
    data = {name: changes[name] for name in ("q", "v") if name in changes} or {name: example.initial[name] for name in ("q", "v")}
    step = changes.get("step", example.step)
    rows = {"steps": steps, "save_every": max(1, steps // ROWS)}
    sol = dx.simulate(system, scheme, **data | rows, step=step, params=params, project=True, compensated=compensated)
    energy = np.asarray(sol.energy())
    good = np.isfinite(energy)
    t, energy, motion = np.asarray(sol.t)[good], energy[good], np.concatenate([sol.q, sol.p], axis=1)[good]
    roundoff = ROUNDINGS * np.finfo(float).eps * steps * (1 + np.abs(energy).max())
    tenth = max(1, len(energy) // 10)
    first, last = np.abs(energy[:tenth] - energy[0]).max(), np.abs(energy[-tenth:] - energy[0]).max()
    if not sol.ok:
        number = f"{round((t[-1] - t[0]) / step):,}".replace(",", " ")
        return f"fails at step {number}: {first:.1e}, {last:.1e}"
    return f"{judge(t, energy, motion, roundoff).verdict}: {first:.1e}, {last:.1e}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=1_000_000)
    parser.add_argument("systems", nargs="*", help="parts of names")
    parser.add_argument("--scheme", default="", help="part of the name of the schemes to run")
    parser.add_argument("--compensated", action="store_true", help="keep what rounding takes from the state")
    chosen = parser.parse_args()
    print("| system, h | scheme | \\|H − H(0)\\|, first tenth, last tenth |\n|---|---|---|")
    for name, (example, changes) in cases().items():
        if chosen.systems and not any(part in name for part in chosen.systems):
            continue
        label = f"{name}, {changes.get('step', example.step):g}; H(0) = {initial_energy(example, changes):.3g}"
        for scheme_name, scheme in SCHEMES.items():
            if chosen.scheme not in scheme_name:
                continue
            try:
                cell = verdict(example, scheme, chosen.steps, changes, chosen.compensated)
            except (TypeError, ValueError) as error:
                cell = f"does not apply: {error}"[:80]
            print(f"| {label} | {scheme_name} | {cell} |", flush=True)
            label = ""


if __name__ == "__main__":
    sys.exit(main())
