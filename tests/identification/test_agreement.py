"""Whether logs agree on the parameters, and what changed between them."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from support.commands import Excite
from support.logs import make_log

import excite
from excite.identification import compare_logs, identify
from excite.model import Model, build
from excite.simulation import Motion, measure, simulate


def softer(model: Model, share: float) -> Model:
    """The machine on soil on which its front roll slips more."""
    machine = model.machine.model_copy(deep=True)
    bodies = list(machine.body)
    k = next(k for k, b in enumerate(bodies) if b.contact is not None)
    contact = bodies[k].contact
    assert contact is not None
    stiffness = contact.Kx.model_copy(update={"value": float(contact.Kx) * share})
    bodies[k] = bodies[k].model_copy(update={"contact": contact.model_copy(update={"Kx": stiffness})})
    return build(machine.model_copy(update={"body": tuple(bodies)}))


@pytest.mark.slow
def test_logs_of_one_machine_agree(straight: Model, straight_motion: Motion) -> None:
    """The level of the test holds: p-values of agreeing logs are spread over 0 to 1."""
    found = [identify(straight, [make_log(straight, straight_motion, seed=s)], "joint") for s in range(12)]
    pairs = [compare_logs(("a", "b"), found[k : k + 2]) for k in range(0, 12, 2)]
    p = [one.p_value for one in pairs if one is not None]
    assert len(p) == 6
    assert min(p) > 1e-3
    assert max(p) > 0.2
    assert all(one.changed == () for one in pairs if one is not None)


@pytest.mark.slow
def test_another_soil_is_named_with_its_values(
    straight: Model, straight_motion: Motion, tmp_path: Path, excite: Excite
) -> None:
    other = softer(straight, 0.9)
    paths = [tmp_path / "tuesday.csv", tmp_path / "wednesday.csv"]
    measure(straight, straight_motion, seed=1).to_csv(paths[0], index=False)
    motion = simulate(other, straight_motion.u, q0=straight_motion.q[0], nu0=straight_motion.nu[0])
    measure(other, motion, seed=2).to_csv(paths[1], index=False)
    code, stdout, _ = excite("identify", "va12_straight", *paths, "--out", tmp_path / "out", "--json")
    assert code == 0
    summary = json.loads(stdout)
    assert summary["agreement"]["agree"] is False
    assert summary["status"] == "doubtful"
    (name, row), *rest = summary["agreement"]["changed"].items()
    assert name == "Kx1"
    assert rest == []
    truth = [m.nominal[m.base.names.index("Kx1")] for m in (straight, other)]
    assert (np.abs(np.subtract(row["value"], truth)) < 3 * np.array(row["std"])).all()
    assert any("what changed: Kx1" in note for note in summary["notes"])

    code, stdout, _ = excite("diagnose", "va12_straight", *paths, "--out", tmp_path / "diagnosed", "--json")
    assert code == 0
    diagnosed = json.loads(stdout)
    assert (diagnosed["verdict"], diagnosed["findings"]) == ("named", [])
    assert list(diagnosed["differences"]["changed"]) == ["Kx1"]
    assert "Each log alone shows nothing that the model lacks, but the logs differ. Kx1: " in diagnosed["answer"]


def test_one_log_has_nothing_to_agree_with(straight: Model, straight_motion: Motion) -> None:
    one = identify(straight, [make_log(straight, straight_motion, seed=1)], "ols")
    assert compare_logs(("a",), [one]) is None


@pytest.mark.parametrize("changed", [(2,), (0, 3)])
def test_what_changed_is_found_among_correlated_parameters(changed: tuple[int, ...]) -> None:
    """Estimates drawn from a known covariance with correlations of 0.9."""
    rng = np.random.default_rng(1)
    n = 5
    C = 0.1 * np.eye(n) + 0.9
    x = np.arange(1.0, n + 1)
    y = x.copy()
    y[list(changed)] += 5.0
    first, second = (_Estimate(rng.multivariate_normal(m, C), C) for m in (x, y))
    found = compare_logs(("a", "b"), [first, second])  # type: ignore[list-item]
    assert found is not None
    assert sorted(c.name for c in found.changed) == [f"p{k}" for k in changed]


class _Estimate:
    """The part of an estimate that is compared."""

    def __init__(self, value: np.ndarray, covariance: np.ndarray) -> None:
        self.value, self.covariance = value, covariance
        self.names = tuple(f"p{k}" for k in range(len(value)))
        self.units = ("",) * len(value)
        self.unidentifiable, self.understated = dict[str, str](), 1.0

    @property
    def std(self) -> np.ndarray:
        return np.sqrt(np.diag(self.covariance))


def test_tables_are_compared_as_files_are(straight: Model, straight_motion: Motion) -> None:
    tables = [measure(straight, straight_motion, seed=s) for s in (1, 2)]
    estimate = excite.identify("va12_straight", tables, "joint")
    assert "one set of parameters explains the 2 logs" in estimate.notes[0]
