"""Certified least squares: NIST Statistical Reference Datasets, linear, and an hour of log.

Data and certified values: https://www.itl.nist.gov/div898/strd/lls/lls.shtml (Longley 1967; Filippelli 1996; Wampler
1970). Digits are log relative errors, -log10 |x - certified| / |certified|, the worst of all coefficients.
"""

from __future__ import annotations

import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from excite.identification.least_squares import Solution, merge, reduce, solve

FILIP = """
0.8116 -6.860120914 0.9072 -4.324130045 0.9052 -4.358625055 0.9039 -4.358426747
0.8053 -6.955852379 0.8377 -6.661145254 0.8667 -6.355462942 0.8809 -6.118102026
0.7975 -7.115148017 0.8162 -6.815308569 0.8515 -6.519993057 0.8766 -6.204119983
0.8885 -5.853871964 0.8859 -6.109523091 0.8959 -5.79832982 0.8913 -5.482672118
0.8959 -5.171791386 0.8971 -4.851705903 0.9021 -4.517126416 0.909 -4.143573228
0.9139 -3.709075441 0.9199 -3.499489089 0.8692 -6.300769497 0.8872 -5.953504836
0.89 -5.642065153 0.891 -5.031376979 0.8977 -4.680685696 0.9035 -4.329846955
0.9078 -3.928486195 0.7675 -8.56735134 0.7705 -8.363211311 0.7713 -8.107682739
0.7736 -7.823908741 0.7775 -7.522878745 0.7841 -7.218819279 0.7971 -6.920818754
0.8329 -6.628932138 0.8641 -6.323946875 0.8804 -5.991399828 0.7668 -8.781464495
0.7633 -8.663140179 0.7678 -8.473531488 0.7697 -8.247337057 0.77 -7.971428747
0.7749 -7.676129393 0.7796 -7.352812702 0.7897 -7.072065318 0.8131 -6.774174009
0.8498 -6.478861916 0.8741 -6.159517513 0.8061 -6.835647144 0.846 -6.53165267
0.8751 -6.224098421 0.8856 -5.910094889 0.8919 -5.598599459 0.8934 -5.290645224
0.894 -4.974284616 0.8957 -4.64454848 0.9047 -4.290560426 0.9129 -3.885055584
0.9209 -3.408378962 0.9219 -3.13200249 0.7739 -8.726767166 0.7681 -8.66695597
0.7665 -8.511026475 0.7703 -8.165388579 0.7702 -7.886056648 0.7761 -7.588043762
0.7809 -7.283412422 0.7961 -6.995678626 0.8253 -6.691862621 0.8602 -6.392544977
0.8809 -6.067374056 0.8301 -6.684029655 0.8664 -6.378719832 0.8834 -6.065855188
0.8898 -5.752272167 0.8964 -5.132414673 0.8963 -4.811352704 0.9074 -4.098269308
0.9119 -3.66174277 0.9228 -3.2644011
"""

LONGLEY = """
60323 83.0 234289 2356 1590 107608 1947
61122 88.5 259426 2325 1456 108632 1948
60171 88.2 258054 3682 1616 109773 1949
61187 89.5 284599 3351 1650 110929 1950
63221 96.2 328975 2099 3099 112075 1951
63639 98.1 346999 1932 3594 113270 1952
64989 99.0 365385 1870 3547 115094 1953
63761 100.0 363112 3578 3350 116219 1954
66019 101.2 397469 2904 3048 117388 1955
67857 104.6 419180 2822 2857 118734 1956
68169 108.4 442769 2936 2798 120445 1957
66513 110.8 444546 4681 2637 121950 1958
68655 112.6 482704 3813 2552 123366 1959
69564 114.2 502601 3931 2514 125368 1960
69331 115.7 518173 4806 2572 127852 1961
70551 116.9 554894 4007 2827 130081 1962
"""

# Wampler 3: the exact polynomial plus these; Wampler 4 and 5: plus 100 and 10 000 times as much
WAMPLER = [759, -2048, 2048, -2048, 2523, -2048, 2048, -2048, 1838, -2048, 2048]
WAMPLER += WAMPLER[-2::-1]


@dataclass(frozen=True)
class Certified:
    """A (m, n), y (m,), coefficients and their standard deviations (n,), and the digits of both to reach by QR."""

    A: np.ndarray
    y: np.ndarray
    value: np.ndarray
    std: np.ndarray
    digits: float
    std_digits: float


def numbers(text: str, columns: int) -> np.ndarray:
    return np.array(text.split(), float).reshape(-1, columns)


def filip() -> Certified:
    y, x = numbers(FILIP, 2).T
    value = """-1467.48961422980 -2772.17959193342 -2316.37108160893 -1127.97394098372 -354.478233703349
        -75.1242017393757 -10.8753180355343 -1.06221498588947 -0.670191154593408E-01 -0.246781078275479E-02
        -0.402962525080404E-04"""
    std = """298.084530995537 559.779865474950 466.477572127796 227.204274477751 71.6478660875927 15.2897178747400
        2.23691159816033 0.221624321934227 0.142363763154724E-01 0.535617408889821E-03 0.896632837373868E-05"""
    A = np.vander(x, 11, increasing=True)
    return Certified(A, y, numbers(value, 1)[:, 0], numbers(std, 1)[:, 0], 7.5, 7.0)


def longley() -> Certified:
    table = numbers(LONGLEY, 7)
    value = [-3482258.63459582, 15.0618722713733, -0.0358191792925910, -2.02022980381683, -1.03322686717359]
    value += [-0.0511041056535807, 1829.15146461355]
    std = [890420.383607373, 84.9149257747669, 0.0334910077722432, 0.488399681651699, 0.214274163161675]
    std += [0.226073200069370, 455.478499142212]
    A = np.column_stack([np.ones(16), table[:, 1:]])
    return Certified(A, table[:, 0], np.array(value), np.array(std), 10.5, 11.0)


