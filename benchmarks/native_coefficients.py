"""Fits the polynomials of the native engine's elementary functions with mpmath and prints src/…/native/functions/coefficients.py.

    python benchmarks/native_coefficients.py > src/dirax/engines/native/functions/coefficients.py

Each is the interpolant in Chebyshev points of a smooth function, rounded to float64; a comment gives its largest error.
"""

from mpmath import mp, mpf

mp.dps = 120


def sine(z):
    x = mp.sqrt(z)
    return (mp.sin(x) - x) / (z * x)


def cosine(z):
    return (mp.cos(mp.sqrt(z)) - 1 + z / 2) / z**2


def exponential(r):
    return (mp.exp(r) - 1 - r) / r**2


def logarithm(z):
    s = mp.sqrt(z)
    return (2 * mp.atanh(s) / s - 2) / z


def logarithm_tail(z):
    s = mp.sqrt(z)
    return ((2 * mp.atanh(s) / s - 2) / z - mpf(2) / 3) / z


def arctangent(z):
    t = mp.sqrt(z)
    return (mp.atan(t) / t - 1) / z


def arcsine(z):
    t = mp.sqrt(z)
    return (mp.asin(t) / t - 1) / z


def cube_root(m):
    return mp.cbrt(m)


def error_function(z):
    x = mp.sqrt(z)
    return mp.erf(x) / x - 2 / mp.sqrt(mp.pi)


def complement(t):
    """erfc(x) exp(x²) (x + 2) with t = (x − 2)/(x + 2), for x from 1 to 28."""
    x = 2 * (1 + t) / (1 - t)
    return mp.erfc(x) * mp.exp(x * x) * (x + 2)


QUARTER = (mp.pi / 4) ** 2
HALF_LN2 = mp.log(2) / 2
S_MAX = ((mp.sqrt(2) - 1) / (mp.sqrt(2) + 1)) ** 2
FITS = (
    ("SINE", sine, 0, QUARTER, 6),
    ("COSINE", cosine, 0, QUARTER, 6),
    ("EXPONENTIAL", exponential, -HALF_LN2, HALF_LN2, 10),
    ("LOGARITHM", logarithm, 0, S_MAX, 7),
    ("LOGARITHM_TAIL", logarithm_tail, 0, S_MAX, 7),
    ("ARCTANGENT", arctangent, 0, mp.tan(mp.pi / 8) ** 2, 11),
    ("ARCSINE", arcsine, 0, mpf(1) / 4, 13),
    ("CUBE_ROOT", cube_root, 1, 8, 5),
    ("ERROR_FUNCTION", error_function, 0, 1, 14),
    ("COMPLEMENT", complement, mpf(-1) / 3, mpf(26) / 30, 26),
)


def fit(function, low, high, count):
    """Coefficients in powers of (z − c), c = 0 for every fit but those of wide intervals, and the largest error."""
    nodes = [(low + high) / 2 + (high - low) / 2 * mp.cos(mp.pi * (2 * i + 1) / (2 * count)) for i in range(count)]
    matrix = mp.matrix(count, count)
    for i, z in enumerate(nodes):
        for j in range(count):
            matrix[i, j] = z**j
    exact = mp.lu_solve(matrix, mp.matrix([function(z) for z in nodes]))
    rounded = [float(c) for c in exact]
    worst = mpf(0)
    for i in range(1, 200):
        z = low + (high - low) * i / 200 + mpf(10) ** -25
        value = sum(c * z**j for j, c in enumerate(exact))
        worst = max(worst, abs(value - function(z)))
    return rounded, worst


def split(value, bits):
    """A float64 with at most `bits` significant bits near `value`."""
    e = mp.floor(mp.log(value, 2)) + 1 - bits
    return float(mp.nint(value / mpf(2) ** e) * mpf(2) ** e)


def parts(value, *bits):
    out = []
    for b in bits:
        out.append(split(value, b) if b < 53 else float(value))
        value -= mpf(out[-1])
    return out


def main():
    print('"""Coefficients of the elementary functions, lowest power first; written by benchmarks/native_coefficients.py."""\n')
    for name, function, low, high, count in FITS:
        values, worst = fit(function, mpf(low), mpf(high), count)
        print(f"{name} = (  # largest error {mp.nstr(worst, 2)} on [{mp.nstr(low, 6)}, {mp.nstr(high, 6)}]")
        for v in values:
            print(f"    {v!r},")
        print(")")
    print(f"HALF_PI = {tuple(parts(mp.pi / 2, 33, 33, 53))}")
    print(f"LN2 = {tuple(parts(mp.log(2), 32, 53))}")
    for name, value in (("PI", mp.pi), ("PI_2", mp.pi / 2), ("PI_4", mp.pi / 4)):
        print(f"{name} = {tuple(parts(value, 53, 53))}")
    mp.dps = 450
    bits = int(mp.floor(2 / mp.pi * mpf(2) ** 1280))
    print("TWO_OVER_PI = (  # 2/π in words of 64 bits, the highest first")
    for i in range(20):
        print(f"    0x{(bits >> (64 * (19 - i))) & (2**64 - 1):016X},")
    print(")")


if __name__ == "__main__":
    main()
