"""The Rosenbrock method RODAS: coefficients and linear solves of its stages.

Source: Hairer and Wanner, "Solving Ordinary Differential Equations II", IV.7.
"""

from __future__ import annotations

import casadi as ca

# (I/(gamma h) - J) U_i = f(t + alpha_i h, y + sum a_ij U_j) + sum c_ij U_j / h + d_i h df/dt
# y1 = y + sum a_6j U_j + U_6, error estimate U_6
GAMMA = 0.25

# alpha_i
STAGE_TIMES = (0.0, 0.386, 0.21, 0.63, 1.0, 1.0)

# d_i
TIME_DERIVATIVE_WEIGHTS = (0.25, -0.1043, 0.1035, -0.0362, 0.0, 0.0)

# a_ij
A_ROWS = (
    (),
    (1.544,),
    (0.9466785280815826, 0.2557011698983284),
    (3.314825187068521, 2.896124015972201, 0.9986419139977817),
    (1.221224509226641, 6.019134481288629, 12.53708332932087, -0.6878860361058950),
    (1.221224509226641, 6.019134481288629, 12.53708332932087, -0.6878860361058950, 1.0),
)

# c_ij
C_ROWS = (
    (),
    (-5.6688,),
    (-2.430093356833875, -0.2063599157091915),
    (-0.1073529058151375, -9.594562251023355, -20.47028614809616),
    (7.496443313967647, -10.24680431464352, -33.99990352819905, 11.70890893206160),
    (8.083246795921522, -7.981132988064893, -31.52159432874371, 16.31930543123136, -6.058818238834054),
)


def lu(A: ca.SX) -> tuple[ca.SX, ca.SX]:
    """Factorise A = lower upper without pivoting, structural zeros kept.

    I/(gamma h) - J of a dissipative system has no small pivot.
    """
    n = A.shape[0]
    lower, upper = ca.SX.eye(n), ca.SX(A)
    for k in range(n):
        for i in range(k + 1, n):
            if not upper.sparsity().has_nz(i, k):
                continue
            lower[i, k] = upper[i, k] / upper[k, k]
            for j in range(k + 1, n):
                if upper.sparsity().has_nz(k, j):
                    upper[i, j] = upper[i, j] - lower[i, k] * upper[k, j]
    return ca.tril(lower), ca.triu(upper)


def lu_solve(lower: ca.SX, upper: ca.SX, b: ca.SX) -> ca.SX:
    """Solve lower upper x = b."""
    return ca.solve(upper, ca.solve(lower, b))
