"""Figures can be read: no text is cut off or lies on another, on machines of all sizes and with long names."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure

from excite.model import Model, build, signal_descriptions
from excite.model.machine import load_machine
from excite.reports import diagnosis_figures, figures, text_faults
from excite.simulation import simulate

LONG = "long names"
MACHINES = ("va12", "emps", "tandem", "pendulum_loader")


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
    assert list(text_faults(KINDS[kind](model))) == []


def test_the_check_finds_what_cannot_be_read() -> None:
    figure = Figure(figsize=(2, 2))
    ax = figure.subplots()
    ax.set_xticks([0.0, 0.01, 1.0], ["a long name", "another long one", "x"])
    figure.text(0.9, 0.5, "beyond the edge of the paper")
    found = list(text_faults(figure))
    assert "cut off: 'beyond the edge of the paper'" in found
    assert "'a long name' lies on 'another long one'" in found
