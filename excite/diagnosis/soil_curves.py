"""Smooth curves of what no effect explains on a machine with contacts: torques of joints and forces of the soil.

The fit beside unknown forces says what each torque and contact force lacks along the logs. Where that is a function of
one signal on stretches that were withheld from it, the function becomes a table in the machine file. The tables are
fitted with the model, and kept if the model then predicts withheld stretches better.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from excite.diagnosis import curves, evidence
from excite.diagnosis.acceptance import MIN_STDS
from excite.diagnosis.curves import Curve
from excite.diagnosis.fits import ExtendedFit, beside_unknown_forces, refit
from excite.diagnosis.hold_out import STRETCH_S, HoldOutErrors, HoldOutGain, hold_out_errors, hold_out_gain
from excite.diagnosis.parallel import CallRunner, run_in_turn
from excite.diagnosis.score_test import Candidate
from excite.diagnosis.selection import fitted_machine, identified_entry
from excite.model import effects
from excite.model.effects import SOIL_SIGNALS, soil_table, torque_table
from excite.model.machine import Body, EffectEntry
from excite.smoothing import NotConvergedError, StateSpace, Trajectory, feature_names

FOLDS = 5  # of stretches, each withheld in turn
MIN_SHARE = 0.1  # of what a force lacks, predicted on withheld stretches, from which its curve is tried; chosen
MOST_FORMS = 4  # of one lack that are tried; chosen
RIDGE = 1e-6  # of the mean square of a basis, which keeps the coefficients of empty knots finite


@dataclass(frozen=True)
class Lack:
    """A torque or a contact's force that the model lacks along all logs.

    body: its joint or contact. values (N,) [N m, N]: the force, or what resists a joint. effect: that has its table.
    kind: of the force, "" for a torque. laws: a factor (N,) by which the curve is multiplied, by what it changes
    (`effects.soil_table`). signals: on which its table may depend in each log, by name and unit.
    """

    body: Body
    effect: str
    kind: str
    values: np.ndarray
    laws: Mapping[str, np.ndarray]
    signals: Mapping[tuple[str, str], list[np.ndarray]]


@dataclass(frozen=True)
class Shown:
    """A lack as a function of one signal.

    signal: name and unit; along: its values in each log. changes: see `Lack.laws`. share: of the lack's mean
    square that is predicted on withheld stretches. coefficients (FOLDS + 1, n): of the splines, without each fold; of
    all.
    """

    lack: Lack
    signal: tuple[str, str]
    along: list[np.ndarray]
    changes: str
    share: float
    coefficients: np.ndarray

    @property
    def label(self) -> str:
        """Name of the effect at its place."""
        return f"{self.lack.effect}@{self.lack.body.where}"

    def entry(self, factor: float = 1.0) -> EffectEntry:
        """Return the curve times a factor as an effect of the machine file."""
        nodes, (signal, _), body = curves.table_nodes(self.along), self.signal, self.lack.body
        f = (factor * curves.spline_basis(nodes, self.along) @ self.coefficients[-1]).tolist()
        x, soil = nodes.tolist(), bool(self.lack.kind)
        own = soil_table(signal, x, f, self.changes) if soil else torque_table(signal, body.index, x, f)
        return identified_entry(self.lack.effect, body.where, 1.0, own)

    def curve(self, fitted: tuple[float, float], percent: float, interval: tuple[float, float], together: int) -> Curve:
        """Return the curve times its fitted factor (with its std), with the scatter of its folds (jackknife)."""
        factor, factor_std = fitted
        at = curves.curve_points(self.along)
        every = curves.spline_basis(at, self.along) @ self.coefficients.T
        scatter = np.sqrt((FOLDS - 1) * np.var(every[:, :FOLDS], axis=1))
        value, std = factor * every[:, -1], np.hypot(factor * scatter, factor_std * every[:, -1])
        unit = "N" if self.lack.kind else "N m" if self.lack.body.joint == "revolute" else "N"
        lacks = f"a {self.lack.kind} force" if self.lack.kind else "a torque"
        if self.changes == "stiffness":
            value, std, unit, lacks = 100 * value, 100 * std, "%", f"a change of its {self.lack.kind} stiffness"
        entry = self.entry(factor).model_copy(update={"std": curves.relative_std(value, std)})
        where, signal = self.lack.body.where.replace("_", " "), (f"its {self.signal[0]}", self.signal[1])
        return Curve((where, unit), signal, at, value, std, percent, interval, entry, lacks, together)


@dataclass(frozen=True)
class WithCurves:
    """A fit with curves, and its gain on withheld stretches over that without."""

    stage: ExtendedFit
    curves: tuple[Curve, ...]
    gain: HoldOutGain


def find_soil_curves(
    stage: ExtendedFit, before: HoldOutErrors | None, runner: CallRunner = run_in_turn
) -> WithCurves | None:
    """Add the curves that withheld stretches of a fit's logs are predicted better with; None if there are none.

    before: errors of the fit on these stretches.
    """
    try:
        known, rate = {e.name for e in stage.model.effects}, float(stage.machine.sampling_hz)
        lacks = _lacks(beside_unknown_forces(stage))
        shown = [x for own in lacks for x in _likeliest(own, rate) if x.label not in known]
        fitted = _fitted(stage, _chosen(stage, shown, runner)) if shown else None
    except NotConvergedError:
        return None
    if fitted is None or fitted[1].impossible:
        return None
    kept, extended, factors = fitted
    # The tables were drawn from all of the logs: their values count as parameters (Schwarz, 1978).
    price = float(np.log(stage.data.n_readings)) * (curves.FUNCTIONS + 1) * len(kept)
    if stage.exact and extended.exact and stage.deviance - extended.deviance < price * extended.dispersion:
        return None
    gain = hold_out_gain(before, hold_out_errors(extended))
    if gain is None or gain.interval is None or not gain.interval[0] > 0:
        return None
    drawn = (x.curve(factors[x.label], gain.percent, gain.interval, len(kept)) for x in kept)
    return WithCurves(extended, tuple(drawn), gain)


Factors = dict[str, tuple[float, float]]  # of the curves, with their standard deviations, by label of the effect


def _fitted(stage: ExtendedFit, found: Sequence[Shown]) -> tuple[Sequence[Shown], ExtendedFit, Factors] | None:
    """Return the curves that clearly act, and the fit with them; None if there are none. Raises NotConvergedError."""
    while found:
        extended = refit(effects.with_effects(fitted_machine(stage), *(x.entry() for x in found)), stage)
        names, fit = extended.model.base.names, extended.fit
        at = {x.label: names.index(x.label) for x in found}
        factors = {name: (float(fit.X[k]), float(fit.std[k])) for name, k in at.items()}
        clear = [x for x in found if factors[x.label][0] > MIN_STDS * factors[x.label][1]]
        if len(clear) == len(found):
            return found, extended, factors
        found = clear
    return None


def _missing_inputs(beside: ExtendedFit, features: Sequence[np.ndarray]) -> np.ndarray:
    """Return what every input lacks along all logs (N, n_inputs) [N m, N], by a fit beside unknown forces."""
    space, found = beside.data.space, []
    for along, trajectory, own in zip(features, beside.fit.trajectories, beside.fit.unknown.lacking, strict=True):
        total = own.added_inputs(trajectory.lacking, along, space.n_inputs)
        total[:, : trajectory.torque_error.shape[1]] += trajectory.sampled_torque_error
        if trajectory.force_error is not None:
            total[:-1, space.n_inputs - len(space.forces) :] += trajectory.force_error
        found.append(total)
    return np.concatenate(found)


def _lacks(beside: ExtendedFit) -> Iterator[Lack]:
    """Yield what each torque and each force along or across a contact lacks."""
    space, model, trajectories = beside.data.space, beside.model, beside.fit.trajectories
    features = [space.features(t.state)[0][:, :, 0] for t in trajectories]
    missing = _missing_inputs(beside, features)
    constant = np.ones(len(missing))
    for k, body in enumerate(model.machine.actuated):
        unit = "rad" if body.joint == "revolute" else "m"
        moved = [_moved(space, body, t) for t in trajectories]
        signals = {("angle", unit): [q for q, _ in moved], ("speed", f"{unit}/s"): [rate for _, rate in moved]}
        yield Lack(body, "torque_map", "", -missing[:, k], {"force": constant}, signals)
    standard = dict(zip(model.base.standard, model.expand @ beside.fit.X, strict=True))
    first = space.n_inputs - len(space.forces)
    for i, (owner, kind) in enumerate(space.forces):
        if kind in ("lengthwise", "lateral"):
            body = model.machine.find(owner)
            along = [_soil_signals(space, body, *own) for own in zip(trajectories, features, strict=True)]
            signals = {name: [own[name] for own in along] for name in along[0]}
            slip = np.concatenate(signals[f"{kind} slip", "-"])
            law = standard[f"K{'x' if kind == 'lengthwise' else 'y'}{owner}"] * slip
            laws = {"force": constant, "stiffness": law}
            yield Lack(body, f"{kind}_map", kind, missing[:, first + i], laws, signals)


def _moved(space: StateSpace, body: Body, trajectory: Trajectory) -> tuple[np.ndarray, np.ndarray]:
    """Return angle or position, and speed (N,) of a joint along a log; zero for a locked one."""
    q, nu, _ = space.unpack(trajectory.state)
    machine = space.model.machine
    if not machine.is_free(body):
        return np.zeros(len(q)), np.zeros(len(q))
    return machine.joint_positions(body, q.T), machine.joint_values(body, nu.T)


def _soil_signals(
    space: StateSpace, body: Body, trajectory: Trajectory, features: np.ndarray
) -> dict[tuple[str, str], np.ndarray]:
    """Return the signals (N,) along a log on which a table at a contact may depend, by name and unit."""
    assert body.contact is not None
    angle, rate = _moved(space, body, trajectory)
    names = feature_names(space.model)
    gx, gy = (features[:, names.index((kind, body.index))] for kind in ("gx", "gy"))
    radius = float(body.contact.radius)
    speed = radius * rate + gx * np.hypot(radius * rate, float(body.contact.v_eps))
    values = gx, gy, np.hypot(gx, gy), speed, radius * angle
    return dict(zip(SOIL_SIGNALS.items(), values, strict=True))


def _likeliest(lack: Lack, rate: float) -> list[Shown]:
    """Return the functions of one signal that predict most of a lack on withheld stretches, if they do enough of it.

    rate [Hz]: of the samples.
    """
    fold = np.arange(len(lack.values)) // round(STRETCH_S * rate) % FOLDS
    found = []
    for signal, along in lack.signals.items():
        if len(np.unique(curves.spline_knots(along))) < 3:  # it rests
            continue
        B = curves.spline_basis(np.concatenate(along), along)
        for changes, law in lack.laws.items():
            if law.any():
                found.append(Shown(lack, signal, along, changes, *_fit(B * law[:, None], lack.values, fold)))
    found.sort(key=lambda one: -one.share)
    return [one for one in found[:MOST_FORMS] if one.share > MIN_SHARE]


def _chosen(stage: ExtendedFit, shown: Sequence[Shown], runner: CallRunner) -> list[Shown]:
    """Return the curves that evidence chooses, at most one of each lack."""
    tried = [Candidate(effects.place_effect(stage.machine, x.entry()), (k,)) for k, x in enumerate(shown)]
    form = stage.form(tried, runner)
    stage.release()
    return [shown[x.columns[0]] for x in evidence.choose(form).candidates]


def _fit(B: np.ndarray, y: np.ndarray, fold: np.ndarray) -> tuple[float, np.ndarray]:
    """Fit y (N,) by columns B (N, n): share predicted on withheld folds, coefficients without each fold and of all."""
    ridge = RIDGE * float(np.mean(B**2)) * len(y) * np.eye(B.shape[1])
    grams = [(B[at].T @ B[at], B[at].T @ y[at]) for at in (fold == f for f in range(FOLDS))]
    A, b = (np.sum(own, axis=0) for own in zip(*grams, strict=True))
    without = [np.linalg.solve(A - own + ridge, b - right) for own, right in grams]
    error = sum(float(((y - B @ c)[fold == f] ** 2).sum()) for f, c in enumerate(without))
    share = 1 - error / max(float(y @ y), 1e-300)
    return share, np.array([*without, np.linalg.solve(A + ridge, b)])
