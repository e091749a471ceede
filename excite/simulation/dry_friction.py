"""Set-valued dry friction: joints that stick, break away and slip, by events between the integrator's steps.

The dry friction of a joint is the set Fs Sgn(w): Fs sgn(w) while it slips, anything from -Fs to Fs at rest. Between two
events every joint either slips with a fixed sign or is held at w = 0, so the equations are smooth. A slipping joint's
event is its rate crossing zero; a held joint's is the torque that holds it leaving the set. At an event the joints at
rest get the friction torques with which all accelerations agree: a joint that starts to slip forward has the upper end
of its set, one that starts backward the lower end, one that stays at rest none in particular. This linear
complementarity problem has one solution as the mass matrix is positive definite and Fs does not depend on the
accelerations. Effects that scale with sgn(w) (Stribeck friction, asymmetry, warm-up, load, brakes) shift the ends of
the set, which are the balance of the joint at sgn = -1 and sgn = 1.

Source: Glocker, "Set-Valued Force Laws", Springer, 2001, ch. 5 and 6; Leine and Nijmeijer, "Dynamics and Bifurcations
of Non-Smooth Mechanical Systems", Springer, 2004, ch. 5 and 6; Murty, "Note on a Bard-type scheme for solving the
complementarity problem", Opsearch 11 (1974), for the pivoting.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

import casadi as ca
import numpy as np

from excite.errors import MachineError, SimulationError
from excite.model import Model

EVENT_TIME = 1e-14  # s, accuracy with which an event is located; chosen, far below the error of a step
BREAKAWAY = 1e-9  # excess of the holding torque over the set's end at which a joint slips, share of its width; chosen
TIE = 1e-12  # excess below which friction and acceleration count as zero in the choice of modes; chosen < BREAKAWAY
MIN_DRY_SHARE = 1e-9  # width of the set, over all torques on the joint, below which it never sticks; chosen
MAX_EVENTS = 1000  # events in one sample; chosen, more means that modes alternate without end


class DryFriction:
    """Modes of all joints with dry friction during one simulation.

    parameters: X, then sgn (n_rubbing,) of the joints' rates, then 1 for each joint that slips and 0 for each that is
    held. The integrator's step reads this array; an event updates it in place. A held joint has sgn = -1: its friction
    is counted from the lower end of its set.
    """

    def __init__(self, model: Model, X: np.ndarray) -> None:
        """Prepare a simulation with base parameters X (n_base,).

        Raises MachineError for an effect whose friction never sticks.
        """
        for e in model.effects:
            if e.unsticking:
                raise MachineError(
                    f"{model.machine.name}: effect {e.name} replaces dry friction by a law that never sticks, simulate"
                    " it with smoothed friction"
                )
        n = len(model.rubbing)
        self.parameters = np.concatenate([X, np.zeros(n), np.ones(n)])
        self._sign, self._slips = self.parameters[len(X) : len(X) + n], self.parameters[len(X) + n :]
        self._names = [b.where for b in model.machine.rubbing]
        self._joints = list(model.rubbing)
        self._rates = [len(model.coordinates) + row for row in model.rubbing]
        self._model = model
        terms = _terms_function(model)
        self._state, self._u = np.zeros(terms.numel_in(0)), np.zeros(terms.numel_in(1))
        n_q = len(model.coordinates)
        self._mass, self._force = np.zeros((n_q, n_q)), np.zeros(n_q)
        self._a, self._width = np.zeros(n_q), np.zeros(n)
        self._buffer, self._evaluate = terms.buffer()
        for k, array in enumerate((self._state, self._u, self.parameters)):
            self._buffer.set_arg(k, array.data)
        for k, array in enumerate((self._mass, self._force, self._a, self._width)):
            self._buffer.set_res(k, array.data)
        self._before = np.zeros(n)  # accelerations of the joints where the step begins
        self._events = 0
        self._history: list[np.ndarray] = []

    def begin(self, state: np.ndarray, u: np.ndarray) -> None:
        """Choose the modes at the start of a motion."""
        self._settle(state, u)
        self._history.append(self.parameters.copy())

    def end_step(
        self, attempt: Callable[[float], np.ndarray], start: np.ndarray, end: np.ndarray, u: np.ndarray, length: float
    ) -> float:
        """End a step of `length` [s] from `start` to `end` at its first event; return the share of it that was taken.

        u (n_u,) [N m]: torques at the end. attempt(h) puts the state after h [s] into `end` and returns the torques
        then.
        Raises SimulationError for events without end or negative dry friction.
        """
        high = length
        if not self._happened(end, u):
            after = self._a[self._joints].copy()
            dip = self._lowest(start, end, after, length)
            if dip is None:
                self._before = after
                return 1.0
            high = dip
            if not self._happened(end, attempt(dip)):
                attempt(length)
                self._before = after
                return 1.0
        low = 0.0
        while high - low > EVENT_TIME:
            middle = (low + high) / 2
            if self._happened(end, attempt(middle)):
                high = middle
            else:
                low = middle
        u = attempt(high)
        crossed = (self._slips > 0) & (self._sign * end[self._rates] < 0)
        end[np.array(self._rates)[crossed]] = 0.0
        self._events += 1
        if self._events > MAX_EVENTS:
            raise SimulationError(
                f"joints stick and slip without end at t = {self._time:.3f} s,"
                f" state {np.array2string(end, precision=3)}: simulate with smoothed friction"
            )
        self._settle(end, u)
        return high / length

    def end_sample(self) -> None:
        """Record the modes at a sample."""
        self._events = 0
        self._history.append(self.parameters.copy())

    def accelerations(self, states: np.ndarray, driven: np.ndarray) -> np.ndarray:
        """Return the accelerations (N, n_q) at the samples under torques driven (N, n_u) [N m]."""
        terms = _terms_function(self._model)
        return np.asarray(terms(states.T, driven.T, np.array(self._history).T)[2].full().T)

    @property
    def _time(self) -> float:
        """Time of the last sample [s]."""
        return max(len(self._history) - 1, 0) / float(self._model.machine.sampling_hz)

    def _update(self, state: np.ndarray, u: np.ndarray) -> None:
        self._state[:], self._u[:] = state, u
        self._evaluate()

    def _happened(self, state: np.ndarray, u: np.ndarray) -> bool:
        """Tell if a slipping joint has passed zero speed, or a held one can't be held any more."""
        self._update(state, u)
        held = (self._force - self._mass @ self._a)[self._joints]
        excess = BREAKAWAY * self._width
        slipping = self._sign * state[self._rates] < 0
        return bool(np.where(self._slips > 0, slipping, (held < -excess) | (held > self._width + excess)).any())

    def _lowest(self, start: np.ndarray, end: np.ndarray, after: np.ndarray, length: float) -> float | None:
        """Return the time [s] in a step at which a slipping joint is slowest and past zero, None if there is none.

        The rate between both ends is the cubic with the rates and accelerations there.
        """
        w0, w1 = (self._sign * x[self._rates] for x in (start, end))
        d0, d1 = (length * self._sign * x for x in (self._before, after))
        found = []
        for k in np.flatnonzero((self._slips > 0) & (d0 < 0) & (d1 > 0)):
            cubic = np.polynomial.Polynomial(
                [w0[k], d0[k], 3 * (w1[k] - w0[k]) - 2 * d0[k] - d1[k], d0[k] + d1[k] - 2 * (w1[k] - w0[k])]
            )
            roots = np.asarray(cubic.deriv().roots(), complex)
            turns = roots.real[(np.abs(roots.imag) < 1e-9) & (roots.real > 0) & (roots.real < 1)]
            found += [length * float(x) for x in turns[np.asarray(cubic(turns)) < 0]]
        return min(found, default=None)

    def _settle(self, state: np.ndarray, u: np.ndarray) -> None:
        """Choose the modes with which the accelerations of all joints at rest agree.

        Raises SimulationError for negative dry friction or an impossible mass matrix.
        """
        rates = state[self._rates]
        still = rates == 0.0
        self._sign[:], self._slips[:] = np.where(still, -1.0, np.sign(rates)), 1.0
        self._update(state, u)
        scale = np.abs(self._force[self._joints]) + np.abs(self._width)
        if (self._width < -MIN_DRY_SHARE * scale).any():
            name = self._names[int(np.argmin(self._width))]
            raise SimulationError(
                f"{name}: dry friction is negative at t = {self._time:.3f} s: check Fs and the effects on it"
            )
        dry = np.flatnonzero(still & (self._width > MIN_DRY_SHARE * scale))
        if len(dry):
            rows = np.array(self._joints)[dry]
            try:
                np.linalg.cholesky(self._mass)
                modes = _consistent_modes(
                    np.linalg.inv(self._mass)[np.ix_(rows, rows)], self._a[rows], self._width[dry]
                )
            except np.linalg.LinAlgError:
                raise SimulationError(
                    "the mass matrix is not positive definite: masses and inertias must be physically possible, check"
                    " the parameters"
                ) from None
            self._sign[dry] = np.where(modes > 0, 1.0, -1.0)
            self._slips[dry] = modes != 0
            self._update(state, u)
        smooth = np.setdiff1d(np.flatnonzero(still), dry)
        self._sign[smooth] = np.where(self._a[self._joints][smooth] < 0, -1.0, 1.0)
        self._update(state, u)
        self._before = self._a[self._joints].copy()