def wampler(which: int) -> Certified:
    x = np.arange(21.0)
    A = np.vander(x, 6, increasing=True)
    value = np.ones(6) if which != 2 else 0.1 ** np.arange(6)
    noise = {1: 0, 2: 0, 3: 1, 4: 100, 5: 10_000}[which]
    y = A @ value + noise * np.array(WAMPLER, float)
    # certified for Wampler 3; 4 and 5 are 100 and 10 000 times as much
    std = [2152.32624678170, 2363.55173469681, 779.343524331583, 101.475507550350, 5.64566512170752, 0.112324854679312]
    digits = {1: 9.0, 2: 10.0, 3: 9.0, 4: 7.5, 5: 5.5}[which]
    return Certified(A, y, value, noise * np.array(std), digits, 12.0)


SETS = {"longley": longley, "filip": filip, **{f"wampler{k}": lambda k=k: wampler(k) for k in range(1, 6)}}


def digits(found: np.ndarray, certified: np.ndarray) -> float:
    return float(-np.log10(max(float((np.abs(found - certified) / np.abs(certified)).max()), 1e-15)))


def solution(c: Certified) -> Solution:
    return solve(reduce(c.A, c.y), 1e-15)


@pytest.mark.parametrize("name", SETS)
def test_certified_digits(name: str) -> None:
    """Measured: Longley 10.9; Filip 8.1; Wampler 9.2, 12.6, 9.6, 7.8, 5.8. numpy's lstsq: 10.9; 5.7; 9.6, 10.4, 9.5,
    7.8, 5.8."""
    c = SETS[name]()
    found = solution(c)
    assert found.dependent == {}
    assert digits(found.x, c.value) >= c.digits
    if c.std.any():
        std = found.residual_norm / np.sqrt(found.degrees) * np.sqrt(np.diag(found.inverse))
        assert digits(std, c.std) >= c.std_digits


@pytest.mark.parametrize("name", SETS)
def test_blocks_cost_no_digits(name: str) -> None:
    c = SETS[name]()
    parts = merge(reduce(a, y) for a, y in zip(np.array_split(c.A, 3), np.array_split(c.y, 3), strict=True))
    assert digits(solve(parts, 1e-15).x, c.value) >= c.digits - 0.7


def test_units_of_columns_cost_no_digits() -> None:
    c = longley()
    units = 10.0 ** np.arange(-9, 12, 3)
    scaled = solve(reduce(c.A * units, c.y), 1e-15)
    assert digits(scaled.x * units, c.value) >= 10.5


def test_dependent_columns_are_found_in_any_unit() -> None:
    A = np.random.default_rng(0).standard_normal((50, 4))
    A[:, 2] = 1e9 * (A[:, 0] - A[:, 1])
    A[:, 3] = 0
    found = solve(reduce(A, A[:, 0]))
    assert found.kept == (0, 1)
    assert set(found.dependent) == {2, 3}
    assert found.dependent[3] is None
    assert found.x == pytest.approx([1, 0, 0, 0], abs=1e-12)


# ------------------------------------------------------------------------------------------------ an hour of log

HOUR = """
import sys, time
sys.path.insert(0, sys.argv[2])
import numpy as np
from support.drives import drive
import excite
from excite.identification import identify
from excite.logs import Log, from_table
from excite.simulation import measure, simulate

model = excite.load("va12")
motion = simulate(model, drive(model, 60, 0, {"u1": 1200, "u2": 4500, "u4": 1200}))
one = from_table(measure(model, motion, seed=1), model.machine)
minutes = int(sys.argv[1])
kinds = {s.name: s.kind for s in model.machine.sensor}
def repeated(name, v):
    travel = v[-1] - v[0] if kinds[name] in ("angle", "wheel") else 0.0
    if name == "theta2":  # a joint that ends where it began, so that it doesn't jump there
        v, travel = v - travel * np.linspace(0, 1, len(v)), 0.0
    return np.concatenate([v[:-1] + k * travel for k in range(minutes)])
long = Log("long", np.arange(6000 * minutes) / 100, {k: repeated(k, v) for k, v in one.values.items()})
begin = time.process_time()
estimate = identify(model, [long], "ols")
spent = time.process_time() - begin
# not ru_maxrss, which a child takes over from the test process that started it
most = next(line.split()[1] for line in open("/proc/self/status") if line.startswith("VmHWM"))
print(spent, int(most) / 1024, len(estimate.value))
"""


@pytest.mark.slow
@pytest.mark.xfail(reason="tests of fit and the uncertainty budget of an hour take 2.4 GB", run=False)
def test_an_hour_of_log_takes_seconds_and_little_memory() -> None:
    """360 000 samples, 22 parameters, 6 rows. Measured: 10 s of processor time, 480 MB at most, 2.2 MB for each
    further minute (log 0.5, signals 0.9, decimated rows 0.6); the regressor as a whole would take 380 MB, several
    times over."""

    def run(minutes: int) -> tuple[float, float]:
        here = str(Path(__file__).parents[1])
        done = subprocess.run(
            [sys.executable, "-c", HOUR, str(minutes), here], capture_output=True, text=True, check=True, cwd=Path.cwd()
        )
        seconds, memory, _ = map(float, done.stdout.split())
        return seconds, memory

    short, few = run(20)
    long, most = run(60)
    assert long < 40
    assert long < 4.5 * short
    assert most < 700
    assert (most - few) / 40 < 4.0
