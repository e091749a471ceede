"""Score EMPS as the benchmark does: fit one log, simulate the other from its forces alone, error in mm.

python results/emps/open_loop.py [DATA_EMPS.mat] [--test DATA_EMPS_PULSES.mat] [--out FOLDER] writes open_loop.json and
open_loop.md. The second log is handed out with the first one. Without it the halves of the first one are fitted and
simulated, each in turn. Rows are the estimates of `excite identify`, and fits of the simulation error: the parameters,
and magnitudes of effects, whose simulation from the forces has the smallest position error on the log that is fitted.
"""

from __future__ import annotations

# ruff: noqa: E402  (the folder of shared helpers comes first)
import argparse
import json
import sys
from dataclasses import dataclass
from pathlib import Path

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parents[1] / "tests"))

import numpy as np
import scipy.io
from scipy.optimize import least_squares
from support import studies

from excite.errors import NoEstimateError
from excite.identification import identify
from excite.logs import log
from excite.model import Model, build
from excite.model.effects import placing
from excite.model.machine import machine
from excite.simulation import simulate

DATA = HERE.parents[1] / ".." / "shared" / "data" / "emps" / "DATA_EMPS.mat"
ESTIMATES = ("ols", "inverse", "joint")
EFFECTS = {
    "friction by direction": ("asymmetric_viscous=-30",),
    "friction by direction, quadratic drag": ("asymmetric_viscous=-30", "quadratic_drag=10"),
    "friction by direction, Stribeck": ("asymmetric_viscous=-30", "stribeck_friction=1"),
}
PUBLISHED = {"linear state space": 5.5, "dynoNet": 2.64}  # mm, others' figures as they are cited, not recomputed
SLOPE_SAMPLES = 10  # from which the speed at the start of a half is found
STEP = 1e-4  # of the derivatives, share of each parameter's scale


@dataclass(frozen=True)
class Record:
    """Forces (N, 1) [N] of a log as measured, and its positions (N,) [m]."""

    force: np.ndarray
    position: np.ndarray

    def part(self, of: slice) -> Record:
        return Record(self.force[of], self.position[of])


def read(path: Path) -> Record:
    raw = {k: np.ravel(v) for k, v in scipy.io.loadmat(path).items() if not k.startswith("_")}
    return Record(float(raw["gtau"][0]) * raw["vir"][:, None], raw["qm"])


def errors(model: Model, X: np.ndarray, record: Record) -> np.ndarray:
    """Return measured less simulated positions (N,) [m] from the forces alone, and where and how fast it starts."""
    delivered = record.force - model.offsets @ X
    t = np.arange(SLOPE_SAMPLES) / float(model.machine.sampling_hz)
    speed = np.polyfit(t, record.position[:SLOPE_SAMPLES], 1)[0]
    motion = simulate(model, delivered, X, record.position[:1], np.array([speed]))
    return np.asarray(record.position - motion.q[:, 0])


def rms_mm(values: np.ndarray) -> float:
    return float(1e3 * np.sqrt(np.mean(values**2)))


def fit_simulation(model: Model, record: Record) -> np.ndarray:
    """Return the base parameters (n_base,) with the smallest simulation error along a record."""
    scale = np.where(model.scale > 0, model.scale, 1.0)
    found = least_squares(
        lambda x: 1e3 * errors(model, x * scale, record),
        model.nominal / scale,
        diff_step=STEP,
        method="lm",
        max_nfev=200,
    )
    return np.asarray(found.x * scale)


def scored(train: list[Record], test: list[Record], path: Path) -> dict[str, dict[str, object]]:
    """Return the errors [mm] of every row on the logs that are fitted, and on those that are not."""
    plain = machine.load_machine("emps")
    rows: dict[str, dict[str, object]] = {}
    model = build(plain)
    whole = log.read_log(path, plain)
    for name in ESTIMATES if len(train) == 1 else ():
        try:
            X = identify(model, [whole], name).value_or(model.nominal)
        except NoEstimateError as failure:
            print(f"{name}: {failure}")
            continue
        rows[f"`{name}`"] = _row(model, [X], train, test)
    for name, texts in {"four parameters": (), **EFFECTS}.items():
        extended = build(placing.with_effects(plain, *(placing.parse_effect(t, plain, 25.0) for t in texts)))
        fitted = [fit_simulation(extended, one) for one in train]
        rows[f"simulation error, {name}"] = _row(extended, fitted, train, test)
    return rows


def _row(model: Model, fitted: list[np.ndarray], train: list[Record], test: list[Record]) -> dict[str, object]:
    names = model.base.names
    return {
        "fitted_mm": [round(rms_mm(errors(model, X, one)), 3) for X, one in zip(fitted, train, strict=True)],
        "simulated_mm": [round(rms_mm(errors(model, X, one)), 3) for X, one in zip(fitted, test, strict=True)],
        "values": [{n: float(f"{x:.5g}") for n, x in zip(names, X, strict=True)} for X in fitted],
    }


def page(rows: dict[str, dict[str, object]], halves: bool) -> str:
    what = "halves of the first log, each fitted and the other simulated" if halves else "second log, simulated"
    lines = [
        "# EMPS in open loop",
        "",
        "Position error, root mean square [mm], of the rig simulated from its forces alone.",
        "",
        f"| fit | log that is fitted | {what} |",
        "|---|---|---|",
    ]
    for name, row in rows.items():
        cells = [" and ".join(f"{x:.2f}" for x in row[key]) for key in ("fitted_mm", "simulated_mm")]  # type: ignore[attr-defined]
        lines.append(f"| {name} | {cells[0]} | {cells[1]} |")
    if not halves:
        lines += [f"| published: {name} | | {x:g} |" for name, x in PUBLISHED.items()]
    lines += [
        "",
        "The fits take dry friction as sharp as the machine file, which leaves local minima: another start may end"
        " lower.",
    ]
    return "\n".join(lines) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("data", type=Path, nargs="?", default=DATA)
    parser.add_argument("--test", type=Path, help="second log, DATA_EMPS_PULSES.mat of the same authors")
    options = studies.parse(parser, __file__)
    first = read(options.data)
    if options.test is None:
        half = len(first.position) // 2
        train = [first.part(slice(0, half)), first.part(slice(half, None))]
        test = train[::-1]
    else:
        train, test = [first], [read(options.test)]
    rows = scored(train, test, options.data)
    content = {**studies.origin(__file__, 0), "published_mm": PUBLISHED, "rows": rows}
    (options.out / "open_loop.json").write_text(json.dumps(content, indent=1) + "\n")
    (options.out / "open_loop.md").write_text(page(rows, options.test is None))


if __name__ == "__main__":
    main()
