"""Figures can be read: no text is cut off or lies on another, on machines of all sizes and with long names."""

from __future__ import annotations

import itertools
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import lru_cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.text import Text

from excite import trajectories
from excite.diagnosis import LogResiduals
from excite.identification import Prediction, Verification
from excite.logs import SlipTable, inspect, motion_columns, torque_column
from excite.model import Model, build, signal_descriptions
from excite.model.machine import Machine, Problem, load_machine
from excite.reports import (
    FigureFiles,
    design_figures,
    diagnosis_figures,
    figures,
    slip_figure,
    top_view_figure,
    torque_figures,
    writing_figures,
)
from excite.simulation import Motion, measure, simulate
from excite.workflows import study_results
from excite.workflows.requests import arm_problems, choose_problem
from excite.workflows.study_plan import Cell, DriveSpec

LONG = "long names"
DIFFERENT = ("va12", "double_loader", "emps", "panda")  # in the number and names of what figures show


def long_names() -> Model:
    """A robot with four drives, whose parts are called as engineers call them."""
    machine = load_machine("skid_robot")
    body = tuple(
        b.model_copy(update={"place": f"{b.where}_with_planetary_gear_and_brake"}) if b.contact else b
        for b in machine.body
    )
    return build(machine.model_copy(update={"body": body}))


@lru_cache
def model_of(name: str) -> Model:
    return long_names() if name == LONG else build(load_machine(name))


def has_problem(machine: Machine) -> bool:
    return bool(machine.problems or arm_problems(machine))


def problem_of(machine: Machine) -> Problem:
    return choose_problem(machine, None, None)[1]


def design(model: Model) -> Figure:
    """A drive, or sines of the joints of an arm."""
    machine, limits = model.machine, [float(b.limit.torque or 1.0) for b in model.machine.actuated]
    if machine.planar:
        motion = simulate(model, 0.3 * np.array(limits) * np.ones((201, 1)))
    else:
        t = np.arange(201) / 100
        wave = np.sin(7 * t)[:, None]
        u, q = 0.3 * np.array(limits) * wave, 0.1 * wave * np.ones(len(model.coordinates))
        motion = Motion(t, q, 7 * q, 49 * q, u, t[:, None], t[:, None])
    return design_figures.design_figure(model, problem_of(machine), motion, f"{machine.title}: a drive")


def sigma(model: Model) -> Figure:
    values = dict(zip(model.base.names, np.geomspace(0.012, 250, len(model.base.names)), strict=True))
    return design_figures.sigma_figure(values, model.machine.title)


def fit(model: Model) -> Figure:
    n, t = len(model.inputs), np.linspace(0, 60, 300)
    y = 1234.5 * np.sin(t + np.arange(n)[:, None])
    units = ["N m" if b.joint == "revolute" else "N" for b in model.machine.actuated]
    compared = SimpleNamespace(
        names=model.inputs, units=units, t=t, measured=y, predicted=0.9 * y, residual=0.1 * y, expected=0 * y + 50
    )
    return figures.comparison_figure(model, compared, f"{model.machine.title}: a_log.csv")  # type: ignore[arg-type]


def estimate(model: Model) -> Any:
    n = len(model.base.names)
    made = np.random.default_rng(0).normal(size=(n, 3 * n))
    covariance = np.cov(made)
    std = np.sqrt(np.diag(covariance))
    return SimpleNamespace(
        names=model.base.names, value=model.nominal + std, std=std, covariance=covariance, prior_std=3 * std
    )


def signals(model: Model) -> Figure:
    row = {"unit": "rad/s", "rms_before": 1.23e-4, "rms_after": 1.1e-5}
    row |= {"systematic_before_percent": 80.0, "systematic_after_percent": 3.0}
    words = signal_descriptions(model.machine)
    return diagnosis_figures.signals_figure(dict.fromkeys(words, row), True, model.machine.title, words)


def verification(model: Model) -> Figure:
    n, runs = len(model.base.names), 20
    error = np.random.default_rng(1).normal(size=(runs, n)) * np.geomspace(1e-4, 0.3, n)
    size = np.where(model.nominal != 0, np.abs(model.nominal), model.scale)
    value, std = model.nominal + size * error, size * np.geomspace(1e-4, 0.3, n)
    ends = value[:, None] + 1.96 * std * np.array([-1, 1])[:, None]
    units = ("",) * n
    found = Verification(
        "joint", "full", model.base.names, units, model.nominal, model.scale, value, 0 * value + std, ends, {}
    )
    return figures.verify_figure(found, f"{model.machine.title}: joint, kit full, 20 runs")


