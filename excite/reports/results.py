"""Results as Python users see them: a text, a table, figures and a folder, all from one account of the result."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, Self, cast

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from excite import output
from excite.diagnosis import Assessment
from excite.errors import UsageError
from excite.identification import Estimate, Prediction, SlipFit, Verification
from excite.logs import Log, profile_of
from excite.model import Model
from excite.reports import figure_files, figures as drawings, pages, plain_text
from excite.reports.charts import Explorable
from excite.reports.description import Description
from excite.reports.descriptions import describe
from excite.reports.html import result_fragment
from excite.simulation import Motion
from excite.trajectories import Campaign, Comparison, Design, Score


@dataclass(frozen=True)
class Account:
    """All that is told of a result.

    kind: as `describe` takes it. summary: content of summary.json. figures: each by its file name, the main one first.
    files: each writes other files into a folder. drawn: figures more, which `draw` writes into a folder, several at a
    time, returning what of them a chart shows.
    frame: the numbers as a table, with units in `attrs["units"]`. joints: of a drive, its joints' motion and torques.
    scene: an arm's motion to look at.
    """

    kind: str
    summary: dict[str, Any]
    figures: Mapping[str, Callable[[], Figure]]
    frame: Callable[[], pd.DataFrame]
    files: Sequence[Callable[[Path], object]] = ()
    drawn: Mapping[str, Callable[[], Figure]] = field(default_factory=dict)
    draw: Callable[[Path], Mapping[str, Explorable]] | None = None
    scene: Callable[[], dict[str, Any]] | None = None
    joints: Callable[[], pd.DataFrame] | None = None

    def write(self, place: Path, command: str | None = None) -> dict[str, Any]:
        """Fill a folder with files, figures, report.html and summary.json; return the summary.

        command: how the report says that it was made, the command line by default.
        """
        for file in self.files:
            file(place)
        explorable = {} if self.draw is None else dict(self.draw(place))
        for name, draw in self.figures.items():
            explorable[name] = drawings.save(draw(), place / name)
        scene = None if self.scene is None else self.scene()
        pages.write_report(place, self.kind, self.summary, command, explorable, scene)
        return self.summary


class Shown:
    """A result that shows itself: printed, in a notebook, as a DataFrame, as a figure, as a folder."""

    @classmethod
    def of(cls, result: Any, account: Callable[[], Account]) -> Self:
        """Return a result that has an account of itself, which is computed when it is first asked for."""
        made = cls(**{f.name: getattr(result, f.name) for f in fields(result)})
        made.__dict__["_make_account"] = account
        return made

    @property
    def account(self) -> Account:
        """All that is told of this result. Raises UsageError for one that was put together by hand."""
        own = self.__dict__
        if "_account" not in own:
            if "_make_account" not in own:
                raise UsageError(f"{type(self).__name__}: was changed or made by hand, only its values are known")
            own["_account"] = own["_make_account"]()
        return own["_account"]

    def __repr__(self) -> str:
        if "_make_account" not in self.__dict__:
            return super().__repr__()
        return plain_text.render(self.description)

    def _repr_html_(self) -> str | None:
        return result_fragment(self.description) if "_make_account" in self.__dict__ else None

    def keep_call(self, call: str) -> None:
        """Keep the call that made this result, which a saved folder records."""
        self.__dict__["_call"] = call

    @property
    def description(self) -> Description:
        """The result in words and tables, as its command prints it."""
        return describe(self.account.kind, self.account.summary)

    @property
    def summary(self) -> dict[str, Any]:
        """The result as in summary.json."""
        return self.account.summary

    def to_frame(self) -> pd.DataFrame:
        """Return the numbers as a table: `attrs["units"]` has the unit of each column, or of each row.

        A log, a drive and a prediction give a row a time; estimates, scores and verifications a row a parameter;
        comparisons a row a drive; diagnoses a row a finding.
        """
        return self.account.frame()

    def plot(
        self, name: str | None = None, *, file: str | Path | None = None, figure_width: str | None = None
    ) -> Figure:
        """Return a figure of the report: the main one, or that of a name such as "sigma". Raises UsageError.

        file: also write it into this file (.png, .svg, .pdf). figure_width: its width in print, such as "88mm".
        """
        if figure_width is not None and file is None:
            raise UsageError("figure_width: is that of the file, give one")
        every = {**self.account.figures, **self.account.drawn}
        drawn = {file.removesuffix(".png"): draw for file, draw in every.items()}
        if not drawn:
            raise UsageError(f"{type(self).__name__}: has no figure")
        name = name or next(iter(drawn))
        if name not in drawn:
            raise UsageError(f"plot: {name} is unknown, allowed: {', '.join(drawn)}")
        width = None if figure_width is None else figure_files.read_width("figure_width", figure_width)
        with figure_files.writing_figures(figure_files.FigureFiles(width_mm=width, tell=warn)):
            figure = drawn[name]()
            if file is not None:
                figure_files.write_alone(figure, Path(file))
        return figure

    def save(
        self, folder: str | Path, *, figures: str | Sequence[str] = ("png",), figure_width: str | None = None
    ) -> Path:
        """Write the files that the command writes, into a folder that is complete or not there. Raises FolderError.

        figures: formats of the figures, png, svg or pdf; the png is always written. figure_width: of every figure in
        print, such as "88mm". Raises UsageError for an unknown format or unit.
        """
        out = Path(folder)
        width = None if figure_width is None else figure_files.read_width("figure_width", figure_width)
        files = figure_files.FigureFiles(figure_files.read_formats("figures", figures), width, warn)
        with output.new_folder(out, "folder") as place, figure_files.writing_figures(files):
            self.account.write(place, self.__dict__.get("_call", "by hand in Python"))
        return out


def warn(line: str) -> None:
    """Warn of a figure whose letters are small."""
    warnings.warn(line, stacklevel=2)


class ShownLog(Shown, Log):
    """Measurements of a log, checked; fields as in `Log`."""


class ShownDrive(Shown):
    """A drive of known accuracy."""

    @property
    def sigma(self) -> pd.DataFrame:
        """Attainable standard deviation of each parameter [% of its nominal value], and what the parameter is."""
        summary = self.summary
        table = pd.DataFrame({"std_percent": pd.Series(summary["sigma_percent"], dtype=float)}).rename_axis("parameter")
        table["meaning"] = [summary["meanings"].get(name, "") for name in table.index]
        table.attrs["units"] = {"std_percent": "%"}
        return table


class ShownDesign(ShownDrive, Design):
    """A designed drive; fields as in `Design`."""

    @property
    def joints(self) -> pd.DataFrame:
        """Torque, position and speed of every driven joint over time, units in `attrs["units"]`."""
        frame = self.account.joints
        assert frame is not None
        return frame()


class ShownCampaign(Shown, Campaign):
    """Drives designed together; fields as in `Campaign`."""


class ShownScore(ShownDrive, Score):
    """A drive judged as a design; fields as in `Score`."""


class ShownComparison(Shown, Comparison):
    """Drives side by side; fields as in `Comparison`."""


class ShownVerification(Shown, Verification):
    """Estimates of many simulated test days; fields as in `Verification`."""


class ShownEstimate(Shown, Estimate):
    """Parameters identified from logs; fields as in `Estimate`. `estimate["M"]` is the row of a parameter."""

    def __getitem__(self, name: str) -> pd.Series:
        """Return value, standard deviation and interval of a parameter. Raises UsageError for an unknown name."""
        table = self.to_frame()
        if name not in table.index:
            raise UsageError(f"estimate: {name} is unknown, allowed: {', '.join(table.index)}")
        return cast(pd.Series, table.loc[name])


class ShownPrediction(Shown, Prediction):
    """Predicted signals with 95 % bands; fields as in `Prediction`."""


class ShownSlip(Shown, SlipFit):
    """Contact laws fitted to a single-wheel test; fields as in `SlipFit`."""


class ShownAssessment(Shown, Assessment):
    """A diagnosis with what its findings gain; fields as in `Assessment`."""


def rows_frame(rows: Mapping[str, Mapping[str, Any]], index: str) -> pd.DataFrame:
    """Return a table with a row for each name; units of rows are those in the column `unit`, of columns by their ends.

    index: what the names are of.
    """
    table = pd.DataFrame.from_dict(dict(rows), orient="index").rename_axis(index)
    units = {str(c): unit for c in table.columns for end, unit in UNITS_OF_ENDS.items() if str(c).endswith(end)}
    if "unit" in table.columns:
        units |= dict(zip(table.index, table["unit"], strict=True))
    table.attrs["units"] = units
    return table


UNITS_OF_ENDS = {"_percent": "%", "_s": "s", "gain_ci95": "%"}  # of columns of a summary


def joints_frame(model: Model, motion: Motion) -> pd.DataFrame:
    """Return torque, position and speed of every driven joint, columns (joint, quantity), over the time [s]."""
    columns: dict[tuple[str, str], np.ndarray] = {}
    units: dict[tuple[str, str], str] = {}
    for k, b in enumerate(model.machine.actuated):
        turns, at = b.joint == "revolute", model.coordinates.index(b.coordinates[0])
        for name, values, unit in (
            ("torque" if turns else "force", motion.u[:, k], "N m" if turns else "N"),
            ("angle" if turns else "position", motion.q[:, at], "rad" if turns else "m"),
            ("speed", motion.nu[:, at], "rad/s" if turns else "m/s"),
        ):
            columns[b.where, name], units[b.where, name] = values, unit
    table = pd.DataFrame(columns, index=pd.Index(motion.t, name="t_s"))
    table.columns.names = ["joint", "quantity"]
    table.attrs["units"] = units
    return table


def drive_frame(model: Model, motion: Motion) -> pd.DataFrame:
    """Return a drive as its profile has it, with the unit of each column."""
    table = profile_of(model, motion)
    table.attrs["units"] = {"t_s": "s"} | {
        str(c): unit for c in table.columns for end, unit in UNITS_OF_COLUMNS.items() if str(c).endswith(end)
    }
    return table


# ends of a profile's columns; longer ones later, as the last one that fits counts
UNITS_OF_COLUMNS = {"_m": "m", "_rad": "rad", "_N": "N", "_Nm": "N m", "_m_s": "m/s", "_rad_s": "rad/s"}
