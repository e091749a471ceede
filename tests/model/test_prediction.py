"""What the equations predict, what can be identified in them, and that the regressor says the same thing."""

from __future__ import annotations

import re

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from excite.model import Model, build, standard_parameters
from excite.model.machine import Machine, load_machine

# The contract's reference machine, by hand.
D2, D3, M0, M1, M2, M4 = 1.45, 1.75, 2600.0, 1900.0, 4300.0, 2200.0
MX0, MY0, MX2, MY2 = -0.55 * M0, 0.10 * M0, -0.95 * M2, -0.10 * M2
ZZ0 = 2900 + M0 * (0.55**2 + 0.10**2)  # about O0
ZZ2 = 5200 + M2 * (0.95**2 + 0.10**2)  # about O2
XX1, XX4 = 976.0, 1144.0
VA12 = {
    "M": (M0 + M1 + M2 + M4, "kg"),
    "MX0R": (MX0 - D2 * (M2 + M4), "kg m"),
    "MY0": (MY0, "kg m"),
    "ZZ0R": (ZZ0 + XX1 + D2**2 * (M2 + M4), "kg m2"),
    "MX2": (MX2 - D3 * M4, "kg m"),
    "MY2": (MY2, "kg m"),
    "ZZ2": (ZZ2 + XX4 + D3**2 * M4, "kg m2"),
    "ZZ1": (556.32, "kg m2"),
    "Fv1": (64.75, "N m s"),
    "Fs1": (174.74, "N m"),
    "Kx1": (-1.0e5, "N"),
    "Ky1": (-0.9e5, "N"),
    "u10": (-183.14, "N m"),
    "Fv2": (4000.0, "N m s"),
    "Fs2": (800.0, "N m"),
    "u20": (-150.0, "N m"),
    "ZZ4": (671.33, "kg m2"),
    "Fv4": (82.84, "N m s"),
    "Fs4": (142.73, "N m"),
    "Kx4": (-1.2e5, "N"),
    "Ky4": (-1.1e5, "N"),
    "u40": (-181.94, "N m"),
}
STRAIGHT = ("M", "ZZ1", "Fv1", "Fs1", "Kx1", "u10", "ZZ4", "Fv4", "Fs4", "Kx4", "u40")
EMPS = {"M": (95.1089, "kg"), "Fv": (203.5034, "N s/m"), "Fc": (20.3935, "N"), "offset": (-3.1648, "N")}
GROUPS = {
    "M": {"M0": 1, "M1": 1, "M2": 1, "M4": 1},
    "MX0R": {"MX0": 1, "M2": -D2, "M4": -D2},
    "ZZ0R": {"ZZ0": 1, "XX1": 1, "M2": D2**2, "M4": D2**2},
    "MX2": {"MX2": 1, "M4": -D3},
    "ZZ2": {"ZZ2": 1, "XX4": 1, "M4": D3**2},
}
MODELS = {name: build(load_machine(name)) for name in ("va12", "va12_straight", "emps")}

seeds = st.integers(0, 2**32 - 1)


@pytest.fixture(params=list(MODELS))
def model(request: pytest.FixtureRequest) -> Model:
    return MODELS[request.param]


@pytest.fixture
def va12() -> Model:
    return MODELS["va12"]


def standard_values(model: Model) -> np.ndarray:
    return np.array([v for v, _ in standard_parameters(model.machine).values()])