def comparison(model: Model) -> Figure:
    machine = model.machine
    broken = max((bound.name for bound in trajectories.machine_limits(model, problem_of(machine))), key=len)
    names = (trajectories.DESIGNED, *trajectories.BASELINES, "a/long/path/to/a_drive_of_my_own_on_gravel.csv")
    rows = [
        SimpleNamespace(name=name, cond_phi=17.0 * 3**k, worst_std_percent=0.8 * 2**k, breaks=broken if k % 2 else None)
        for k, name in enumerate(names)
    ]
    return design_figures.compare_figure(rows, f"{machine.title}: designed and usual drives")  # type: ignore[arg-type]


def prediction(model: Model, along_log: bool) -> Figure:
    """Torques along a log, or the motion of a profile."""
    units = {"_N": "N", "_Nm": "N m"}
    names = [torque_column(model, name) for name in model.inputs]
    kinds = [units[name[name.rindex("_") :]] for name in names]
    if not along_log:
        columns = motion_columns(model)
        turns = ["rad" if place.endswith("_rad") else "m" for place, _ in columns]
        names = [rate for _, rate in columns] + [place for place, _ in columns]
        kinds = [f"{unit}/s" for unit in turns] + turns
    t = np.linspace(0, 60, 300)
    value = 12345.6 * np.sin(t + np.arange(len(names))[:, None])
    band = 0 * value + 100
    measured = {"measured": value + 80, "reading_band": 2 * band} if along_log else {}
    found = Prediction(tuple(names), tuple(kinds), t, value, band, band, tuple(names[-1:]), **measured)
    return figures.prediction_figure(found, f"{model.machine.title}: by joint, along results/a_long_folder/a_log.csv")


def log_check(model: Model) -> Figure:
    """A log with a gap and a dead stretch."""
    torque = np.array([0.2 * float(b.limit.torque or 1.0) for b in model.machine.actuated])
    table = measure(model, simulate(model, torque * np.ones((800, 1))), kit="full", seed=0)
    table = table.drop(index=range(300, 420)).reset_index(drop=True)
    table.loc[500:640, table.columns[1]] = table.loc[500, table.columns[1]]
    return figures.log_figure(inspect(table, model.machine), "a/long/folder/of/logs/log_of_the_third_drive.csv")


def residuals(model: Model, size: float) -> Any:
    """Residuals of a log as `diagnosis.residuals_of_logs` names them."""
    machine, rng, t = model.machine, np.random.default_rng(2), np.arange(3000) / 100
    missing, quantities = {}, {}
    for name, b in zip(model.inputs, machine.actuated, strict=True):
        label = f"{'torque' if b.joint == 'revolute' else 'force'} {name}, {b.where.replace('_', ' ')}"
        missing[label] = (size * 12345.6 * np.sin(t), "N m" if b.joint == "revolute" else "N", 50.0)
    if machine.planar:
        missing["force to the left"] = (size * 2345.6 * np.cos(t), "N", float("nan"))
    units = {"time": "s", "speed": "m/s", "distance": "m", "rotation": "rad", "torque": "N m", "slip": "-"}
    units |= {f"{b.where} angle": "rad" for b in machine.actuated if b.contact is None}
    for name, unit in units.items():
        x = t if name == "time" else 1e-3 * np.cumsum(rng.normal(size=len(t)))
        quantities[name] = (unit, dict.fromkeys(missing, x))
    sensors = tuple(s.name for s in machine.sensors("full"))
    linear = SimpleNamespace(innovations=size * rng.normal(size=(len(t), len(sensors))))
    return LogResiduals("log.csv", t, missing, quantities, sensors, linear)  # type: ignore[arg-type]


def missing(model: Model, kind: str) -> Figure:
    draw: Callable[..., Figure] = diagnosis_figures.KINDS[kind]
    more = {"words": signal_descriptions(model.machine)} if kind == "when" else {}
    return draw(residuals(model, 2.0), residuals(model, 1.0), f"{model.machine.title}: a_log.csv", **more)


def torques(model: Model) -> Any:
    """A diagnosis by regression."""
    machine, n = model.machine, 600
    t, rng = np.arange(n) / 100, np.random.default_rng(3)
    shape = (len(model.coordinates), n)
    rows = SimpleNamespace(t=t, at=np.arange(n), used=np.ones(shape, bool), nu=rng.normal(size=shape).T)
    level = dict.fromkeys(model.actuated, 1234.5)
    made = SimpleNamespace(model=model, rows=[rows], residual=[rng.normal(size=shape)], level=level, lowest=level)
    names = tuple((s.name, "N m") for s in machine.sensors("full") if s.kind == "torque")
    curve = {"at": t, "value": 12345.6 * np.sin(t), "std": 0 * t + 100, "signal": (f"the speed of {LONG}", "rad/s")}
    lacks = ("a torque", "a change of its lengthwise stiffness")
    curves = [SimpleNamespace(row=row, lacks=lacks[k % 2], **curve) for k, row in enumerate(names)]
    return SimpleNamespace(
        before=made, after=made, torques=names, findings=("one",), sources=("log.csv",), curves=curves
    )


