"""The planar double pendulum (two unit masses on unit rods) and its midpoint scheme written by hand in C."""

import ctypes
import shutil
import subprocess
import tempfile
import time
from pathlib import Path

import jax.numpy as jnp
import numpy as np

import dirax as dx

GRAVITY = 9.81
START = ([1.0, 0.5], [0.0, 0.5])
STEP = 1e-3


def lagrangian(q, v):
    """q: angles of the rods from the vertical."""
    kinetic = v[0] ** 2 + v[1] ** 2 / 2 + v[0] * v[1] * jnp.cos(q[0] - q[1])
    return kinetic + GRAVITY * (2 * jnp.cos(q[0]) + jnp.cos(q[1]))


SYSTEM = dx.LagrangeDirac(lagrangian)
SCHEME = dx.LagrangeDAlembert("midpoint")

# p + D1 L_d = p + h/2 L_q − L_v = 0 at the midpoint, p' = D2 L_d = h/2 L_q + L_v; every update with its own Jacobian,
# extrapolation and stopping rule as in dirax.engines.stopping
C_SOURCE = r"""
#include <math.h>
#define G 9.81
static double larger(double x, double y) { return x > y ? x : y; }
/* rows: (steps + 1) x 4; returns the number of Newton updates, or -1 */
long run(double *z, double h, long steps, double *rows) {
    double a = z[0], b = z[1], pa = z[2], pb = z[3], u = z[4], w = z[5];
    double du = 0, dw = 0, ddu = 0, ddw = 0;
    long updates = 0;
    for (long k = 0; k < steps; k++) {
        rows[4*k] = a; rows[4*k + 1] = b; rows[4*k + 2] = pa; rows[4*k + 3] = pb;
        double x = u + du + ddu, y = w + dw + ddw, before = 0, fa, fb, ma, mb;
        for (int i = 0;; i++) {
            if (i == 50) return -1;
            double qa = a + h*x/2, qb = b + h*y/2;
            double s = sin(qa - qb), c = cos(qa - qb), sa = sin(qa), ca = cos(qa), sb = sin(qb), cb = cos(qb);
            fa = -x*y*s - 2*G*sa; fb = x*y*s - G*sb;          /* L_q */
            ma = 2*x + y*c; mb = y + x*c;                      /* L_v */
            double ra = pa + h/2*fa - ma, rb = pb + h/2*fb - mb;
            double laa = -x*y*c - 2*G*ca, lab = x*y*c, lbb = -x*y*c - G*cb;
            double j00 = h/2*(h/2*laa - y*s) - (-h/2*y*s + 2);
            double j01 = h/2*(h/2*lab - x*s) - (h/2*y*s + c);
            double j10 = h/2*(h/2*lab + y*s) - (-h/2*x*s + c);
            double j11 = h/2*(h/2*lbb + x*s) - (h/2*x*s + 1);
            double det = j00*j11 - j01*j10;
            double ex = (j11*ra - j01*rb)/det, ey = (j00*rb - j10*ra)/det;
            x -= ex; y -= ey; updates++;
            double update = larger(fabs(ex)/(fabs(x) + 1), fabs(ey)/(fabs(y) + 1)), ratio = update/before;
            int known = i > 0;
            before = update;
            if (update <= 1.7763568394002505e-15) break;
            if (known && (2*ratio*update <= 2.220446049250313e-21 || (ratio >= 0.5 && update < 1e-9))) break;
        }
        double qa = a + h*x/2, qb = b + h*y/2, s = sin(qa - qb), c = cos(qa - qb);
        fa = -x*y*s - 2*G*sin(qa); fb = x*y*s - G*sin(qb);
        ma = 2*x + y*c; mb = y + x*c;
        pa = h/2*fa + ma; pb = h/2*fb + mb; a += h*x; b += h*y;
        double eu = k > 0 ? x - u : 0, ew = k > 0 ? y - w : 0;
        ddu = k > 1 ? eu - du : 0; ddw = k > 1 ? ew - dw : 0;
        du = eu; dw = ew; u = x; w = y;
    }
    rows[4*steps] = a; rows[4*steps + 1] = b; rows[4*steps + 2] = pa; rows[4*steps + 3] = pb;
    return updates;
}
"""


def compiled(flags: str):
    """(steps) -> (seconds, rows, Newton updates) of the C program, or None without a compiler."""
    compiler = shutil.which("gcc") or shutil.which("cc")
    if compiler is None:
        return None
    folder = Path(tempfile.mkdtemp())
    (folder / "pendulum.c").write_text(C_SOURCE)
    command = [compiler, *flags.split(), "-shared", "-fPIC", "-o", str(folder / "pendulum.so"), str(folder / "pendulum.c"), "-lm"]
    if subprocess.run(command, capture_output=True).returncode:
        return None
    library = ctypes.CDLL(str(folder / "pendulum.so"))
    pointer = ctypes.POINTER(ctypes.c_double)
    library.run.argtypes = [pointer, ctypes.c_double, ctypes.c_long, pointer]
    library.run.restype = ctypes.c_long
    (a, b), (u, w) = START
    c = np.cos(a - b)
    start = np.array([a, b, 2 * u + w * c, w + u * c, u, w])

    def run(steps: int):
        rows = np.empty((steps + 1, 4))
        tick = time.perf_counter()
        updates = library.run(start.ctypes.data_as(pointer), STEP, steps, rows.ctypes.data_as(pointer))
        return time.perf_counter() - tick, rows, updates

    return run
