"""Fit contact laws to measurements of a wheel on sand, as `excite slip` does, by both definitions of slip.

python results/sand/study.py [--out FOLDER] [--data DATA.csv] writes README.md, summary.json, sand.png and sand_rim.png
from the single-wheel measurements of Carnegie Mellon University (../shared/data/cmu_single_wheel), straight driving
only (slip angle 0).
"""

from __future__ import annotations

# ruff: noqa: E402  (threads are set before numpy loads)
import argparse
import os
import sys
from pathlib import Path

for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parents[1] / "tests"))

import pandas as pd
from support import studies

import excite
from excite.output import to_json
from excite.reports import ShownSlip, save
from excite.text import format_number, format_uncertain

DATA = HERE.parents[2] / "shared" / "data" / "cmu_single_wheel" / "smooth_wheel.csv"
COLUMNS = {"speed": "avg_Vx_mm_s", "rim_speed": "avg_Vry_mm_s", "traction": "-avg_Fy_N", "load": "-avg_Fz_N"}
PAGE = """# A wheel on sand: which slip law is missing

![traction against slip](sand.png)

**Result.** Driving and braking differ. With slip divided by the larger speed, as the authors do, braking is {stiffer}
times as stiff as driving (A = {asymmetry}); the error on slip levels left out falls from {linear} N (linear law)
to {named} N. Repeats differ by {repeats} N. {larger_verdict}

{larger_table}

**The result depends on the definition of slip.** Divided by the rim speed, as on the roller and in machine files, slip
grows without bound when a wheel locks (that level is left out).
{rim_verdict}

![the same with slip divided by the rim speed](sand_rim.png)

{rim_table}

- *Chance* is that of predicting a new slip level better than the first law of the table; 0.5 is as well, below 0.05 a
  law is ruled out. Supported laws (bold) are those not ruled out, without those that add to another of them.
- **Saturation with slip divided by the larger speed is not supported**: its magnitude runs to the bound where it has
  no effect.
- **What remains** is {remains} times the repeatability by the larger speed, {remains_rim} times by the rim speed:
  driving flattens at about 1 N, which a linear law on both sides can't follow.

`python results/sand/study.py --out results/sand` uses measurements of a smooth wheel on sand by Carnegie Mellon
University (`../shared/data/cmu_single_wheel`): straight driving, 9 slip levels, 3 repeats each; `excite slip` does the
same with any table. Standard deviations allow for errors shared by the repeats of a slip level.
"""


def table(fit: ShownSlip) -> str:
    """Return the laws as a table in Markdown, best prediction first."""
    lines = ["| law | error fitted | error on slip levels left out | chance |", "|---|---|---|---|"]
    for law in fit.laws:
        name = f"**{law.name}**" if law in fit.supported else law.name
        errors = " | ".join(f"{format_number(x, 3)} N" for x in (law.rms_fitted, law.rms_left_out))
        lines.append(f"| {name} | {errors} | {format_number(law.chance, 2)} |")
    return "\n".join(lines)


def verdict(fit: ShownSlip) -> str:
    """Return what the data support, in a sentence."""
    names = [f"*{law.name}*" for law in fit.supported]
    if len(names) == 1:
        return f"The data support {names[0]}."
    return f"The data then can't tell {' from '.join(names)}."


def main(data: Path, out: Path) -> None:
    raw = pd.read_csv(data)
    straight = raw[raw["beta_deg"] == 0].reset_index(drop=True)
    larger, rim = (excite.slip(straight, columns=COLUMNS, per=per) for per in ("larger", "rim"))
    named = larger.supported[0]
    asymmetry, std = named.parameters["drive_brake_asymmetry"]
    linear = next(law for law in larger.laws if law.name == "linear")
    for fit, name in ((larger, "sand"), (rim, "sand_rim")):
        save(fit.plot(), out / f"{name}.png")
    summaries = {per: fit.summary for per, fit in (("larger", larger), ("rim", rim))}
    (out / "summary.json").write_text(to_json(studies.origin(__file__, 0) | summaries), encoding="utf-8")
    text = PAGE.format(
        larger_verdict=verdict(larger),
        stiffer=format_number(1 + asymmetry, 2),
        asymmetry=format_uncertain(asymmetry, std or 0.0),
        linear=format_number(linear.rms_left_out, 3),
        named=format_number(named.rms_left_out, 3),
        repeats=format_number(larger.repeatability["traction"], 2),
        larger_table=table(larger),
        rim_verdict=verdict(rim),
        remains=format_number(named.rms_left_out / (larger.repeatability["traction"] or 1.0), 2),
        remains_rim=format_number(rim.supported[0].rms_left_out / (rim.repeatability["traction"] or 1.0), 2),
        rim_table=table(rim),
    )
    (out / "README.md").write_text(text, encoding="utf-8")
    print(f"{out}: written")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, default=DATA)
    given = studies.parse(parser, __file__)
    main(given.data, given.out)