def states(model: Model, n: int, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    q, nu, a = rng.normal(size=(3, len(model.coordinates), n))
    return q, nu, a


def multisine(model: Model, seed: int, seconds: float = 20.0, n: int = 200) -> tuple[np.ndarray, ...]:
    """A random smooth motion: velocities as sums of five sines, with their exact integral and derivative."""
    rng = np.random.default_rng(seed)
    size = (len(model.coordinates), 5, 1)
    amplitude, phase, w = rng.normal(0, 0.5, size), rng.uniform(0, 6.3, size), rng.uniform(0.2, 2.5, size)
    t = np.linspace(0, seconds, n)
    angle = w * t + phase
    nu = (amplitude * np.sin(angle)).sum(axis=1)
    return (-amplitude / w * np.cos(angle)).sum(axis=1), nu, (amplitude * w * np.cos(angle)).sum(axis=1)


def stacked_standard(model: Model, q: np.ndarray, nu: np.ndarray, a: np.ndarray) -> np.ndarray:
    """Standard regressor of N samples, (N n_rows, n_standard)."""
    n, width = q.shape[1], len(model.base.standard)
    W = model.standard_regressor(q, nu, a, standard_values(model)).full()
    return W.reshape(-1, n, width).transpose(1, 0, 2).reshape(-1, width)


def rank(W: np.ndarray) -> int:
    """Numerical rank by singular values of the columns at unit length."""
    size = np.linalg.norm(W, axis=0)
    s = np.linalg.svd(W[:, size > 1e-9 * size.max()] / size[size > 1e-9 * size.max()], compute_uv=False)
    return int(np.sum(s > 1e-8 * s[0]))


def forward(model: Model, q: np.ndarray, nu: np.ndarray, u: np.ndarray, p: np.ndarray) -> np.ndarray:
    """Accelerations by brute force: the mass matrix from unit accelerations, standard parameters, numpy's solver."""
    n = len(model.coordinates)

    def row(a: np.ndarray) -> np.ndarray:
        return model.predict(q, nu, a, p).full()[:, 0]

    rest = row(np.zeros(n))
    M = np.column_stack([row(e) - rest for e in np.eye(n)])
    drive = np.zeros(n)
    offsets = [p[model.base.standard.index(f"u{b.index}0")] for b in model.machine.actuated]
    drive[list(model.actuated)] = u + offsets
    return np.linalg.solve(M, drive - rest)


# ---------------------------------------------------------------------------------------------- the regressor
@settings(max_examples=20, deadline=None)
@given(seed=seeds)
@pytest.mark.parametrize("name", MODELS)
def test_regressor_times_parameters_is_the_prediction(name: str, seed: int) -> None:
    """W X = Y on random motions, Y from all standard parameters, W X from the base ones alone."""
    model = MODELS[name]
    q, nu, a = multisine(model, seed)
    Y = model.predict(q, nu, a, standard_values(model)).full()
    WX = (model.stacked_regressor(q, nu, a) @ model.nominal).T
    assert np.linalg.norm(WX - Y) <= 1e-9 * np.linalg.norm(Y)
    assert np.abs(WX - Y).max() <= 1e-9 * np.abs(Y).max()


def test_regressor_is_the_jacobian_of_the_prediction(model: Model) -> None:
    """Differences over wide steps: exact but for rounding, because every parameter enters linearly."""
    q, nu, a = states(model, 20, seed=1)
    p = standard_values(model)
    W = model.standard_regressor(q, nu, a, p).full().reshape(-1, 20, len(p))
    for j in range(len(p)):
        step = np.zeros(len(p))
        step[j] = max(1.0, abs(p[j]))
        up, down = (model.predict(q, nu, a, p + sign * step).full() for sign in (1, -1))
        column = (up - down) / (2 * step[j])
        assert np.allclose(W[:, :, j], column, rtol=1e-9, atol=1e-12 * np.abs(up).max() / step[j])


def test_prediction_has_no_part_without_parameters(model: Model) -> None:
    q, nu, a = states(model, 20, seed=2)
    assert not model.predict(q, nu, a, np.zeros(len(model.base.standard))).full().any()


def test_no_parameter_of_the_linear_law_enters_nonlinearly(model: Model) -> None:
    assert model.nonlinear == ()


def test_a_batch_is_its_samples_one_by_one(va12: Model) -> None:
    q, nu, a = states(va12, 7, seed=3)
    batch = va12.stacked_regressor(q, nu, a)
    assert batch.shape == (7, 6, 22)
    for k in range(7):
        assert np.array_equal(batch[k], va12.regressor(q[:, k], nu[:, k], a[:, k]).full())


def test_pose_on_level_ground_changes_nothing(va12: Model) -> None:
    q, nu, a = states(va12, 50, seed=4)
    elsewhere = q.copy()
    elsewhere[:3] += np.random.default_rng(5).normal(0, 10, (3, 50))
    p = standard_values(va12)
    assert np.array_equal(va12.predict(q, nu, a, p).full(), va12.predict(elsewhere, nu, a, p).full())
    assert np.array_equal(va12.stacked_regressor(q, nu, a), va12.stacked_regressor(elsewhere, nu, a))


def test_roll_angles_change_nothing(va12: Model) -> None:
    """The rolls are round: only the articulation angle matters."""
    q, nu, a = states(va12, 50, seed=6)
    turned = q.copy()
    turned[[3, 5]] += 1.234
    assert np.allclose(va12.stacked_regressor(q, nu, a), va12.stacked_regressor(turned, nu, a), rtol=1e-9, atol=1e-9)


# --------------------------------------------------------------------------------------------- base parameters
def test_va12_has_the_contracts_22_base_parameters(va12: Model) -> None:
    assert va12.base.names == tuple(VA12)
    assert dict(zip(va12.base.names, va12.base.units, strict=True)) == {n: unit for n, (_, unit) in VA12.items()}
    assert va12.nominal == pytest.approx([value for value, _ in VA12.values()], rel=1e-12)


def test_va12_groups_as_the_contract_says(va12: Model) -> None:
    for name in VA12:
        assert va12.base.grouping(name) == pytest.approx(GROUPS.get(name, {name: 1}), rel=1e-9)


def test_the_straight_line_has_the_contracts_11(va12: Model) -> None:
    straight = MODELS["va12_straight"]
    assert straight.base.names == STRAIGHT
    assert straight.base.units == tuple(VA12[n][1] for n in STRAIGHT)
    assert straight.nominal == pytest.approx([VA12[n][0] for n in STRAIGHT], rel=1e-12)
    for name in STRAIGHT:
        assert straight.base.grouping(name) == pytest.approx(GROUPS.get(name, {name: 1}), rel=1e-9)


def test_emps_has_four() -> None:
    emps = MODELS["emps"]
    assert dict(zip(emps.base.names, zip(emps.nominal, emps.base.units, strict=True), strict=True)) == EMPS


@settings(max_examples=30, deadline=None)
@given(seed=seeds)
@pytest.mark.parametrize(("name", "n"), [("va12", 22), ("va12_straight", 11), ("emps", 4)])
def test_rank_stays_under_random_motions(name: str, n: int, seed: int) -> None:
    """Neither fewer columns can be told apart nor, among all standard parameters, more."""
    model = MODELS[name]
    motion = multisine(model, seed)
    assert rank(model.stacked_regressor(*motion).reshape(-1, n)) == n
    assert rank(stacked_standard(model, *motion)) == n


def test_dependent_columns_are_what_the_grouping_says(model: Model) -> None:
    """Every standard column is its reported combination of the base columns; an invisible one is zero."""
    q, nu, a = states(model, 100, seed=7)
    W, base = stacked_standard(model, q, nu, a), model.base
    size = np.abs(W).max(axis=0)
    assert np.allclose(W, W[:, list(base.independent)] @ base.matrix, rtol=1e-9, atol=1e-9 * size.max())
    assert size[[base.standard.index(s) for s in base.invisible]] == pytest.approx(0, abs=1e-12)
    grouped = {s for name in base.names for s in base.grouping(name)}
    assert grouped.isdisjoint(base.invisible)
    assert grouped | set(base.invisible) == set(base.standard)


def test_what_cannot_be_seen_on_the_plane_is_reported(va12: Model) -> None:
    assert set(va12.base.invisible) == {f"{n}{k}" for n in ("MZ", "XX", "XY", "XZ", "YY", "YZ") for k in (0, 2)}
    assert {"Kx1", "M", "M0"}.isdisjoint(MODELS["va12_straight"].base.invisible)
    assert {"Ky1", "Ky4", "Fv2", "Fs2", "u20", "ZZ0", "ZZ2"} < set(MODELS["va12_straight"].base.invisible)


@settings(max_examples=40, deadline=None)
@given(seed=seeds)
@pytest.mark.parametrize("name", MODELS)
def test_two_machines_with_equal_base_values_move_alike(name: str, seed: int) -> None:
    """Shift mass between the bodies, inertia between roll and chassis, ...: the same torques, the same motion."""
    model = MODELS[name]
    rng = np.random.default_rng(seed)
    p = standard_values(model)
    _, s, Vt = np.linalg.svd(model.base.matrix)
    hidden = Vt[np.sum(s > 1e-9) :].T
    other = p + hidden @ rng.normal(0, 300, hidden.shape[1])
    assert np.linalg.norm(other - p) > 100
    assert model.base.matrix @ other == pytest.approx(model.nominal, rel=1e-9)
    (q, nu, _), u = (z[..., 0] for z in states(model, 1, seed)), rng.normal(0, 2000, len(model.inputs))
    a, b = forward(model, q, nu, u, p), forward(model, q, nu, u, other)
    assert np.linalg.norm(a - b) <= 1e-7 * np.linalg.norm(a)
    assert np.linalg.norm(model.acceleration(q, nu, u, model.nominal).full()[:, 0] - a) <= 1e-7 * np.linalg.norm(a)


def test_base_parameters_do_not_depend_on_the_units_of_length_and_mass() -> None:
    """A model of va12 at a scale 1 : 10 has the same 22, grouped with its own lengths."""
    raw = load_machine("va12").model_dump()
    for body in raw["body"]:
        body["d"]["value"] /= 10
        if body["inertia"]:
            for key, power in {"mass": 3, "XX": 5, "ZZ": 5}.items():
                body["inertia"][key]["value"] /= 10.0**power
            body["inertia"]["com"]["value"] = tuple(x / 10 for x in body["inertia"]["com"]["value"])
        if body["contact"]:
            for key in ("radius", "width"):
                body["contact"][key]["value"] /= 10
            for key in ("Kx", "Ky"):
                body["contact"][key]["value"] /= 1000
    small = build(Machine.model_validate(raw))
    assert small.base.names == tuple(VA12)
    assert small.base.grouping("ZZ0R") == pytest.approx({"ZZ0": 1, "XX1": 1, "M2": D2**2 / 100, "M4": D2**2 / 100})


def test_expanded_base_values_are_themselves(model: Model) -> None:
    assert model.base.matrix @ model.expand == pytest.approx(np.eye(len(model.nominal)))
    assert model.base_values() == pytest.approx(model.nominal)


def test_one_changed_standard_value_changes_its_groups(va12: Model) -> None:
    change = va12.base_values({"M4": M4 + 100}) - va12.nominal
    seen = {n: x for n, x in zip(va12.base.names, change, strict=True) if abs(x) > 1e-6}
    assert seen == pytest.approx({"M": 100, "MX0R": -100 * D2, "ZZ0R": 100 * D2**2, "MX2": -175, "ZZ2": 100 * D3**2})


def test_scale_is_the_size_of_the_nominal_value_with_the_files_floor(va12: Model) -> None:
    floor = {"MY0": 1000.0, "MY2": 1000.0, "u20": 500.0}
    assert va12.scale == pytest.approx([floor.get(n, abs(value)) for n, (value, _) in VA12.items()])


def test_units_are_those_of_the_quantities(model: Model) -> None:
    kinds = {
        r"M\d?R?": "kg",
        r"M[XYZ]\d?R?": "kg m",
        r"[XYZ][XYZ]\d?R?": "kg m2",
        r"K[xy]\d": "N",
        r"Fv\d?": "N m s|N s/m",
        r"(Fs|Fc)\d?|u\d0|offset": "N m|N",
    }
    units = {name: unit for name, (_, unit) in standard_parameters(model.machine).items()}
    units |= dict(zip(model.base.names, model.base.units, strict=True))
    for name, unit in units.items():
        (allowed,) = (u for pattern, u in kinds.items() if re.fullmatch(pattern, name))
        assert unit in allowed.split("|"), name


# --------------------------------------------------------------------------------------------- forward dynamics
@settings(max_examples=30, deadline=None)
@given(seed=seeds)
@pytest.mark.parametrize("name", MODELS)
def test_forward_dynamics_inverts_the_prediction(name: str, seed: int) -> None:
    """Torques to accelerations and back: a driven row reads u + u0, every other row zero."""
    model = MODELS[name]
    q, nu, _ = states(model, 10, seed)
    u = np.random.default_rng(seed).normal(0, 3000, (len(model.inputs), 10))
    a = model.acceleration(q, nu, u, model.nominal).full()
    Y = model.predict(q, nu, a, standard_values(model)).full()
    want = np.zeros_like(Y)
    values = dict(zip(standard_parameters(model.machine), standard_values(model), strict=True))
    offsets = np.array([[values[f"u{b.index}0"]] for b in model.machine.actuated])
    want[list(model.actuated)] = u + offsets
    WX = (model.stacked_regressor(q, nu, a) @ model.nominal).T
    largest = np.abs(model.stacked_regressor(q, nu, a) * model.nominal).max()  # of the terms that cancel in a row
    assert np.abs(Y - want).max() <= 1e-9 * largest
    assert np.abs(WX - want).max() <= 1e-9 * largest


def test_inputs_drive_their_own_rows(va12: Model) -> None:
    assert va12.coordinates == ("x0", "y0", "theta0", "theta1", "theta2", "theta4")
    assert va12.inputs == ("u1", "u2", "u4")
    assert va12.actuated == (3, 4, 5)
    straight = MODELS["va12_straight"]
    assert straight.coordinates == ("x0", "theta1", "theta4")
    assert straight.inputs == ("u1", "u4")
    assert straight.slips == ("gx1", "gx4")


def test_mass_matrix_and_bias_are_the_prediction_without_offsets(va12: Model) -> None:
    q, nu, a = (z[:, 0] for z in states(va12, 1, seed=11))
    qs, nus, _ = va12.symbols()
    f = ca.Function("f", [qs, nus], va12.equations(qs, nus, ca.DM(va12.nominal)))
    M, bias = (x.full() for x in f(q, nu))
    offsets = np.array([0, 0, 0, -183.14, -150.0, -181.94])
    Y = va12.predict(q, nu, a, standard_values(va12)).full()[:, 0]
    assert M @ a + bias[:, 0] + offsets == pytest.approx(Y, rel=1e-9)


def test_friction_and_offset_stand_in_the_torque_that_is_measured(va12: Model) -> None:
    """(28), joint 1 turning alone at w with the soil taken away: Fv w + Fs tanh(w / 0.02) + u0."""
    table = {
        n: (0.0 if n[0] in "KM" or n[:2] in ("XX", "ZZ") else v)
        for n, (v, _) in standard_parameters(va12.machine).items()
    }
    for w in (-2.0, -0.01, 0.0, 0.005, 3.0):
        nu = np.array([0, 0, 0, w, 0, 0])
        Y = va12.predict(np.zeros(6), nu, np.zeros(6), np.array(list(table.values()))).full()[:, 0]
        assert Y[3] == pytest.approx(64.75 * w + 174.74 * np.tanh(w / 0.02) - 183.14, rel=1e-12)
        nu = np.array([0, 0, 0, 0, w, 0])
        Y = va12.predict(np.zeros(6), nu, np.zeros(6), np.array(list(table.values()))).full()[:, 0]
        assert Y[4] == pytest.approx(4000 * w + 800 * np.tanh(w / 0.005) - 150, rel=1e-12)


def test_emps_is_a_sliding_mass() -> None:
    """M q'' + Fv q' + Fc sign(q') + offset: its authors' model, in numpy."""
    emps = MODELS["emps"]
    q, nu, a = states(emps, 100, seed=12)
    want = 95.1089 * a + 203.5034 * nu + 20.3935 * np.sign(nu) - 3.1648
    assert emps.predict(q, nu, a, standard_values(emps)).full() == pytest.approx(want, rel=1e-9)


def test_measuring_wheels_roll_with_their_side_of_the_chassis(va12: Model) -> None:
    """(32): R theta' = V_x -+ D theta0', left at +y."""
    nu = np.array([1.2, 0.1, 0.3, 0, 0, 0])
    wheels = va12.kinematics(np.zeros(6), nu)[2].full()[:, 0]
    assert wheels == pytest.approx([(1.2 - 1.25 * 0.3) / 0.33, (1.2 + 1.25 * 0.3) / 0.33])