def sensors(model: Model) -> Figure:
    """A value for every change of the sensors of a kit."""
    names = [s.name for s in model.machine.sensors("full")]
    values = [
        SimpleNamespace(sensor=n, change="ten times as accurate", worst_percent=0.5 + 0.1 * k, median_percent=0.2)
        for k, n in enumerate(["as they are", *names])
    ]
    return design_figures.sensors_figure(values, f"{model.machine.title}, kit full")  # type: ignore[arg-type]


def campaign(model: Model) -> Figure:
    trials = [
        {"drives": n, "duration_s": seconds, "percent": 300 / (n * seconds)} for n in (1, 2, 4) for seconds in (20, 60)
    ]
    summary = {"trials": trials, "target_percent": 0.9, "total_s": 240.0, "attained_percent": 0.8, "objective": "worst"}
    return design_figures.campaign_figure(summary, f"{model.machine.title}: drives for 0.9 %")


@dataclass(frozen=True)
class Law:
    name: str
    parts: tuple[str, ...]
    rms_left_out: float = 12.3

    def forces(self, table: SlipTable) -> np.ndarray:
        return np.stack([900 * table.slip, 300 * table.slip], axis=1)


def slip(model: Model) -> Figure:
    """Laws of a single-wheel test with traction and side force at two angles."""
    s = np.linspace(0.02, 0.6, 12)
    one = np.ones(12)
    forces = {"traction": 900 * s, "side": 300 * s}
    table = SlipTable("a.csv", one, 0 * s, one / (1 - s), 1e3 * one, forces, np.arange(12), "rim")
    laws = [Law("linear", ()), *(Law(f"saturation + side force + speed {k}", ("x",)) for k in range(6))]
    fit = SimpleNamespace(table=table, supported=laws[1:3], laws=laws, repeatability={"traction": 5.0})
    return slip_figure(fit, None, f"{model.machine.title}: a_single_wheel_test.csv")  # type: ignore[arg-type]


def budget(model: Model) -> Figure:
    """Many sources, of which the largest are drawn."""
    sources = [
        f"{kind} of {b.where.replace('_', ' ')}" for b in model.machine.body for kind in ("radius", "torque gain")
    ]
    share = dict.fromkeys(sources, 0.9 / len(sources))
    made: Any = SimpleNamespace(budget={name: {"noise": 0.1, **share} for name in model.base.names})
    return figures.budget_figure(made, model.machine.title)


def study(model: Model, durations: tuple[float, ...], verdicts: bool = False) -> Figure:
    """Four cells that differ in the length of the drive, or in their effects."""
    sizes = zip(model.base.names, np.geomspace(0.1, 50, len(model.base.names)), strict=True)
    errors = {} if verdicts else {name: {"rms_percent": x, "coverage95": 0.94} for name, x in sizes}
    cells = []
    for k in range(4):
        drive = DriveSpec(model.machine.name, "R60", "accuracy", durations[k % len(durations)], (), 1, 0, None)
        effects = ("torque_offset_drift@front_roll=0.5",) * (k if len(durations) == 1 else 0)
        cell = Cell(drive, "full", "joint", effects, 0)
        found = {"clean": 3, "tied": 2} if verdicts else {}
        cells.append(study_results.CellResult(k, cell, "joint", 17.0, {"done": 5}, {}, errors, (), found))
    return study_results.study_figure(cells, f"{model.machine.title}: a study, 20 runs")


KINDS: dict[str, Callable[[Model], Figure]] = {
    "design": design,
    "sigma": sigma,
    "fit": fit,
    "correlation": lambda m: figures.correlation_figure(estimate(m), m.machine.title),
    "prior": lambda m: figures.prior_figure(estimate(m), m.nominal, m.machine.title),
    "signals": signals,
    "verify": verification,
    "compare": comparison,
    "prediction of a log": lambda m: prediction(m, along_log=True),
    "prediction of a drive": lambda m: prediction(m, along_log=False),
    "log": log_check,
    "clearest": lambda m: missing(m, "clearest"),
    "misfit": lambda m: missing(m, "misfit"),
    "when": lambda m: missing(m, "when"),
    "misfit of torques": lambda m: torque_figures.misfit_of_torques(torques(m), m.machine.title),
    "sensors": sensors,
    "campaign": campaign,
    "top": lambda m: top_view_figure(m.machine),
    "slip": slip,
    "budget": budget,
    "swept study": lambda m: study(m, (10.0, 20.0, 40.0, 80.0)),
    "study": lambda m: study(m, (60.0,)),
    "study of verdicts": lambda m: study(m, (60.0,), verdicts=True),
    "curves": lambda m: torque_figures.curves_figure(torques(m).curves, m.machine.title),
}