def _consistent_modes(W: np.ndarray, b: np.ndarray, width: np.ndarray) -> np.ndarray:
    """Return the modes (n,) of joints at rest: 0 held, 1 slips forward, -1 backward.

    Find f with 0 <= f <= width and a = b - W f such that a <= 0 at f = 0, a >= 0 at f = width, a = 0 in between.
    W (n, n), positive definite: accelerations by friction torques; b (n,): accelerations at f = 0.
    Pivoting by the least index ends for a positive definite W.
    """
    mode = np.zeros(len(b), int)
    slack = TIE * np.diag(W) * width
    for _ in range(3 ** len(b)):
        held = mode == 0
        f = np.where(mode > 0, width, 0.0)
        f[held] = np.linalg.solve(W[np.ix_(held, held)], b[held] - W[np.ix_(held, ~held)] @ f[~held])
        a = b - W @ f
        below, above = held & (f < -TIE * width), held & (f > (1 + TIE) * width)
        wrong = below | above | ((mode < 0) & (a > slack)) | ((mode > 0) & (a < -slack))
        if not wrong.any():
            return mode
        k = int(np.argmax(wrong))
        mode[k] = -1 if below[k] else 1 if above[k] else 0
    raise np.linalg.LinAlgError("no consistent modes")


@lru_cache(maxsize=8)
def _terms_function(model: Model) -> ca.Function:
    """Build (state, u, parameters of `DryFriction`) -> mass matrix, force, acceleration, width of the friction sets.

    force (n_q,): torques delivered minus bias at the given signs; M a = force but for held joints, whose friction above
    the lower end of the set is the difference. width (n_rubbing,) [N m].
    """
    q, nu, _ = model.symbols()
    n, wheels = len(model.rubbing), sum(s.kind == "wheel" for s in model.machine.sensor)
    u, z = ca.SX.sym("u", len(model.inputs)), ca.SX.sym("z", len(model.memory))
    X = ca.SX.sym("X", len(model.base.names))
    sign, slips = ca.SX.sym("sign", n), ca.SX.sym("slips", n)
    M, bias = model.equations(q, nu, X, u, z, sign)
    low, high = (model.equations(q, nu, X, u, z, side * ca.SX.ones(n))[1] for side in (-1, 1))
    a = model.accelerate(q, nu, u, X, z, sign, slips)
    state = ca.vertcat(q, nu, ca.SX.sym("w", wheels), z)
    results = [ca.densify(x) for x in (M, model.joint_torques(u) - bias, a, (high - low)[list(model.rubbing)])]
    return ca.Function("terms", [state, u, ca.vertcat(X, sign, slips)], results, {"cse": True})
