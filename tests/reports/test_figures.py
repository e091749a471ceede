"""Figures can be read: no text is cut off or lies on another, on machines of all sizes and with long names."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from functools import lru_cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.text import Text

from excite.model import Model, build, signal_descriptions
from excite.model.machine import load_machine
from excite.reports import diagnosis_figures, figures
from excite.simulation import simulate

LONG = "long names"
MACHINES = ("va12", "emps", "tandem", "pendulum_loader")
TOUCH = 1.0  # px by which boxes of texts may overlap: letters don't fill theirs


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


def faults(figure: Figure) -> Iterator[str]:
    """Yield each visible text that is cut off or lies on another one."""
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    renderer = canvas.get_renderer()
    texts = [t for t in figure.findobj(Text) if t.get_visible() and t.get_text().strip()]  # type: ignore[union-attr]
    hidden = {id(t) for ax in figure.axes if not (ax.get_visible() and ax.axison) for t in ax.findobj(Text)}
    ticks = {}
    for ax in figure.axes:
        for axis, limits in ((ax.xaxis, ax.get_xlim()), (ax.yaxis, ax.get_ylim())):
            low, high = sorted(limits)
            for tick in [*axis.get_major_ticks(), *axis.get_minor_ticks()]:
                if not low - 1e-9 * abs(low) <= tick.get_loc() <= high + 1e-9 * abs(high):
                    ticks[id(tick.label1)] = ticks[id(tick.label2)] = True
    boxes = [(t.get_text(), t.get_window_extent(renderer)) for t in texts if id(t) not in hidden and id(t) not in ticks]
    whole = figure.bbox
    for text, box in boxes:
        if box.x0 < whole.x0 - 1 or box.x1 > whole.x1 + 1 or box.y0 < whole.y0 - 1 or box.y1 > whole.y1 + 1:
            yield f"cut off: {text!r}"
    for (one, a), (other, b) in itertools.combinations(boxes, 2):
        wide, high = min(a.x1, b.x1) - max(a.x0, b.x0), min(a.y1, b.y1) - max(a.y0, b.y0)
        if wide > TOUCH and high > TOUCH:
            yield f"{one!r} lies on {other!r}"


def design(model: Model) -> Figure:
    machine = model.machine
    torque = np.array([0.3 * float(b.limit.torque or 1.0) for b in machine.actuated]) * np.ones((201, 1))
    problem = machine.problems[str(machine.problem)] if machine.problem else next(iter(machine.problems.values()))
    return figures.design_figure(model, problem, simulate(model, torque), f"{machine.title}: a drive")


def sigma(model: Model) -> Figure:
    values = dict(zip(model.base.names, np.geomspace(0.012, 250, len(model.base.names)), strict=True))
    return figures.sigma_figure(values, model.machine.title)


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


KINDS: dict[str, Callable[[Model], Figure]] = {
    "design": design,
    "sigma": sigma,
    "fit": fit,
    "correlation": lambda m: figures.correlation_figure(estimate(m), m.machine.title),
    "prior": lambda m: figures.prior_figure(estimate(m), m.nominal, m.machine.title),
    "signals": signals,
}


@pytest.mark.parametrize("machine", [LONG, *(pytest.param(name, marks=pytest.mark.slow) for name in MACHINES)])
@pytest.mark.parametrize("kind", KINDS)
def test_no_text_is_cut_off_or_lies_on_another(kind: str, machine: str) -> None:
    model = model_of(machine)
    if kind == "design" and not model.machine.problems:
        pytest.skip("has no design problem")
    assert list(faults(KINDS[kind](model))) == []


def test_the_check_finds_what_cannot_be_read() -> None:
    figure = Figure(figsize=(2, 2))
    ax = figure.subplots()
    ax.set_xticks([0.0, 0.01, 1.0], ["a long name", "another long one", "x"])
    figure.text(0.9, 0.5, "beyond the edge of the paper")
    found = list(faults(figure))
    assert "cut off: 'beyond the edge of the paper'" in found
    assert "'a long name' lies on 'another long one'" in found