def test_a_block_of_oscillation_has_an_excerpt() -> None:
    t = np.arange(6001) / 100
    burst = 40 * np.sin(2 * np.pi * t / 0.8) * (np.abs(t - 40) < 2.8)
    small = 4 * np.sin(2 * np.pi * t / 0.4) * (np.abs(t - 10) < 2)
    part = design_figures._fast_part(t, [small, burst])
    assert part is not None
    assert 37 < t[part][0] < t[part][-1] < 43
    assert design_figures._fast_part(t, [40 * np.sin(2 * np.pi * t / 10)]) is None


def test_speeds_of_an_arm_are_called_as_its_joints_are() -> None:
    axes = {ax.get_ylabel(): ax for ax in design(model_of("ur10")).axes}
    speeds, angles = (
        [t.get_text() for t in axes[label].get_legend().get_texts()] for label in ("speed [rad/s]", "angle [rad]")
    )
    assert speeds == angles


TOUCH_PX = 1.0  # by which boxes of texts may overlap: letters don't fill theirs


def text_faults(figure: Figure) -> Iterator[str]:
    """Yield each visible text that is cut off or lies on another one."""
    canvas: Any = FigureCanvasAgg(figure)
    canvas.draw()
    renderer = canvas.get_renderer()
    found = figure.findobj(Text)
    texts = [t for t in found if isinstance(t, Text) and t.get_visible() and t.get_text().strip()]
    hidden = {id(t) for ax in figure.axes if not (ax.get_visible() and ax.axison) for t in ax.findobj(Text)}
    for ax in figure.axes:
        for axis, limits in ((ax.xaxis, ax.get_xlim()), (ax.yaxis, ax.get_ylim())):
            low, high = sorted(limits)
            for tick in [*axis.get_major_ticks(), *axis.get_minor_ticks()]:
                if not low - 1e-9 * abs(low) <= tick.get_loc() <= high + 1e-9 * abs(high):
                    hidden |= {id(tick.label1), id(tick.label2)}
    boxes = [(t.get_text(), t.get_window_extent(renderer)) for t in texts if id(t) not in hidden]
    whole = figure.bbox
    for text, box in boxes:
        if box.x0 < whole.x0 - 1 or box.x1 > whole.x1 + 1 or box.y0 < whole.y0 - 1 or box.y1 > whole.y1 + 1:
            yield f"cut off: {text!r}"
    for (one, a), (other, b) in itertools.combinations(boxes, 2):
        wide, high = min(a.x1, b.x1) - max(a.x0, b.x0), min(a.y1, b.y1) - max(a.y0, b.y0)
        if wide > TOUCH_PX and high > TOUCH_PX:
            yield f"{one!r} lies on {other!r}"


WIDTHS_AND_MACHINES = [
    (88.0, LONG),
    (None, LONG),
    pytest.param(180.0, LONG, marks=pytest.mark.slow),
    *(pytest.param(width, name, marks=pytest.mark.slow) for width in (88.0, 180.0) for name in DIFFERENT),
]


@pytest.mark.parametrize(("width_mm", "machine"), WIDTHS_AND_MACHINES)
@pytest.mark.parametrize("kind", KINDS)
def test_no_text_is_cut_off_or_lies_on_another(kind: str, width_mm: float | None, machine: str) -> None:
    model = model_of(machine)
    without = {"top": not model.machine.planar, **dict.fromkeys(("design", "compare"), not has_problem(model.machine))}
    if without.get(kind):
        pytest.skip("has no such figure")
    with warnings.catch_warnings(), writing_figures(FigureFiles(width_mm=width_mm)):
        warnings.simplefilter("error")  # a plot without room
        figure = KINDS[kind](model)
        assert list(text_faults(figure)) == []
    scale = 1.0 if width_mm is None else width_mm / 25.4 / figure.get_figwidth()
    letters = min(t.get_fontsize() for t in figure.findobj(Text) if t.get_text().strip())
    assert scale * letters > (6.0 if width_mm else 8.0) - 0.01
    most = {None: np.inf, 88.0: 270.0 if machine == LONG else 240.0, 180.0: 240.0}[width_mm]  # text of a page [mm]
    assert scale * figure.get_figheight() * 25.4 < most + 0.01


def test_the_check_finds_what_cannot_be_read() -> None:
    figure = Figure(figsize=(2, 2))
    ax = figure.subplots()
    ax.set_xticks([0.0, 0.01, 1.0], ["a long name", "another long one", "x"])
    figure.text(0.9, 0.5, "beyond the edge of the paper")
    found = list(text_faults(figure))
    assert "cut off: 'beyond the edge of the paper'" in found
    assert "'a long name' lies on 'another long one'" in found
